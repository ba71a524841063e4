//! Rows of tables: sorted by bucket, added up, and as gradients.
//!
//! A bucket is a power of two of consecutive rows, few enough for their values to fit a core's cache. Contributions to rows are sorted by bucket
//! ([`Buckets`]), and each bucket then belongs to one task, which takes its contributions in order: no atomics, nothing shared for writing, and
//! the same bits for any number of threads.

mod buckets;
pub(crate) mod deferred;
pub(crate) mod merge;
pub(crate) mod sparse;
pub(crate) mod sum;

pub use buckets::{Buckets, Places, buckets_of};
