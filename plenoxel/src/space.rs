//! Spaces: how positions in the world become positions in the box of a field.
//!
//! A field is a function on a box. The world may be larger than any box: a room seen from inside has walls, windows and sky. A [`Space`]
//! maps the world, or the part of it that cameras see, to a box.

pub(crate) mod tracked;

use crate::camera::{Camera, Ray};
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use glam::{DVec3, dvec3};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Map from the world to the box of a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Space {
    /// The identity: the box is a box of the world, and nothing outside of it is seen.
    #[default]
    Box,
    /// Normalized device coordinates of a reference camera at the origin that looks along −z, for forward-facing captures (Mildenhall et
    /// al. 2020, appendix C): (x, y, z) becomes (−a x / z, −b y / z, 1 + 2 / z) for z ≤ −1, with −1 the near plane.
    Ndc {
        /// a = 2 fx / width of the reference camera.
        a: f64,
        /// b = 2 fy / height of the reference camera.
        b: f64,
    },
    /// The contraction of mip-NeRF 360 (Barron et al. 2022) in its infinity-norm form: with m = max |xᵢ|, x for m ≤ 1 and
    /// (2 − 1 / m) x / m beyond. The whole world becomes the box [−2, 2]³.
    Contracted,
}

impl Space {
    /// Half width of the box of [`Space::Contracted`].
    pub const CONTRACTED: f64 = 2.0;

    /// Checks that the box is one of the world, for a model or a command that knows no other. `what` names it.
    ///
    /// Errors if the space is another one.
    pub fn require_box(&self, what: &str) -> Result<()> {
        if *self == Space::Box {
            return Ok(());
        }
        let found = format!("`{what}` needs a box of the world, and the space of this capture is {self}");
        Err(Error::usage("space", found, "use the preset photos, or set space to box, and half_width to the size of the object"))
    }

    /// Returns rays in the coordinates of the box, if they are straight there. For [`Space::Contracted`] they are those of the world;
    /// [`Spacing::Contracted`](crate::sampling::Spacing::Contracted) bends them.
    ///
    /// A ray in normalized device coordinates begins at the near plane, and its direction has unit length. With o the origin, moved along
    /// the ray to z = −1, and d the direction: o' = (−a o_x / o_z, −b o_y / o_z, 1 + 2 / o_z) and d' ∝ (−a (d_x / d_z − o_x / o_z), −b (d_y / d_z − o_y / o_z),
    /// −2 / o_z).
    pub fn rays<'a>(&self, rays: &'a [Ray]) -> Cow<'a, [Ray]> {
        match *self {
            Space::Box | Space::Contracted => Cow::Borrowed(rays),
            Space::Ndc { .. } => Cow::Owned(rays.iter().map(|ray| self.ray(ray)).collect()),
        }
    }

    /// Returns one ray as [`rays`](Self::rays) does.
    pub fn ray(&self, ray: &Ray) -> Ray {
        match *self {
            Space::Box | Space::Contracted => *ray,
            Space::Ndc { a, b } => ndc(ray, a, b),
        }
    }

    /// Returns the position in the box of a position x of the world. In normalized device coordinates, x must have z < 0.
    pub fn to_box(&self, x: DVec3) -> DVec3 {
        match *self {
            Space::Box => x,
            Space::Ndc { a, b } => dvec3(-a * x.x / x.z, -b * x.y / x.z, 1.0 + 2.0 / x.z),
            Space::Contracted => contract(x),
        }
    }

    /// Returns the position in the world of a position p of the box, the inverse of [`to_box`](Self::to_box); `None` if it is at infinity or beyond. Contracted
    /// space: p for m = max |pᵢ| ≤ 1, p / (m (2 − m)) beyond. NDC: z = 2 / (p_z − 1), x = −p_x z / a, y = −p_y z / b.
    pub fn to_world(&self, p: DVec3) -> Option<DVec3> {
        match *self {
            Space::Box => Some(p),
            Space::Ndc { a, b } => {
                let z = 2.0 / (p.z - 1.0);
                (p.z < 1.0).then(|| dvec3(-p.x * z / a, -p.y * z / b, z))
            }
            Space::Contracted => {
                let m = p.abs().max_element();
                (m < Self::CONTRACTED).then(|| if m <= 1.0 { p } else { p / (m * (Self::CONTRACTED - m)) })
            }
        }
    }

    /// Returns the t of [`Samples`](crate::sampling::Samples) at a distance from the origin of a ray of the world. It grows with the distance. In
    /// [`Space::Box`] it is the distance, in [`Space::Contracted`] the s of [`Bend`], and in NDC the distance from the near plane in the box.
    pub fn place(&self, ray: &Ray, distance: f64) -> f64 {
        match self {
            Space::Box => distance,
            Space::Contracted => Bend::of(ray).place(distance),
            Space::Ndc { .. } => {
                let moved = self.ray(ray);
                (self.to_box(ray.origin + distance * ray.direction) - moved.origin).dot(moved.direction)
            }
        }
    }

    /// Returns the distance from the origin of a ray of the world, given the t of [`Samples`](crate::sampling::Samples): the inverse of
    /// [`place`](Self::place). Infinite at infinity.
    pub fn distance(&self, ray: &Ray, place: f64) -> f64 {
        match self {
            Space::Box => place,
            Space::Contracted => {
                let bend = Bend::of(ray);
                if place < bend.end() { bend.distance(place) } else { f64::INFINITY }
            }
            Space::Ndc { .. } => {
                let moved = self.ray(ray);
                let world = self.to_world(moved.origin + place * moved.direction);
                world.map_or(f64::INFINITY, |world| (world - ray.origin).dot(ray.direction))
            }
        }
    }
}

