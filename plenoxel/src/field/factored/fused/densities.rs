//! Densities of a field without gradients: at given positions, and as a table for pictures.
//!
//! In each cell, the product of a bilinear plane and a linear line is trilinear, and so is the sum of products, the density feature s. A table of s at the nodes
//! therefore gives the same densities as the factors, up to rounding, and a sample reads eight numbers instead of 18 rows ([`NodeTable`]). Samples whose opacity
//! is surely below a bound are left out.

use super::super::{Factored, PLANE_OF, SCALE, SHIFT};
use super::lookup::{self, LANES, Pairs, RUN, add_lanes, density_of};
use crate::field::lanes::{self, Matter};
use crate::field::node_table::{BRICKS_OF_TASK, ENTRIES, NodeTable, SIDE, StoredBricks};
use crate::geometry::Aabb;
use crate::render::Field;
use crate::sampling::Occupancy;
use autograd::lattice::{BRICK, BrickGrid};
use autograd::{Real, Tensor, dispatched, no_grad, parallel};
use glam::DVec3;
use std::sync::Arc;

/// Density feature of bricks that are left out. The density is 0.
const NOTHING: f64 = -1e3;

/// Table of the density features at the nodes of a field.
#[derive(Debug)]
pub struct Densities<T: Real> {
    /// s − 10 at the nodes.
    features: NodeTable<T>,
    cells: Occupancy,
    /// Factor and summand that map positions in cells of the table to cells of `cells`, along each axis.
    to_occupancy: [[T; 2]; 3],
}

impl<T: Real> Densities<T> {
    /// Largest size of the table relative to the field. Objects in empty space need 1.0 to 1.2 times as much as the field, captures, whose boxes are full of thin fog,
    /// 1.8 to 2.2 times as much. With a table and rays in lanes, pictures of captures take 0.63 to 0.78 of the time.
    pub const MOST: f64 = 2.5;

    /// Computes the table. Samples are left out if the densities of all nodes around them, 1 / length, are at most `negligible`. `None` if the table would need
    /// more than [`MOST`](Self::MOST) times the memory of the field, or more than 2³² entries.
    pub fn new(field: &Factored<T>, negligible: f64) -> Option<Self> {
        let nodes = field.nodes();
        let bricks = BrickGrid::new(nodes.map(|n| n - 1));
        let reach = field.reach().cloned().unwrap_or_else(|| Occupancy::full(field.aabb(), nodes.map(|n| n - 1)));
        // σ = SCALE softplus(s − 10)
        let least = T::lit((negligible / SCALE).exp_m1().ln());
        let tables = field.tables();
        let pairs = Pairs::of(&tables[..6], field.nodes(), field.shape().density_components);
        let features = |brick: u32| {
            let low = bricks.place(brick as usize).map(|place| place * BRICK);
            let mut values = [T::lit(NOTHING); ENTRIES];
            match parallel::fused() {
                true => features_of::<T, true>(pairs, low, &mut values),
                false => features_of::<T, false>(pairs, low, &mut values),
            }
            values
        };
        let reached = reached(&reach, bricks, |aabb| nodes_around(field, aabb));
        let kept = parallel::map_chunks(reached.len(), BRICKS_OF_TASK, |range| {
            let dense = |brick: &u32| features(*brick).iter().any(|&value| value > least);
            reached[range].iter().copied().filter(dense).collect::<Vec<_>>()
        });
        let kept = kept.concat();
        let most = Self::MOST * tables.iter().map(Tensor::len).sum::<usize>() as f64;
        if StoredBricks::entries(kept.len()) as f64 > most {
            return None;
        }
        // The features are computed a second time: keeping those of the first pass would double the memory.
        let table = NodeTable::new(Arc::new(StoredBricks::new(nodes, kept)?), [T::lit(NOTHING)], |brick, values| {
            *values = features(brick).map(|value| [value])
        });
        let cells = reach.kept(|aabb| {
            let [low, high] = nodes_around(field, aabb);
            let mut nodes =
                (low[0]..=high[0]).flat_map(|i| (low[1]..=high[1]).flat_map(move |j| (low[2]..=high[2]).map(move |k| [i, j, k])));
            nodes.any(|node| table.value(node)[0] > least)
        });
        let per_side = DVec3::from_array(cells.cells().map(|n| n as f64)) / (cells.aabb().max - cells.aabb().min);
        let (factor, summand) = (field.sides() * per_side, (field.aabb().min - cells.aabb().min) * per_side);
        let to_occupancy = [0, 1, 2].map(|a| [factor[a], summand[a]].map(T::lit));
        Some(Densities { features: table, cells, to_occupancy })
    }

