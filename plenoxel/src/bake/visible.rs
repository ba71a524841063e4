//! Visibility of points from cameras, by depth maps (Williams 1978).

use super::GridSpace;
use crate::camera::{Camera, Intrinsics};
use crate::field::voxel_grid::VoxelGrid;
use crate::field::voxel_grid::fused::largest_weights;
use crate::render::RenderOptions;
use crate::render::picture::picture_by;
use glam::{DAffine3, DVec3};

/// Most cameras, evenly spaced among all.
const MOST_CAMERAS: usize = 100;
/// Most pixels along each side of a depth map.
const MOST_PIXELS: usize = 256;
/// Distance behind a surface up to which a point is visible, in sides of voxels.
const BEHIND: f64 = 2.0;
/// Transmittance below which rays end.
const STOP_BELOW: f64 = 1e-2;
/// Opacity of a pixel that shows a surface.
const OPAQUE: f32 = 0.5;

/// Cameras and their depth maps.
pub struct Sights {
    coordinates: GridSpace,
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
pub fn weights(grid: &VoxelGrid<f32>, coordinates: GridSpace, cameras: &[Camera]) -> Vec<f32> {
    let options = RenderOptions { stop_below: STOP_BELOW, ..coordinates.options(grid, grid.shape().voxel_side()) };
    let rays = small(cameras).map(|camera| {
        let k = camera.intrinsics;
        let pixels = (0..k.width * k.height).map(|p| camera.ray((p % k.width) as f64 + 0.5, (p / k.width) as f64 + 0.5));
        pixels.map(|ray| coordinates.ray(&ray)).collect()
    });
    largest_weights(grid, rays, &options)
}

impl Sights {
    /// Renders the depth maps of a grid.
    pub fn new(grid: &VoxelGrid<f32>, coordinates: GridSpace, cameras: &[Camera]) -> Self {
        let side = grid.shape().voxel_side();
        let options = RenderOptions { stop_below: STOP_BELOW, ..coordinates.options(grid, side) };
        let eyes = small(cameras).map(|camera| Eye::new(&camera, grid, coordinates, &options)).collect();
        Sights { coordinates, eyes, behind: BEHIND * coordinates.step(side) }
    }

    /// Returns the positions of all cameras.
    pub fn cameras(&self) -> impl Iterator<Item = DVec3> {
        self.eyes.iter().map(|eye| eye.position)
    }

    /// Returns the positions of the cameras that see a point of the world.
    pub fn cameras_that_see(&self, point: DVec3) -> Vec<DVec3> {
        let place = |eye: &Eye| {
            let (ray, distance) = GridSpace::sight(eye.position, point);
            self.coordinates.space.place(&ray, distance)
        };
        let sees = |eye: &&Eye| eye.surface(point).is_some_and(|surface| place(eye) <= surface + self.behind);
        self.eyes.iter().filter(sees).map(|eye| eye.position).collect()
    }
}

impl Eye {
    fn new(camera: &Camera, grid: &VoxelGrid<f32>, coordinates: GridSpace, options: &RenderOptions<'_>) -> Self {
        let picture = picture_by(|rays| coordinates.render(grid, rays, options), camera);
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
        let shape =
            GridShape { resolution: 16, half_width: 1.0, interpolation: Interpolation::Trilinear, color: Color::Rgb, sh_reduction: 1 };
        let cube = VoxelGrid::uniform(shape, 100.0, 0.0);
        let eye = DVec3::new(5.0, 0.3, 0.2);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(64, 64, 0.7));
        let sights = Sights::new(&cube, GridSpace::default(), &[camera]);
        assert_eq!(sights.cameras_that_see(DVec3::new(1.1, 0.1, 0.1)), [eye]);
        assert_eq!(sights.cameras_that_see(DVec3::new(0.95, 0.1, 0.1)), [eye]);
        for hidden in [DVec3::ZERO, DVec3::new(-1.0, 0.1, 0.1), DVec3::new(20.0, 0.0, 0.0), DVec3::new(0.0, 5.0, 0.0)] {
            assert!(sights.cameras_that_see(hidden).is_empty(), "{hidden}");
        }
    }
}
