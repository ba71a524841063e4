//! Coordinates of a grid.

use crate::camera::Ray;
use crate::geometry::Aabb;
use crate::sampling::Spacing;
use crate::space::{Space, contract_adjoint};
use glam::{DVec3, dvec3};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::borrow::Cow;

/// Coordinates q of a grid: q = stretch ∘ p with p in the box of a [`Space`]. The voxels of a grid are cubes in q.
///
/// The cells of a field in normalized device coordinates are longer along the depth: there the stretch is (1, 1, k), elsewhere it is 1. A ray has the
/// t of the box ([`Samples`](crate::sampling::Samples)), and the density is that per length of the box, so that the opacity of a sample is that of the
/// field. The harmonics of a color are those of the direction stretch ∘ d, where d is the unit direction of the ray in the box.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GridSpace {
    /// Space of the box.
    pub space: Space,
    /// Factor of each axis.
    #[serde(with = "numbers")]
    pub stretch: DVec3,
}

mod numbers {
    use super::*;

    pub fn serialize<S: Serializer>(v: &DVec3, serializer: S) -> Result<S::Ok, S::Error> {
        v.to_array().serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DVec3, D::Error> {
        <[f64; 3]>::deserialize(deserializer).map(DVec3::from)
    }
}

impl Default for GridSpace {
    fn default() -> Self {
        Self::WORLD
    }
}

/// Distance of voxels from the faces of the box that are at infinity, if they are nearer or beyond.
const INFINITY: f64 = 1e-4;

impl GridSpace {
    /// The coordinates of the world.
    pub const WORLD: Self = GridSpace { space: Space::Box, stretch: DVec3::ONE };

    /// Returns the coordinates in which cells with these sides are cubes, up to the roundings of their numbers.
    pub(crate) fn of(space: Space, sides: DVec3) -> Self {
        let depth = if matches!(space, Space::Ndc { .. }) { 0.5 * (sides.x + sides.y) / sides.z } else { 1.0 };
        GridSpace { space, stretch: DVec3::new(1.0, 1.0, depth) }
    }

    /// Returns the box with these corners in the grid, in the coordinates of the space.
    pub(crate) fn unstretched(&self, aabb: Aabb) -> Aabb {
        Aabb { min: aabb.min / self.stretch, max: aabb.max / self.stretch }
    }

    /// Returns a position of the grid in the coordinates of the space.
    pub fn to_box(&self, q: DVec3) -> DVec3 {
        q / self.stretch
    }

    /// Returns a position of the grid in the world. Positions at infinity and beyond are moved before it.
    pub fn to_world(&self, q: DVec3) -> DVec3 {
        let p = self.to_box(q);
        let finite = match self.space {
            Space::Box => p,
            Space::Contracted => p.clamp(DVec3::splat(INFINITY - Space::CONTRACTED), DVec3::splat(Space::CONTRACTED - INFINITY)),
            Space::Ndc { .. } => p.with_z(p.z.min(1.0 - INFINITY)),
        };
        self.space.to_world(finite).unwrap_or(finite)
    }

    /// Returns the gradient in the world of a function of the grid, given its gradient g at a position q of the grid: Jᵀ g with the Jacobian J of q over the
    /// position in the world.
    pub(crate) fn gradient_in_world(&self, q: DVec3, g: DVec3) -> DVec3 {
        let (x, g) = (self.to_world(q), self.stretch * g);
        match self.space {
            Space::Box => g,
            Space::Contracted => contract_adjoint(x, g),
            Space::Ndc { a, b } => dvec3(-a * g.x / x.z, -b * g.y / x.z, (a * x.x * g.x + b * x.y * g.y - 2.0 * g.z) / (x.z * x.z)),
        }
    }

    /// Returns a ray of the world in the coordinates of the grid. Its direction is not a unit vector if the stretch is not 1.
    pub fn ray(&self, ray: &Ray) -> Ray {
        let ray = self.space.ray(ray);
        Ray { origin: self.stretch * ray.origin, direction: self.stretch * ray.direction, ..ray }
    }

    /// Returns rays of the world as [`ray`](Self::ray) does.
    pub fn rays<'a>(&self, rays: &'a [Ray]) -> Cow<'a, [Ray]> {
        match self.space {
            Space::Box | Space::Contracted => Cow::Borrowed(rays),
            Space::Ndc { .. } => Cow::Owned(rays.iter().map(|ray| self.ray(ray)).collect()),
        }
    }

    /// Returns the t between the samples of a ray along the depth whose distance in the grid is `length`.
    pub fn step(&self, length: f64) -> f64 {
        length / self.stretch.z
    }

    /// Returns the spacing of samples whose distance in the grid is `length`.
    pub fn spacing(&self, length: f64) -> Spacing {
        Spacing::even(self.space, self.step(length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_in_the_world_are_those_of_finite_differences() {
        let spaces = [
            GridSpace::WORLD,
            GridSpace { space: Space::Contracted, ..GridSpace::WORLD },
            GridSpace { space: Space::Ndc { a: 1.6, b: 2.1 }, stretch: dvec3(1.0, 1.0, 0.3) },
        ];
        let g = dvec3(0.7, -1.1, 0.4);
        for coordinates in spaces {
            for x in [dvec3(0.3, -0.2, -1.4), dvec3(-2.5, 0.8, -3.0), dvec3(0.4, 5.0, -2.0)] {
                let in_grid = |x: DVec3| coordinates.stretch * coordinates.space.to_box(x);
                let found = coordinates.gradient_in_world(in_grid(x), g);
                for axis in 0..3 {
                    let step = 1e-5 * DVec3::AXES[axis];
                    let want = g.dot(in_grid(x + step) - in_grid(x - step)) / 2e-5;
                    assert!((found[axis] - want).abs() < 1e-7, "{coordinates:?} at {x}, axis {axis}: {} instead of {want}", found[axis]);
                }
            }
        }
    }
}
