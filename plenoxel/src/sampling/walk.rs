//! Traversal of the voxels along a ray, each once, in order, with the exact chord (Amanatides and Woo 1987). Empty bricks of 4³ voxels are
//! crossed in one step.

use crate::camera::Ray;
use crate::geometry::Aabb;
use autograd::lattice::{BRICK, BrickGrid, bit_of};
use std::ops::ControlFlow;

/// Voxel crossed by a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// Index of the voxel.
    pub voxel: [usize; 3],
    /// Number of its brick; bricks are in row-major order.
    pub brick: usize,
    /// Its bit in the brick's mask.
    pub bit: usize,
    /// Distance along the ray at which the ray enters the voxel.
    pub enter: f64,
    /// Distance along the ray at which the ray leaves the voxel, above `enter`.
    pub leave: f64,
}

/// Traversal of the voxels of a box.
#[derive(Clone, Copy, Debug)]
pub struct Walk {
    aabb: Aabb,
    bricks: BrickGrid,
    /// Range of voxels that are visited: the lowest, and one above the highest.
    extent: [[usize; 3]; 2],
}

/// Planes between voxels along one axis, numbered from 0 to `voxels`, as crossed by a ray.
#[derive(Clone, Copy)]
struct Planes {
    voxels: usize,
    /// Start of the ray in voxels, and voxels per unit of distance.
    start: f64,
    pace: f64,
    /// Distance along the ray between planes; negative if the ray crosses them in decreasing order.
    spacing: f64,
    /// Plane at distance 0, as a fraction: the start of the ray. If the ray crosses no plane, -1, which puts all planes at distances beyond
    /// any box.
    origin: f64,
    /// Offset from a cell to the plane at which the ray leaves it: 1 if the ray crosses planes in increasing order, otherwise 0.
    forward: usize,
    /// Step from a cell to the next, by wrapping addition.
    step: usize,
}

/// Distance that no ray reaches.
const NEVER: f64 = 1e300;

impl Planes {
    fn new(voxels: usize, origin: f64, direction: f64, low: f64, high: f64) -> Self {
        let side = (high - low) / voxels as f64;
        let forward = usize::from(direction > 0.0);
        let start = (origin - low) / side;
        let still = direction == 0.0;
        Planes {
            voxels,
            start,
            pace: direction / side,
            spacing: if still { NEVER } else { side / direction },
            origin: if still { -1.0 } else { start },
            forward,
            step: (2 * forward).wrapping_sub(1),
        }
    }

    /// Returns the distance along the ray at which it crosses a plane.
    #[inline(always)]
    fn at(&self, plane: usize) -> f64 {
        (plane as f64 - self.origin) * self.spacing
    }

    /// Returns the distances at which the ray enters and leaves the space between two planes.
    fn chord(&self, low: usize, high: usize) -> (f64, f64) {
        if self.pace == 0.0 {
            let inside = self.start >= low as f64 && self.start <= high as f64;
            return if inside { (f64::NEG_INFINITY, f64::INFINITY) } else { (f64::INFINITY, f64::NEG_INFINITY) };
        }
        let (low, high) = (self.at(low), self.at(high));
        (low.min(high), low.max(high))
    }

    /// Returns the cell among `low..high` that contains the ray just after distance t, up to rounding.
    #[inline(always)]
    fn cell(&self, t: f64, low: usize, high: usize) -> usize {
        ((self.start + t * self.pace) as usize).clamp(low, high - 1)
    }

    /// Returns the distance at which the ray leaves a brick and the bricks within `layers` − 1 of it.
    #[inline(always)]
    fn leaves_bricks(&self, brick: usize, layers: usize) -> f64 {
        let plane = if self.forward == 1 { brick + layers } else { (brick + 1).saturating_sub(layers) };
        self.at(plane * BRICK)
    }
}

/// Current cell (brick or voxel) of a traversal.
struct Front {
    place: [usize; 3],
    /// Distance at which the ray leaves the cell along each axis.
    exits: [f64; 3],
}

