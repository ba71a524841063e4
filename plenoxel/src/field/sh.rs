//! Real spherical harmonics, degrees 0 to 3, in the order and with the signs of svox2 (also of PlenOctrees, and of the source paper's atan2
//! form).
//!
//! Up to degree d there are (d + 1)² functions: 1; −y, z, −x; xy, −yz, 2z² − x² − y², −xz, x² − y²; and seven of degree 3. Each is
//! multiplied by its normalization constant.

pub(crate) mod least_squares;

use autograd::{Real, Tensor, no_grad};
use ndarray::{Array2, ArrayView2};

/// Constant function of degree 0, 1 / (2 √π).
pub const Y0: f64 = 0.282_094_791_773_878_14;

/// Returns the number of functions up to a degree.
pub const fn count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Largest supported degree.
pub const MAX_DEGREE: usize = 3;

/// Evaluates the basis at unit directions `[n, 3]`. Returns `[n, (degree + 1)²]`, differentiable in the directions.
///
/// Panics if the degree is above 3 or the directions are not `[n, 3]`.
#[track_caller]
pub fn basis<T: Real>(directions: &Tensor<T>, degree: usize) -> Tensor<T> {
    assert!(degree <= MAX_DEGREE, "spherical harmonics of degree {degree}: only 0 to {MAX_DEGREE}");
    assert!(directions.ndim() == 2 && directions.shape()[1] == 3, "directions must be [n, 3], got {:?}", directions.shape());
    let [x, y, z] = [0, 1, 2].map(|axis| directions.index_axis(1, axis));
    let mut columns = vec![Tensor::full(x.shape(), Y0)];
    if degree >= 1 {
        columns.extend([-0.488_602_511_902_919_9 * &y, 0.488_602_511_902_919_9 * &z, -0.488_602_511_902_919_9 * &x]);
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x.square(), y.square(), z.square());
        columns.extend([
            1.092_548_430_592_079_2 * (&x * &y),
            -1.092_548_430_592_079_2 * (&y * &z),
            0.315_391_565_252_520_05 * (2.0 * &zz - &xx - &yy),
            -1.092_548_430_592_079_2 * (&x * &z),
            0.546_274_215_296_039_6 * (&xx - &yy),
        ]);
        if degree >= 3 {
            let four = 4.0 * &zz - &xx - &yy;
            columns.extend([
                -0.590_043_589_926_643_5 * (&y * (3.0 * &xx - &yy)),
                2.890_611_442_640_554 * (&x * &y * &z),
                -0.457_045_799_464_465_8 * (&y * &four),
                0.373_176_332_590_115_4 * (&z * (2.0 * &zz - 3.0 * &xx - 3.0 * &yy)),
                -0.457_045_799_464_465_8 * (&x * &four),
                1.445_305_721_320_277 * (&z * (&xx - &yy)),
                -0.590_043_589_926_643_5 * (&x * (&xx - 3.0 * &yy)),
            ]);
        }
    }
    Tensor::stack(&columns.iter().collect::<Vec<_>>(), 1)
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
    fn signs_and_order_are_those_of_svox2() {
        // At (x, y, z) = (0.48, 0.6, 0.64): −y, z, −x in front of 0.4886; xy > 0, −yz < 0, 2z² − x² − y² = 0.2288, −xz < 0, x² − y² = −0.1296.
        let b = basis(&Tensor::from_vec(vec![0.48, 0.6, 0.64], &[1, 3]), 2);
        let want: [f64; 9] = [0.282_095, -0.293_162, 0.312_706, -0.234_529, 0.314_654, -0.419_539, 0.072_162, -0.335_631, -0.070_797];
        for (got, want) in b.data().iter().zip(want) {
            assert!((got - want).abs() < 1e-5, "{got} against {want}");
        }
    }
}
