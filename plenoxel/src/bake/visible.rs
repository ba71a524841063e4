//! Visibility of points from cameras, by depth maps (Williams 1978).

use crate::camera::{Camera, Intrinsics};
use crate::field::voxel_grid::VoxelGrid;
use crate::render::picture::picture;
use crate::render::{Engine, RenderOptions};
use crate::sampling::{Jitter, Spacing};
use glam::{DAffine3, DVec3};

/// Most cameras, evenly spaced among all.
const MOST_CAMERAS: usize = 100;
/// Most pixels along each side of a depth map.
const MOST_PIXELS: usize = 256;
/// Distance behind a surface up to which a point is visible, in sides of voxels.
const BEHIND: f64 = 2.0;
/// Opacity of a pixel that shows a surface.
const OPAQUE: f32 = 0.5;

/// Cameras and their depth maps.
pub struct Sights {
    eyes: Vec<Eye>,
    /// Distance behind a surface up to which a point is visible, world length.
    behind: f64,
}

struct Eye {
    position: DVec3,
    world_to_camera: DAffine3,
    intrinsics: Intrinsics,
    /// Distance of the surface along the ray of each pixel; infinite for transparent pixels.
    distance: Vec<f32>,
}

impl Sights {
    /// Renders the depth maps of a grid.
    pub fn new(grid: &VoxelGrid<f32>, cameras: &[Camera]) -> Self {
        let options = RenderOptions {
            aabb: grid.aabb(),
            spacing: Spacing::Step(grid.shape().voxel_side()),
            jitter: Jitter::None,
            background: [0.0; 3],
            occupancy: None,
            engine: Engine::Fused,
            stop_below: 1e-2,
        };
        let n = cameras.len().min(MOST_CAMERAS);
        let eyes = (0..n).map(|i| Eye::new(&cameras[i * cameras.len() / n], grid, &options)).collect();
        Sights { eyes, behind: BEHIND * grid.shape().voxel_side() }
    }

    /// Returns the positions of all cameras.
    pub fn cameras(&self) -> impl Iterator<Item = DVec3> {
        self.eyes.iter().map(|eye| eye.position)
    }

    /// Returns the positions of the cameras that see a point.
    pub fn cameras_that_see(&self, point: DVec3) -> Vec<DVec3> {
        let sees = |eye: &&Eye| eye.surface(point).is_some_and(|surface| (point - eye.position).length() <= surface + self.behind);
        self.eyes.iter().filter(sees).map(|eye| eye.position).collect()
    }
}

impl Eye {
    fn new(camera: &Camera, grid: &VoxelGrid<f32>, options: &RenderOptions<'_>) -> Self {
        let longest = camera.intrinsics.width.max(camera.intrinsics.height);
        let small = Camera { intrinsics: camera.intrinsics.downscaled(longest.div_ceil(MOST_PIXELS)), ..*camera };
        let picture = picture(grid, &small, options);
        let of_pixel = |(&depth, &opacity): (&f32, &f32)| if opacity > OPAQUE { depth / opacity } else { f32::INFINITY };
        Eye {
            position: camera.position(),
            world_to_camera: camera.camera_to_world.inverse(),
            intrinsics: small.intrinsics,
            distance: picture.depth.iter().zip(&picture.opacity).map(of_pixel).collect(),
        }
    }

    /// Returns the distance of the surface in the direction of a point; `None` if the point is outside of the image.
    fn surface(&self, point: DVec3) -> Option<f64> {
        let k = &self.intrinsics;
        let (x, y, _) = k.project(self.world_to_camera.transform_point3(point))?;
        let inside = (0.0..k.width as f64).contains(&x) && (0.0..k.height as f64).contains(&y);
        inside.then(|| f64::from(self.distance[y as usize * k.width + x as usize]))
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
        let sights = Sights::new(&cube, &[camera]);
        assert_eq!(sights.cameras_that_see(DVec3::new(1.1, 0.1, 0.1)), [eye]);
        assert_eq!(sights.cameras_that_see(DVec3::new(0.95, 0.1, 0.1)), [eye]);
        for hidden in [DVec3::ZERO, DVec3::new(-1.0, 0.1, 0.1), DVec3::new(20.0, 0.0, 0.0), DVec3::new(0.0, 5.0, 0.0)] {
            assert!(sights.cameras_that_see(hidden).is_empty(), "{hidden}");
        }
    }
}
