//! Coordinates of a baked grid, and rendering in them.

use crate::camera::{Camera, Ray};
use crate::field::voxel_grid::VoxelGrid;
use crate::geometry::Aabb;
use crate::render::{Engine, RenderOptions, Rendered, render};
use crate::sampling::{Jitter, Occupancy, Spacing};
use crate::space::Space;
use glam::DVec3;
use serde::{Serialize, Serializer};

/// Coordinates q of a grid: q = stretch ∘ p with p in the box of a [`Space`]. The voxels of a grid are cubes in q.
///
/// The cells of a field in normalized device coordinates are longer along the depth: there the stretch is (1, 1, k) with k < 1, elsewhere it is 1. A ray has the
/// t of the box ([`Samples`](crate::sampling::Samples)), and the density is that per length of the box, so that the opacity of a sample is that of the
/// field. The harmonics of a color are those of the direction stretch ∘ d, where d is the unit direction of the ray in the box.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GridSpace {
    /// Space of the box.
    pub space: Space,
    /// Factor of each axis.
    #[serde(serialize_with = "numbers")]
    pub stretch: DVec3,
}

fn numbers<S: Serializer>(v: &DVec3, serializer: S) -> Result<S::Ok, S::Error> {
    v.to_array().serialize(serializer)
}

impl Default for GridSpace {
    /// The world.
    fn default() -> Self {
        GridSpace { space: Space::Box, stretch: DVec3::ONE }
    }
}

/// Distance of voxels from the faces of the box that are at infinity, if they are nearer or beyond.
const INFINITY: f64 = 1e-4;
/// Transmittance below which rays end.
const STOP_BELOW: f64 = 1e-4;

impl GridSpace {
    /// Returns the coordinates in which cells with these sides are cubes, up to the roundings of their numbers.
    pub(super) fn of(space: Space, sides: DVec3) -> Self {
        let depth = if matches!(space, Space::Ndc { .. }) { 0.5 * (sides.x + sides.y) / sides.z } else { 1.0 };
        GridSpace { space, stretch: DVec3::new(1.0, 1.0, depth) }
    }

    /// Returns the box with these corners in the grid, in the coordinates of the space.
    pub(super) fn unstretched(&self, aabb: Aabb) -> Aabb {
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

    /// Returns a ray of the world in the coordinates of the grid. Its direction is not a unit vector if the stretch is not 1.
    pub fn ray(&self, ray: &Ray) -> Ray {
        let ray = self.space.ray(ray);
        Ray { origin: self.stretch * ray.origin, direction: self.stretch * ray.direction, ..ray }
    }

    /// Returns the ray of the world from a point to another, and their distance.
    pub fn sight(from: DVec3, to: DVec3) -> (Ray, f64) {
        let distance = from.distance(to);
        (Ray { origin: from, direction: (to - from).normalize_or(DVec3::Z), stretch: 1.0 }, distance)
    }

    /// Returns the t between the samples of a ray along the depth whose distance in the grid is `length`.
    pub fn step(&self, length: f64) -> f64 {
        length / self.stretch.z
    }

    /// Returns options for rendering a grid with steps of `length` in the grid, without jitter.
    pub fn options(&self, grid: &VoxelGrid<f32>, length: f64) -> RenderOptions<'static> {
        RenderOptions {
            aabb: grid.aabb(),
            spacing: Spacing::even(self.space, self.step(length)),
            jitter: Jitter::None,
            background: [0.0; 3],
            occupancy: None,
            engine: Engine::Fused,
            stop_below: STOP_BELOW,
        }
    }

    /// Renders rays of the world through a grid, with `options` of [`options`](Self::options).
    pub fn render(&self, grid: &VoxelGrid<f32>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<f32> {
        let rays: Vec<Ray> = rays.iter().map(|ray| self.ray(ray)).collect();
        render(grid, &rays, options)
    }

    /// Returns a function that renders rays of the world through a grid over a background, with steps of `length` in the grid.
    pub fn show<'a>(
        &self,
        grid: &'a VoxelGrid<f32>,
        length: f64,
        background: [f32; 3],
    ) -> impl Fn(&[Ray]) -> Rendered<f32> + Sync + use<'a> {
        let (coordinates, matter) = (*self, grid.matter());
        let options = RenderOptions { background, ..self.options(grid, length) };
        move |rays| coordinates.render(grid, rays, &RenderOptions { occupancy: Some(&matter), ..options.clone() })
    }

    /// Returns the distance from a camera to what it looks at: to the surface at the principal point, or the median over points around it. `None` if
    /// there is no surface.
    pub fn focus(&self, grid: &VoxelGrid<f32>, matter: &Occupancy, camera: &Camera) -> Option<f64> {
        const AROUND: i32 = 2;
        let k = &camera.intrinsics;
        let apart = 0.05 * k.width.min(k.height) as f64;
        let at = |i: i32, middle: f64| middle + f64::from(i) * apart;
        let rays: Vec<Ray> = (-AROUND..=AROUND)
            .flat_map(|y| (-AROUND..=AROUND).map(move |x| (x, y)))
            .map(|(x, y)| camera.ray(at(x, 0.5 * k.width as f64), at(y, 0.5 * k.height as f64)))
            .collect();
        let options = RenderOptions { occupancy: Some(matter), ..self.options(grid, grid.shape().voxel_side()) };
        let seen = autograd::no_grad(|| self.render(grid, &rays, &options));
        let (depth, opacity) = (seen.depth(), seen.opacity.data().to_vec());
        let surface = |((ray, &depth), &opacity): ((&Ray, &f32), &f32)| {
            (opacity > 0.5).then(|| self.space.distance(ray, f64::from(depth / opacity))).filter(|distance| distance.is_finite())
        };
        let mut found: Vec<f64> = rays.iter().zip(depth.data()).zip(&opacity).filter_map(surface).collect();
        found.sort_by(f64::total_cmp);
        found.get(found.len() / 2).copied()
    }
}
