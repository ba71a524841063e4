//! Visibility of points from cameras, by depth maps (Williams 1978); weights of voxels in the pictures of cameras; and the point that a camera looks at.

use crate::camera::{Camera, Intrinsics, Ray};
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::largest_weights;
use crate::render::picture::picture_by;
use crate::render::{Engine, RenderOptions, Rendered, render};
use crate::sampling::{Jitter, Occupancy};
use crate::space::Space;
use glam::{DAffine3, DVec3};

/// Most cameras, evenly spaced among all.
const MOST_CAMERAS: usize = 100;
/// Most pixels along each side of a depth map.
const MOST_PIXELS: usize = 256;
/// Distance behind a surface up to which a point is visible, in sides of voxels.
const BEHIND: f64 = 2.0;
/// Transmittance below which rays of depth maps end.
const STOP_BELOW: f64 = 1e-2;
/// Transmittance below which rays of [`focus`] end.
const STOP_FOCUS_BELOW: f64 = 1e-4;
/// Opacity of a pixel that shows a surface.
const OPAQUE: f32 = 0.5;

/// Returns options for rendering a grid with steps of a voxel, without jitter.
fn options(grid: &VoxelGrid<f32>, stop_below: f64) -> RenderOptions<'static> {
    RenderOptions {
        aabb: grid.aabb(),
        spacing: grid.shape().coordinates.spacing(grid.shape().voxel_side()),
        jitter: Jitter::None,
        background: [0.0; 3],
        occupancy: None,
        engine: Engine::Fused,
        stop_below,
    }
}

/// Renders rays of the world through a grid.
fn see(grid: &VoxelGrid<f32>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<f32> {
    render(grid, &grid.shape().coordinates.rays(rays), options)
}

/// Returns the ray of the world from a point to another, and their distance.
pub fn sight(from: DVec3, to: DVec3) -> (Ray, f64) {
    let distance = from.distance(to);
    (Ray { origin: from, direction: (to - from).normalize_or(DVec3::Z), stretch: 1.0 }, distance)
}

/// Returns the distance in the world from a camera to what it looks at: to the surface at the principal point, or the median over points around it. `matter` is
/// that of the grid. `None` if there is no surface.
pub fn focus(grid: &VoxelGrid<f32>, matter: &Occupancy, camera: &Camera) -> Option<f64> {
    const AROUND: i32 = 2;
    let k = &camera.intrinsics;
    let apart = 0.05 * k.width.min(k.height) as f64;
    let at = |i: i32, middle: f64| middle + f64::from(i) * apart;
    let rays: Vec<Ray> = (-AROUND..=AROUND)
        .flat_map(|y| (-AROUND..=AROUND).map(move |x| (x, y)))
        .map(|(x, y)| camera.ray(at(x, 0.5 * k.width as f64), at(y, 0.5 * k.height as f64)))
        .collect();
    let options = RenderOptions { occupancy: Some(matter), ..options(grid, STOP_FOCUS_BELOW) };
    let seen = autograd::no_grad(|| see(grid, &rays, &options));
    let (depth, opacity, space) = (seen.depth(), seen.opacity.data().to_vec(), grid.shape().coordinates.space);
    let surface = |((ray, &depth), &opacity): ((&Ray, &f32), &f32)| {
        (opacity > OPAQUE).then(|| space.distance(ray, f64::from(depth / opacity))).filter(|distance| distance.is_finite())
    };
    let mut found: Vec<f64> = rays.iter().zip(depth.data()).zip(&opacity).filter_map(surface).collect();
    found.sort_by(f64::total_cmp);
    found.get(found.len() / 2).copied()
}

/// Cameras and their depth maps.
pub struct Sights {
    space: Space,
    eyes: Vec<Eye>,
    /// t behind a surface up to which a point is visible.
    behind: f64,
}

struct Eye {
    position: DVec3,
    world_to_camera: DAffine3,
    intrinsics: Intrinsics,
    /// t of the surface along the ray of each pixel; infinite for transparent pixels.
    surface: Vec<f32>,
}

/// Returns small cameras for depth maps.
fn small(cameras: &[Camera]) -> impl Iterator<Item = Camera> + '_ {
    let n = cameras.len().min(MOST_CAMERAS);
    (0..n).map(move |i| {
        let camera = &cameras[i * cameras.len() / n];
        let longest = camera.intrinsics.width.max(camera.intrinsics.height);
        Camera { intrinsics: camera.intrinsics.downscaled(longest.div_ceil(MOST_PIXELS)), ..*camera }
    })
}

