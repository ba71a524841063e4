//! Limits on the number of things that are done at the same time.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

/// A number of places.
#[derive(Debug)]
pub struct Places {
    most: usize,
    taken: Arc<AtomicUsize>,
}

/// A place that is taken, until it is dropped.
#[derive(Debug)]
pub struct Place(Arc<AtomicUsize>);

impl Places {
    pub fn new(most: usize) -> Self {
        Places { most, taken: Arc::default() }
    }

    /// Takes a place, if one is free.
    pub fn take(&self) -> Option<Place> {
        let place = Place(self.taken.clone());
        // If there are too many, dropping it gives it back.
        (self.taken.fetch_add(1, SeqCst) < self.most).then_some(place)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, SeqCst);
    }
}
