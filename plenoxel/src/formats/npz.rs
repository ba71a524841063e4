//! NumPy archives (.npz): a zip file with one .npy file for each array, stored or deflated.
//!
//! Arrays are read one at a time. The size of an array is checked three times before memory is taken for it: its header must agree with
//! the archive, the archive with the number of its compressed bytes, and both with the available memory.

use crate::error::{Error, Result};
use crate::files::npy::Header;
use crate::memory;
use half::f16;
use std::io::{Cursor, Read, Seek, Write};
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// Most bytes that deflate makes of one byte.
const MOST_OF_DEFLATE: u64 = 1032;
/// Bytes read at a time.
const RUN: usize = 1 << 16;
/// Advice for a damaged file.
const REMEDY: &str = "use an undamaged copy of the file";

/// Seekable source of bytes.
trait Source: Read + Seek {}
impl<R: Read + Seek> Source for R {}

/// An archive, opened for reading.
pub struct Npz<'a> {
    path: PathBuf,
    archive: ZipArchive<Box<dyn Source + 'a>>,
}

/// An array in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct Array<T> {
    /// Length of each axis; none for a single number.
    pub shape: Vec<usize>,
    /// The numbers.
    pub values: Vec<T>,
}

/// Type of the numbers of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// Half, single or double precision.
    Float(usize),
    /// Signed integers of so many bytes.
    Int(usize),
    /// Unsigned integers of so many bytes, or true and false.
    Uint(usize),
    /// Text of so many characters.
    Text(usize),
}

impl Kind {
    fn of(name: &str) -> Option<Self> {
        Some(match name {
            "<f2" => Kind::Float(2),
            "<f4" => Kind::Float(4),
            "<f8" => Kind::Float(8),
            "|i1" => Kind::Int(1),
            "<i2" => Kind::Int(2),
            "<i4" => Kind::Int(4),
            "<i8" => Kind::Int(8),
            "|u1" | "|b1" => Kind::Uint(1),
            "<u2" => Kind::Uint(2),
            "<u4" => Kind::Uint(4),
            "<u8" => Kind::Uint(8),
            text => Kind::Text(text.strip_prefix("<U")?.parse().ok().filter(|characters| *characters <= RUN / 4)?),
        })
    }

    /// Bytes of a number.
    fn size(self) -> usize {
        match self {
            Kind::Float(bytes) | Kind::Int(bytes) | Kind::Uint(bytes) => bytes,
            Kind::Text(characters) => 4 * characters,
        }
    }

    /// The number in little-endian bytes.
    fn value(self, bytes: &[u8]) -> f64 {
        let mut whole = [0; 8];
        whole[..bytes.len()].copy_from_slice(bytes);
        let word = u64::from_le_bytes(whole);
        match self {
            Kind::Float(2) => f16::from_bits(word as u16).to_f64(),
            Kind::Float(4) => f64::from(f32::from_bits(word as u32)),
            Kind::Float(_) => f64::from_bits(word),
            // The sign is extended.
            Kind::Int(size) => ((word << (64 - 8 * size)) as i64 >> (64 - 8 * size)) as f64,
            Kind::Uint(_) | Kind::Text(_) => word as f64,
        }
    }
}

