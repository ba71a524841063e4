//! The still life: its objects, its light and the picture a camera takes of it.
//!
//! Chosen to exercise what voxel fields find easy and hard: stripes and checkers near the voxel size, dark and bright paint,
//! rods and hoops about as thin as a pixel, hollows that no silhouette shows (a bowl, dimples in a block), and glossy
//! spheres whose color changes with the direction of view, smoothly enough for spherical harmonics of degree 2. World z is
//! up; everything lies within 1.3 of the origin. Light is the same in every picture and is not part of the scene's geometry.

use super::shapes::{Ball, Convex, Hit, Solid};
use crate::camera::{Camera, Ray};
use crate::dataset::image::RgbaImage;
use glam::{DVec3, dvec3};
use ndarray::Array2;
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Height of the table's top.
const TABLE: f64 = -0.45;
/// Distance by which a shadow ray starts off its surface.
const OFFSET: f64 = 1e-6;

/// An analytic scene: solids with paint, seen under a fixed light.
#[derive(Debug, Clone)]
pub struct Scene {
    objects: Vec<Object>,
    /// One per object, computed once.
    bounds: Vec<Ball>,
}

/// What a ray met: surface and object.
#[derive(Debug, Clone, Copy)]
struct Surface {
    hit: Hit,
    object: usize,
}

#[derive(Debug, Clone)]
struct Object {
    solid: Solid,
    skin: Paint,
    /// Paint of the holes' walls, which are always matt.
    lining: Paint,
    /// Fraction of the light of the sky that the walls of its holes still see. Inside a sphere every point of the wall sees
    /// the opening under the same form factor: the opening's share of the sphere.
    openness: f64,
    /// Radius of the ball that stands for the object when others are darkened by it; 0 for thin things.
    shade: f64,
}

/// Albedo (linear) in two colors, and how strongly the surface mirrors.
#[derive(Debug, Clone, Copy)]
struct Paint {
    pattern: Pattern,
    colors: [DVec3; 2],
    gloss: f64,
}

/// Where the second color goes.
#[derive(Debug, Clone, Copy)]
enum Pattern {
    Plain,
    /// Cells of `side` along axes turned about the vertical through `center`, of which `across` is the first; an infinite side
    /// makes stripes.
    Checker { center: DVec3, across: DVec3, side: DVec3 },
    /// Stripes that go `turns` times around the vertical through `center` and `rise` times per unit of height.
    Spiral { center: DVec3, turns: f64, rise: f64 },
    /// Meridians and parallels of a globe.
    Globe { center: DVec3, meridians: f64, belts: f64 },
}

impl Pattern {
    fn second(&self, p: DVec3) -> bool {
        let azimuth = |o: DVec3| o.y.atan2(o.x) / TAU;
        let cell = match *self {
            Pattern::Plain => 0.0,
            Pattern::Checker { center, across, side } => {
                let o = p - center;
                let cells = (dvec3(across.dot(o), across.x * o.y - across.y * o.x, o.z) / side).floor();
                cells.x + cells.y + cells.z
            }
            Pattern::Spiral { center, turns: 0.0, rise } => (rise * (p.z - center.z)).floor(),
            Pattern::Spiral { center, turns, rise } => (turns * azimuth(p - center) + rise * (p.z - center.z)).floor(),
            Pattern::Globe { center, meridians, belts } => {
                let o = p - center;
                let polar = (o.z / o.length()).clamp(-1.0, 1.0).acos() / PI;
                (meridians * azimuth(o)).floor() + (belts * polar).floor()
            }
        };
        cell.rem_euclid(2.0) >= 1.0
    }
}

impl Scene {
    /// The built-in still life.
    pub fn still_life() -> Self {
        let objects = objects();
        let bounds = objects.iter().map(|object| object.solid.bound()).collect();
        Scene { objects, bounds }
    }

    /// Signed distance from `point` to the nearest surface, negative inside solid matter. The sign is exact; outside, the value
    /// never exceeds the true distance.
    pub fn distance(&self, point: DVec3) -> f64 {
        self.objects.iter().map(|object| object.solid.distance(point)).fold(f64::INFINITY, f64::min)
    }

