//! Radiance fields with their recipes, one assembled model in each file. [`Model`] is the trait that they have in common.
//!
#![doc = include_str!("../docs/own_field.md")]

pub mod plenoxels;

pub use crate::train::Model;