impl<'a> Npz<'a> {
    /// Opens an archive that `path` names in error messages.
    ///
    /// Errors if it is not a zip file.
    pub fn new(path: &Path, source: impl Read + Seek + 'a) -> Result<Self> {
        let archive = ZipArchive::new(Box::new(source) as Box<dyn Source + 'a>);
        let archive = archive.map_err(|e| Error::input(path, format!("this is not a complete .npz file ({e})"), REMEDY))?;
        Ok(Npz { path: path.to_owned(), archive })
    }

    /// Returns the path of the file, for error messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the names of the arrays, sorted.
    pub fn names(&self) -> Vec<String> {
        let files = self.archive.file_names().filter_map(|name| Some(name.ok()?.strip_suffix(".npy")?.to_owned()));
        let mut names: Vec<String> = files.collect();
        names.sort();
        names
    }

    /// Returns true if there is an array of this name.
    pub fn contains(&self, name: &str) -> bool {
        self.archive.index_for_name(&format!("{name}.npy")).is_some()
    }

    /// Reads an array of numbers and converts them.
    ///
    /// Errors if it is missing or damaged, is not in C order or of another type, or if there is not enough memory; `convert` returned
    /// `None`.
    fn read<T>(&mut self, name: &str, accepted: &str, convert: impl Fn(Kind, &[u8]) -> Option<T>) -> Result<Array<T>> {
        let path = self.path.clone();
        let bad = |found: String| Error::input(&path, format!("array `{name}`: {found}"), REMEDY);
        if !self.contains(name) {
            return Err(Error::input(&path, format!("the file has no array `{name}`"), REMEDY));
        }
        let mut file = self.archive.by_name(&format!("{name}.npy")).map_err(|e| bad(e.to_string()))?;
        let (size, stored) = (file.size(), file.compressed_size());
        let header = Header::read(&mut file).map_err(&bad)?;
        let wrong = |found: String| Error::input(&path, format!("array `{name}`: {found}"), format!("expected {accepted} in C order"));
        let kind = Kind::of(&header.kind).ok_or_else(|| wrong(format!("the numbers are of type '{}'", header.kind)))?;
        // The order is of no importance for a list.
        if header.fortran_order && header.shape.iter().filter(|side| **side != 1).count() > 1 {
            return Err(wrong("the array is in Fortran order".into()));
        }
        let count = header.shape.iter().try_fold(1usize, |count, side| count.checked_mul(*side));
        let bytes = count.and_then(|count| u64::try_from(count.checked_mul(kind.size())?).ok());
        let Some((count, bytes)) = count.zip(bytes).filter(|(_, bytes)| *bytes < size) else {
            return Err(bad(format!("the shape {} does not fit into its {size} bytes", header.shape_as_text())));
        };
        if size / MOST_OF_DEFLATE > stored {
            return Err(bad(format!("the archive announces {size} bytes in {stored} compressed bytes")));
        }
        memory::check(&path, &format!("reading the array `{name}`"), count as u64 * size_of::<T>() as u64)?;
        let mut values = Vec::new();
        values.try_reserve_exact(count).map_err(|_| bad(format!("there is no memory for {bytes} bytes")))?;
        let mut run = vec![0; RUN / kind.size().max(1) * kind.size()];
        let mut left = bytes as usize;
        while left > 0 {
            let part = &mut run[..left.min(RUN / kind.size() * kind.size())];
            file.read_exact(part).map_err(|e| bad(format!("the numbers cannot be read ({e})")))?;
            for number in part.chunks_exact(kind.size()) {
                values.push(convert(kind, number).ok_or_else(|| wrong(format!("the numbers are of type '{}'", header.kind)))?);
            }
            left -= part.len();
        }
        // The checksum is compared at the end of the file.
        match file.read(&mut [0]) {
            Ok(0) => Ok(Array { shape: header.shape, values }),
            Ok(_) => Err(bad("the array has more numbers than its shape".into())),
            Err(e) => Err(bad(format!("the numbers cannot be read ({e})"))),
        }
    }

    /// Reads numbers of any type in single precision.
    ///
    /// Errors if the array is missing or damaged, or has other content, or if there is not enough memory.
    pub fn numbers(&mut self, name: &str) -> Result<Array<f32>> {
        self.read(name, "numbers", |kind, bytes| match kind {
            Kind::Text(_) => None,
            kind => Some(kind.value(bytes) as f32),
        })
    }

    /// Reads integers of any type; those beyond 32 bits become the nearest of 32 bits.
    ///
    /// Errors: those of [`numbers`](Self::numbers).
    pub fn integers(&mut self, name: &str) -> Result<Array<i32>> {
        self.read(name, "integers", |kind, bytes| match kind {
            Kind::Int(_) | Kind::Uint(_) => Some(kind.value(bytes) as i32),
            Kind::Float(_) | Kind::Text(_) => None,
        })
    }

    /// Reads one text.
    ///
    /// Errors: those of [`numbers`](Self::numbers).
    pub fn text(&mut self, name: &str) -> Result<String> {
        let texts = self.read(name, "a text", |kind, bytes| match kind {
            Kind::Text(_) => {
                let characters = bytes.as_chunks::<4>().0.iter().map(|c| char::from_u32(u32::from_le_bytes(*c)).unwrap_or('\u{fffd}'));
                Some(characters.collect::<String>().trim_end_matches('\0').to_owned())
            }
            _ => None,
        })?;
        match &texts.values[..] {
            [text] => Ok(text.clone()),
            texts => Err(Error::input(&self.path, format!("array `{name}` has {} texts", texts.len()), "expected one text")),
        }
    }
}

/// An archive that is being written, in memory.
pub struct NpzWriter {
    archive: ZipWriter<Cursor<Vec<u8>>>,
    options: SimpleFileOptions,
}

impl NpzWriter {
    /// Creates a writer. `compressed` deflates the arrays, as `numpy.savez_compressed` does; `numpy.savez` stores them.
    pub fn new(compressed: bool) -> Self {
        let method = if compressed { CompressionMethod::Deflated } else { CompressionMethod::Stored };
        // Without a time, equal grids give equal files. Arrays may exceed 4 GiB.
        let options = SimpleFileOptions::default().compression_method(method).last_modified_time(zip::DateTime::default()).large_file(true);
        NpzWriter { archive: ZipWriter::new(Cursor::new(Vec::new())), options }
    }