    /// True inside solid matter.
    pub fn occupied(&self, point: DVec3) -> bool {
        self.distance(point) < 0.0
    }

    /// Distance along the unit ray to the first surface, infinite where there is none.
    pub fn depth(&self, ray: &Ray) -> f64 {
        self.first(ray.origin, ray.direction, u32::MAX).map_or(f64::INFINITY, |surface| surface.hit.t)
    }

    /// Color in [0, 1] (as stored in an image) where the ray first meets a surface, or `None` where it meets none. It depends on
    /// the direction for glossy surfaces.
    pub fn color(&self, ray: &Ray) -> Option<[f64; 3]> {
        self.first(ray.origin, ray.direction, u32::MAX).map(|surface| self.shade(&surface, ray.origin, ray.direction).to_array())
    }

    /// The picture `camera` takes, with `supersample` x `supersample` rays per pixel, and the exact depth along the ray of each
    /// pixel's centre, [height, width], infinite where it meets nothing.
    ///
    /// Alpha is the share of rays that hit; color is the mean over those, so that alpha is straight.
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
        // Both buffers have the sizes the constructors ask for, so neither refuses.
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

    /// The objects (as bits) whose bounds come within the pixel's cone of rays. Deciding this once per pixel instead of once per
    /// ray makes the empty pixels nearly free.
    fn candidates(&self, camera: &Camera, i: usize, j: usize) -> u32 {
        let ray = camera.ray(i as f64 + 0.5, j as f64 + 0.5);
        let spread = 0.75 / camera.intrinsics.fx.min(camera.intrinsics.fy); // half a pixel's diagonal, a little more
        let near = |ball: &Ball| {
            let to = ball.center - ray.origin;
            let along = to.dot(ray.direction);
            let reach = ball.radius + spread * (along.abs() + ball.radius);
            to.length_squared() - along * along <= reach * reach
        };
        self.bounds.iter().enumerate().filter(|(_, ball)| near(ball)).fold(0, |bits, (k, _)| bits | 1 << k)
    }

    /// The first surface along the ray among the candidate objects.
    fn first(&self, origin: DVec3, direction: DVec3, candidates: u32) -> Option<Surface> {
        let mut nearest: Option<Surface> = None;
        let mut limit = f64::INFINITY;
        let mut remaining = candidates;
        while remaining != 0 {
            let k = remaining.trailing_zeros() as usize;
            remaining &= remaining - 1;
            // More bits may be asked for than there are objects.
            let (Some(object), Some(ball)) = (self.objects.get(k), self.bounds.get(k)) else { break };
            if within(ball, origin, direction, limit)
                && let Some(hit) = object.solid.first_hit(origin, direction)
                && hit.t < limit
            {
                limit = hit.t;
                nearest = Some(Surface { hit, object: k });
            }
        }
        nearest
    }

    /// True if anything lies between `point` and the key light.
    fn shadowed(&self, point: DVec3, light: DVec3) -> bool {
        let blocks = |(object, ball): (&Object, &Ball)| within(ball, point, light, f64::INFINITY) && object.solid.first_hit(point, light).is_some();
        self.objects.iter().zip(&self.bounds).any(blocks)
    }

    /// Lambert under a key light with shadows, a fill light and a sky darkened by neighbours; on glossy paint, broad
    /// Blinn-Phong highlights and a soft reflection of the sky that grows towards grazing angles (Schlick 1994).
    fn shade(&self, surface: &Surface, origin: DVec3, direction: DVec3) -> DVec3 {
        let key = dvec3(0.5, -0.42, 0.76).normalize();
        let fill = dvec3(-0.75, 0.35, 0.56).normalize();
        let (object, n) = (&self.objects[surface.object], surface.hit.normal);
        let p = origin + surface.hit.t * direction;
        let paint = if surface.hit.carved { &object.lining } else { &object.skin };
        let albedo = paint.colors[usize::from(paint.pattern.second(p))];

        let toward = n.dot(key);
        let lit = if toward > 0.0 && !self.shadowed(p + OFFSET * n, key) { 1.0 } else { 0.0 };
        let sky = self.open_sky(p, n, surface.object) * if surface.hit.carved { object.openness } else { 1.0 };
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
        // A square root stands for the display's gamma: a picture stores values as the eye wants them.
        color.clamp(DVec3::ZERO, DVec3::ONE).map(f64::sqrt)
    }

