//! Gradient checks: comparison of rules with finite differences, and of kernels with their references.
//!
//! The check contracts the derivatives to one number: s₁(x) = ⟨f(x), v⟩ for a random direction v, then s₂(x) = ⟨∇s₁(x), w⟩ for a random direction w, and so on
//! for higher orders. The derivative of sₖ along a random direction u is compared with a central difference of sₖ. This takes four evaluations for any size of
//! the input, and detects an error in any entry of the k-th derivative with probability one (`check_grads` of Autograd). The checks run in `f64`. A gradient in
//! `f32` should be compared with the gradient in `f64` by [`Closeness`].

mod kernel;

pub use kernel::{Closeness, KernelReport, check_kernel};

use crate::backward::grad;
use crate::error::GradcheckError;
use crate::random::Stream;
use crate::tensor::Tensor;
use ndarray::{ArrayD, Dimension, IxDyn};

/// Checks the first and second derivatives of `f` at `inputs` by finite differences, with the default settings of [`Gradcheck`].
///
/// Panics with the message of the [`GradcheckError`] if the check fails.
///
/// ```
/// use autograd::gradcheck;
/// use ndarray::arr1;
/// gradcheck(|x| x[0].sin() * &x[1], [arr1(&[0.3, 1.2]).into_dyn(), arr1(&[2.0, -0.5]).into_dyn()]);
/// ```
#[track_caller]
pub fn gradcheck(f: impl Fn(&[Tensor<f64>]) -> Tensor<f64>, inputs: impl Into<Vec<ArrayD<f64>>>) -> GradcheckReport {
    match Gradcheck::new(f, inputs).run() {
        Ok(report) => report,
        Err(error) => panic!("{error}"),
    }
}

/// The result of a passed gradient check.
#[derive(Debug, Clone, PartialEq)]
pub struct GradcheckReport {
    /// Largest element of `by_order`.
    pub worst_relative_error: f64,
    /// Largest relative error for each order of derivative, from the first order on.
    pub by_order: Vec<f64>,
}

/// A gradient check with settings.
///
/// ```
/// use autograd::Gradcheck;
/// use ndarray::arr1;
/// // |x| has a kink at x = 0. The check would report it if a finite difference stepped across it.
/// let check = Gradcheck::new(|x| x[0].abs(), [arr1(&[0.5, -2.0]).into_dyn()]).named("abs").away_from(|x| x[0].clone());
/// let report = check.order(3).run()?;
/// assert_eq!(report.by_order.len(), 3);
/// # Ok::<(), autograd::GradcheckError>(())
/// ```
pub struct Gradcheck<F> {
    f: F,
    inputs: Vec<ArrayD<f64>>,
    name: String,
    order: usize,
    directions: usize,
    elementwise: bool,
    tolerance: f64,
    step: Option<f64>,
    seed: u64,
    kinks: Option<Kinks>,
}

type Kinks = Box<dyn Fn(&[Tensor<f64>]) -> Tensor<f64>>;

impl<F: Fn(&[Tensor<f64>]) -> Tensor<f64>> Gradcheck<F> {
    /// Creates a check of the function `f` at `inputs`. The result of `f` may have any shape.
    pub fn new(f: F, inputs: impl Into<Vec<ArrayD<f64>>>) -> Self {
        Gradcheck {
            f,
            inputs: inputs.into(),
            name: "function".into(),
            order: 2,
            directions: 3,
            elementwise: false,
            tolerance: 1e-7,
            step: None,
            seed: 0,
            kinks: None,
        }
    }

    /// Sets the name of the function in error messages.
    pub fn named(mut self, name: impl Into<String>) -> Self {
        self.name = name.into();
        self
    }

    /// Sets the highest order of derivative to check; all lower orders are also checked. The default is 2.
    pub fn order(mut self, order: usize) -> Self {
        self.order = order;
        self
    }

    /// Sets the number of random directions for each input and order. The default is 3.
    pub fn directions(mut self, directions: usize) -> Self {
        self.directions = directions;
        self
    }

    /// Varies one entry of the inputs at a time instead of random directions, so that an error names the entry. This is slow for large inputs.
    pub fn elementwise(mut self) -> Self {
        self.elementwise = true;
        self
    }

    /// Sets the largest allowed relative error, |analytic − numeric| / max(Σ|gᵢuᵢ|, |numeric|, 1e-5 Σ|terms of s|). The last term prevents a derivative of zero
    /// from being compared with rounding errors. The default is 1e-7.
    pub fn tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Sets the step of the finite differences. The default is 1/2000 of the root mean square of the input that is varied, or 1/2000 if that is 0.
    pub fn step(mut self, step: f64) -> Self {
        self.step = Some(step);
        self
    }