impl Front {
    /// Moves to the next cell; `spacing` is the distance between planes. Branch-free, because the axis is hard to predict.
    #[inline(always)]
    fn advance(&mut self, spacing: &[f64; 3], step: &[usize; 3]) {
        let [x, y, z] = self.exits;
        let first = (x <= y) & (x <= z);
        let second = !first & (y <= z);
        for (a, crossed) in [first, second, !(first | second)].into_iter().enumerate() {
            self.exits[a] += if crossed { spacing[a] } else { 0.0 };
            self.place[a] = self.place[a].wrapping_add(if crossed { step[a] } else { 0 });
        }
    }

    /// Returns the distance at which the ray leaves the cell.
    #[inline(always)]
    fn leave(&self) -> f64 {
        let [x, y, z] = self.exits;
        smaller(smaller(x, y), z)
    }
}

impl Walk {
    /// Creates a traversal of the voxels of a box.
    pub fn new(aabb: Aabb, voxels: [usize; 3]) -> Self {
        Walk { aabb, bricks: BrickGrid::new(voxels), extent: [[0; 3], voxels] }
    }

    /// Restricts the traversal to a range of voxels ([`super::Occupancy::extent`]).
    pub fn within(self, extent: [[usize; 3]; 2]) -> Self {
        Walk { extent, ..self }
    }

    /// Calls `visit` for each voxel along a ray, from the ray's origin on, until it breaks. Voxels that the ray only touches are not
    /// visited. Voxels of empty bricks are skipped.
    ///
    /// `free(brick)` is called when the ray enters a brick, with the brick's number in row-major order. It returns the number of layers of
    /// empty bricks: 0 if the brick is not empty, k if all bricks within k − 1 of it are empty ([`super::Occupancy::free`]).
    ///
    /// Without empty bricks, the chords sum to that of the extent, up to rounding.
    #[inline]
    pub fn along(&self, ray: &Ray, free: impl Fn(usize) -> u8, mut visit: impl FnMut(Crossing) -> ControlFlow<()>) {
        let axis = |a: usize| Planes::new(self.bricks.nodes()[a], ray.origin[a], ray.direction[a], self.aabb.min[a], self.aabb.max[a]);
        let planes = [axis(0), axis(1), axis(2)];
        let (mut t, mut end) = (0.0_f64, f64::INFINITY);
        let [low, high] = self.extent;
        for (a, axis) in planes.iter().enumerate() {
            let (enter, leave) = axis.chord(low[a], high[a]);
            (t, end) = (t.max(enter), end.min(leave));
        }
        // A ray with direction zero never leaves the box.
        if t >= end || end.is_infinite() {
            return;
        }
        let step = [planes[0].step, planes[1].step, planes[2].step];
        let spacing = [planes[0].spacing.abs(), planes[1].spacing.abs(), planes[2].spacing.abs()];
        let brick_spacing = [spacing[0] * BRICK as f64, spacing[1] * BRICK as f64, spacing[2] * BRICK as f64];
        let mut front = Front { place: [0; 3], exits: [0.0; 3] };
        for (a, axis) in planes.iter().enumerate() {
            front.place[a] = axis.cell(t, 0, axis.voxels) / BRICK;
            front.exits[a] = axis.leaves_bricks(front.place[a], 1);
        }
        let count = self.bricks.count();
        while t < end && front.place[0] < count[0] && front.place[1] < count[1] && front.place[2] < count[2] {
            let brick = self.bricks.number(front.place);
            let layers = usize::from(free(brick));
            if layers > 1 {
                // Skip to the exit of the ray from the cube of empty bricks.
                let leaves = |a: usize| planes[a].leaves_bricks(front.place[a], layers);
                let beyond = Front { place: front.place, exits: [leaves(0), leaves(1), leaves(2)] };
                t = larger(t, beyond.leave());
                for (a, axis) in planes.iter().enumerate() {
                    front.place[a] = match beyond.exits[a] <= t {
                        true => front.place[a].wrapping_add(axis.step.wrapping_mul(layers)),
                        false => axis.cell(t, 0, axis.voxels) / BRICK,
                    };
                    if front.place[a] >= count[a] {
                        return;
                    }
                    front.exits[a] = axis.leaves_bricks(front.place[a], 1);
                }
                continue;
            }
            let leave = smaller(front.leave(), end);
            if layers == 0 && leave > t && cross(&planes, (&spacing, &step), front.place, brick, t, leave, &mut visit).is_break() {
                return;
            }
            t = larger(t, leave);
            front.advance(&brick_spacing, &step);
        }
    }
}

