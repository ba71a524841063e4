//! The still life: objects, light and rendering.
//!
//! It contains details that are easy and hard for voxel fields: stripes and checkers near the size of a voxel, dark and bright paint, rods
//! and rings about one pixel thick, hollows that no silhouette shows (a bowl, dimples in a block), and glossy spheres whose view-dependent
//! color is smooth enough for spherical harmonics of degree 2. World z is up. All objects lie within 1.3 of the origin. The light is the
//! same in every image and is not part of the geometry.

use super::bounds::Bounds;
use super::paint::sky_color;
use super::solid::Hit;
use super::still_life::{Object, objects};
use crate::camera::{Camera, Ray};
use crate::dataset::image::RgbaImage;
use glam::{DVec3, dvec3};
use ndarray::Array2;
use rayon::prelude::*;

/// Offset of a shadow ray from its surface.
const OFFSET: f64 = 1e-6;

/// Analytic scene: painted solids under a fixed light.
#[derive(Debug, Clone)]
pub struct Scene {
    objects: Vec<Object>,
    bounds: Bounds,
    /// Bit set of the objects that can shade others. The table cannot: it is convex and below everything else.
    casters: u32,
}

/// Surface point hit by a ray, and its object.
#[derive(Debug, Clone, Copy)]
struct Surface {
    hit: Hit,
    object: usize,
}

impl Scene {
    /// Creates the built-in still life.
    pub fn still_life() -> Self {
        let objects = objects();
        let casters = objects.iter().enumerate().filter(|(_, object)| object.casts).fold(0, |bits, (k, _)| bits | 1 << k);
        Scene { bounds: Bounds::new(&objects), casters, objects }
    }

    /// Returns the signed distance from `point` to the nearest surface, negative inside solid matter. The sign is exact. Outside, the value
    /// never exceeds the true distance.
    pub fn distance(&self, point: DVec3) -> f64 {
        self.objects.iter().map(|object| object.solid.distance(point)).fold(f64::INFINITY, f64::min)
    }

    /// Returns true inside solid matter.
    pub fn occupied(&self, point: DVec3) -> bool {
        self.distance(point) < 0.0
    }

    /// Returns true in a hole of a solid: in the bowl, and in the dimples of the block.
    pub fn in_hollow(&self, point: DVec3) -> bool {
        !self.occupied(point) && self.objects.iter().any(|object| object.solid.in_hollow(point))
    }

    /// Returns the distance along the unit ray to the first surface; infinite if there is none.
    pub fn depth(&self, ray: &Ray) -> f64 {
        self.first(ray.origin, ray.direction, u32::MAX).map_or(f64::INFINITY, |surface| surface.hit.t)
    }

    /// Returns the color in [0, 1] (as stored in an image) of the first surface along the ray; `None` if there is none. The color of glossy
    /// surfaces depends on the direction.
    pub fn color(&self, ray: &Ray) -> Option<[f64; 3]> {
        self.first(ray.origin, ray.direction, u32::MAX).map(|surface| self.shade(&surface, ray.origin, ray.direction).to_array())
    }

    /// Renders the image of `camera` with `supersample` x `supersample` rays per pixel, and the exact depth along the ray of each pixel's
    /// centre, [height, width], infinite if it hits nothing.
    ///
    /// Alpha is the fraction of rays that hit a surface. Color is the mean over these rays, so alpha is straight.
    pub fn render(&self, camera: &Camera, supersample: usize) -> (RgbaImage, Array2<f32>) {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let mut pixels = vec![0_u8; 4 * width * height];
        let mut depth = vec![f32::INFINITY; width * height];
        let rows = pixels.par_chunks_mut(4 * width).zip(depth.par_chunks_mut(width)).enumerate();
        rows.for_each(|(j, (pixels, depth))| {
            for i in 0..width {
                let candidates = self.candidates(camera, i, j);
                if candidates == 0 {
                    continue;
                }
                let center = camera.ray(i as f64 + 0.5, j as f64 + 0.5);
                if let Some(surface) = self.first(center.origin, center.direction, candidates) {
                    depth[i] = surface.hit.t as f32;
                }
                pixels[4 * i..4 * i + 4].copy_from_slice(&self.pixel(camera, i, j, supersample, candidates));
            }
        });
        // Both buffers have the required sizes, so these calls never fall back to the default.
        let depth = Array2::from_shape_vec((height, width), depth).unwrap_or_default();
        (RgbaImage::from_raw(width as u32, height as u32, pixels).unwrap_or_default(), depth)
    }

