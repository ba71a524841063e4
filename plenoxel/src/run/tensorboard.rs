//! TensorBoard event files: the figures of `metrics.jsonl` for `tensorboard --logdir runs`.
//!
//! A file is a sequence of records. A record is a length, the checksum of the length, the data, and the checksum of the data. The data is a protocol
//! buffer of type `Event`. Records, masked checksums and field numbers follow TensorFlow's `record_writer.h`, `event.proto` and `summary.proto`.
//! Readers ignore a truncated last record.

use super::machine;
use crate::error::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Prefix by which TensorBoard recognizes the files. The time in seconds follows, by which it sorts them.
const PREFIX: &str = "events.out.tfevents.";
/// Contents of the first record.
const VERSION: &str = "brain.Event:2";

/// A writer for an event file.
pub struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// Creates a new file in a run folder after `taken` steps. TensorBoard drops later steps of earlier files.
    ///
    /// Errors: the file cannot be created.
    pub fn create(folder: &Path, taken: u64) -> Result<Self> {
        let newest = present(folder).filter_map(|path| number(&path)).max();
        let number = (machine::time() as u64).max(newest.map_or(0, |newest| newest.saturating_add(1)));
        let path = folder.join(format!("{PREFIX}{number}.plenoxel"));
        let file = OpenOptions::new().append(true).create_new(true).open(&path);
        let file = file.map_err(|e| Error::io(&path, e, "creating the TensorBoard event file"))?;
        let mut events = EventFile { path, file };
        events.append(0, field::FILE_VERSION, VERSION.as_bytes())?;
        if taken > 0 {
            // SessionLog { status: START }: TensorBoard drops this step and later ones, which will be repeated.
            events.append(taken, field::SESSION_LOG, &Message::default().varint(1, 1).0)?;
        }
        Ok(events)
    }

    /// Appends named scalars after a step.
    ///
    /// Errors: the file cannot be written.
    pub fn scalars<'n>(&mut self, step: u64, values: impl IntoIterator<Item = (&'n str, f64)>) -> Result<()> {
        let summary = values.into_iter().fold(Message::default(), |summary, (tag, value)| {
            summary.bytes(field::VALUE, &Message::default().bytes(field::TAG, tag.as_bytes()).float(field::SIMPLE_VALUE, value as f32).0)
        });
        self.append(step, field::SUMMARY, &summary.0)
    }

    /// Appends an image after a step: the bytes of a PNG file of `(width, height)` pixels.
    ///
    /// Errors: the file cannot be written.
    pub fn image(&mut self, step: u64, tag: &str, (width, height): (usize, usize), png: &[u8]) -> Result<()> {
        const RGB: u64 = 3;
        let image = Message::default().varint(1, height as u64).varint(2, width as u64).varint(3, RGB).bytes(4, png);
        let value = Message::default().bytes(field::TAG, tag.as_bytes()).bytes(field::IMAGE, &image.0);
        self.append(step, field::SUMMARY, &Message::default().bytes(field::VALUE, &value.0).0)
    }

    /// Appends an event with one field besides the time and the step.
    fn append(&mut self, step: u64, field: u64, content: &[u8]) -> Result<()> {
        let event = Message::default().double(field::WALL_TIME, machine::time()).varint(field::STEP, step).bytes(field, content);
        let written = self.file.write_all(&record(&event.0));
        written.map_err(|e| Error::io(&self.path, e, "writing the TensorBoard event file"))
    }
}

/// Returns the event files in a folder.
pub fn present(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| name(path).is_some_and(|name| name.starts_with(PREFIX)))
}

fn name(path: &Path) -> Option<&str> {
    path.file_name()?.to_str()
}

/// The time in the name of an event file.
fn number(path: &Path) -> Option<u64> {
    name(path)?.strip_prefix(PREFIX)?.split('.').next()?.parse().ok()
}

/// Bytes with their length and the two checksums.
fn record(bytes: &[u8]) -> Vec<u8> {
    let length = (bytes.len() as u64).to_le_bytes();
    [&length[..], &checksum(&length), bytes, &checksum(bytes)].concat()
}

/// The masked CRC-32C of TFRecord files: rotated, and shifted by a constant, because a checksum of bytes that contain checksums is weak.
fn checksum(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

/// Fields by their numbers: of `Event`, of `Summary`, of `Summary.Value`.
mod field {
    pub const WALL_TIME: u64 = 1;
    pub const STEP: u64 = 2;
    pub const FILE_VERSION: u64 = 3;
    pub const SUMMARY: u64 = 5;
    pub const SESSION_LOG: u64 = 7;

    pub const VALUE: u64 = 1;

    pub const TAG: u64 = 1;
    pub const SIMPLE_VALUE: u64 = 2;
    pub const IMAGE: u64 = 4;
}

/// Writer of a protocol buffer: each field follows a tag with its number and, in three bits, its wire type.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(mut self, field: u64, value: u64) -> Self {
        self.number(field << 3);
        self.number(value);
        self
    }

    fn double(mut self, field: u64, value: f64) -> Self {
        self.number(field << 3 | 1);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, bytes: &[u8]) -> Self {
        self.number(field << 3 | 2);
        self.number(bytes.len() as u64);
        self.0.extend(bytes);
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.number(field << 3 | 5);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Seven bits a byte, the lowest first; the eighth says that more follow.
    fn number(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}
