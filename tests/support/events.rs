//! Reads TensorBoard's event files, on a path of its own: checksums bit by bit, fields as they come.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// What happened after a step.
#[derive(Default)]
pub struct Event {
    pub step: u64,
    pub version: String,
    pub restart: bool,
    pub scalars: Vec<(String, f32)>,
    /// Width, height and file.
    pub images: Vec<(String, (u64, u64), Vec<u8>)>,
}

/// The event files of a run, in order.
pub fn files(run: &Path) -> Vec<PathBuf> {
    let paths = fs::read_dir(run).unwrap().map(|entry| entry.unwrap().path());
    let mut paths: Vec<PathBuf> = paths.filter(|path| path.to_string_lossy().contains("/events.out.tfevents.")).collect();
    paths.sort();
    paths
}

/// The whole records of a file. Panics where a checksum or a field is wrong.
pub fn read(path: &Path) -> Vec<Event> {
    let bytes = fs::read(path).unwrap();
    let (mut rest, mut events) = (&bytes[..], Vec::new());
    while rest.len() >= 12 {
        let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
        assert_eq!(checksum(&rest[..8]).to_le_bytes(), rest[8..12], "checksum of a length");
        if rest.len() < length + 16 {
            break;
        }
        let (record, after) = rest[12..].split_at(length);
        assert_eq!(checksum(record).to_le_bytes(), after[..4], "checksum of a record");
        events.push(event(record));
        rest = &after[4..];
    }
    events
}

/// What is left of all files when each new one has taken back what it does again: steps and values by name.
pub fn scalars(run: &Path) -> BTreeMap<String, Vec<(u64, f32)>> {
    let mut curves: BTreeMap<String, Vec<(u64, f32)>> = BTreeMap::new();
    for event in files(run).iter().flat_map(|path| read(path)) {
        if event.restart {
            curves.values_mut().for_each(|curve| curve.retain(|(step, _)| *step < event.step));
        }
        for (tag, value) in event.scalars {
            curves.entry(tag).or_default().push((event.step, value));
        }
    }
    curves
}

fn event(record: &[u8]) -> Event {
    let mut event = Event::default();
    for (field, content) in fields(record) {
        match (field, content) {
            (1, Content::Fixed(time)) => assert!(f64::from_le_bytes(time.try_into().unwrap()) > 1.6e9, "the time"),
            (2, Content::Number(step)) => event.step = step,
            (3, Content::Bytes(version)) => event.version = String::from_utf8(version.to_vec()).unwrap(),
            (5, Content::Bytes(summary)) => fields(summary).into_iter().for_each(|(field, content)| match (field, content) {
                (1, Content::Bytes(value)) => add_value(&mut event, value),
                _ => panic!("field {field} of a summary"),
            }),
            (7, Content::Bytes(log)) => event.restart = matches!(fields(log)[..], [(1, Content::Number(1))]),
            _ => panic!("field {field} of an event"),
        }
    }
    event
}

fn add_value(event: &mut Event, value: &[u8]) {
    match &fields(value)[..] {
        [(1, Content::Bytes(tag)), (2, Content::Fixed(number))] => {
            event.scalars.push((text(tag), f32::from_le_bytes((*number).try_into().unwrap())));
        }
        [(1, Content::Bytes(tag)), (4, Content::Bytes(image))] => match &fields(image)[..] {
            [(1, Content::Number(height)), (2, Content::Number(width)), (3, Content::Number(3)), (4, Content::Bytes(file))] => {
                event.images.push((text(tag), (*width, *height), file.to_vec()));
            }
            _ => panic!("an image"),
        },
        _ => panic!("a value"),
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

enum Content<'a> {
    Number(u64),
    Fixed(&'a [u8]),
    Bytes(&'a [u8]),
}

fn fields(mut message: &[u8]) -> Vec<(u64, Content<'_>)> {
    let mut fields = Vec::new();
    while !message.is_empty() {
        let key = number(&mut message);
        let content = match key & 7 {
            0 => Content::Number(number(&mut message)),
            1 => Content::Fixed(take(&mut message, 8)),
            2 => {
                let length = number(&mut message);
                Content::Bytes(take(&mut message, length as usize))
            }
            5 => Content::Fixed(take(&mut message, 4)),
            kind => panic!("a field of kind {kind}"),
        };
        fields.push((key >> 3, content));
    }
    fields
}

fn number(message: &mut &[u8]) -> u64 {
    let bytes = message.iter().take_while(|byte| **byte >= 0x80).count() + 1;
    take(message, bytes).iter().rev().fold(0, |value, byte| value << 7 | u64::from(byte & 0x7f))
}

fn take<'a>(message: &mut &'a [u8], length: usize) -> &'a [u8] {
    let (taken, rest) = message.split_at(length);
    *message = rest;
    taken
}

/// CRC-32C with the mask of TensorFlow's records.
fn checksum(bytes: &[u8]) -> u32 {
    let crc = !bytes.iter().fold(!0u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 })
    });
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

#[test]
fn the_checksum_is_that_of_the_standard() {
    // RFC 3720, B.4: thirty-two zeros.
    let masked = |crc: u32| crc.rotate_right(15).wrapping_add(0xa282_ead8);
    assert_eq!(checksum(&[0; 32]), masked(0x8a91_36aa));
}