    fn pixel(&self, camera: &Camera, i: usize, j: usize, supersample: usize, candidates: u32) -> [u8; 4] {
        let (mut sum, mut hits) = (DVec3::ZERO, 0_usize);
        for k in 0..supersample * supersample {
            let place = |cell: usize| (cell as f64 + 0.5) / supersample as f64;
            let ray = camera.ray(i as f64 + place(k % supersample), j as f64 + place(k / supersample));
            if let Some(surface) = self.first(ray.origin, ray.direction, candidates) {
                sum += self.shade(&surface, ray.origin, ray.direction);
                hits += 1;
            }
        }
        if hits == 0 {
            return [0; 4];
        }
        let [r, g, b] = (sum / hits as f64 * 255.0).round().to_array().map(|value| value as u8);
        let alpha = (hits as f64 / (supersample * supersample) as f64 * 255.0).round() as u8;
        [r, g, b, alpha]
    }

    /// Returns the bit set of objects whose bounds intersect the pixel's cone of rays. It is computed once per pixel, which makes empty
    /// pixels nearly free.
    fn candidates(&self, camera: &Camera, i: usize, j: usize) -> u32 {
        let ray = camera.ray(i as f64 + 0.5, j as f64 + 0.5);
        // Slightly more than half the diagonal of a pixel.
        let spread = 0.75 / camera.intrinsics.fx.min(camera.intrinsics.fy);
        self.bounds.near(ray.origin, ray.direction, spread as f32)
    }

    /// Returns the first surface along the ray among the candidate objects.
    fn first(&self, origin: DVec3, direction: DVec3, candidates: u32) -> Option<Surface> {
        let mut nearest: Option<Surface> = None;
        let near = candidates & self.bounds.near(origin, direction, 0.0);
        for (k, object) in members(near, &self.objects) {
            if let Some(hit) = object.solid.first_hit(origin, direction)
                && nearest.is_none_or(|found| hit.t < found.hit.t)
            {
                nearest = Some(Surface { hit, object: k });
            }
        }
        nearest
    }

    /// Returns true if an object lies between the key light and `point`, on an object facing the light.
    fn shadowed(&self, point: DVec3, light: DVec3, own: usize) -> bool {
        // A convex solid cannot shade its own lit side.
        let others = if self.objects[own].solid.convex() { !(1 << own) } else { u32::MAX };
        let near = self.casters & others & self.bounds.near(point, light, 0.0);
        members(near, &self.objects).any(|(_, object)| object.solid.first_hit(point, light).is_some())
    }

    /// Shades a surface: Lambert shading under a shadowed key light, a fill light and a sky darkened by neighbours. Glossy paint adds wide
    /// Blinn-Phong highlights and a soft reflection of the sky that grows towards grazing angles (Schlick 1994).
    fn shade(&self, surface: &Surface, origin: DVec3, direction: DVec3) -> DVec3 {
        let key = dvec3(0.5, -0.42, 0.76).normalize();
        let fill = dvec3(-0.75, 0.35, 0.56).normalize();
        let (object, n) = (&self.objects[surface.object], surface.hit.normal);
        let p = origin + surface.hit.t * direction;
        let paint = if surface.hit.carved { &object.lining } else { &object.skin };
        let albedo = paint.colors[usize::from(paint.pattern.second(p))];

        let toward = n.dot(key);
        let lit = if toward > 0.0 && !self.shadowed(p + OFFSET * n, key, surface.object) { 1.0 } else { 0.0 };
        let sky = self.bounds.open_sky(p, n, surface.object) * if surface.hit.carved { object.openness } else { 1.0 };
        let ambient = sky * (dvec3(0.26, 0.20, 0.16).lerp(dvec3(0.38, 0.42, 0.50), 0.5 + 0.5 * n.z));
        let diffuse = lit * toward.max(0.0) * dvec3(1.02, 0.95, 0.82) + n.dot(fill).max(0.0) * sky * dvec3(0.14, 0.17, 0.24);
        let mut color = albedo * (ambient + diffuse);
        if paint.gloss > 0.0 {
            let facing = (-n.dot(direction)).max(0.0);
            let highlight = |light: DVec3, power: i32| (light - direction).normalize().dot(n).max(0.0).powi(power);
            let fresnel = 0.10 + 0.55 * (1.0 - facing).powi(3);
            let mirrored = sky_color((direction - 2.0 * n.dot(direction) * n).z);
            let shine = lit * highlight(key, 16) * dvec3(0.85, 0.80, 0.72) + highlight(fill, 12) * dvec3(0.10, 0.13, 0.20);
            color = color * (1.0 - paint.gloss * fresnel) + paint.gloss * (fresnel * sky * mirrored + shine);
        }
        // The square root approximates the display's gamma, because images store sRGB values.
        color.clamp(DVec3::ZERO, DVec3::ONE).map(f64::sqrt)
    }
}

