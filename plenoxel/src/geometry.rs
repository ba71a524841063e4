//! Geometry of rays, grids and frames: the axis-aligned box, and the similarity.

use glam::{DAffine3, DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Axis-aligned box in world coordinates, including its faces.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aabb {
    /// Corner with the smallest coordinates.
    pub min: DVec3,
    /// Corner with the largest coordinates.
    pub max: DVec3,
}

impl Aabb {
    /// Returns the cube from -`half_width` to `half_width` on every axis.
    pub fn cube(half_width: f64) -> Self {
        Aabb { min: DVec3::splat(-half_width), max: DVec3::splat(half_width) }
    }

    /// Returns the number of grid nodes along each axis, with nodes on the faces, at which the box has about as many cells as a cube of `resolution` nodes
    /// along each axis, with about equal sides.
    pub fn nodes(&self, resolution: usize) -> [usize; 3] {
        let side = self.volume().cbrt() / (resolution - 1) as f64;
        ((self.max - self.min) / side).to_array().map(|cells| cells.round().max(1.0) as usize + 1)
    }

    /// Returns the volume.
    pub fn volume(&self) -> f64 {
        (self.max - self.min).element_product()
    }

    /// Returns true for points inside or on a face.
    pub fn contains(&self, point: DVec3) -> bool {
        point.cmpge(self.min).all() && point.cmple(self.max).all()
    }

    /// Returns the interval of the ray `origin + t direction`, t >= 0, inside the box: `Some((t_enter, t_exit))` with 0 <= t_enter <=
    /// t_exit, or `None` if the ray misses the box or the box is behind it. t is in units of the direction's length.
    ///
    /// Slab test (Kay and Kajiya 1986). A direction component of zero is not divided by: such a ray is in that slab for every t or for
    /// none.
    pub fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<(f64, f64)> {
        let (mut enter, mut exit) = (0.0_f64, f64::INFINITY);
        for axis in 0..3 {
            let (o, d, min, max) = (origin[axis], direction[axis], self.min[axis], self.max[axis]);
            if d == 0.0 {
                if o < min || o > max {
                    return None;
                }
                continue;
            }
            let (a, b) = ((min - o) / d, (max - o) / d);
            enter = enter.max(a.min(b));
            exit = exit.min(a.max(b));
        }
        // A zero direction inside the box would leave the exit infinite; it is not a ray.
        (enter <= exit && exit.is_finite()).then_some((enter, exit))
    }
}

/// Similarity p ↦ s R p + t: rotation, scale and translation. In files, it is the 3 x 4 matrix (s R | t).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(into = "[[f64; 4]; 3]", try_from = "[[f64; 4]; 3]")]
pub struct Similarity {
    /// s, positive.
    pub scale: f64,
    /// R, a rotation.
    pub rotation: DMat3,
    /// t.
    pub translation: DVec3,
}

impl Default for Similarity {
    /// The identity.
    fn default() -> Self {
        Similarity { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO }
    }
}

impl Similarity {
    /// Returns the similarity that moves `center` to the origin, then rotates and scales.
    pub fn about(center: DVec3, rotation: DMat3, scale: f64) -> Self {
        Similarity { scale, rotation, translation: -scale * (rotation * center) }
    }

    /// Returns the image of a point.
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.scale * (self.rotation * p) + self.translation
    }

    /// Returns the image of a camera: its position is mapped, and its axes are rotated.
    pub fn camera(&self, camera_to_world: DAffine3) -> DAffine3 {
        DAffine3 { matrix3: self.rotation * camera_to_world.matrix3, translation: self.point(camera_to_world.translation) }
    }

    /// Returns the inverse, p ↦ Rᵀ (p - t) / s.
    pub fn inverse(&self) -> Self {
        Similarity::about(self.translation, self.rotation.transpose(), 1.0 / self.scale)
    }
}

impl From<Similarity> for [[f64; 4]; 3] {
    fn from(of: Similarity) -> Self {
        let rows = (of.scale * of.rotation).transpose();
        [0, 1, 2].map(|i| {
            let row = rows.col(i);
            [row.x, row.y, row.z, of.translation[i]]
        })
    }
}

impl TryFrom<[[f64; 4]; 3]> for Similarity {
    type Error = &'static str;

    fn try_from(rows: [[f64; 4]; 3]) -> Result<Self, Self::Error> {
        let scaled = DMat3::from_cols_array_2d(&rows.map(|[x, y, z, _]| [x, y, z])).transpose();
        let scale = scaled.determinant().cbrt();
        let rotation = scaled * scale.recip();
        let error = rotation.transpose() * rotation - DMat3::IDENTITY;
        let translation = DVec3::from_array(rows.map(|row| row[3]));
        // Not a number is not near either.
        let near = error.to_cols_array().into_iter().all(|value| value.abs() < 1e-6);
        if scale > 0.0 && near && translation.is_finite() {
            Ok(Similarity { scale, rotation, translation })
        } else {
            Err("expected a similarity, a 3 x 4 matrix of a rotation, a positive scale and a translation")
        }
    }
}

