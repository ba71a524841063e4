//! Named tensors in a `safetensors` file. Tensors are created, written and read one at a time, so that a file may be as large as the
//! memory.
//!
//! The metadata have one entry, `plenoxel`, a JSON object. Several entries would be written in random order, and equal models should give
//! identical files.

use crate::error::{Error, Result};
use crate::files;
use crate::memory;
use autograd::{Lattice, Real, Tensor};
pub(crate) use safetensors::tensor::{Dtype, TensorInfo};
use safetensors::tensor::{Metadata, View};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Key of the metadata.
const KEY: &str = "plenoxel";
/// Length of the longest header that is read, enough for a hundred thousand tensors. The format allows ten times as much.
const LONGEST: u64 = 10_000_000;
/// Advice for a damaged file.
pub(crate) const RETRAIN: &str = "train again, or use an undamaged copy";

/// Tensor to write.
pub(crate) struct Entry<'a> {
    pub name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Box<dyn Fn() -> Vec<u8> + 'a>,
}

impl<'a> Entry<'a> {
    /// Creates an entry. `bytes` returns the little-endian bytes when the tensor is written.
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

/// Writes tensors and a header atomically.
pub(crate) fn write(path: &Path, header: &impl Serialize, entries: &[Entry<'_>]) -> Result<()> {
    let header = serde_json::to_string(header).map_err(|e| {
        let found = format!("the header cannot be written as JSON ({e})");
        Error::input(path, found, "this is a defect of the program")
    })?;
    let views = entries.iter().map(|entry| (&entry.name, entry));
    let bytes = header.len() + entries.iter().map(|entry| entry.data_len()).sum::<usize>();
    let folder = path.parent().unwrap_or(Path::new(""));
    files::check_room(folder, bytes as u64, bytes as u64).map_err(|e| Error::io(path, e, "writing the file"))?;
    files::atomically(path, |temporary| {
        // The library creates files with restricted permissions; use the default permissions instead.
        let permissions = File::create(temporary)?.metadata()?.permissions();
        safetensors::serialize_to_file(views, Some(HashMap::from([(KEY.to_owned(), header)])), temporary).map_err(|e| match e {
            safetensors::SafeTensorError::IoError(e) => e,
            e => std::io::Error::other(e),
        })?;
        std::fs::set_permissions(temporary, permissions)
    })
}

/// Tensors and facts to be written to a file, collected by [`Model::write`](crate::train::Model::write).
pub struct TensorWriter<'a> {
    dtype: Dtype,
    facts: Map<String, Value>,
    entries: Vec<Entry<'a>>,
}

impl<'a> TensorWriter<'a> {
    /// Creates a writer of numbers in the precision of `T`.
    pub(crate) fn of<T: Real>() -> Self {
        TensorWriter { dtype: dtype_of::<T>(), facts: Map::new(), entries: Vec::new() }
    }

    /// Creates a writer that converts all numbers to `f32`.
    pub(crate) fn single() -> Self {
        TensorWriter { dtype: Dtype::F32, facts: Map::new(), entries: Vec::new() }
    }

    /// Adds a fact to the JSON object in the file's metadata.
    ///
    /// Panics if the value cannot be written as JSON.
    #[track_caller]
    pub fn fact(&mut self, name: &str, value: impl Serialize) {
        let value = serde_json::to_value(value).unwrap_or_else(|e| panic!("the fact `{name}` cannot be written as JSON: {e}"));
        self.facts.insert(name.to_owned(), value);
    }

    /// Adds a tensor.
    pub fn tensor<T: Real>(&mut self, name: impl Into<String>, tensor: &'a Tensor<T>) {
        self.numbers(name, tensor.shape(), tensor.data());
    }

    /// Adds a tensor of this shape from its values in row-major order.
    pub fn numbers<T: Real>(&mut self, name: impl Into<String>, shape: &[usize], values: &'a [T]) {
        let dtype = self.dtype;
        self.entries.push(Entry::new(name, dtype, shape.to_vec(), move || bytes_of(values, dtype)));
    }

    /// Adds a tensor that the writer owns.
    pub fn owned<T: Real>(&mut self, name: impl Into<String>, tensor: Tensor<T>) {
        let dtype = self.dtype;
        self.entries.push(Entry::new(name, dtype, tensor.shape().to_vec(), move || bytes_of(tensor.data(), dtype)));
    }

    /// Adds a list of 64-bit words.
    pub fn words(&mut self, name: impl Into<String>, words: &'a [u64]) {
        let bytes = || words.iter().flat_map(|word| word.to_le_bytes()).collect();
        self.entries.push(Entry::new(name, Dtype::U64, vec![words.len()], bytes));
    }

    /// Writes the file atomically.
    pub(crate) fn write(&self, path: &Path) -> Result<()> {
        write(path, &self.facts, &self.entries)
    }
}

/// Seekable source of bytes.
trait Source: Read + Seek {}
impl<R: Read + Seek> Source for R {}

/// File of tensors, opened for reading.
pub struct TensorFile<'a> {
    path: PathBuf,
    source: Box<dyn Source + 'a>,
    metadata: Metadata,
    /// Offset of the tensors in the file.
    begin: u64,
}

impl<'a> TensorFile<'a> {
    /// Opens a file.
    ///
    /// Errors if it cannot be read, is not a regular file, or is not a complete file of this program.
    pub fn open(path: &Path) -> Result<Self> {
        Self::new(path, files::open(path, files::TENSORS)?)
    }

