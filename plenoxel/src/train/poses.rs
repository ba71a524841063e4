//! Refinement of camera poses: rays of the training views from corrected cameras.
//!
//! View v has a rotation vector ωᵥ and a translation τᵥ, both in world coordinates and 0 at the beginning. A ray (o, d) of the view becomes
//!
//! o' = o + τᵥ,  d' = R(ωᵥ) d,  R(ω) d = d + 2 (c × d + c × (c × d)) / (1 + |c|²) with c = ω / 2.
//!
//! The camera rotates about its own position. R is the Cayley map: a rotation by 2 atan(|ω| / 2), which is |ω| up to third order, without a singularity at 0.
//!
//! *Gauge.* If all cameras and the scene are moved, turned or scaled together, all pixels stay as they are. So photographs cannot tell these seven motions of the
//! cameras, and a field that follows them no longer fits the given poses of test views. The corrections are the learned numbers without their component along the seven
//! motions, in the metric Σᵥ |ωᵥ|² + |τᵥ|² / ℓ² with ℓ the root mean square distance of the cameras from their mean position. BARF (Lin et al. 2021) instead lets the
//! scene move, and afterwards looks for the similarity between the learned and the given cameras. Here test views, paths and exports keep the given poses. Errors that the
//! given poses of all training views have in common are not corrected, and motions of second order are not removed; test views are not aligned.

use crate::camera::{Camera, TrackedRays};
use crate::dataset::View;
use crate::rays::RayBatch;
use autograd::{Indices, Real, Tensor};
use glam::{DMat3, DVec3};
use serde::Serialize;

/// Corrections of the poses of some views, without their common motion.
#[derive(Debug)]
pub struct PoseCorrections<T: Real> {
    /// Orthonormal basis of the common motions, `[6 views, k]`, and its transpose.
    gauge: Tensor<T>,
    transposed: Tensor<T>,
    /// ℓ, world length.
    spread: f64,
}

impl<T: Real> PoseCorrections<T> {
    /// Creates the corrections of views.
    pub fn of(views: &[View]) -> Self {
        let positions: Vec<DVec3> = views.iter().map(|view| view.camera.position()).collect();
        let mean = positions.iter().sum::<DVec3>() / positions.len() as f64;
        let square = positions.iter().map(|position| position.distance_squared(mean)).sum::<f64>() / positions.len() as f64;
        // Cameras at one place have rotations only; any length will do.
        let spread = if square > 0.0 { square.sqrt() } else { 1.0 };
        let relative: Vec<DVec3> = positions.iter().map(|&position| (position - mean) / spread).collect();
        let motion = |of_view: &dyn Fn(DVec3) -> [DVec3; 2]| -> Vec<f64> {
            relative.iter().flat_map(|&position| of_view(position)).flat_map(|v| v.to_array()).collect()
        };
        let turns = DVec3::AXES.map(|axis| motion(&|position| [axis, axis.cross(position)]));
        let moves = DVec3::AXES.map(|axis| motion(&|_| [DVec3::ZERO, axis]));
        let scaling = motion(&|position| [DVec3::ZERO, position]);
        let basis = orthonormal(turns.into_iter().chain(moves).chain([scaling]));
        let (rows, k) = (6 * views.len(), basis.len());
        let transposed: Vec<T> = basis.into_iter().flatten().map(T::lit).collect();
        let transposed = Tensor::from_vec(transposed, &[k, rows]);
        PoseCorrections { gauge: transposed.transpose(), transposed, spread }
    }

    /// Returns ω in rad and τ / ℓ of each view, `[views, 6]`, from the learned numbers, `[views, 6]`.
    fn corrections(&self, learned: &Tensor<T>) -> Tensor<T> {
        let all = learned.reshape(&[1, learned.len()]);
        let common = all.matmul(&self.gauge).matmul(&self.transposed);
        (all - common).reshape(learned.shape())
    }

    /// Returns the rays of a batch from the corrected cameras. Gradients flow through them to the learned numbers, `[views, 6]`.
    pub fn rays(&self, learned: &Tensor<T>, batch: &RayBatch<T>) -> TrackedRays<T> {
        let n = batch.len();
        let given = |of_ray: fn(&crate::camera::Ray) -> DVec3| {
            Tensor::from_vec(batch.rays.iter().flat_map(|ray| of_ray(ray).to_array()).map(T::lit).collect(), &[n, 3])
        };
        let of_rays = self.corrections(learned).gather_rows(&Indices::from(batch.view.clone()));
        let origins = given(|ray| ray.origin) + of_rays.narrow(1, 3, 3) * self.spread;
        let directions = rotated(&of_rays.narrow(1, 0, 3), &given(|ray| ray.direction));
        TrackedRays::new(origins, directions, &batch.rays)
    }