/// Returns the objects whose bits are set, with their numbers.
fn members(mut bits: u32, objects: &[Object]) -> impl Iterator<Item = (usize, &Object)> {
    std::iter::from_fn(move || {
        let k = bits.trailing_zeros() as usize;
        bits &= bits.wrapping_sub(1);
        objects.get(k).map(|object| (k, object))
    })
}

#[cfg(test)]
mod tests {
    use super::super::bounds::MOST;
    use super::super::still_life::TABLE;
    use super::*;
    use crate::camera::Intrinsics;

    fn camera(eye: DVec3) -> Camera {
        Camera::look_at(eye.normalize() * 4.03, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(48, 48, 0.6911))
    }

    #[test]
    fn the_scene_lies_within_a_ball_of_radius_1_3() {
        let scene = Scene::still_life();
        for k in 0..4000 {
            let z = 1.0 - 2.0 * (f64::from(k) + 0.5) / 4000.0;
            let (sin, cos) = (2.4 * f64::from(k)).sin_cos();
            let r = (1.0 - z * z).sqrt();
            assert!(!scene.occupied(1.3 * dvec3(r * cos, r * sin, z)));
        }
        assert!(scene.objects.len() <= MOST);
    }

    #[test]
    fn hollows_are_empty_although_no_silhouette_shows_it() {
        let scene = Scene::still_life();
        assert!(!scene.occupied(dvec3(-0.47, -0.40, TABLE + 0.2)) && scene.occupied(dvec3(-0.47, -0.40, TABLE + 0.01)));
        let block = dvec3(0.46, 0.50, TABLE + 0.31);
        assert!(!scene.occupied(block + DVec3::Z * 0.2) && scene.occupied(block));
    }

    #[test]
    fn depth_is_where_the_distance_vanishes_and_the_way_there_is_free() {
        let scene = Scene::still_life();
        let camera = camera(dvec3(1.0, -2.0, 1.5));
        let (image, depth) = scene.render(&camera, 2);
        let mut seen = 0;
        for ((j, i), &t) in depth.indexed_iter() {
            let ray = camera.ray(i as f64 + 0.5, j as f64 + 0.5);
            if t.is_finite() {
                seen += 1;
                // f32 keeps a distance of 4 to 2.4e-7.
                assert!(scene.distance(ray.origin + f64::from(t) * ray.direction).abs() < 1e-6);
                for k in 1..40 {
                    assert!(!scene.occupied(ray.origin + f64::from(t) * f64::from(k) / 40.0 * ray.direction));
                }
            } else if image.get_pixel(i as u32, j as u32).0[3] == 0 {
                assert!(scene.depth(&ray).is_infinite());
            }
        }
        assert!(seen > 48 * 48 / 3, "the scene fills the frame: {seen}");
    }

    #[test]
    fn candidates_of_a_pixel_miss_nothing() {
        let scene = Scene::still_life();
        let camera = camera(dvec3(-1.0, -0.7, 0.4));
        for (i, j) in (0..48).flat_map(|j| (0..48).map(move |i| (i, j))) {
            let candidates = scene.candidates(&camera, i, j);
            for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.4, 0.7)] {
                let ray = camera.ray(i as f64 + dx, j as f64 + dy);
                let (some, all) = (scene.first(ray.origin, ray.direction, candidates), scene.first(ray.origin, ray.direction, u32::MAX));
                assert_eq!(some.map(|found| found.hit.t), all.map(|found| found.hit.t));
            }
        }
    }

    #[test]
    fn only_glossy_paint_depends_on_the_direction_of_view() {
        let scene = Scene::still_life();
        let seen = |target: DVec3, from: DVec3| {
            scene.color(&Ray { origin: target + 2.0 * from.normalize(), direction: -from.normalize(), stretch: 1.0 }).unwrap()
        };
        let difference = |target: DVec3, a: DVec3, b: DVec3| {
            let (a, b) = (seen(target, a), seen(target, b));
            (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f64::max)
        };
        let ball_top = dvec3(0.50, -0.44, TABLE + 0.74);
        assert!(difference(ball_top, dvec3(0.6, -0.5, 1.0), dvec3(-0.8, 0.1, 1.0)) > 0.2);
        let table = dvec3(0.55, 0.02, TABLE);
        assert!(difference(table, dvec3(0.3, 0.0, 1.0), dvec3(0.1, 0.1, 1.0)) < 1e-9);
    }
}
