//! A row of the table, and the inputs of the functions.

use autograd::nn::{Activation, Mlp};
use autograd::random::Stream;
use autograd::{Closeness, Gradcheck, Indices, Module, Real, Tensor, grad};
use ndarray::ArrayD;

pub type Function<T> = fn(&[Tensor<T>]) -> Tensor<T>;

/// A function in both precisions, and the inputs at which it is checked.
pub struct Row {
    pub op: &'static str,
    pub case: &'static str,
    pub double: Function<f64>,
    pub single: Function<f32>,
    pub inputs: Vec<ArrayD<f64>>,
    /// Kink function, which is zero where the function has a kink.
    pub kinks: Option<Function<f64>>,
}

/// Tolerance for a gradient in `f32`, which differs from the gradient in `f64` by a few rounding errors.
const SINGLE_PRECISION: f64 = 2e-6;

impl Row {
    /// Checks the row. Returns the relative errors of the first and the second derivative, and of the gradient in `f32`.
    pub fn check(&self) -> Result<[f64; 3], String> {
        let name = format!("{} ({})", self.op, self.case);
        let mut check = Gradcheck::new(self.double, self.inputs.clone()).named(&name);
        if let Some(kinks) = self.kinks {
            check = check.away_from(kinks);
        }
        let report = check.run().map_err(|error| error.to_string())?;
        let closeness = self.single_to_double();
        if closeness.within(SINGLE_PRECISION) {
            Ok([report.by_order[0], report.by_order[1], closeness.relative_l2])
        } else {
            Err(format!("{name}: the gradient in f32 differs from that in f64: {closeness}"))
        }
    }

    /// Compares the gradient of the sum of squares with respect to all inputs in both precisions. The gradient in `f32` is computed by `backward`, as in training,
    /// and the gradient in `f64` by the differentiable pass, which has been compared with finite differences.
    fn single_to_double(&self) -> Closeness {
        let single: Vec<Tensor<f32>> = self.inputs.iter().map(|x| Tensor::variable(x.mapv(|v| v as f32))).collect();
        let double: Vec<Tensor<f64>> = self.inputs.iter().map(|x| Tensor::variable(x.clone())).collect();
        let gradients = (self.single)(&single).square().sum().backward();
        let got: Vec<f32> = single.iter().flat_map(|x| gradients.array(x)).collect();
        let want = grad(&(self.double)(&double).square().sum(), &double.iter().collect::<Vec<_>>());
        let want: Vec<f64> = want.iter().flat_map(|g| g.to_array()).collect();
        Closeness::between(&got, &want)
    }
}

/// Returns numbers with magnitudes from 0.3 to 1.5 and both signs.
pub fn numbers(shape: &[usize], seed: u64) -> ArrayD<f64> {
    let mut index = 0u64;
    ArrayD::from_shape_simple_fn(shape, || {
        index += 1;
        let bits = (index + 1000 * seed).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_mul(0xd1b5_4a32_d192_ed03) >> 32;
        let magnitude = 0.3 + 1.2 * (bits % 1000) as f64 / 1000.0;
        // Every input is representable in both precisions.
        f64::from((if bits & 1024 == 0 { magnitude } else { -magnitude }) as f32)
    })
}

/// Returns numbers from 0.3 to 1.5.
pub fn positive(shape: &[usize], seed: u64) -> ArrayD<f64> {
    numbers(shape, seed).mapv(f64::abs)
}

/// Returns distinct multiples of 1/8, not sorted.
pub fn distinct(shape: &[usize]) -> ArrayD<f64> {
    let n: usize = shape.iter().product();
    let mut index = 0;
    ArrayD::from_shape_simple_fn(shape, || {
        index += 1;
        // 7 has no factor in common with the sizes used.
        (index * 7 % n) as f64 / 8.0 - 1.0
    })
}

/// Returns positions whose coordinates are at least a tenth of a cell away from the nodes. Every fourth position is outside the grid along one axis.
pub fn positions(m: usize, nodes: [usize; 3]) -> ArrayD<f64> {
    let fractions = positive(&[m, 3], 77).mapv(|x| 0.1 + 0.8 * (x - 0.3) / 1.2);
    ArrayD::from_shape_fn(vec![m, 3], |at| {
        let (p, axis) = (at[0], at[1]);
        let cells = nodes[axis].max(2) - 1;
        let inside = ((p * 5 + axis * 3) % cells) as f64 + fractions[[p, axis]];
        let outside = if p % 8 == 3 { -inside } else { inside + cells as f64 };
        let coordinate = if p % 4 == 3 && p % 3 == axis { outside } else { inside };
        f64::from(coordinate as f32)
    })
}

pub fn indices(rows: &[u32]) -> Indices {
    Indices::from(rows.to_vec())
}

/// Returns a mask of ones and zeros.
pub fn mask<T: Real>(shape: &[usize]) -> Tensor<T> {
    let n = shape.iter().product();
    Tensor::from_vec((0..n).map(|i| if i % 3 == 1 { T::zero() } else { T::one() }).collect(), shape)
}

/// Returns the differences of all pairs of elements. An extremum has a kink where a difference is zero.
pub fn differences(x: &Tensor<f64>) -> Tensor<f64> {
    let n = x.len();
    let identity = Tensor::constant(ndarray::Array2::<f64>::eye(n));
    x.reshape(&[n, 1]) - x.reshape(&[1, n]) + identity
}

/// Returns numbers that are zero at the integers, where trilinear interpolation has kinks.
pub fn at_integers(u: &Tensor<f64>) -> Tensor<f64> {
    (u * std::f64::consts::PI).sin()
}

/// Returns numbers that are zero half-way between the integers, where the nearest node changes.
pub fn at_halves(u: &Tensor<f64>) -> Tensor<f64> {
    (u * std::f64::consts::PI).cos()
}

/// Returns the output of a network for the input `x[0]` and the weights and biases `x[1..]`.
pub fn network<T: Real>(widths: &[usize], activation: Activation, skip: Option<usize>, x: &[Tensor<T>]) -> Tensor<T> {
    let random = Stream::new(0);
    let mut net = match skip {
        None => Mlp::new("net", widths, activation, &random),
        Some(skip) => Mlp::with_skip("net", widths, activation, skip, &random),
    };
    let mut given = x[1..].iter();
    net.visit_mut(&mut |param| {
        let tensor = given.next().expect("a tensor for each parameter").clone();
        if tensor.is_tracked() { param.bind(tensor) } else { param.replace(tensor) }
    });
    net.forward(&x[0])
}