    /// The share of the sky that the other objects, taken as balls, leave open to the point `p` with normal `n`: each takes the
    /// form factor r² cos / d² of a ball.
    fn open_sky(&self, p: DVec3, n: DVec3, own: usize) -> f64 {
        let mut open = 1.0;
        for (k, (object, ball)) in self.objects.iter().zip(&self.bounds).enumerate() {
            if k == own || object.shade == 0.0 {
                continue;
            }
            let to = ball.center - p;
            let cosine = n.dot(to);
            if cosine > 0.0 {
                let squared = to.length_squared();
                open *= 1.0 - (cosine * object.shade * object.shade / (squared * squared.sqrt())).min(0.85);
            }
        }
        open
    }
}

/// True if the ray passes through the ball somewhere between its origin and the distance `limit`.
#[inline]
fn within(ball: &Ball, origin: DVec3, direction: DVec3, limit: f64) -> bool {
    let to = ball.center - origin;
    let along = to.dot(direction);
    let squared = ball.radius * ball.radius;
    along > -ball.radius && along - ball.radius < limit && to.length_squared() - along * along <= squared
}

/// The sky seen in a mirror that reflects into a direction of the given height (cosine to the vertical).
fn sky_color(height: f64) -> DVec3 {
    let (ground, horizon, zenith) = (dvec3(0.10, 0.06, 0.04), dvec3(0.95, 0.85, 0.72), dvec3(0.22, 0.45, 0.95));
    if height < 0.15 {
        let s = ((height + 0.55) / 0.7).clamp(0.0, 1.0);
        ground.lerp(horizon, s * s * (3.0 - 2.0 * s))
    } else {
        horizon.lerp(zenith, (height - 0.15) / 0.85)
    }
}