/// Computes eigenvalues and unit eigenvectors of a symmetric matrix, the smallest value first, with Jacobi rotations (Golub and Van Loan,
/// 8.5). Each rotation makes one off-diagonal entry 0. Convergence is quadratic, so a few sweeps reach the precision of `f64`.
pub(crate) fn eigen(mut a: DMat3) -> [(f64, DVec3); 3] {
    const SWEEPS: usize = 12;
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = a.col(q)[p];
            if off == 0.0 {
                continue;
            }
            let theta = (a.col(q)[q] - a.col(p)[p]) / (2.0 * off);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let mut rotation = DMat3::IDENTITY;
            rotation.col_mut(p)[p] = c;
            rotation.col_mut(q)[q] = c;
            rotation.col_mut(q)[p] = s;
            rotation.col_mut(p)[q] = -s;
            a = rotation.transpose() * a * rotation;
            vectors *= rotation;
        }
    }
    let mut pairs = [0, 1, 2].map(|i| (a.col(i)[i], vectors.col(i)));
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, uniform};

    #[test]
    fn a_similarity_survives_being_written_and_read_and_others_are_refused() {
        let rotation = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 0.8);
        let of = Similarity::about(DVec3::new(3.0, -1.0, 2.0), rotation, 0.25);
        let again: Similarity = serde_json::from_str(&serde_json::to_string(&of).unwrap()).unwrap();
        let p = DVec3::new(0.3, 5.0, -2.0);
        assert!((again.point(p) - of.point(p)).length() < 1e-12 && (again.scale - 0.25).abs() < 1e-15);
        assert!((of.inverse().point(of.point(p)) - p).length() < 1e-12);
        for rows in [
            "[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
            "[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
            "[[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]",
            "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
        ] {
            assert!(serde_json::from_str::<Similarity>(rows).is_err(), "{rows}");
        }
    }

    #[test]
    fn eigenvectors_of_a_symmetric_matrix_are_orthonormal_and_put_it_together_again() {
        for seed in 0..200 {
            let number = |i| 2.0 * uniform(seed, Purpose::Initial, 0, i) - 1.0;
            // Every fourth matrix is singular.
            let half = DMat3::from_cols(
                DVec3::new(number(0), number(1), number(2)),
                DVec3::new(number(3), number(4), number(5)),
                if seed % 4 == 0 { DVec3::ZERO } else { DVec3::new(number(6), number(7), number(8)) },
            );
            let a = half * half.transpose();
            let pairs = eigen(a);
            assert!(pairs.is_sorted_by(|a, b| a.0 <= b.0));
            let [values, vectors] =
                [DMat3::from_diagonal(pairs.map(|(value, _)| value).into()), DMat3::from_cols_array_2d(&pairs.map(|(_, v)| v.into()))];
            let again = vectors * values * vectors.transpose();
            assert!(again.abs_diff_eq(a, 1e-14) && (vectors.transpose() * vectors).abs_diff_eq(DMat3::IDENTITY, 1e-14), "seed {seed}");
        }
    }

    #[test]
    fn ray_from_outside_enters_and_leaves() {
        let t = Aabb::cube(1.5).intersect(DVec3::new(-4.0, 0.5, 0.0), DVec3::X);
        assert_eq!(t, Some((2.5, 5.5))); // -4 + 2.5 = -1.5 and -4 + 5.5 = 1.5
        let diagonal = Aabb::cube(1.0).intersect(DVec3::splat(2.0), DVec3::splat(-1.0).normalize()).unwrap();
        // From corner (1,1,1), sqrt(3) away, to corner (-1,-1,-1), 3 sqrt(3) away.
        assert!((diagonal.0 - 3f64.sqrt()).abs() < 1e-12 && (diagonal.1 - 3.0 * 3f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn ray_from_inside_starts_at_zero() {
        assert_eq!(Aabb::cube(1.0).intersect(DVec3::ZERO, DVec3::NEG_Z), Some((0.0, 1.0)));
    }

    #[test]
    fn ray_that_misses_or_looks_away_finds_nothing() {
        let cube = Aabb::cube(1.0);
        assert_eq!(cube.intersect(DVec3::new(-4.0, 1.2, 0.0), DVec3::X), None);
        assert_eq!(cube.intersect(DVec3::new(-4.0, 0.0, 0.0), DVec3::NEG_X), None);
        assert_eq!(cube.intersect(DVec3::new(-4.0, 0.0, 0.0), DVec3::new(1.0, 1.0, 0.0).normalize()), None);
    }

    #[test]
    fn zero_components_and_negative_zero_do_not_divide() {
        let cube = Aabb::cube(1.0);
        assert_eq!(cube.intersect(DVec3::new(1.0, 1.0, -3.0), DVec3::new(0.0, -0.0, 1.0)), Some((2.0, 4.0)));
        assert_eq!(cube.intersect(DVec3::new(1.0 + 1e-12, 0.0, -3.0), DVec3::new(-0.0, 0.0, 1.0)), None);
        assert_eq!(cube.intersect(DVec3::ZERO, DVec3::ZERO), None);
    }

    #[test]
    fn faces_belong_to_the_box() {
        let cube = Aabb::cube(1.0);
        assert!(cube.contains(DVec3::new(1.0, -1.0, 0.0)) && !cube.contains(DVec3::new(1.0 + 1e-9, 0.0, 0.0)));
        assert!(!cube.contains(DVec3::new(f64::NAN, 0.0, 0.0)));
    }
}
