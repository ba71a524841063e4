//! Real spherical harmonics, degrees 0 to 3, in the order and with the signs of svox2 (also of PlenOctrees, and of the source paper's atan2
//! form).
//!
//! Up to degree d there are (d + 1)² functions: 1; −y, z, −x; xy, −yz, 2z² − x² − y², −xz, x² − y²; and seven of degree 3. Each is
//! multiplied by its normalization constant.

pub(crate) mod least_squares;

use autograd::{Buffer, Real, Tensor, dispatched, is_recording, no_grad, parallel};
use ndarray::{Array2, ArrayView2};
use std::ops::{Mul, Sub};

/// Constant function of degree 0, 1 / (2 √π).
pub const Y0: f64 = 0.282_094_791_773_878_14;

/// Returns the number of functions up to a degree.
pub const fn count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Largest supported degree.
pub const MAX_DEGREE: usize = 3;

/// Largest number of functions.
const MOST: usize = count(MAX_DEGREE);

/// Evaluates the basis at unit directions `[n, 3]`. Returns `[n, (degree + 1)²]`, differentiable in the directions.
///
/// Panics if the degree is above 3 or the directions are not `[n, 3]`.
#[track_caller]
pub fn basis<T: Real>(directions: &Tensor<T>, degree: usize) -> Tensor<T> {
    assert!(degree <= MAX_DEGREE, "spherical harmonics of degree {degree}: only 0 to {MAX_DEGREE}");
    assert!(directions.ndim() == 2 && directions.shape()[1] == 3, "directions must be [n, 3], got {:?}", directions.shape());
    if !(directions.is_tracked() && is_recording()) {
        return untracked(directions, degree);
    }
    let [x, y, z] = [0, 1, 2].map(|axis| directions.index_axis(1, axis));
    let mut columns: Vec<Tensor<T>> = vec![Tensor::full(x.shape(), Y0)];
    if degree >= 1 {
        columns.extend(of_degree_1([x.clone(), y.clone(), z.clone()], |number| number));
    }
    if degree >= 2 {
        columns.extend(of_degree_2([x.clone(), y.clone(), z.clone()], |number| number));
    }
    if degree >= 3 {
        columns.extend(of_degree_3([x, y, z], |number| number));
    }
    Tensor::stack(&columns.iter().collect::<Vec<_>>(), 1)
}

/// Evaluates the basis without a graph.
fn untracked<T: Real>(directions: &Tensor<T>, degree: usize) -> Tensor<T> {
    /// Directions of one task.
    const DIRECTIONS: usize = 1 << 10;
    let (n, count) = (directions.shape()[0], count(degree));
    let mut values = Buffer::stale(n * count);
    parallel::for_each_chunk(&mut values, DIRECTIONS * count, |first, values| {
        let directions = &directions.data().as_chunks::<3>().0[first / count..];
        match degree {
            0 => values.fill(T::lit(Y0)),
            1 => evaluate::<T, 1>(directions, values),
            2 => evaluate::<T, 2>(directions, values),
            _ => evaluate::<T, 3>(directions, values),
        }
    });
    Tensor::from_buffer(values, &[n, count])
}

dispatched! {
/// Evaluates the basis up to degree `DEGREE`, 1 to 3, into one row for each direction.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn evaluate<T: Real, const DEGREE: usize>(directions: &[[T; 3]], rows: &mut [T]) {
    /// Directions that are evaluated together.
    const RUN: usize = 64;
    let count = count(DEGREE);
    let mut values = [[T::lit(Y0); RUN]; MOST];
    for (directions, rows) in directions.chunks(RUN).zip(rows.chunks_mut(RUN * count)) {
        let [mut x, mut y, mut z] = [[T::zero(); RUN]; 3];
        for i in 0..directions.len() {
            [x[i], y[i], z[i]] = directions[i];
        }
        for i in 0..RUN {
            [values[1][i], values[2][i], values[3][i]] = of_degree_1([x[i], y[i], z[i]], T::lit);
        }
        if DEGREE >= 2 {
            for i in 0..RUN {
                [values[4][i], values[5][i], values[6][i], values[7][i], values[8][i]] = of_degree_2([x[i], y[i], z[i]], T::lit);
            }
        }
        if DEGREE >= 3 {
            for i in 0..RUN {
                let own = of_degree_3([x[i], y[i], z[i]], T::lit);
                for k in 0..7 {
                    values[9 + k][i] = own[k];
                }
            }
        }
        for (i, row) in rows.chunks_exact_mut(count).enumerate() {
            for k in 0..count {
                row[k] = values[k][i];
            }
        }
    }
}
}

/// Number or tensor, of which products and differences are taken.
trait Term: Clone + Mul<Output = Self> + Sub<Output = Self> {}
impl<V: Clone + Mul<Output = V> + Sub<Output = V>> Term for V {}

// The functions of each degree at (x, y, z), for tensors that record a graph and for numbers. `number` makes a factor of a constant.

#[inline(always)]
fn of_degree_1<V, C: Mul<V, Output = V>>([x, y, z]: [V; 3], number: impl Fn(f64) -> C) -> [V; 3] {
    [number(-0.488_602_511_902_919_9) * y, number(0.488_602_511_902_919_9) * z, number(-0.488_602_511_902_919_9) * x]
}

