//! Row numbers.

use crate::pool::Buffer;
use std::ops::Deref;
use std::sync::Arc;

/// Row numbers, shared between the graph and whoever computed them.
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
