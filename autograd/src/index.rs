//! [`Indices`]: shared arrays of row numbers.

use crate::pool::Buffer;
use std::ops::Deref;
use std::sync::Arc;

/// An immutable array of row numbers. A clone shares the array, so the graph and the caller can both hold it.
#[derive(Clone, Debug)]
pub struct Indices(Arc<Buffer<u32>>);

impl From<Vec<u32>> for Indices {
    fn from(rows: Vec<u32>) -> Self {
        Indices(Arc::new(rows.into()))
    }
}

impl From<Buffer<u32>> for Indices {
    fn from(rows: Buffer<u32>) -> Self {
        Indices(Arc::new(rows))
    }
}

impl Deref for Indices {
    type Target = [u32];
    fn deref(&self) -> &[u32] {
        &self.0
    }
}