/// Visits the voxels of one brick between two distances.
#[inline(always)]
fn cross(
    planes: &[Planes; 3],
    (spacing, step): (&[f64; 3], &[usize; 3]),
    place: [usize; 3],
    brick: usize,
    mut t: f64,
    end: f64,
    visit: &mut impl FnMut(Crossing) -> ControlFlow<()>,
) -> ControlFlow<()> {
    let low = [place[0] * BRICK, place[1] * BRICK, place[2] * BRICK];
    // A brick at the border may have fewer voxels.
    let mut size = [BRICK; 3];
    let mut front = Front { place: [0; 3], exits: [0.0; 3] };
    for (a, axis) in planes.iter().enumerate() {
        size[a] = BRICK.min(axis.voxels - low[a]);
        let voxel = axis.cell(t, low[a], low[a] + size[a]);
        front.place[a] = voxel - low[a];
        front.exits[a] = axis.at(voxel + axis.forward);
    }
    while t < end && front.place[0] < size[0] && front.place[1] < size[1] && front.place[2] < size[2] {
        let leave = smaller(front.leave(), end);
        let [x, y, z] = front.place;
        if leave > t {
            let voxel = [low[0] + x, low[1] + y, low[2] + z];
            visit(Crossing { voxel, brick, bit: bit_of([x, y, z]), enter: t, leave })?;
            t = leave;
        }
        front.advance(spacing, step);
    }
    ControlFlow::Continue(())
}

/// Returns the minimum in one instruction. The library's version also handles NaN.
#[inline(always)]
fn smaller(x: f64, y: f64) -> f64 {
    if x < y { x } else { y }
}