    /// Returns the cells outside of which all samples are left out.
    pub fn cells(&self) -> &Occupancy {
        &self.cells
    }
}

/// Returns the densities at positions `[m, 3]`, as [`Field::density`](crate::render::Field::density) does, without recording a gradient.
///
/// Panics if the kernel does not [support](super::supports) the field.
pub fn densities_at<T: Real>(field: &Factored<T>, positions: &Tensor<T>) -> Tensor<T> {
    assert!(super::supports(field.shape()), "the kernel does not compute fields of this shape");
    let cells = no_grad(|| field.cells(positions));
    let tables = field.tables();
    let (pairs, cells) = (Pairs::of(&tables[..6], field.nodes(), field.shape().density_components), cells.data().as_chunks::<3>().0);
    let mut sigma = vec![T::zero(); cells.len()];
    parallel::for_each_chunk(&mut sigma, parallel::CHUNK / RUN * RUN, |first, sigma| {
        let columns = [0, 1, 2].map(|axis| cells[first..][..sigma.len()].iter().map(|cell| cell[axis]).collect::<Vec<_>>());
        let at = columns.each_ref().map(|column| &column[..]);
        let mut slope = [T::zero(); RUN];
        for (run, sigma) in sigma.chunks_mut(RUN).enumerate() {
            let [own, later] = [run, run + 1].map(|run| lookup::run_of(at, run));
            match parallel::fused() {
                true => lookup::density::<T, true>(pairs, own, later, sigma, &mut slope),
                false => lookup::density::<T, false>(pairs, own, later, sigma, &mut slope),
            }
        }
    });
    Tensor::from_vec(sigma, &[cells.len()])
}

/// Returns the lowest and the highest node of the cells that overlap a box, along each axis.
fn nodes_around<T: Real>(field: &Factored<T>, aabb: Aabb) -> [[usize; 3]; 2] {
    /// Rounding of positions, in cells.
    const ROUNDING: f64 = 1e-3;
    let (low, sides, most) = (field.aabb().min, field.sides(), field.nodes().map(|n| n - 1));
    let node = |at: DVec3| [0, 1, 2].map(|a| at[a].clamp(0.0, most[a] as f64) as usize);
    let (from, to) = ((aabb.min - low) / sides - ROUNDING, (aabb.max - low) / sides + ROUNDING);
    let (from, to) = (node(from.floor()), node(to.ceil()));
    // At the upper face, samples read the last cell.
    [[0, 1, 2].map(|a| from[a].min(most[a] - 1)), [0, 1, 2].map(|a| to[a].max(1))]
}

/// Returns the bricks that overlap bricks of occupied cells, in order. `nodes_around` maps a box to its nodes.
fn reached(cells: &Occupancy, bricks: BrickGrid, nodes_around: impl Fn(Aabb) -> [[usize; 3]; 2]) -> Vec<u32> {
    let mut reached = vec![false; bricks.len()];
    for aabb in cells.boxes_of_bricks() {
        let [low, high] = nodes_around(aabb);
        let range = |a: usize| low[a] / BRICK..=(high[a] - 1) / BRICK;
        for (i, j) in range(0).flat_map(|i| range(1).map(move |j| (i, j))) {
            let [first, last] = [*range(2).start(), *range(2).end()].map(|k| bricks.number([i, j, k]));
            reached[first..=last].fill(true);
        }
    }
    (0..).zip(reached).filter(|(_, reached)| *reached).map(|(brick, _)| brick).collect()
}