#[inline(always)]
fn of_degree_2<V: Term, C: Mul<V, Output = V>>([x, y, z]: [V; 3], number: impl Fn(f64) -> C) -> [V; 5] {
    let product = |a: &V, b: &V| a.clone() * b.clone();
    let (xx, yy, zz) = (product(&x, &x), product(&y, &y), product(&z, &z));
    [
        number(1.092_548_430_592_079_2) * product(&x, &y),
        number(-1.092_548_430_592_079_2) * product(&y, &z),
        number(0.315_391_565_252_520_05) * (number(2.0) * zz - xx.clone() - yy.clone()),
        number(-1.092_548_430_592_079_2) * product(&x, &z),
        number(0.546_274_215_296_039_6) * (xx - yy),
    ]
}

#[inline(always)]
fn of_degree_3<V: Term, C: Mul<V, Output = V>>([x, y, z]: [V; 3], number: impl Fn(f64) -> C) -> [V; 7] {
    let product = |a: &V, b: &V| a.clone() * b.clone();
    let times = |factor: f64, a: &V| number(factor) * a.clone();
    let (xx, yy, zz) = (product(&x, &x), product(&y, &y), product(&z, &z));
    let four = times(4.0, &zz) - xx.clone() - yy.clone();
    let two = times(2.0, &zz) - times(3.0, &xx) - times(3.0, &yy);
    [
        number(-0.590_043_589_926_643_5) * product(&y, &(times(3.0, &xx) - yy.clone())),
        number(2.890_611_442_640_554) * product(&product(&x, &y), &z),
        number(-0.457_045_799_464_465_8) * product(&y, &four),
        number(0.373_176_332_590_115_4) * product(&z, &two),
        number(-0.457_045_799_464_465_8) * product(&x, &four),
        number(1.445_305_721_320_277) * product(&z, &(xx.clone() - yy.clone())),
        number(-0.590_043_589_926_643_5) * product(&x, &(xx - times(3.0, &yy))),
    ]
}

/// The basis on arrays: unit directions `[n, 3]` to `[n, (degree + 1)²]`.
///
/// Panics as [`basis`] does.
#[track_caller]
pub fn values<T: Real>(directions: ArrayView2<'_, T>, degree: usize) -> Array2<T> {
    let (rows, columns) = (directions.nrows(), count(degree));
    let directions = Tensor::from_vec(directions.iter().copied().collect(), &[rows, directions.ncols()]);
    let values = no_grad(|| basis(&directions, degree));
    Array2::from_shape_fn((rows, columns), |(row, column)| values.data()[row * columns + column])
}

#[cfg(test)]
mod tests {
    use super::*;
    use autograd::Param;

    #[test]
    fn the_basis_is_orthonormal_over_the_sphere() {
        // Gauss-Legendre with 8 nodes in z and 16 equal angles integrate products of two functions of degree 3 exactly.
        let nodes: [(f64, f64); 4] = [
            (0.183_434_642_495_649_8, 0.362_683_783_378_361_96),
            (0.525_532_409_916_329, 0.313_706_645_877_887_3),
            (0.796_666_477_413_626_7, 0.222_381_034_453_374_48),
            (0.960_289_856_497_536_2, 0.101_228_536_290_376_26),
        ];
        let (mut directions, mut weights) = (Vec::new(), Vec::new());
        for (z, w) in nodes.iter().flat_map(|&(z, w)| [(z, w), (-z, w)]) {
            for k in 0..16 {
                let phi = std::f64::consts::TAU * f64::from(k) / 16.0;
                let r = (1.0 - z * z).sqrt();
                directions.extend([r * phi.cos(), r * phi.sin(), z]);
                weights.push(w * std::f64::consts::TAU / 16.0);
            }
        }
        let n = weights.len();
        let b = basis(&Tensor::from_vec(directions, &[n, 3]), 3);
        let weighted = &b * Tensor::from_vec(weights, &[n, 1]);
        let gram = b.transpose().matmul(&weighted);
        for i in 0..16 {
            for j in 0..16 {
                let want = f64::from(u8::from(i == j));
                assert!((gram.value()[[i, j]] - want).abs() < 1e-12, "⟨{i}, {j}⟩ = {}", gram.value()[[i, j]]);
            }
        }
    }

    #[test]
    fn values_are_those_of_the_graph() {
        let directions: Vec<f64> = (0..150_000).map(|k| f64::from(k).sin()).collect();
        for degree in 0..=MAX_DEGREE {
            for n in [0, 1, 63, 64, 65, 2000, 50_000] {
                let directions = Tensor::from_vec(directions[..3 * n].to_vec(), &[n, 3]);
                let graph = basis(Param::from_tensor("directions", directions.clone()).tensor(), degree);
                let values = basis(&directions, degree);
                assert_eq!(values.shape(), graph.shape());
                assert!(graph.is_tracked() == (degree > 0) && !values.is_tracked());
                assert!(values.data().iter().zip(graph.data()).all(|(a, b)| (a - b).abs() < 1e-15), "degree {degree}, {n} directions");
            }
        }
    }

    #[test]
    fn signs_and_order_are_those_of_svox2() {
        // At (x, y, z) = (0.48, 0.6, 0.64): −y, z, −x in front of 0.4886; xy > 0, −yz < 0, 2z² − x² − y² = 0.2288, −xz < 0, x² − y² = −0.1296.
        let b = basis(&Tensor::from_vec(vec![0.48, 0.6, 0.64], &[1, 3]), 2);
        let want: [f64; 9] = [0.282_095, -0.293_162, 0.312_706, -0.234_529, 0.314_654, -0.419_539, 0.072_162, -0.335_631, -0.070_797];
        for (got, want) in b.data().iter().zip(want) {
            assert!((got - want).abs() < 1e-5, "{got} against {want}");
        }
    }
}