/// Box of a field, in the coordinates of a space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Space.
    pub space: Space,
    /// Box.
    pub aabb: Aabb,
}

impl Region {
    /// Returns the region that cameras see in a space: a cube of the world with this half width; the whole contracted world; the part of
    /// normalized device coordinates that the rays of the image corners cross, at most 3 times as wide as the image of the reference camera.
    pub fn of(space: Space, cameras: &[Camera], half_width: f64) -> Self {
        const WIDEST: f64 = 3.0;
        let aabb = match space {
            Space::Box => Aabb::cube(half_width),
            Space::Contracted => Aabb::cube(Space::CONTRACTED),
            Space::Ndc { .. } => {
                let corners = cameras.iter().flat_map(|camera| {
                    // Centers of pixels: beyond them a lens may fold over.
                    let [right, bottom] = [camera.intrinsics.width, camera.intrinsics.height].map(|n| n as f64 - 0.5);
                    [[0.5, 0.5], [right, 0.5], [0.5, bottom], [right, bottom]].map(|[x, y]| camera.ray(x, y))
                });
                let rays: Vec<Ray> = corners.filter(|ray| ray.direction.z < 0.0).collect();
                // A ray ends at z = 1, the infinite distance.
                let ends = space
                    .rays(&rays)
                    .iter()
                    .flat_map(|ray| [ray.origin, ray.origin + 2.0 / ray.direction.z * ray.direction])
                    .collect::<Vec<_>>();
                let reach = |axis: usize| ends.iter().map(|end| end[axis].abs()).fold(1.0, f64::max).min(WIDEST);
                let half = dvec3(reach(0), reach(1), 1.0);
                Aabb { min: -half, max: half }
            }
        };
        Region { space, aabb }
    }

    /// Returns the box, for a model that is trained in a box of the world only. `kind` names the model.
    ///
    /// Errors if the space is another one.
    pub fn in_box(&self, kind: &str) -> Result<Aabb> {
        self.space.require_box(kind).map(|()| self.aabb)
    }
}

impl std::fmt::Display for Space {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Space::Box => "box",
            Space::Ndc { .. } => "ndc",
            Space::Contracted => "contracted",
        })
    }
}

/// Returns a ray in normalized device coordinates. A ray that does not look along −z sees nothing: it is moved out of the box.
fn ndc(ray: &Ray, a: f64, b: f64) -> Ray {
    let d = ray.direction;
    if d.z >= 0.0 {
        return Ray { origin: dvec3(0.0, 0.0, 1e6), direction: DVec3::Z, stretch: ray.stretch };
    }
    let o = ray.origin - (1.0 + ray.origin.z) / d.z * d;
    let origin = dvec3(-a * o.x / o.z, -b * o.y / o.z, 1.0 + 2.0 / o.z);
    let direction = dvec3(-a * (d.x / d.z - o.x / o.z), -b * (d.y / d.z - o.y / o.z), -2.0 / o.z);
    Ray { origin, direction: direction.normalize(), stretch: ray.stretch }
}