    /// Adds an array from its type, as in `<f4`, its shape, and its little-endian bytes in several parts.
    pub fn add(&mut self, name: &str, kind: &str, shape: &[usize], parts: impl IntoIterator<Item = Vec<u8>>) -> Result<()> {
        let failed = |e: std::io::Error| Error::io(format!("{name}.npy"), e, "writing the array");
        self.archive.start_file(format!("{name}.npy"), self.options).map_err(|e| failed(e.into()))?;
        self.archive.write_all(&Header::encode(kind, shape)).map_err(failed)?;
        parts.into_iter().try_for_each(|part| self.archive.write_all(&part)).map_err(failed)
    }

    /// Adds 32-bit floats.
    pub fn floats(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Result<()> {
        self.add(name, "<f4", shape, parts(values, |value| value.to_le_bytes()))
    }

    /// Adds 32-bit integers.
    pub fn integers(&mut self, name: &str, shape: &[usize], values: &[i32]) -> Result<()> {
        self.add(name, "<i4", shape, parts(values, |value| value.to_le_bytes()))
    }

    /// Adds floats in half precision. Numbers beyond its range become the largest.
    pub fn halves(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Result<()> {
        self.add(name, "<f2", shape, parts(values, |value| half(value).to_le_bytes()))
    }

    /// Adds one integer.
    pub fn integer(&mut self, name: &str, value: i64) -> Result<()> {
        self.add(name, "<i8", &[], [value.to_le_bytes().to_vec()])
    }

    /// Adds a text.
    pub fn text(&mut self, name: &str, text: &str) -> Result<()> {
        let characters: Vec<u8> = text.chars().flat_map(|c| u32::from(c).to_le_bytes()).collect();
        self.add(name, &format!("<U{}", text.chars().count()), &[], [characters])
    }

    /// Returns the bytes of the archive.
    pub fn finish(self) -> Result<Vec<u8>> {
        let bytes = self.archive.finish().map_err(|e| Error::io("archive.npz", e.into(), "writing the archive"))?;
        Ok(bytes.into_inner())
    }
}

/// The nearest number of half precision, or the largest.
pub(super) fn half(value: f32) -> f16 {
    f16::from_f32(value.clamp(f16::MIN.to_f32(), f16::MAX.to_f32()))
}

/// The bytes of numbers, in parts.
fn parts<T: Copy, const N: usize>(values: &[T], bytes: impl Fn(T) -> [u8; N]) -> impl Iterator<Item = Vec<u8>> {
    values.chunks(RUN).map(move |part| part.iter().flat_map(|value| bytes(*value)).collect())
}
