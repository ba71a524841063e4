//! Radiance fields and their storage.
//!
//! [`Field`] and [`Radiance`] are defined by [`render`](crate::render), which depends on no particular field.

pub mod dvgo;
pub mod encoding;
pub mod factored;
pub mod grouping;
pub mod hash_grid;
mod lanes;
pub(crate) mod neighbours;
pub mod nerf;
pub mod ngp;
pub(crate) mod node_table;
pub mod sh;
pub mod voxel_grid;

pub use crate::render::{Field, Radiance};
