//! Radiance fields with their recipes, one assembled model in each file. [`Model`] is what they have in common.

pub mod plenoxels;

pub use crate::train::Model;
