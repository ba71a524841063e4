//! Named tables in a `safetensors` file, which are made, written and read one at a time: a file may be as large as the memory.
//!
//! The metadata have one entry, `plenoxel`: a JSON object. (One entry, for several would be written in a random order, and equal grids are to
//! be equal files.)

use crate::error::{Error, Result};
use crate::files;
use autograd::Real;
pub(crate) use safetensors::tensor::{Dtype, TensorInfo};
use safetensors::tensor::{Metadata, View};
use serde::Serialize;
use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Key of the metadata.
const KEY: &str = "plenoxel";
/// The longest header that the format allows.
const LONGEST: u64 = 100_000_000;
/// What helps against a damaged file.
pub(crate) const RETRAIN: &str = "train again, or use an undamaged copy";

/// A table to write.
pub(crate) struct Entry<'a> {
    pub name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Box<dyn Fn() -> Vec<u8> + 'a>,
}

impl<'a> Entry<'a> {
    /// What `bytes` makes, little-endian, when it is written.
    pub fn new(name: impl Into<String>, dtype: Dtype, shape: Vec<usize>, bytes: impl Fn() -> Vec<u8> + 'a) -> Self {
        Entry { name: name.into(), dtype, shape, bytes: Box::new(bytes) }
    }
}

impl View for &Entry<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Owned((self.bytes)())
    }

    fn data_len(&self) -> usize {
        self.shape.iter().product::<usize>() * self.dtype.bitsize() / 8
    }
}

/// Writes tables and what is to be known of them, whole or not at all.
pub(crate) fn write(path: &Path, header: &impl Serialize, entries: &[Entry<'_>]) -> Result<()> {
    let header = serde_json::to_string(header).map_err(|e| {
        let found = format!("the header cannot be put together ({e})");
        Error::input(path, found, "this is a defect of the program")
    })?;
    let views = entries.iter().map(|entry| (&entry.name, entry));
    files::atomically(path, |temporary| {
        // The library makes files that nobody else may read.
        let permissions = File::create(temporary)?.metadata()?.permissions();
        safetensors::serialize_to_file(views, Some(HashMap::from([(KEY.to_owned(), header)])), temporary).map_err(|e| match e {
            safetensors::SafeTensorError::IoError(e) => e,
            e => std::io::Error::other(e),
        })?;
        std::fs::set_permissions(temporary, permissions)
    })
}

/// A file whose tables can be read.
pub(crate) struct TensorFile<R> {
    path: PathBuf,
    source: R,
    metadata: Metadata,
    /// Where the tables begin.
    begin: u64,
}

/// Opens a file to be read as one of tables.
pub(crate) fn open(path: &Path) -> Result<File> {
    File::open(path).map_err(|e| refused(path, e))
}

impl<R: Read + Seek> TensorFile<R> {
    /// The tables of a source, which `path` names in messages. Errors: it cannot be read, or is not a whole file of this program.
    pub fn new(path: &Path, mut source: R) -> Result<Self> {
        let refused = |e| refused(path, e);
        let size = source.seek(SeekFrom::End(0)).map_err(refused)?;
        source.rewind().map_err(refused)?;
        let (mut length, mut text) = (Vec::new(), Vec::new());
        source.by_ref().take(8).read_to_end(&mut length).map_err(refused)?;
        let length = length.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
        source.by_ref().take(length.min(LONGEST)).read_to_end(&mut text).map_err(refused)?;
        let metadata: Metadata = serde_json::from_slice(&text).map_err(|e| damaged(path, &e))?;
        let (begin, expected) = (length.saturating_add(8), metadata.data_len() as u64);
        if size.checked_sub(begin) != Some(expected) {
            return Err(damaged(path, &format!("{size} bytes, where {} are announced", begin.saturating_add(expected))));
        }
        Ok(TensorFile { path: path.to_owned(), source, metadata, begin })
    }

    /// What is to be known of the tables, as it was written.
    pub fn header(&self) -> Result<serde_json::Value> {
        let Some(text) = self.metadata.metadata().as_ref().and_then(|m| m.get(KEY)) else {
            let found = format!("a safetensors file without `{KEY}` in its metadata");
            return Err(Error::input(&self.path, found, "give a checkpoint that this program wrote"));
        };
        serde_json::from_str(text).map_err(|e| self.unreadable(&e))
    }

    /// The header cannot be read, for this reason.
    pub fn unreadable(&self, e: &dyn std::fmt::Display) -> Error {
        Error::input(&self.path, format!("the header cannot be read ({e})"), RETRAIN)
    }

    /// Type, shape and place of a table, if it is there.
    pub fn info(&self, name: &str) -> Option<&TensorInfo> {
        self.metadata.info(name)
    }

    /// The bytes of a table of this type and shape.
    pub fn read(&mut self, name: &str, dtype: Dtype, expected: &[usize]) -> Result<Vec<u8>> {
        let Some(info) = self.info(name) else {
            return Err(Error::input(&self.path, format!("no tensor `{name}`"), RETRAIN));
        };
        if info.dtype != dtype || info.shape != expected {
            let found = format!("tensor `{name}` is {:?} {:?}", info.dtype, info.shape);
            return Err(Error::input(&self.path, found, format!("{dtype:?} {expected:?} is expected; {RETRAIN}")));
        }
        let (from, to) = info.data_offsets;
        // As long as the file is: its length was compared.
        let mut bytes = vec![0; to - from];
        let read = self.source.seek(SeekFrom::Start(self.begin + from as u64)).and_then(|_| self.source.read_exact(&mut bytes));
        read.map_err(|e| refused(&self.path, e))?;
        Ok(bytes)
    }

    /// The numbers of a table.
    pub fn numbers<T: Real>(&mut self, name: &str, dtype: Dtype, expected: &[usize]) -> Result<Vec<T>> {
        let bytes = self.read(name, dtype, expected)?;
        Ok(match dtype {
            Dtype::F64 => bytes.as_chunks::<8>().0.iter().map(|b| T::lit(f64::from_le_bytes(*b))).collect(),
            _ => bytes.as_chunks::<4>().0.iter().map(|b| T::lit(f64::from(f32::from_le_bytes(*b)))).collect(),
        })
    }
}

fn refused(path: &Path, e: std::io::Error) -> Error {
    Error::io(path, e, "reading the checkpoint")
}

fn damaged(path: &Path, e: &dyn std::fmt::Display) -> Error {
    Error::input(path, format!("not a whole safetensors file ({e})"), RETRAIN)
}

/// The type that holds every number of T.
pub(crate) fn dtype_of<T: Real>() -> Dtype {
    if size_of::<T>() == 8 { Dtype::F64 } else { Dtype::F32 }
}

/// Numbers as a file has them.
pub(crate) fn bytes_of<T: Real>(values: &[T], dtype: Dtype) -> Vec<u8> {
    match dtype {
        Dtype::F64 => values.iter().flat_map(|x| x.as_f64().to_le_bytes()).collect(),
        _ => values.iter().flat_map(|x| (x.as_f64() as f32).to_le_bytes()).collect(),
    }
}