    /// Opens a source that `path` names in error messages.
    ///
    /// Errors if it cannot be read, or is not a complete file of this program.
    pub(crate) fn new(path: &Path, mut source: impl Read + Seek + 'a) -> Result<Self> {
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
            return Err(damaged(path, &format!("it has {size} bytes, its header announces {}", begin.saturating_add(expected))));
        }
        Ok(TensorFile { path: path.to_owned(), source: Box::new(source), metadata, begin })
    }

    /// Returns the path of the file, for error messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the JSON object in the file's metadata.
    pub fn facts(&self) -> Result<Value> {
        let Some(text) = self.metadata.metadata().as_ref().and_then(|m| m.get(KEY)) else {
            let found = format!("a safetensors file without the key `{KEY}` in its metadata");
            return Err(Error::input(&self.path, found, "use a checkpoint that this program wrote"));
        };
        serde_json::from_str(text).map_err(|e| self.unreadable(&e))
    }

    /// Returns a fact that was added with [`TensorWriter::fact`].
    ///
    /// Errors if it is missing or has another type.
    pub fn fact<V: DeserializeOwned>(&self, name: &str) -> Result<V> {
        serde_json::from_value(self.facts()?[name].take()).map_err(|e| self.unreadable(&format!("{name}: {e}")))
    }

    /// Returns the error for a header that cannot be read.
    pub(crate) fn unreadable(&self, e: &dyn std::fmt::Display) -> Error {
        Error::input(&self.path, format!("the header cannot be read ({e})"), RETRAIN)
    }

    /// Returns an error for invalid content of the file.
    pub fn damaged(&self, found: impl Into<String>) -> Error {
        Error::input(&self.path, found, RETRAIN)
    }

    /// Returns names and shapes of the tensors, sorted by name.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>)> {
        let mut all: Vec<_> = self.metadata.tensors().into_iter().map(|(name, info)| (name, info.shape.clone())).collect();
        all.sort();
        all
    }

    /// Returns true if there is a tensor of this name.
    pub fn contains(&self, name: &str) -> bool {
        self.info(name).is_some()
    }

    /// Returns type, shape and offsets of a tensor, if it exists.
    pub(crate) fn info(&self, name: &str) -> Option<&TensorInfo> {
        self.metadata.info(name)
    }

    /// Reads the bytes of a tensor of this type and shape.
    pub(crate) fn read(&mut self, name: &str, dtype: Dtype, expected: &[usize]) -> Result<Vec<u8>> {
        let Some(info) = self.info(name) else {
            return Err(Error::input(&self.path, format!("no tensor `{name}`"), RETRAIN));
        };
        if info.dtype != dtype || info.shape != expected {
            let found = format!("tensor `{name}` is {:?} {:?}", info.dtype, info.shape);
            return Err(Error::input(&self.path, found, format!("expected {dtype:?} {expected:?}; {RETRAIN}")));
        }
        let (from, to) = info.data_offsets;
        // The size is bounded by that of the file, which was checked. The factor 2 accounts for the numbers converted from the bytes.
        memory::check(&self.path, &format!("reading the tensor `{name}`"), 2 * (to - from) as u64)?;
        let mut bytes = vec![0; to - from];
        let read = self.source.seek(SeekFrom::Start(self.begin + from as u64)).and_then(|_| self.source.read_exact(&mut bytes));
        read.map_err(|e| refused(&self.path, e))?;
        Ok(bytes)
    }

    /// Reads a tensor of this shape, stored in single or double precision.
    pub fn tensor<T: Real>(&mut self, name: &str, shape: &[usize]) -> Result<Tensor<T>> {
        let dtype = self.info(name).map(|info| info.dtype).filter(|dtype| [Dtype::F32, Dtype::F64].contains(dtype));
        let values = self.numbers(name, dtype.unwrap_or(dtype_of::<T>()), shape)?;
        Ok(Tensor::from_vec(values, shape))
    }

    /// Reads the brick masks of `cells`, as in [`autograd::Lattice::masks`]. Returns `None` if a mask has a bit outside of `cells`.
    ///
    /// Errors as for [`words`](Self::words).
    pub fn brick_masks(&mut self, name: &str, cells: [usize; 3]) -> Result<Option<Vec<u64>>> {
        let whole = Lattice::bricks(cells);
        let masks = self.words(name, whole.masks().len())?;
        let inside = masks.iter().zip(whole.masks()).all(|(mask, whole)| mask & !whole == 0);
        Ok(inside.then_some(masks))
    }

    /// Reads a list of 64-bit words.
    pub fn words(&mut self, name: &str, length: usize) -> Result<Vec<u64>> {
        let bytes = self.read(name, Dtype::U64, &[length])?;
        Ok(bytes.as_chunks::<8>().0.iter().map(|b| u64::from_le_bytes(*b)).collect())
    }

    /// Reads the numbers of a tensor.
    pub(crate) fn numbers<T: Real>(&mut self, name: &str, dtype: Dtype, expected: &[usize]) -> Result<Vec<T>> {
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
    Error::input(path, format!("not a complete safetensors file ({e})"), RETRAIN)
}

/// Returns the type that stores numbers of type `T` exactly.
pub(crate) fn dtype_of<T: Real>() -> Dtype {
    if size_of::<T>() == 8 { Dtype::F64 } else { Dtype::F32 }
}

/// Returns the little-endian bytes of numbers.
pub(crate) fn bytes_of<T: Real>(values: &[T], dtype: Dtype) -> Vec<u8> {
    match dtype {
        Dtype::F64 => values.iter().flat_map(|x| x.as_f64().to_le_bytes()).collect(),
        _ => values.iter().flat_map(|x| (x.as_f64() as f32).to_le_bytes()).collect(),
    }
}
