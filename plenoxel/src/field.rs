//! Fields that fill space, and how they are stored.
//!
//! [`Field`] and [`Radiance`] are defined by [`render`](crate::render), which knows no field.

pub(crate) mod neighbours;
pub mod sh;
pub mod voxel_grid;

pub use crate::render::{Field, Radiance};
