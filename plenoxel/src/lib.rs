//! Voxel radiance fields: differentiable rendering, training, and what surrounds it.

/// One enum for everything a user, a disk or a diverging run can cause.
pub mod error;
/// Files that appear whole or not at all.
pub mod files;
/// The axis-aligned box that rays are clipped to.
pub mod geometry;
/// Photographs with known cameras, in three splits.
pub mod dataset;
/// Intrinsics and pose; pixel to ray: the one place for camera conventions.
pub mod camera;
/// PSNR and SSIM.
pub mod metrics;
/// Random numbers as a function of what they are for.
pub mod random;
/// Training rays, made on the fly.
pub mod rays;
/// Where a ray looks at the field.
pub mod sampling;
/// What fills space.
pub mod field;
/// From rays to pixels.
pub mod render;
/// Losses and their weighted sum.
pub mod loss;
/// Training, coarse to fine.
pub mod train;
/// A trained grid on disk.
pub mod checkpoint;