/// Returns a position of the world in the contracted space ([`Space::Contracted`]).
#[inline(always)]
pub fn contract(x: DVec3) -> DVec3 {
    let m = x.abs().max_element().max(1.0);
    x * ((2.0 - 1.0 / m) / m)
}

/// Returns the cotangent of a position x of the world from that of its [contraction](contract) x s, with s = 2 / m − 1 / m² and m = |x_b| the largest
/// coordinate beyond 1: s g + (g · x) (2 / m³ − 2 / m²) sign(x_b) e_b.
pub(crate) fn contract_adjoint(x: DVec3, g: DVec3) -> DVec3 {
    let m = x.abs().max_element();
    if m <= 1.0 {
        return g;
    }
    let b = x.abs().max_position();
    let mut of_x = g * ((2.0 - 1.0 / m) / m);
    of_x[b] += g.dot(x) * (2.0 / m - 2.0) / (m * m) * x[b].signum();
    of_x
}

/// Path of a ray through the contracted space, by a parameter s whose even steps are about even in that space.
///
/// Let b be the axis along which the direction d is largest, and t₁ the distance at which the ray leaves the slab |x_b| ≤ 1. Up to there s
/// is the distance t. Behind it |x_b| = 1 + |d_b| (t − t₁), and 1 / |x_b| falls evenly with s: 1 / |x_b| = 1 − |d_b| (s − t₁), which is 0, at infinity, for
/// s = t₁ + 1 / |d_b|.
/// If the ray begins behind the slab, the s of this formula is not 0 at its origin, where its value s₀ is subtracted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bend {
    /// t₁
    pub(crate) turn: f64,
    /// |d_b|
    pub(crate) rate: f64,
    /// The value s₀ of the formula at the origin of the ray. It is 0 if the ray begins before or in the slab.
    pub(crate) start: f64,
}

impl Bend {
    /// Distance of the near plane from a camera. What is nearer is not seen.
    const NEAR: f64 = 0.05;

    /// Returns the path of a ray.
    pub fn of(ray: &Ray) -> Self {
        let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
        let b = (1..3).fold(0, |b, axis| if d[axis].abs() > d[b].abs() { axis } else { b });
        let rate = d[b].abs();
        let bend = Bend { turn: (1.0 - o[b] * d[b].signum()) / rate, rate, start: 0.0 };
        Bend { start: bend.place(0.0), ..bend }
    }

    /// Returns s at the near plane.
    pub fn near(&self) -> f64 {
        self.place(Self::NEAR)
    }

    /// Returns s at infinity.
    pub fn end(&self) -> f64 {
        self.turn + 1.0 / self.rate - self.start
    }

    /// Returns s at a distance from the origin of the ray.
    pub fn place(&self, t: f64) -> f64 {
        let m = 1.0 + self.rate * (t - self.turn);
        let s = if m <= 1.0 { t } else { self.turn + (1.0 - 1.0 / m) / self.rate };
        s - self.start
    }

    /// Returns the distance from the origin of the ray at s.
    #[inline(always)]
    pub fn distance(&self, s: f64) -> f64 {
        let s = s + self.start;
        let m = 1.0 / (1.0 - self.rate * (s - self.turn));
        if s <= self.turn { s } else { self.turn + (m - 1.0) / self.rate }
    }

    /// Returns a bound of |dp_a / ds| along each axis a, for the positions p on the path of a ray: 1 + 2 max |(o × d)_a|.
    ///
    /// Where |x_k| > 1 is the largest coordinate, let u = 1 / |x_k| and x_j = A |x_k| + B. Then p_k = ± (2 − u), p_j = (A + B u) (2 − u), |A + B u| ≤ 1 and
    /// |du / ds| ≤ |d_k|, so that |dp_j / ds| ≤ |d_k| (1 + 2 |B|), and |d_k B| = |o_j d_k − o_k d_j|.
    pub(crate) fn steepest(ray: &Ray) -> f64 {
        1.0 + 2.0 * ray.origin.cross(ray.direction).abs().max_element()
    }