dispatched! {
/// Computes s − 10 at the nodes of a brick, from its lowest node.
fn features_of<T: Real, const FUSED: bool>(pairs: Pairs<'_, T>, low: [usize; 3], out: &mut [T; ENTRIES]) {
    let chunks = pairs.width / LANES;
    // The last brick may have fewer nodes; its other entries are not read.
    let node = |axis: usize, local: usize| (low[axis] + local).min(pairs.nodes[axis] - 1);
    for i in 0..SIDE {
        for j in 0..SIDE {
            let mut sums = [[T::zero(); LANES]; SIDE];
            for axis in 0..3 {
                let (plane, line) = (pairs.planes[axis].as_chunks::<LANES>().0, pairs.lines[axis].as_chunks::<LANES>().0);
                let [b, c] = PLANE_OF[axis];
                for (k, sum) in sums.iter_mut().enumerate() {
                    let at = [node(0, i), node(1, j), node(2, k)];
                    let (row, along) = (at[b] * pairs.nodes[c] + at[c], at[axis]);
                    for chunk in 0..chunks {
                        let (p, l) = (&plane[row * chunks + chunk], &line[along * chunks + chunk]);
                        let old = *sum;
                        let mut new = [T::zero(); LANES];
                        for lane in 0..LANES {
                            new[lane] = p[lane].multiply_add::<FUSED>(l[lane], old[lane]);
                        }
                        *sum = new;
                    }
                }
            }
            add_lanes(&mut sums);
            for (k, sum) in sums.iter().enumerate() {
                out[(i * SIDE + j) * SIDE + k] = sum[0] + T::lit(SHIFT);
            }
        }
    }
}
}

