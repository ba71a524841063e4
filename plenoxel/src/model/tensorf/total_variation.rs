//! Total variation of the density planes.

use super::Tensorf;
use crate::field::factored::PLANE_OF;
use crate::loss::{Objective, Step};
use autograd::optim::Schedule;
use autograd::random::Stream;
use autograd::{Indices, Real, Tensor};

/// Factor of the mean squared differences in the authors' `TVLoss`, 2, and in `TV_loss_density`, 10⁻².
const SCALE: f64 = 0.02;
/// Steps between two evaluations.
const INTERVAL: u64 = 10;
/// Share of the rows of a plane that an evaluation reads.
const SHARE: f64 = 0.2;
/// Number of differences between neighbouring rows in a run; an evaluation reads whole runs.
const RUN: usize = 8;

/// Adds the total variation of the density planes to an objective, with the authors' `TV_weight_density` as its weight; 0 adds nothing. The authors evaluate
/// whole planes at every step; here every tenth step has ten times the weight, on a fifth of the rows.
pub(super) fn with_density<T: Real>(objective: Objective<T, Tensorf<T>>, weight: f64) -> Objective<T, Tensorf<T>> {
    let tv = |step: &Step<'_, T, Tensorf<T>>| {
        let random = Stream::new(step.seed).named("density_tv").numbered(step.number);
        let number = |k: usize| random.uniform(k as u64);
        let factors = step.model.field().density_factors();
        let planes: Vec<Tensor<T>> = factors.planes.iter().map(|plane| plane.tensor().clone()).collect();
        of_planes(&planes, factors.nodes(), SHARE, number)
    };
    if weight > 0.0 { objective.with("density_tv", Sometimes { weight: weight * INTERVAL as f64 }, tv) } else { objective }
}

/// A weight at every [`INTERVAL`]-th step, and 0 at the others.
#[derive(Debug)]
struct Sometimes {
    weight: f64,
}

impl Schedule for Sometimes {
    fn at(&self, step: u64) -> f64 {
        if step.is_multiple_of(INTERVAL) { self.weight } else { 0.0 }
    }
}

/// Returns 0.02 Σ over planes of (mean (P_{b+1,c} − P_{b,c})² + mean (P_{b,c+1} − P_{b,c})²) for a share of the rows b, which `number(k)` in [0, 1) chooses.
/// With a share of 1 it reads every row.
fn of_planes<T: Real>(planes: &[Tensor<T>], nodes: [usize; 3], share: f64, number: impl Fn(usize) -> f64) -> Tensor<T> {
    let of_plane = |axis: usize| {
        let [rows, columns] = PLANE_OF[axis].map(|a| nodes[a]);
        let plane = &planes[axis];
        let run = if share < 1.0 { RUN.min(rows - 1) } else { rows - 1 };
        let runs = if share < 1.0 { (share * rows as f64 / run as f64).ceil() as usize } else { 1 };
        let first = |r: usize| (number(axis << 20 | r) * (rows - run) as f64) as usize;
        let read = (0..runs).flat_map(|r| first(r) * columns..(first(r) + run + 1) * columns).map(|row| row as u32);
        let values = plane.gather_rows(&Indices::from(read.collect::<Vec<_>>())).reshape(&[runs, run + 1, columns, plane.shape()[1]]);
        let differences = |axis: usize, n: usize| (values.narrow(axis, 1, n - 1) - values.narrow(axis, 0, n - 1)).square().mean();
        differences(1, run + 1) + differences(2, columns)
    };
    (of_plane(0) + of_plane(1) + of_plane(2)) * SCALE
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::Gradcheck;

    const NODES: [usize; 3] = [4, 12, 5];

    fn planes() -> Vec<Tensor<f64>> {
        let sides = PLANE_OF.map(|axes| axes.map(|a| NODES[a]));
        sides.iter().zip(0..).map(|(side, k)| Stream::new(k).normal_tensor(&[side[0] * side[1], 3], 0.0, 1.0)).collect()
    }

    #[test]
    fn it_is_the_mean_of_squared_differences_and_a_share_of_the_rows_estimates_it() {
        let planes = planes();
        let mut want = 0.0;
        for (plane, [rows, columns]) in planes.iter().zip(PLANE_OF.map(|axes| axes.map(|a| NODES[a]))) {
            let at = |b: usize, c: usize, r: usize| plane.data()[(b * columns + c) * 3 + r];
            let mut sums = [(0.0, 0.0); 2];
            for (b, c, r) in (0..rows).flat_map(|b| (0..columns).flat_map(move |c| (0..3).map(move |r| (b, c, r)))) {
                let next = [(b + 1, c), (b, c + 1)];
                for ((sum, count), (b1, c1)) in sums.iter_mut().zip(next).filter(|(_, (b1, c1))| *b1 < rows && *c1 < columns) {
                    *sum += (at(b1, c1, r) - at(b, c, r)).powi(2);
                    *count += 1.0;
                }
            }
            want += 0.02 * sums.iter().map(|(sum, count)| sum / count).sum::<f64>();
        }
        assert!((of_planes(&planes, NODES, 1.0, |_| 0.0).item() / want - 1.0).abs() < 1e-12);
        let random = Stream::new(9);
        let shares = (0..500).map(|n| of_planes(&planes, NODES, 0.2, |k| random.numbered(n).uniform(k as u64)).item());
        // Rows at the border are in fewer runs than those inside.
        assert!((shares.sum::<f64>() / 500.0 / want - 1.0).abs() < 0.1);
    }

    #[test]
    fn its_gradient_agrees_with_finite_differences() {
        let start: Vec<_> = planes().iter().map(Tensor::to_array).collect();
        let f = |x: &[Tensor<f64>]| of_planes(x, NODES, 0.2, |k| (0.7 * k as f64).fract());
        Gradcheck::new(f, start).named("density_tv").order(2).run().unwrap_or_else(|e| panic!("{e}"));
    }
}
