//! Total variation of the density planes.

use super::Tensorf;
use crate::field::factored::PLANE_OF;
use crate::loss::{Objective, Step};
use autograd::random::Stream;
use autograd::{Buffer, GradSink, Kernel, KernelCall, Real, RowSparse, Tensor, dispatched, parallel};
use std::ops::Range;

/// Factor of the mean squared differences in the authors' `TVLoss`, 2, and in `TV_loss_density`, 10⁻².
const SCALE: f64 = 0.02;
/// Share of the lines of a plane that a step reads.
const SHARE: f64 = 0.05;

/// Adds the total variation of the density planes to an objective, with the authors' `TV_weight_density` as its weight; 0 adds nothing. The authors read whole
/// planes at every step; here a step reads a twentieth of each plane, at a random place.
pub(super) fn with_density<T: Real>(objective: Objective<T, Tensorf<T>>, weight: f64) -> Objective<T, Tensorf<T>> {
    let tv = |step: &Step<'_, T, Tensorf<T>>| {
        let random = Stream::new(step.seed).named("density_tv").numbered(step.number);
        let factors = step.model.field().density_factors();
        let planes: Vec<Tensor<T>> = factors.planes.iter().map(|plane| plane.tensor().clone()).collect();
        of_planes(&planes, factors.nodes(), SHARE, |axis| random.uniform(axis as u64))
    };
    if weight > 0.0 { objective.with("density_tv", weight, tv) } else { objective }
}

/// Returns 0.02 Σ over planes of (mean (P_{b+1,c} − P_{b,c})² + mean (P_{b,c+1} − P_{b,c})²) over a share of consecutive lines b, whose first `number(axis)` in
/// [0, 1) chooses. With a share of 1 it reads every line.
fn of_planes<T: Real>(planes: &[Tensor<T>], nodes: [usize; 3], share: f64, number: impl Fn(usize) -> f64) -> Tensor<T> {
    let of_plane = |axis: usize| {
        let [lines, columns] = PLANE_OF[axis].map(|a| nodes[a]);
        // Between two lines at least.
        let steps = ((share * lines as f64).ceil() as usize).min(lines - 1);
        let first = (number(axis) * (lines - steps) as f64) as usize;
        of_lines(&planes[axis], columns, first..first + steps + 1)
    };
    (of_plane(0) + of_plane(1) + of_plane(2)) * SCALE
}

/// Returns the means of the squared differences between neighbours of some lines of a plane, along both axes. The gradient is row-sparse.
fn of_lines<T: Real>(plane: &Tensor<T>, columns: usize, lines: Range<usize>) -> Tensor<T> {
    let kernel = TotalVariation { columns, lines };
    let (values, width) = (kernel.values(plane), plane.shape()[1]);
    let stride = columns * width;
    let sums = parallel::map_indices(kernel.lines.len(), |line| {
        let own = &values[line * stride..][..stride];
        let next = values.get((line + 1) * stride..(line + 2) * stride);
        [next.map_or(T::zero(), |next| squares(own, next)), squares(&own[width..], &own[..stride - width])]
    });
    let [across, along] = kernel.counts(width).map(|count| T::lit(1.0 / count));
    let value = sums.iter().map(|sums| sums[0] * across + sums[1] * along).sum();
    Tensor::from_kernel(vec![value].into(), &[], &[plane], kernel)
}

/// Kernel of [`of_lines`].
#[derive(Debug)]
struct TotalVariation {
    /// Nodes of a line.
    columns: usize,
    lines: Range<usize>,
}

impl TotalVariation {
    /// Returns the values of the lines.
    fn values<'a, T: Real>(&self, plane: &'a Tensor<T>) -> &'a [T] {
        let stride = self.columns * plane.shape()[1];
        &plane.data()[self.lines.start * stride..self.lines.end * stride]
    }

    /// Returns the numbers of differences between lines and along lines of rows of this width.
    fn counts(&self, width: usize) -> [f64; 2] {
        [(self.lines.len() - 1) * self.columns, self.lines.len() * (self.columns - 1)].map(|count| (count * width) as f64)
    }
}