impl<T: Real> Matter<T> for Densities<T> {
    fn table(&self) -> &NodeTable<T> {
        &self.features
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Several arrays have the same index.
    fn sigma<const FUSED: bool>(&self, at: &[[T; lanes::LANES]; 3], features: [T; lanes::LANES]) -> [T; lanes::LANES] {
        let occupied: [bool; lanes::LANES] = self.cells.occupied(|axis, i, cells| {
            let [factor, summand] = self.to_occupancy[axis];
            at[axis][i].multiply_add::<FUSED>(factor, summand).max(T::zero()).min(T::lit((cells - 1) as f64)).index()
        });
        let mut sigma = [T::zero(); lanes::LANES];
        for i in 0..lanes::LANES {
            sigma[i] = density_of::<T, FUSED>(features[i]).0;
        }
        for i in 0..lanes::LANES {
            sigma[i] = if occupied[i] { sigma[i] } else { T::zero() };
        }
        sigma
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Ray;
    use crate::field::encoding::Directions;
    use crate::field::factored::Shape;
    use crate::field::node_table::Cells;
    use crate::render::{Engine, RenderOptions, render};
    use crate::sampling::{Jitter, Spacing};
    use autograd::random::Stream;
    use autograd::{Module, Param};
    use std::ops::Range;
    use std::slice::from_ref;

    const BOX: Aabb = Aabb { min: DVec3::new(-1.0, -0.7, -1.2), max: DVec3::new(1.1, 0.9, 0.8) };

    /// A field with dense and with empty parts.
    fn field(nodes: [usize; 3]) -> Factored<f64> {
        let directions = Directions::Harmonics(1);
        let shape = Shape { density_components: 16, appearance_components: 64, features: 4, hidden: 4, feature_octaves: 0, directions };
        let mut field = Factored::new(shape, BOX, nodes, &Stream::new(3));
        field.visit_mut(&mut |param: &mut Param<f64>| {
            if param.name().starts_with("density") {
                *param = Param::from_tensor(param.name(), param.tensor() * 7.0);
            }
        });
        field
    }

    fn positions(count: usize) -> Tensor<f64> {
        let shares = Stream::new(4).uniform_tensor::<f64>(&[count, 3], 0.0, 1.0);
        let side = BOX.max - BOX.min;
        let at = |share: &[f64]| {
            // Some lie on faces of the box.
            let share = DVec3::from_slice(share);
            BOX.min + side * (1.1 * share - 0.05).clamp(DVec3::ZERO, DVec3::ONE)
        };
        Tensor::from_vec(shares.data().chunks(3).flat_map(|share| at(share).to_array()).collect(), &[count, 3])
    }

    fn read(table: &Densities<f64>, field: &Factored<f64>, positions: &Tensor<f64>) -> Vec<f64> {
        let all = field.cells(positions);
        let runs = all.data().chunks(3 * lanes::LANES).flat_map(|run| {
            let at = [0, 1, 2].map(|axis| std::array::from_fn(|i| run.get(3 * i + axis).copied().unwrap_or(0.0)));
            let cells = Cells::find(table.features.bricks(), at.each_ref());
            let sigma = match parallel::fused() {
                true => table.sigma::<true>(&at, cells.numbers::<true>(&table.features)),
                false => table.sigma::<false>(&at, cells.numbers::<false>(&table.features)),
            };
            sigma.into_iter().take(run.len() / 3)
        });
        runs.collect()
    }

    #[test]
    fn densities_at_positions_are_those_of_the_graph() {
        for nodes in [[9, 12, 10], [30, 17, 24]] {
            let (field, at) = (field(nodes), positions(3 * RUN + 5));
            let (want, found) = (no_grad(|| field.density(&at)), densities_at(&field, &at));
            assert_eq!(found.shape(), want.shape());
            for (want, found) in want.data().iter().zip(found.data()) {
                assert!((want - found).abs() <= 1e-12 * want.abs().max(1.0), "{want} {found}");
            }
        }
    }

    #[test]
    fn each_ray_of_a_batch_has_the_densities_that_it_has_alone() {
        let field = field([30, 17, 24]);
        // Rays beside the box, through edges and through the middle: with no sample, with less than a run, and with several runs.
        let ray = |i: usize| {
            let origin = DVec3::new(0.055 * i as f64 - 1.8, 0.3 - 0.02 * i as f64, 2.0);
            Ray { origin, direction: DVec3::new(0.2, 0.1, -1.0), stretch: 1.0 }
        };
        let rays: Vec<Ray> = (0..64).map(ray).collect();
        let counts = [0.0, 0.97].map(|stop_below| {
            let (spacing, jitter, engine) = (Spacing::Step(0.05), Jitter::None, Engine::Fused);
            let options = RenderOptions { aabb: BOX, spacing, jitter, background: [1.0; 3], occupancy: None, engine, stop_below };
            let all = render(&field, &rays, &options);
            let mut counts = Vec::new();
            for (i, ray) in rays.iter().enumerate() {
                let one = render(&field, from_ref(ray), &options);
                assert_eq!(one.opacity.data()[0], all.opacity.data()[i], "ray {i}, stop {stop_below}");
                assert_eq!(one.depth().data()[0], all.depth().data()[i], "ray {i}, stop {stop_below}");
                counts.push(one.sample_count);
            }
            assert_eq!(counts.iter().sum::<usize>(), all.sample_count);
            counts
        });
        let has = |range: Range<usize>| counts[0].iter().any(|count| range.contains(count));
        assert!(has(0..1) && has(1..RUN) && has(RUN + 1..2 * RUN) && has(2 * RUN..100), "{:?}", counts[0]);
        assert!(counts[0].iter().zip(&counts[1]).any(|(all, stopped)| stopped < all), "no ray ends early");
    }

    #[test]
    fn the_table_has_the_densities_of_the_factors() {
        for nodes in [[2, 2, 2], [5, 9, 4], [6, 13, 10]] {
            let field = field(nodes);
            let at = positions(1000);
            let (want, found) = (field.density(&at), read(&Densities::new(&field, 0.0).expect("a small table"), &field, &at));
            for (want, found) in want.data().iter().zip(&found) {
                assert!((want - found).abs() < 1e-10 * (1.0 + want), "{nodes:?}: {found} instead of {want}");
            }
        }
    }

    #[test]
    fn only_samples_below_the_bound_and_outside_of_the_reach_are_left_out() {
        let nodes = [30, 21, 26];
        for cells in [None, Some([17, 24, 19])] {
            let mut field = field(nodes);
            // The reach may belong to an earlier, larger box.
            let larger = Aabb { min: BOX.min - 0.1, max: BOX.max + 0.2 };
            let scattered = |cells: [usize; 3]| {
                let numbers = Stream::new(9).uniform_tensor::<f64>(&[cells.iter().product()], 0.0, 1.0);
                Occupancy::new(larger, cells, &numbers.data().iter().map(|&number| number < 0.5).collect::<Vec<_>>())
            };
            field.occupied = cells.map(scattered);
            let negligible = 0.5;
            let table = Densities::new(&field, negligible).expect("a small table");
            let at = positions(20_000);
            let (want, found) = (field.density(&at), read(&table, &field, &at));
            let mut left_out = 0;
            for ((at, &want), &found) in at.data().chunks(3).zip(want.data()).zip(&found) {
                let at = DVec3::from_slice(at);
                let reached = field.occupied.as_ref().is_none_or(|reach| reach.contains_point(at));
                let inside = table.cells().contains_point(at.min(BOX.max - 1e-9));
                assert!(!inside || reached);
                if reached && inside {
                    assert!((want - found).abs() < 1e-10 * (1.0 + want) || want <= negligible, "{found} instead of {want} at {at}");
                } else {
                    assert!(found == 0.0 && (want <= negligible || !reached), "{found} instead of {want} at {at}");
                    left_out += usize::from(reached);
                }
            }
            assert!(left_out > 1000, "{left_out}");
        }
    }
}
