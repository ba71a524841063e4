#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! | module | contents |
//! | --- | --- |
//! | [`dataset`] | images with known cameras, in a train, a validation and a test split |
//! | [`camera`], [`geometry`] | pixel to ray; the box that rays are clipped to |
//! | [`camera_path`] | camera paths of rendered films, by formula or from a file |
//! | [`rays`] | training rays, generated for each batch |
//! | [`sampling`] | sample positions along rays; occupancy of space |
//! | [`field`] | radiance fields: density and color at a point |
//! | [`render`] | volume rendering; [`render::composite`](mod@render::composite) is the reference implementation |
//! | [`loss`] | losses and their weighted sum |
//! | [`train`] | batch → render → loss → gradients → optimizer, for any [`Model`](train::Model) |
//! | [`model`] | radiance fields with their training recipes: [`plenoxels`](model::plenoxels), [`tensorf`](model::tensorf), [`dvgo`](model::dvgo), [`ngp`](model::ngp), [`nerf`](model::nerf) |
//! | [`space`] | the map from the world to the box of a field: the identity, NDC, a contraction |
//! | [`tensor_file`] | named tensors in a safetensors file |
//! | [`evaluate`] | PSNR and SSIM of a model on the images of a split |
//! | [`bake`] | a voxel grid with the density and the colors of a field without voxels |
//! | [`carve`] | an opaque grid from silhouettes and colors, without gradients |
//! | [`checkpoint`] | a trained grid in a file |
//! | [`run`] | complete runs, without printing: settings, run folder, metrics, evaluation |
//! | [`export`] | a grid as MagicaVoxel .vox, as a mesh of its surface, or for the web viewer |
//! | [`formats`] | a grid in the files of svox2 and PlenOctrees, in both directions |
//! | [`metrics`] | PSNR and SSIM |
//! | [`point_cloud`] | a trained grid as colored points, filters, PLY files |
//! | [`random`] | random numbers from a seed and a purpose |
//! | [`files`], [`json`] | size-limited reads and atomic writes; JSON |
//! | [`text`], [`error`] | untrusted text made safe to print; errors |
#![deny(unsafe_code)]
#![warn(missing_docs)]

pub mod bake;
pub mod camera;
pub mod camera_path;
pub mod carve;
pub mod checkpoint;
pub mod dataset;
pub mod error;
pub mod evaluate;
pub mod export;
pub mod field;
pub mod files;
pub mod formats;
pub mod geometry;
#[cfg(debug_assertions)]
#[doc(hidden)]
pub mod instances;
pub mod json;
pub mod loss;
mod memory;
pub mod metrics;
pub mod model;
pub mod point_cloud;
pub mod random;
pub mod rays;
pub mod render;
pub mod run;
pub mod sampling;
pub mod space;
pub mod tensor_file;
pub mod text;
pub mod train;

/// A test that compiles and runs the code of the repository's README.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct FrontPage;