    /// Sets the seed of the random directions. The default is 0.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Sets the kink function, which maps the inputs to numbers that are zero at a kink and change sign across it. If a finite difference would change a sign,
    /// the check fails with [`GradcheckError::Kink`] instead of comparing meaningless numbers.
    pub fn away_from(mut self, kinks: impl Fn(&[Tensor<f64>]) -> Tensor<f64> + 'static) -> Self {
        self.kinks = Some(Box::new(kinks));
        self
    }

    /// Runs the check.
    pub fn run(&self) -> Result<GradcheckReport, GradcheckError> {
        let mut random = Random::new(self.seed);
        let by_order = (1..=self.order).map(|order| self.check(order, &mut random)).collect::<Result<Vec<f64>, _>>()?;
        Ok(GradcheckReport { worst_relative_error: by_order.iter().copied().fold(0.0, f64::max), by_order })
    }

    /// Checks the derivative of one order and returns its largest relative error.
    fn check(&self, order: usize, random: &mut Random) -> Result<f64, GradcheckError> {
        let constants: Vec<Tensor<f64>> = self.inputs.iter().map(|x| Tensor::constant(x.clone())).collect();
        let shape = (self.f)(&constants).shape().to_vec();
        let mut worst = 0.0;
        for _ in 0..if self.elementwise { 1 } else { self.directions } {
            let probe = Probe {
                output: random.direction(&shape),
                inputs: (1..order).map(|_| constants.iter().map(|x| random.direction(x.shape())).collect()).collect(),
            };
            let variables: Vec<Tensor<f64>> = constants.iter().map(|x| x.clone().into_variable()).collect();
            let (s, size) = self.contract(&variables, &probe);
            let gradients = s.backward();
            let backward: Vec<Tensor<f64>> = variables.iter().map(|x| Tensor::constant(gradients.array(x))).collect();
            let differentiable = grad(&s, &variables.iter().collect::<Vec<_>>());
            for (input, x) in constants.iter().enumerate() {
                for (index, direction) in self.directions_of(x, random) {
                    let numeric = self.difference(&constants, input, &direction, &probe)?;
                    for (pass, g) in [("backward", &backward[input]), ("grad", &differentiable[input])] {
                        let terms = || g.data().iter().zip(direction.data()).map(|(g, u)| g * u);
                        let (analytic, magnitude): (f64, f64) = (terms().sum(), terms().map(f64::abs).sum());
                        let distance = (analytic - numeric).abs();
                        let relative_error = if distance == 0.0 { 0.0 } else { distance / magnitude.max(numeric.abs()).max(1e-5 * size) };
                        if relative_error.is_nan() || relative_error > self.tolerance {
                            let (name, tolerance) = (self.name.clone(), self.tolerance);
                            return Err(GradcheckError::Derivative {
                                name,
                                input,
                                index,
                                order,
                                pass,
                                analytic,
                                numeric,
                                relative_error,
                                tolerance,
                            });
                        }
                        worst = relative_error.max(worst);
                    }
                }
            }
        }
        Ok(worst)
    }

    /// Returns s and Σ|terms of s|, which is the scale of the rounding errors of s.
    fn contract(&self, x: &[Tensor<f64>], probe: &Probe) -> (Tensor<f64>, f64) {
        let size = |terms: &Tensor<f64>| terms.data().iter().map(|t| t.abs()).sum::<f64>();
        let terms = (self.f)(x) * &probe.output;
        let (mut s, mut total) = (terms.sum(), size(&terms));
        for directions in &probe.inputs {
            let slopes = grad(&s, &x.iter().collect::<Vec<_>>());
            (s, total) = slopes.iter().zip(directions).fold((Tensor::scalar(0.0), 0.0), |(s, total), (slope, w)| {
                let terms = slope * w;
                (s + terms.sum(), total + size(&terms))
            });
        }
        (s, total)
    }

    /// Returns the derivative of s along a direction in one input, by the five-point stencil. Its error is h⁴/30 times the fifth derivative.
    fn difference(&self, x: &[Tensor<f64>], input: usize, direction: &Tensor<f64>, probe: &Probe) -> Result<f64, GradcheckError> {
        let mean_square = x[input].data().iter().map(|v| v * v).sum::<f64>() / x[input].len() as f64;
        let h = self.step.unwrap_or(if mean_square > 0.0 { mean_square.sqrt() / 2000.0 } else { 1.0 / 2000.0 });
        let at = |steps: f64| {
            let mut moved = x.to_vec();
            moved[input] = &x[input] + direction * (steps * h);
            if let Some(kinks) = &self.kinks {
                let (before, after) = (kinks(x), kinks(&moved));
                if let Some((&b, &a)) = before.data().iter().zip(after.data()).find(|(b, a)| *b * *a <= 0.0) {
                    return Err(GradcheckError::Kink { name: self.name.clone(), input, distances: (b, a) });
                }
            }
            // A graph is needed only if s contains gradients.
            if !probe.inputs.is_empty() {
                moved.iter_mut().for_each(|x| *x = x.clone().into_variable());
            }
            Ok(self.contract(&moved, probe).0.item())
        };
        let (near, far) = (at(1.0)? - at(-1.0)?, at(2.0)? - at(-2.0)?);
        Ok((8.0 * near - far) / (12.0 * h))
    }