impl<T: Real> Kernel<T> for TotalVariation {
    fn name(&self) -> &'static str {
        "total_variation_of_plane"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let (lines, columns, width) = (self.lines.len(), self.columns, inputs[0].shape()[1]);
        let values = inputs[0].narrow(0, self.lines.start * columns, lines * columns).reshape(&[lines, columns, width]);
        let differences = |axis: usize, n: usize| (values.narrow(axis, 1, n - 1) - values.narrow(axis, 0, n - 1)).square().mean();
        differences(0, lines) + differences(1, columns)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (plane, scale) = (call.input(0), call.cotangent().item() * T::lit(2.0));
        let (values, width) = (self.values(&plane), plane.shape()[1]);
        let stride = self.columns * width;
        let [across, along] = self.counts(width).map(|count| scale / T::lit(count));
        let mut gradient = Buffer::zeros(values.len());
        parallel::for_each_chunk(&mut gradient, stride, |first, sums| {
            let own = &values[first..first + stride];
            if first > 0 {
                add_differences(across, own, &values[first - stride..first], sums);
            }
            if first + stride < values.len() {
                add_differences(across, own, &values[first + stride..first + 2 * stride], sums);
            }
            add_differences(along, &own[width..], own, &mut sums[width..]);
            add_differences(along, own, &own[width..], sums);
        });
        let mut rows = Buffer::stale(values.len() / width);
        rows.iter_mut().zip((self.lines.start * self.columns) as u32..).for_each(|(to, row)| *to = row);
        out.rows(0, RowSparse::new(plane.shape(), rows, gradient));
    }
}

dispatched! {
/// Returns Σ (aᵢ − bᵢ)².
fn squares<T: Real>(a: &[T], b: &[T]) -> T {
    const LANES: usize = 16;
    let mut lanes = [T::zero(); LANES];
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANES {
            lanes[l] += (a[l] - b[l]) * (a[l] - b[l]);
        }
    }
    for (l, (&a, &b)) in rest_a.iter().zip(rest_b).enumerate() {
        lanes[l] += (a - b) * (a - b);
    }
    let mut sum = T::zero();
    for lane in lanes {
        sum += lane;
    }
    sum
}
}

dispatched! {
/// Adds s (aᵢ − bᵢ) to each sum that has both.
fn add_differences<T: Real>(scale: T, a: &[T], b: &[T], sums: &mut [T]) {
    for ((sum, &a), &b) in sums.iter_mut().zip(a).zip(b) {
        *sum += scale * (a - b);
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::{Gradcheck, check_kernel};

    const NODES: [usize; 3] = [4, 12, 5];

    fn planes() -> Vec<Tensor<f64>> {
        let sides = PLANE_OF.map(|axes| axes.map(|a| NODES[a]));
        sides.iter().zip(0..).map(|(side, k)| Stream::new(k).normal_tensor(&[side[0] * side[1], 3], 0.0, 1.0)).collect()
    }

    #[test]
    fn it_is_the_mean_of_squared_differences_and_a_share_of_the_lines_estimates_it() {
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
        let shares = (0..500).map(|n| of_planes(&planes, NODES, 0.2, |axis| random.numbered(n).uniform(axis as u64)).item());
        // Lines at the border are read less often than those inside.
        assert!((shares.sum::<f64>() / 500.0 / want - 1.0).abs() < 0.1);
    }

    #[test]
    fn the_kernel_agrees_with_its_reference_and_finite_differences() {
        let plane = planes().remove(2).to_array();
        for lines in [0..2, 3..7, 0..12] {
            let report = check_kernel(|x| of_lines(&x[0], 4, lines.clone()), [plane.clone()], 1e-12);
            report.unwrap_or_else(|e| panic!("{lines:?}: {e}"));
        }
        let start: Vec<_> = planes().iter().map(Tensor::to_array).collect();
        let f = |x: &[Tensor<f64>]| of_planes(x, NODES, 0.2, |axis| (0.7 * axis as f64).fract());
        Gradcheck::new(f, start).named("density_tv").order(2).run().unwrap_or_else(|e| panic!("{e}"));
    }
}
