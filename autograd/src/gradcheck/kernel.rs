//! Comparison of kernels with their references.

use crate::error::GradcheckError;
use crate::graph::Rule;
use crate::op::input;
use crate::real::Real;
use crate::tensor::Tensor;
use ndarray::ArrayD;
use std::fmt;

/// Measures of the distance between two arrays, as vectors. An absolute tolerance for values near zero can hide a missing term; these measures do not (gsplat).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Closeness {
    /// Relative L2 distance, |got − want|₂ / |want|₂.
    pub relative_l2: f64,
    /// Cosine similarity, ⟨got, want⟩ / (|got|₂ |want|₂): 1 if the vectors have the same direction.
    pub cosine: f64,
    /// Signed bias, Σ (got − want) / Σ |want|. Rounding errors mostly cancel in it; a systematic error does not.
    pub signed_bias: f64,
    /// Largest error relative to the largest value, max |got − want| / max |want|.
    pub worst_element: f64,
}

impl Closeness {
    /// Computes the measures between `got` and `want`, which may have different precisions. Two arrays of zeros are equal.
    ///
    /// Panics if their lengths differ.
    #[track_caller]
    pub fn between<A: Real, B: Real>(got: &[A], want: &[B]) -> Self {
        assert_eq!(got.len(), want.len(), "Closeness: {} values cannot be compared with {}", got.len(), want.len());
        let pairs = || got.iter().zip(want).map(|(a, b)| (a.as_f64(), b.as_f64()));
        let sum = |f: fn(f64, f64) -> f64| pairs().map(|(a, b)| f(a, b)).sum::<f64>();
        let largest = |f: fn(f64, f64) -> f64| pairs().map(|(a, b)| f(a, b)).fold(0.0, |m, v| if v > m || v.is_nan() { v } else { m });
        // 0 / 0 counts as equality; other divisions by zero and NaN are kept, so that they fail the comparison.
        let ratio = |a: f64, b: f64| if a == 0.0 && b == 0.0 { 0.0 } else { a / b };
        let (norm_got, norm_want) = (sum(|a, _| a * a).sqrt(), sum(|_, b| b * b).sqrt());
        Closeness {
            relative_l2: ratio(sum(|a, b| (a - b) * (a - b)).sqrt(), norm_want),
            cosine: if norm_got == 0.0 && norm_want == 0.0 { 1.0 } else { sum(|a, b| a * b) / (norm_got * norm_want) },
            signed_bias: ratio(sum(|a, b| a - b), sum(|_, b| b.abs())),
            worst_element: ratio(largest(|a, b| (a - b).abs()), largest(|_, b| b.abs())),
        }
    }

    /// Returns true if the relative L2 distance, the magnitude of the signed bias and 1 − cosine are at most `tolerance`, and the error of the worst element is
    /// at most 10 · `tolerance`.
    pub fn within(&self, tolerance: f64) -> bool {
        self.relative_l2 <= tolerance
            && self.signed_bias.abs() <= tolerance
            && 1.0 - self.cosine <= tolerance
            && self.worst_element <= 10.0 * tolerance
    }
}

impl fmt::Display for Closeness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "relative L2 {:.1e}, 1 − cosine {:.1e}, signed bias {:+.1e}, worst element {:.1e}",
            self.relative_l2,
            1.0 - self.cosine,
            self.signed_bias,
            self.worst_element
        )
    }
}

/// The result of a passed comparison of a kernel with its reference.
#[derive(Debug, Clone, PartialEq)]
pub struct KernelReport {
    /// Closeness of the value.
    pub value: Closeness,
    /// Closeness of the gradient with respect to each input.
    pub gradients: Vec<Closeness>,
}