    /// Returns the rotation vector ω, rad, and the translation τ, world length, of each view.
    fn by_view(&self, learned: &Tensor<T>) -> Vec<[DVec3; 2]> {
        let corrections = self.corrections(&learned.detach());
        let of_view = |row: &[T]| {
            let [rotation, translation] = [0, 3].map(|first| DVec3::from_array([0, 1, 2].map(|axis| row[first + axis].as_f64())));
            [rotation, translation * self.spread]
        };
        corrections.data().chunks_exact(6).map(of_view).collect()
    }

    /// Returns the corrected cameras of the views.
    pub fn cameras(&self, learned: &Tensor<T>, views: &[View]) -> Vec<Camera> {
        let corrected = |(view, [rotation, translation]): (&View, [DVec3; 2])| {
            let mut camera = view.camera;
            let pose = &mut camera.camera_to_world;
            pose.translation += translation;
            pose.matrix3 = cayley(rotation) * pose.matrix3;
            camera
        };
        views.iter().zip(self.by_view(learned)).map(corrected).collect()
    }

    /// Returns the size of the corrections.
    pub fn figures(&self, learned: &Tensor<T>, views: &[View]) -> PoseFigures {
        let of_view = |(view, [rotation, translation]): (&View, [DVec3; 2])| ViewCorrection {
            name: view.name.clone(),
            degrees: (2.0 * (0.5 * rotation.length()).atan()).to_degrees(),
            translation: translation.length(),
        };
        let views: Vec<ViewCorrection> = views.iter().zip(self.by_view(learned)).map(of_view).collect();
        let mean = |of: fn(&ViewCorrection) -> f64| views.iter().map(of).sum::<f64>() / views.len() as f64;
        PoseFigures { mean_degrees: mean(|view| view.degrees), mean_translation: mean(|view| view.translation), spread: self.spread, views }
    }
}

/// Size of the corrections of the training views' poses.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PoseFigures {
    /// Mean angle of rotation, degrees.
    pub mean_degrees: f64,
    /// Mean length of the translation, world length.
    pub mean_translation: f64,
    /// Root mean square distance of the cameras from their mean position, world length.
    pub spread: f64,
    /// Correction of each training view.
    pub views: Vec<ViewCorrection>,
}

/// Size of the correction of a view's pose.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewCorrection {
    /// Name of the view.
    pub name: String,
    /// Angle of rotation, degrees.
    pub degrees: f64,
    /// Length of the translation, world length.
    pub translation: f64,
}

impl std::fmt::Display for PoseFigures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let share = 100.0 * self.mean_translation / self.spread;
        write!(
            f,
            "mean rotation {:.3}°, mean translation {:.2e} ({share:.2} % of the spread of the cameras)",
            self.mean_degrees, self.mean_translation
        )
    }
}

/// Returns R(ω) d for rotation vectors ω and directions d, `[n, 3]`.
fn rotated<T: Real>(rotations: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
    let half = rotations * 0.5;
    let turned = cross(&half, directions);
    let scale = 2.0 / (half.square().sum_axis(1).unsqueeze(1) + 1.0);
    directions + scale * (&turned + cross(&half, &turned))
}

/// Returns the cross products of the rows of two tensors, `[n, 3]`.
fn cross<T: Real>(x: &Tensor<T>, y: &Tensor<T>) -> Tensor<T> {
    let turned = |tensor: &Tensor<T>| [1, 2].map(|by| Tensor::concat(&[&tensor.narrow(1, by, 3 - by), &tensor.narrow(1, 0, by)], 1));
    let ([x1, x2], [y1, y2]) = (turned(x), turned(y));
    x1 * y2 - x2 * y1
}

/// Returns the matrix R(ω).
fn cayley(rotation: DVec3) -> DMat3 {
    let half = 0.5 * rotation;
    let scale = 2.0 / (1.0 + half.length_squared());
    DMat3::from_cols_array_2d(&DVec3::AXES.map(|d| (d + scale * (half.cross(d) + half.cross(half.cross(d)))).to_array()))
}

/// Returns an orthonormal basis of the span of some vectors, by the Gram-Schmidt process, twice for each vector because of rounding.
fn orthonormal(vectors: impl Iterator<Item = Vec<f64>>) -> Vec<Vec<f64>> {
    let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for mut vector in vectors {
        let before = dot(&vector, &vector).sqrt();
        for other in basis.iter().chain(&basis) {
            let along = dot(&vector, other);
            vector.iter_mut().zip(other).for_each(|(x, y)| *x -= along * y);
        }
        let length = dot(&vector, &vector).sqrt();
        // Vectors that depend on the others, such as the scaling of a single camera, are left out.
        if length > 1e-6 * before {
            vector.iter_mut().for_each(|x| *x /= length);
            basis.push(vector);
        }
    }
    basis
}

#[cfg(test)]
mod tests;