    /// Returns one random direction or, in an elementwise check, the unit direction of each entry with its index.
    fn directions_of(&self, x: &Tensor<f64>, random: &mut Random) -> Vec<(Option<Vec<usize>>, Tensor<f64>)> {
        if x.is_empty() {
            Vec::new()
        } else if self.elementwise {
            let entries = ndarray::indices(IxDyn(x.shape())).into_iter().enumerate();
            entries
                .map(|(flat, index)| {
                    let mut unit = vec![0.0; x.len()];
                    unit[flat] = 1.0;
                    (Some(index.slice().to_vec()), Tensor::from_vec(unit, x.shape()))
                })
                .collect()
        } else {
            vec![(None, random.direction(x.shape()))]
        }
    }
}

/// The random directions that contract a function to one number: v for its result, and w for the gradient of each lower order.
struct Probe {
    output: Tensor<f64>,
    inputs: Vec<Vec<Tensor<f64>>>,
}

/// A generator of random directions.
struct Random {
    stream: Stream,
    drawn: u64,
}

impl Random {
    fn new(seed: u64) -> Self {
        Random { stream: Stream::new(seed), drawn: 0 }
    }

    fn next(&mut self) -> u64 {
        self.drawn += 1;
        self.stream.bits(self.drawn - 1)
    }

    /// Returns a direction whose entries have magnitudes from 1/2 to 1 and random signs, so that no entry is small enough to hide an error.
    fn direction(&mut self, shape: &[usize]) -> Tensor<f64> {
        let entry = |bits: u64| {
            let magnitude = 0.5 + (bits >> 12) as f64 / (1u64 << 53) as f64;
            if bits & 1 == 0 { magnitude } else { -magnitude }
        };
        Tensor::from_vec((0..shape.iter().product()).map(|_| entry(self.next())).collect(), shape)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr1;

    fn input() -> Vec<ArrayD<f64>> {
        vec![arr1(&[0.7, -1.3, 2.1]).into_dyn()]
    }

    #[test]
    fn a_right_gradient_passes_with_nine_digits_to_spare_in_every_order() {
        let report = Gradcheck::new(|x| x[0].sin() * x[0].exp(), input()).order(4).run().expect("sin and exp are right");
        assert_eq!(report.by_order.len(), 4);
        assert!(report.worst_relative_error < 1e-9, "{report:?}");
    }

    #[test]
    fn a_function_of_nothing_has_the_gradient_zero() {
        let report = Gradcheck::new(|x| Tensor::ones(x[0].shape()), input()).run().expect("constants have no gradient");
        assert_eq!(report.worst_relative_error, 0.0);
    }

    /// Checks x² with one factor detached, so that half of the gradient is lost.
    #[test]
    fn a_lost_gradient_is_found_and_named() {
        let f = |x: &[Tensor<f64>]| &x[0] * x[0].detach();
        let error = Gradcheck::new(f, input()).named("half a square").elementwise().run().expect_err("the gradient is half of 2x");
        let GradcheckError::Derivative { index, order, analytic, numeric, .. } = &error else { panic!("{error}") };
        assert_eq!((index.as_deref(), *order), (Some(&[0][..]), 1));
        assert!((numeric / analytic - 2.0).abs() < 1e-9, "{error}");
    }

    /// With c = x detached, c² + 2c (x − c) has the value and the first derivative of x², but a second derivative of zero.
    #[test]
    fn a_lost_second_derivative_is_found_though_the_first_is_right() {
        let f = |x: &[Tensor<f64>]| x[0].detach().square() + 2.0 * x[0].detach() * (&x[0] - x[0].detach());
        let error = Gradcheck::new(f, input()).run().expect_err("a linearised square has no curvature");
        assert!(matches!(error, GradcheckError::Derivative { order: 2, .. }), "{error}");
    }

    #[test]
    fn a_step_across_a_kink_is_refused() {
        let near = vec![arr1(&[1.0, 1e-5]).into_dyn()];
        let error = Gradcheck::new(|x| x[0].abs(), near).named("abs").away_from(|x| x[0].clone()).run();
        assert!(matches!(error, Err(GradcheckError::Kink { input: 0, .. })), "{error:?}");
    }
}