/// Returns the largest rendering weight of each row of a grid in pictures of the cameras.
pub fn weights(grid: &VoxelGrid<f32>, cameras: &[Camera]) -> Vec<f32> {
    let (coordinates, options) = (grid.shape().coordinates, options(grid, STOP_BELOW));
    let rays = small(cameras).map(|camera| {
        let k = camera.intrinsics;
        let pixels = (0..k.width * k.height).map(|p| camera.ray((p % k.width) as f64 + 0.5, (p / k.width) as f64 + 0.5));
        pixels.map(|ray| coordinates.ray(&ray)).collect()
    });
    largest_weights(grid, rays, &options)
}

impl Sights {
    /// Renders the depth maps of a grid.
    pub fn new(grid: &VoxelGrid<f32>, cameras: &[Camera]) -> Self {
        let (coordinates, options) = (grid.shape().coordinates, options(grid, STOP_BELOW));
        let eyes = small(cameras).map(|camera| Eye::new(&camera, grid, &options)).collect();
        Sights { space: coordinates.space, eyes, behind: BEHIND * coordinates.step(grid.shape().voxel_side()) }
    }

    /// Returns the positions of all cameras.
    pub fn cameras(&self) -> impl Iterator<Item = DVec3> {
        self.eyes.iter().map(|eye| eye.position)
    }

    /// Returns the positions of the cameras that see a point of the world.
    pub fn cameras_that_see(&self, point: DVec3) -> Vec<DVec3> {
        let place = |eye: &Eye| {
            let (ray, distance) = sight(eye.position, point);
            self.space.place(&ray, distance)
        };
        let sees = |eye: &&Eye| eye.surface(point).is_some_and(|surface| place(eye) <= surface + self.behind);
        self.eyes.iter().filter(sees).map(|eye| eye.position).collect()
    }
}

impl Eye {
    fn new(camera: &Camera, grid: &VoxelGrid<f32>, options: &RenderOptions<'_>) -> Self {
        let picture = picture_by(|rays| see(grid, rays, options), camera);
        let of_pixel = |(&depth, &opacity): (&f32, &f32)| if opacity > OPAQUE { depth / opacity } else { f32::INFINITY };
        Eye {
            position: camera.position(),
            world_to_camera: camera.camera_to_world.inverse(),
            intrinsics: camera.intrinsics,
            surface: picture.depth.iter().zip(&picture.opacity).map(of_pixel).collect(),
        }
    }

    /// Returns the t of the surface in the direction of a point of the world; `None` if the point is outside of the image.
    fn surface(&self, point: DVec3) -> Option<f64> {
        let k = &self.intrinsics;
        let (x, y, _) = k.project(self.world_to_camera.transform_point3(point))?;
        let inside = (0.0..k.width as f64).contains(&x) && (0.0..k.height as f64).contains(&y);
        inside.then(|| f64::from(self.surface[y as usize * k.width + x as usize]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::voxel_grid::{Color, GridShape, Interpolation};

    #[test]
    fn a_camera_sees_the_near_side_of_a_cube_only() {
        let shape = GridShape::new(16, 1.0, Interpolation::Trilinear, Color::Rgb);
        let cube = VoxelGrid::uniform(shape, 100.0, 0.0);
        let eye = DVec3::new(5.0, 0.3, 0.2);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(64, 64, 0.7));
        let sights = Sights::new(&cube, &[camera]);
        assert_eq!(sights.cameras_that_see(DVec3::new(1.1, 0.1, 0.1)), [eye]);
        assert_eq!(sights.cameras_that_see(DVec3::new(0.95, 0.1, 0.1)), [eye]);
        for hidden in [DVec3::ZERO, DVec3::new(-1.0, 0.1, 0.1), DVec3::new(20.0, 0.0, 0.0), DVec3::new(0.0, 5.0, 0.0)] {
            assert!(sights.cameras_that_see(hidden).is_empty(), "{hidden}");
        }
    }
}