/// Returns the maximum in one instruction. The library's version also handles NaN.
#[inline(always)]
fn larger(x: f64, y: f64) -> f64 {
    if x > y { x } else { y }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, uniform};
    use crate::sampling::Occupancy;
    use glam::{DVec3, dvec3};

    fn crossings(walk: &Walk, origin: DVec3, direction: DVec3) -> Vec<Crossing> {
        let mut found = Vec::new();
        walk.along(
            &Ray { origin, direction, stretch: 1.0 },
            |_| 0,
            |crossing| {
                found.push(crossing);
                ControlFlow::Continue(())
            },
        );
        found
    }

    /// Returns a ray from a random point on a sphere around the box towards a random point near it.
    fn random_ray(seed: u64) -> (DVec3, DVec3) {
        let number = |k: u64| 2.0 * uniform(seed, Purpose::Initial, 9, k) - 1.0;
        let from = 4.0 * dvec3(number(0), number(1), number(2)).normalize();
        let to = 1.2 * dvec3(number(3), number(4), number(5));
        (from, (to - from).normalize())
    }

    #[test]
    fn the_voxels_of_random_rays_are_those_of_their_middles_and_their_chords_add_up() {
        let aabb = Aabb { min: dvec3(-1.0, -0.8, -1.3), max: dvec3(1.1, 0.9, 1.2) };
        let voxels = [13, 8, 21];
        let walk = Walk::new(aabb, voxels);
        for seed in 0..2000 {
            let (origin, direction) = random_ray(seed);
            let found = crossings(&walk, origin, direction);
            assert!(found.iter().all(|c| (0..3).all(|a| c.voxel[a] < voxels[a])), "ray {seed} leaves the box");
            let chord: f64 = found.iter().map(|c| c.leave - c.enter).sum();
            let expected = aabb.intersect(origin, direction).map_or(0.0, |(enter, leave)| leave - enter);
            assert!((chord - expected).abs() < 1e-12, "ray {seed}: {chord} against {expected}");
            assert!(found.windows(2).all(|pair| (pair[0].leave - pair[1].enter).abs() < 1e-12), "ray {seed} has gaps");
            for c in found.iter().filter(|c| c.leave - c.enter > 1e-9) {
                let middle = origin + 0.5 * (c.enter + c.leave) * direction;
                let u = (middle - aabb.min) / (aabb.max - aabb.min);
                let voxel: [usize; 3] = std::array::from_fn(|a| (u[a] * voxels[a] as f64) as usize);
                assert_eq!(c.voxel, voxel, "ray {seed}");
            }
        }
    }

    #[test]
    fn rays_along_axes_and_faces_go_straight() {
        let walk = Walk::new(Aabb::cube(1.0), [8; 3]);
        let straight = crossings(&walk, dvec3(-3.0, 0.3, -0.9), DVec3::X);
        assert_eq!(straight.iter().map(|c| c.voxel).collect::<Vec<_>>(), (0..8).map(|i| [i, 5, 0]).collect::<Vec<_>>());
        let back = crossings(&walk, dvec3(0.3, 0.3, 5.0), -DVec3::Z);
        assert_eq!(back.iter().map(|c| c.voxel).collect::<Vec<_>>(), (0..8).rev().map(|k| [5, 5, k]).collect::<Vec<_>>());
        // Between two voxels the ray crosses one of them; from inside it crosses the rest; beside the box, and away from it, none.
        assert_eq!(crossings(&walk, dvec3(-3.0, 0.25, 0.1), DVec3::X).len(), 8);
        assert_eq!(crossings(&walk, dvec3(0.1, 0.1, 0.1), DVec3::Y).len(), 4);
        assert!(crossings(&walk, dvec3(-3.0, 1.1, 0.0), DVec3::X).is_empty());
        assert!(crossings(&walk, dvec3(-3.0, 0.0, 0.0), -DVec3::X).is_empty());
        assert!(crossings(&walk, DVec3::ZERO, DVec3::ZERO).is_empty());
    }

    #[test]
    fn empty_bricks_are_left_out_and_breaking_ends_the_walk() {
        let walk = Walk::new(Aabb::cube(1.0), [16; 3]);
        let (origin, direction) = random_ray(7);
        let all = crossings(&walk, origin, direction);
        let ray = Ray { origin, direction, stretch: 1.0 };
        let mut odd = Vec::new();
        walk.along(
            &ray,
            |brick| u8::from(brick % 2 == 0),
            |c| {
                odd.push(c);
                ControlFlow::Continue(())
            },
        );
        assert!(!odd.is_empty() && odd.iter().copied().eq(all.iter().copied().filter(|c| c.brick % 2 == 1)));
        // Skipping several layers of empty bricks does not change the result.
        let occupancy = Occupancy::new(Aabb::cube(1.0), [37; 3], &(0..37 * 37 * 37).map(|v| v % 2999 == 7).collect::<Vec<_>>());
        let walk_large = Walk::new(Aabb::cube(1.0), [37; 3]);
        let near = walk_large.within(occupancy.extent().unwrap());
        for seed in 0..500 {
            let (origin, direction) = random_ray(seed);
            let ray = Ray { origin, direction, stretch: 1.0 };
            let along = |walk: &Walk, free: &dyn Fn(usize) -> u8| {
                let mut found = Vec::new();
                walk.along(&ray, free, |c| {
                    found.push(c);
                    ControlFlow::Continue(())
                });
                found
            };
            let (jumps, steps) =
                (along(&walk_large, &|brick| occupancy.free(brick)), along(&walk_large, &|brick| occupancy.free(brick).min(1)));
            let chord = |found: &[Crossing]| -> f64 { found.iter().map(|c| c.leave - c.enter).sum() };
            assert!((chord(&jumps) - chord(&steps)).abs() < 1e-9, "ray {seed}");
            let solid =
                |found: &[Crossing]| -> Vec<[usize; 3]> { found.iter().filter(|c| c.leave - c.enter > 1e-9).map(|c| c.voxel).collect() };
            assert_eq!(solid(&jumps), solid(&steps), "ray {seed}");
            // Restricting the traversal to the extent of the matter does not change the crossed matter.
            let matter = |found: &[Crossing]| solid(found).into_iter().filter(|&voxel| occupancy.contains(voxel)).collect::<Vec<_>>();
            assert_eq!(matter(&along(&near, &|brick| occupancy.free(brick))), matter(&jumps), "ray {seed}");
        }
        let mut first = None;
        walk.along(
            &ray,
            |_| 0,
            |c| {
                assert!(first.replace(c).is_none());
                ControlFlow::Break(())
            },
        );
        assert_eq!(first, all.first().copied());
    }
}