/// Compares the kernel that computed the result of `f` with its [`reference`](crate::Kernel::reference): its value, and the gradient of a random contraction
/// of the result with respect to each of `inputs`.
///
/// The gradients are computed with all inputs tracked. If there are several inputs, each gradient is also computed with the other inputs constant, because a
/// kernel may then skip work. A `tolerance` of 1e-12 in `f64` and of 1e-5 in `f32` is usual; a kernel should be checked in both precisions.
///
/// Returns [`GradcheckError::Kernel`] if a distance exceeds the tolerance ([`Closeness::within`]).
///
/// Panics if the result of `f` was not computed by a kernel, or if the reference has another shape than the kernel.
#[track_caller]
pub fn check_kernel<T: Real>(
    f: impl Fn(&[Tensor<T>]) -> Tensor<T>,
    inputs: impl Into<Vec<ArrayD<T>>>,
    tolerance: f64,
) -> Result<KernelReport, GradcheckError> {
    let inputs: Vec<Tensor<T>> = inputs.into().into_iter().map(Tensor::variable).collect();
    let fast = f(&inputs);
    let node = fast.node.as_ref().expect("check_kernel: the result does not depend on the inputs");
    let Rule::Kernel(kernel) = &node.rule else {
        panic!("check_kernel: the result was computed by the op {}, not by a kernel", node.rule.name())
    };
    let operands: Vec<Tensor<T>> = (0..node.inputs.len()).map(|i| input(node, i, true)).collect();
    let slow = kernel.reference(&operands);
    assert_eq!(fast.shape(), slow.shape(), "{}: the outputs of the kernel and the reference differ in shape", kernel.name());

    let compare = |what: String, got: &[T], want: &[T]| {
        let closeness = Closeness::between(got, want);
        if closeness.within(tolerance) {
            Ok(closeness)
        } else {
            Err(GradcheckError::Kernel { name: kernel.name().into(), what, closeness, tolerance })
        }
    };
    let value = compare("value".into(), fast.data(), slow.data())?;
    let direction = super::Random::new(0).direction(fast.shape());
    let direction = Tensor::from_vec(direction.data().iter().map(|&v| T::lit(v)).collect(), fast.shape());
    let (fast, slow) = (fast.backward_from(&direction), slow.backward_from(&direction));
    let flat = |a: ArrayD<T>| a.into_iter().collect::<Vec<T>>();
    let gradients = inputs.iter().enumerate().map(|(i, x)| {
        let want = flat(slow.array(x));
        let closeness = compare(format!("gradient of input {i}"), &flat(fast.array(x)), &want)?;
        if inputs.len() > 1 {
            let alone: Vec<Tensor<T>> = inputs.iter().enumerate().map(|(j, x)| if i == j { x.clone() } else { x.detach() }).collect();
            let got = flat(f(&alone).backward_from(&direction).array(x));
            compare(format!("gradient of input {i} with the other inputs constant"), &got, &want)?;
        }
        Ok(closeness)
    });
    Ok(KernelReport { value, gradients: gradients.collect::<Result<_, _>>()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::{GradSink, Kernel, KernelCall};
    use crate::pool::Buffer;
    use ndarray::arr1;

    /// y = x³ with an adjoint that is `share` times the correct one.
    #[derive(Debug)]
    struct Cube {
        share: f64,
    }
    impl<T: Real> Kernel<T> for Cube {
        fn name(&self) -> &'static str {
            "cube"
        }
        fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
            inputs[0].square() * &inputs[0]
        }
        fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
            let slope = T::lit(3.0 * self.share);
            let (x, g) = (call.input(0), call.cotangent());
            let values: Vec<T> = x.data().iter().zip(g.data()).map(|(&x, &g)| g * slope * x * x).collect();
            out.dense(0, values.into());
        }
    }

    fn cube<T: Real>(x: &Tensor<T>, share: f64) -> Tensor<T> {
        let values: Vec<T> = x.data().iter().map(|&x| x * x * x).collect();
        Tensor::from_kernel(Buffer::from(values), x.shape(), &[x], Cube { share })
    }

    #[test]
    fn a_right_kernel_passes_in_both_precisions() {
        let report = check_kernel(|x| cube(&x[0], 1.0), [arr1(&[0.5f64, -2.0, 3.0]).into_dyn()], 1e-14).expect("a right adjoint");
        assert_eq!(report.gradients.len(), 1);
        check_kernel(|x| cube(&x[0], 1.0), [arr1(&[0.5f32, -2.0, 3.0]).into_dyn()], 1e-6).expect("a right adjoint");
    }

    #[test]
    fn a_kernel_with_a_wrong_factor_fails_by_its_name_and_input() {
        let error = check_kernel(|x| cube(&x[0], 1.001), [arr1(&[0.5f64, -2.0, 3.0]).into_dyn()], 1e-6).expect_err("a wrong adjoint");
        let text = error.to_string();
        assert!(text.starts_with("cube: ") && text.contains("gradient of input 0") && text.contains("relative L2 1.0e-3"), "{text}");
    }

    #[test]
    fn closeness_tells_a_scaled_from_a_turned_and_a_shifted_vector() {
        let want = [3.0f64, -4.0];
        let scaled = Closeness::between(&[6.0f32, -8.0], &want);
        assert_eq!((scaled.relative_l2, scaled.cosine, scaled.worst_element), (1.0, 1.0, 1.0));
        let turned = Closeness::between(&[4.0f64, 3.0], &want);
        assert_eq!(turned.cosine, 0.0);
        // (1 + 1) / 7
        assert_eq!(Closeness::between(&[4.0f64, -3.0], &want).signed_bias, 2.0 / 7.0);
        let nothing = Closeness::between(&[0.0f64, 0.0], &[0.0f64, 0.0]);
        assert!(nothing.within(0.0));
        assert!(!Closeness::between(&[f64::NAN], &[1.0f64]).within(1.0));
    }
}
