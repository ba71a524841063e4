#![doc = include_str!("../README.md")]
//!
//! # The straight line
//!
//! | module | what it does |
//! | --- | --- |
//! | [`dataset`] | photographs with known cameras, in three splits |
//! | [`camera`], [`geometry`] | pixel to ray; the box that rays are clipped to |
//! | [`camera_path`] | where the camera of a film stands, by formula or from a file |
//! | [`rays`] | training rays, made on the fly |
//! | [`sampling`] | where a ray looks at the field |
//! | [`field`] | what fills space: density and radiance |
//! | [`render`] | from samples to pixels; [`render::composite`](mod@render::composite) is the specification |
//! | [`loss`] | losses and their weighted sum |
//! | [`train`] | batch → render → loss → gradients → optimizer, for any [`Model`](train::Model) |
//! | [`model`] | fields with their recipes: [`model::plenoxels`] |
//! | [`evaluate`] | a model against photographs |
//! | [`carve`] | an opaque grid from silhouettes and colors, without gradients |
//! | [`checkpoint`] | a trained grid on disk |
//! | [`run`] | a run without a screen: settings, folder, metrics, evaluation |
//! | [`export`] | a grid as MagicaVoxel .vox, or its surface as a mesh |
//! | [`metrics`] | PSNR and SSIM |
//! | [`point_cloud`], [`export`] | a trained grid as colored points; filters; files for other programs |
//! | [`random`], [`files`], [`json`], [`text`], [`error`] | numbers by purpose, files within bounds and whole, JSON, text of others on a screen, what can go wrong |
#![deny(unsafe_code)]
#![warn(missing_docs)]

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
pub mod tensor_file;
pub mod text;
pub mod train;

/// The code of the repository's front page is compiled and run with the tests.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct FrontPage;
