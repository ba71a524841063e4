//! Cotangents of the origins and directions of rays, from those of the positions of their samples.

use super::super::PLANE_OF;
use super::Tracked;
use super::adjoint::Kept;
use super::forward::{Block, Tables};
use super::lookup::{Cells, Cotangents, LANES, Pairs, Places, RUN, line_at, plane_at, prefetch};
use crate::camera::Ray;
use crate::sampling::Spacing;
use crate::space::{Bend, contract_adjoint};
use autograd::{Buffer, Real, dispatched, parallel};
use glam::DVec3;

/// Cotangents of the rays of a block: of encoded directions, `[rays, e]`, of origins and of directions, `[rays, 3]`.
pub type OfRays<T> = [Buffer<T>; 3];

/// Joins the cotangents of all blocks.
pub fn joined<T: Real>(blocks: &[OfRays<T>]) -> OfRays<T> {
    [0, 1, 2].map(|k| {
        let mut all = Buffer::stale(blocks.iter().map(|block| block[k].len()).sum());
        let mut rest = &mut all[..];
        for block in blocks {
            let (own, others) = rest.split_at_mut(block[k].len());
            own.copy_from_slice(&block[k]);
            rest = others;
        }
        all
    })
}

/// Computes the cotangents of the origins and directions of the rays of a block from those of the density features of samples and of the products of groups. A ray
/// without samples has the cotangent 0.
pub fn of_rays<T: Real>(tracked: &Tracked, block: &Block<T>, tables: &Tables<'_, T>, [density, products]: [&Kept<T>; 2]) -> [Buffer<T>; 2] {
    let mut of_samples = slopes(tables.density, density, block.len());
    let of_groups = slopes(tables.appearance, products, block.groups.len());
    for (group, sample, share) in block.groups.shares(block.weight()) {
        (0..3).for_each(|axis| of_samples[axis][sample] += share * of_groups[axis][group]);
    }
    let rays = block.offsets.len() - 1;
    let (mut of_origins, mut of_directions) = (Buffer::stale(3 * rays), Buffer::stale(3 * rays));
    for (r, (ray, own)) in tracked.rays[block.first..].iter().zip(block.rays()).enumerate() {
        let (mut origin, mut direction) = (DVec3::ZERO, DVec3::ZERO);
        let position = tracked.position_of(ray);
        for i in own {
            let g = DVec3::from_array([0, 1, 2].map(|axis| of_samples[axis][i].as_f64())) * tracked.per_length;
            let (g, distance) = position(block.t()[i].as_f64(), g);
            origin += g;
            direction += distance * g;
        }
        of_origins[3 * r..][..3].copy_from_slice(&origin.to_array().map(T::lit));
        of_directions[3 * r..][..3].copy_from_slice(&direction.to_array().map(T::lit));
    }
    [of_origins, of_directions]
}

impl Tracked {
    /// Returns a function from t of a sample of a ray, and the cotangent of its position, to the cotangent of o + t d and the distance from o.
    fn position_of(&self, ray: &Ray) -> impl Fn(f64, DVec3) -> (DVec3, f64) {
        let (ray, bend) = (*ray, matches!(self.spacing, Spacing::Contracted(_)).then(|| Bend::of(ray)));
        move |t, g| match bend {
            None => (g, t),
            Some(bend) => {
                let distance = bend.distance(t);
                (contract_adjoint(ray.origin + distance * ray.direction, g), distance)
            }
        }
    }
}

/// Returns the cotangents of the positions of `all` samples or groups, in units of cells, from those of the products of some; the others have 0.
fn slopes<T: Real>(pairs: Pairs<'_, T>, kept: &Kept<T>, all: usize) -> [Buffer<T>; 3] {
    let mut slopes = [0, 1, 2].map(|_| Buffer::zeros(all));
    for (run, numbers) in kept.numbers.chunks(RUN).enumerate() {
        let range = run * RUN..run * RUN + numbers.len();
        let (at, g) = (kept.at().map(|at| &at[range.clone()]), kept.g().of(range, 3 * pairs.width));
        let mut out = [[T::zero(); RUN]; 3];
        if parallel::fused() {
            add_slopes::<T, true>(pairs, at, g, &mut out);
        } else {
            add_slopes::<T, false>(pairs, at, g, &mut out);
        }
        for (slopes, out) in slopes.iter_mut().zip(&out) {
            numbers.iter().zip(out).for_each(|(&i, &slope)| slopes[i as usize] = slope);
        }
    }
    slopes
}

dispatched! {
/// Adds the cotangents of the positions of up to [`RUN`] samples. With a = P L for the axis of a line, P of the axes (b, c), and fractions x and y of the cell
/// along b and c: ∂a/∂p_a = P ΔL, ∂a/∂p_b = L ((1 − y) ΔP₀ + y ΔP₁), ∂a/∂p_c likewise, where Δ are differences of neighbouring nodes.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn add_slopes<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, at: Places<'_, T>, g: Cotangents<'_, T>, out: &mut [[T; RUN]; 3]) {
    let cells = Cells::new(at, pairs.nodes);
    prefetch(pairs, &cells);
    let chunks = pairs.width / LANES;
    for axis in 0..3 {
        let (plane, line) = (pairs.planes[axis].as_chunks::<LANES>().0, pairs.lines[axis].as_chunks::<LANES>().0);
        let [b, c] = PLANE_OF[axis];
        for i in 0..cells.count {
            let (corner, along) = (cells.corner(axis, i), cells.along(axis, i));
            let (x, y) = (cells.share[b][i], cells.share[c][i]);
            let (u, v) = (T::one() - x, T::one() - y);
            let (mut of_a, mut of_b, mut of_c) = ([T::zero(); LANES], [T::zero(); LANES], [T::zero(); LANES]);
            for k in 0..chunks {
                let (first, second) = (corner.rows[0] * chunks + k, corner.rows[1] * chunks + k);
                let (p, q, r, s) = (&plane[first], &plane[first + chunks], &plane[second], &plane[second + chunks]);
                let (low, high) = (&line[along.row * chunks + k], &line[(along.row + 1) * chunks + k]);
                let value = g.times(i, axis * chunks + k, 3 * chunks, plane_at::<T, FUSED>(plane, corner, chunks, k));
                let factor = g.times(i, axis * chunks + k, 3 * chunks, line_at::<T, FUSED>(line, along, chunks, k));
                let (a, b, c) = (of_a, of_b, of_c);
                for l in 0..LANES {
                    of_a[l] = a[l] + value[l] * (high[l] - low[l]);
                    of_b[l] = b[l] + factor[l] * (v * (r[l] - p[l]) + y * (s[l] - q[l]));
                    of_c[l] = c[l] + factor[l] * (u * (q[l] - p[l]) + x * (s[l] - r[l]));
                }
            }
            for (axis, lanes) in [(axis, of_a), (b, of_b), (c, of_c)] {
                let mut sum = out[axis][i];
                for value in lanes {
                    sum += value;
                }
                out[axis][i] = sum;
            }
        }
    }
}
}
