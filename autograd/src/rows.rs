//! Row-sparse gradients, and the sums of contributions to rows.
//!
//! A bucket is a range of consecutive rows whose values fit the cache of a core; its length is a power of two. Contributions to rows are sorted by bucket
//! ([`Buckets`]). Each bucket then belongs to one task, which adds its contributions in order. This needs no atomics, no task writes to shared memory, and
//! the bits are the same for any number of threads.

mod buckets;
pub(crate) mod deferred;
pub(crate) mod merge;
pub(crate) mod sparse;
pub(crate) mod sum;

pub use buckets::{BucketCursors, Buckets, buckets_of};