    /// Returns the positions at several s: x, y and z of each. `field/lanes/paths.rs` computes those of several rays.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // One short loop for each array: such loops vectorise.
    pub(crate) fn positions<const N: usize>(&self, ray: &Ray, s: &[f64; N]) -> [[f64; N]; 3] {
        let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
        // Intervals after the last would lie beyond infinity.
        let last = self.end() - 1e-9;
        let mut t = [0.0; N];
        for i in 0..N {
            t[i] = self.distance(s[i].min(last));
        }
        // The operations of [`contract`].
        let (mut at, mut m) = ([[0.0; N]; 3], [1.0; N]);
        for a in 0..3 {
            for i in 0..N {
                at[a][i] = o[a] + t[i] * d[a];
            }
            for i in 0..N {
                m[i] = larger(at[a][i].abs(), m[i]);
            }
        }
        let mut scale = [0.0; N];
        for i in 0..N {
            scale[i] = (2.0 - 1.0 / m[i]) / m[i];
        }
        for a in 0..3 {
            for i in 0..N {
                at[a][i] *= scale[i];
            }
        }
        at
    }
}

/// Returns the larger of two numbers that are not NaN: one instruction, where [`f64::max`] is several.
#[inline(always)]
fn larger(x: f64, y: f64) -> f64 {
    if x > y { x } else { y }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::random::Stream;

    /// Rays with origins in [−1.5, 1.5]³ and random directions.
    fn rays(count: usize) -> Vec<Ray> {
        let numbers = Stream::new(3).uniform_tensor::<f64>(&[count, 6], -1.0, 1.0);
        let ray = |x: &[f64]| {
            let direction = dvec3(x[3], x[4], x[5]).normalize();
            Ray { origin: 1.5 * dvec3(x[0], x[1], x[2]), direction, stretch: 1.0 }
        };
        numbers.data().chunks(6).map(ray).collect()
    }

    #[test]
    fn the_contraction_is_continuous_and_maps_infinity_to_the_faces_of_the_box() {
        assert_eq!(contract(dvec3(0.3, -1.0, 0.5)), dvec3(0.3, -1.0, 0.5));
        assert!(contract(dvec3(4.0, -2.0, 1.0)).abs_diff_eq(dvec3(1.75, -0.875, 0.4375), 1e-15)); // m = 4: (2 - 1/4) / 4 = 0.4375
        assert!(contract(dvec3(1e9, 0.0, 0.0)).abs_diff_eq(dvec3(2.0, 0.0, 0.0), 1e-8));
        for ray in rays(50) {
            let at = |t: f64| contract(ray.origin + t * ray.direction);
            for k in 0..1000 {
                let t = f64::from(k) * 0.01;
                assert!((at(t + 1e-6) - at(t)).length() < 4e-6, "{ray:?} at {t}");
            }
        }
    }

    #[test]
    fn the_parameter_of_a_bent_ray_begins_with_0_and_grows_wherever_the_ray_begins() {
        for x in [-3.0, -1.5, 0.3, 1.0, 1.5, 3.0, 40.0] {
            let ray = Ray { origin: dvec3(x, 0.2, -0.1), direction: dvec3(1.0, 0.3, -0.2).normalize(), stretch: 1.0 };
            let bend = Bend::of(&ray);
            let places = [0.0, 0.01, 0.1, 1.0, 5.0, 100.0].map(|t| (t, bend.place(t)));
            assert_eq!(places[0].1, 0.0);
            assert!(places.is_sorted_by(|(_, before), (_, s)| before < s) && places[5].1 < bend.end(), "{x}: {places:?}");
            for (t, s) in places {
                assert!((bend.distance(s) - t).abs() < 1e-9 * (1.0 + t * t), "{x}, {t}: {}", bend.distance(s));
            }
        }
    }

    #[test]
    fn places_on_a_bent_ray_and_distances_are_inverse_and_end_at_infinity() {
        for ray in rays(200) {
            let bend = Bend::of(&ray);
            for t in [0.05, 0.3, 1.0, 2.5, 7.0, 100.0, 1e4] {
                let s = bend.place(t);
                assert!((bend.distance(s) - t).abs() < 1e-7 * t * t.max(1.0), "{ray:?}: {t} at {s}");
            }
            assert!(bend.end() < 6.0 + 1.0 && bend.distance(bend.end() - 1e-9) > 1e7);
            let s: [f64; 16] = std::array::from_fn(|k| bend.near() + (bend.end() - bend.near()) * k as f64 / 16.0);
            let at = bend.positions(&ray, &s);
            for (k, &s) in s.iter().enumerate() {
                let expected = contract(ray.origin + bend.distance(s) * ray.direction);
                assert!(dvec3(at[0][k], at[1][k], at[2][k]).abs_diff_eq(expected, 1e-9));
            }
        }
    }

    #[test]
    fn no_coordinate_changes_faster_on_a_bent_ray_than_the_bound() {
        let mut tightest = f64::INFINITY;
        for ray in rays(2000) {
            let (bend, bound) = (Bend::of(&ray), Bend::steepest(&ray));
            let at = |s: f64| contract(ray.origin + bend.distance(s) * ray.direction);
            for k in 0..500 {
                let s = bend.near() + (bend.end() - bend.near() - 1e-3) * f64::from(k) / 500.0;
                let steepest = ((at(s + 1e-6) - at(s)) / 1e-6).abs().max_element();
                assert!(steepest <= bound + 1e-4, "{ray:?} at {s}: {steepest} above {bound}");
                tightest = tightest.min(bound / steepest);
            }
        }
        assert!(tightest < 1.1, "{tightest}");
    }

    #[test]
    fn positions_of_the_world_come_back_from_the_box_and_places_on_rays_from_their_distance() {
        for space in [Space::Box, Space::Contracted, Space::Ndc { a: 1.6, b: 2.1 }] {
            let forward = |ray: &&Ray| !matches!(space, Space::Ndc { .. }) || ray.direction.z < -0.1;
            for ray in rays(200).iter().filter(forward) {
                for t in [0.3, 1.0, 2.5, 7.0, 100.0] {
                    // Normalized device coordinates are those of the points before the near plane.
                    let t = if matches!(space, Space::Ndc { .. }) { t - (1.0 + ray.origin.z) / ray.direction.z } else { t };
                    let x = ray.origin + t * ray.direction;
                    let again = space.to_world(space.to_box(x)).expect("a finite position");
                    assert!(again.abs_diff_eq(x, 1e-9 * (1.0 + x.length_squared())), "{space}: {x} came back as {again}");
                    let place = space.place(ray, t);
                    assert!((space.distance(ray, place) - t).abs() < 1e-7 * (1.0 + t * t), "{space}: {t} at {place}");
                    // A place is where a sample with this t is.
                    let at = match space {
                        Space::Contracted => contract(ray.origin + Bend::of(ray).distance(place) * ray.direction),
                        _ => space.ray(ray).origin + place * space.ray(ray).direction,
                    };
                    assert!(at.abs_diff_eq(space.to_box(x), 1e-8), "{space}");
                }
            }
        }
        assert_eq!((Space::Contracted.to_world(dvec3(0.0, 2.0, 0.0)), Space::Ndc { a: 1.0, b: 1.0 }.to_world(DVec3::Z)), (None, None));
        assert_eq!(Space::Contracted.distance(&rays(1)[0], 100.0), f64::INFINITY);
    }

    #[test]
    fn points_of_a_ray_lie_on_its_ray_in_normalized_device_coordinates() {
        let space = Space::Ndc { a: 1.6, b: 2.1 };
        let all = rays(200);
        for (ray, moved) in all.iter().zip(space.rays(&all).iter()).filter(|(ray, _)| ray.direction.z < -0.1) {
            assert!((moved.origin.z + 1.0).abs() < 1e-12 && (moved.direction.length() - 1.0).abs() < 1e-12);
            for z in [-1.5, -4.0, -1e5] {
                let p = ray.origin + (z - ray.origin.z) / ray.direction.z * ray.direction;
                let expected = dvec3(-1.6 * p.x / p.z, -2.1 * p.y / p.z, 1.0 + 2.0 / p.z);
                let along = (expected - moved.origin).dot(moved.direction);
                assert!((moved.origin + along * moved.direction).abs_diff_eq(expected, 1e-9), "{ray:?} at z = {z}");
                assert!(along > 0.0);
            }
        }
        let away = Ray { origin: DVec3::ZERO, direction: DVec3::Z, stretch: 1.0 };
        assert!(crate::geometry::Aabb::cube(2.0).intersect(space.rays(&[away])[0].origin, DVec3::Z).is_none());
    }
}