/// The list of things on the table.
fn objects() -> Vec<Object> {
    let matt = |pattern, first: [f64; 3], second: [f64; 3]| Paint { pattern, colors: [first.into(), second.into()], gloss: 0.0 };
    let plain = |color: [f64; 3], gloss| Paint { pattern: Pattern::Plain, colors: [color.into(); 2], gloss };
    let whole = |piece: Convex, skin: Paint, shade: f64| Object {
        solid: Solid::Carved { body: vec![piece], holes: vec![] },
        skin,
        lining: skin,
        openness: 1.0,
        shade,
    };
    let ring = |center, axis: DVec3, radius, tube, skin: Paint| Object {
        solid: Solid::Torus { center, axis: axis.normalize(), radius, tube },
        skin,
        lining: skin,
        openness: 1.0,
        shade: 0.0,
    };
    let up = |x: f64, y: f64, above: f64| dvec3(x, y, TABLE + above);
    let toward = |yaw: f64| dvec3(yaw.cos(), yaw.sin(), 0.0);
    let stripes = f64::INFINITY;

    let bowl = up(-0.47, -0.40, 0.42);
    let yaw = 0.6;
    let block = up(0.46, 0.50, 0.31);
    let dimple = |side: DVec3| Convex::Sphere { center: block + 0.365 * side, radius: 0.21 };
    let globe = dvec3(0.0, 0.08, 0.62);
    let brass = plain([0.62, 0.34, 0.05], 0.35);
    let leg = |x: f64, y: f64| whole(Convex::capsule(up(x, y, 0.02), globe, 0.025), plain([0.05, 0.03, 0.02], 0.0), 0.0);

    vec![
        // The table: a round board with a checkered top and edge.
        whole(
            Convex::cylinder(up(0.0, 0.0, -0.12), up(0.0, 0.0, 0.0), 1.14),
            matt(
                Pattern::Checker { center: up(0.0, 0.0, -0.5), across: toward(0.35), side: dvec3(0.19, 0.19, stripes) },
                [0.02, 0.13, 0.17],
                [0.74, 0.42, 0.10],
            ),
            0.0,
        ),
        // The bowl: blue outside, a matt globe pattern inside.
        Object {
            solid: Solid::Carved {
                body: vec![Convex::Sphere { center: bowl, radius: 0.44 }, Convex::Below { z: bowl.z + 0.02 }],
                holes: vec![Convex::Sphere { center: bowl, radius: 0.385 }],
            },
            skin: matt(Pattern::Spiral { center: bowl, turns: 0.0, rise: 6.0 }, [0.03, 0.07, 0.36], [0.30, 0.46, 0.70]),
            lining: matt(Pattern::Globe { center: bowl, meridians: 12.0, belts: 8.0 }, [0.85, 0.22, 0.03], [0.95, 0.80, 0.45]),
            openness: 0.47, // half the sphere, less what the rim 0.02 above its middle hides
            shade: 0.38,
        },
        // The glossy ball.
        whole(Convex::Sphere { center: up(0.50, -0.44, 0.37), radius: 0.37 }, plain([0.36, 0.015, 0.03], 1.0), 0.37),
        // The block with spherical dimples in three sides and the top.
        Object {
            solid: Solid::Carved {
                body: vec![Convex::block(block, DVec3::splat(0.31), yaw)],
                holes: vec![dimple(toward(yaw - PI / 2.0)), dimple(toward(yaw)), dimple(toward(yaw + PI)), dimple(DVec3::Z)],
            },
            skin: matt(
                Pattern::Checker { center: block + DVec3::Z * 0.08, across: toward(yaw), side: dvec3(stripes, stripes, 0.155) },
                [0.20, 0.015, 0.26],
                [0.62, 0.16, 0.52],
            ),
            lining: plain([0.95, 0.70, 0.06], 0.0),
            openness: 0.63, // the hollow is 0.155 of the sphere's 0.42 high, so this share of the sphere is open
            shade: 0.36,
        },
        // The cone with a spiral.
        whole(
            Convex::Cone { base: up(-0.48, 0.48, 0.0), radius: 0.34, height: 1.05 },
            matt(Pattern::Spiral { center: up(-0.48, 0.48, 0.0), turns: 2.0, rise: 5.5 }, [0.78, 0.05, 0.04], [0.92, 0.88, 0.80]),
            0.29,
        ),
        // A globe with two hoops on a tripod: glossy and thin.
        whole(Convex::Sphere { center: globe, radius: 0.17 }, plain([0.015, 0.16, 0.07], 1.0), 0.17),
        leg(0.21, 0.04),
        leg(-0.18, 0.27),
        leg(-0.11, -0.15),
        ring(globe, dvec3(0.25, -0.2, 1.0), 0.30, 0.023, brass),
        ring(globe, dvec3(1.0, 0.3, 0.15), 0.255, 0.023, brass),
        // A candle, a ring lying about, two marbles.
        whole(
            Convex::cylinder(up(0.04, -0.84, 0.0), up(0.04, -0.84, 0.48), 0.12),
            matt(Pattern::Spiral { center: up(0.04, -0.84, 0.02), turns: 0.0, rise: 7.5 }, [0.02, 0.02, 0.025], [0.93, 0.66, 0.04]),
            0.13,
        ),
        ring(up(0.86, 0.04, 0.05), DVec3::Z, 0.14, 0.05, plain([0.02, 0.30, 0.12], 0.0)),
        whole(Convex::Sphere { center: up(-0.90, 0.10, 0.13), radius: 0.13 }, plain([0.04, 0.10, 0.42], 1.0), 0.13),
        whole(
            Convex::Sphere { center: up(0.0, 0.82, 0.16), radius: 0.16 },
            matt(Pattern::Globe { center: up(0.0, 0.82, 0.16), meridians: 6.0, belts: 4.0 }, [0.02, 0.02, 0.02], [0.90, 0.90, 0.86]),
            0.16,
        ),
    ]
}

#[cfg(test)]
mod tests {
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
        assert!(scene.objects.len() <= 32, "candidates are bits of a u32");
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
        let seen = |target: DVec3, from: DVec3| scene.color(&Ray { origin: target + 2.0 * from.normalize(), direction: -from.normalize(), stretch: 1.0 }).unwrap();
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
