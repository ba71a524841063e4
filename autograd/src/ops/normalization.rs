//! Log-sum-exp, softmax, norm and normalization along an axis.

use crate::real::Real;
use crate::tensor::Tensor;

impl<T: Real> Tensor<T> {
    /// Returns y = ln Σ eˣ along one axis, which is removed.   ∂L/∂x = ∂L/∂y · softmax x
    ///
    /// It is computed as y = m + ln Σ eˣ⁻ᵐ with the largest element m, so the exponentials do not overflow. Where all elements are −∞, y is −∞ and the
    /// gradient is NaN.
    ///
    /// Panics if the axis does not exist or has no elements.
    #[track_caller]
    pub fn log_sum_exp(&self, axis: usize) -> Self {
        self.check_axis("log_sum_exp", axis);
        let largest = self.largest(axis);
        (self - largest.unsqueeze(axis)).exp().sum_axis(axis).ln() + largest
    }

    /// Returns y = eˣ / Σ eˣ along one axis, with the shape of x.   ∂L/∂x = y (∂L/∂y − Σ y ∂L/∂y)
    ///
    /// The largest element is subtracted first, so the exponentials do not overflow. Where all elements are −∞, y is NaN.
    ///
    /// Panics if the axis does not exist or has no elements.
    #[track_caller]
    pub fn softmax(&self, axis: usize) -> Self {
        self.check_axis("softmax", axis);
        let weights = (self - self.largest(axis).unsqueeze(axis)).exp();
        &weights / weights.sum_axis(axis).unsqueeze(axis)
    }

    /// Returns the Euclidean norm y = √Σ x² along one axis, which is removed.   ∂L/∂x = ∂L/∂y · x / y
    ///
    /// The norm is not differentiable where y = 0; derivatives of every order are 0 there. The squares are not scaled, so they may overflow or underflow.
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn norm(&self, axis: usize) -> Self {
        self.check_axis("norm", axis);
        let squared = self.square().sum_axis(axis);
        // √ has an infinite derivative at 0, and 0 · ∞ is NaN. The sum is therefore replaced by 1 there, and a mask removes it from value and gradient.
        let zero = squared.equal(&Tensor::scalar(T::zero()));
        let positive = squared.constant_map(|y| if y == T::zero() { T::zero() } else { T::one() });
        (squared + zero).sqrt().masked(&positive)
    }

    /// Returns the unit vectors y = x / max(|x|, 10⁻¹²) along one axis, with the Euclidean norm |x|, as `torch.nn.functional.normalize` does.
    ///
    /// y is 0 where x is 0. The gradient there is ∂L/∂y · 10¹², since the denominator is constant. There is a kink at |x| = 10⁻¹².
    ///
    /// Panics if the axis does not exist.
    #[track_caller]
    pub fn normalize(&self, axis: usize) -> Self {
        self.check_axis("normalize", axis);
        self / self.norm(axis).unsqueeze(axis).maximum(&Tensor::scalar(T::lit(1e-12)))
    }

    /// Returns the largest element along an axis, as a constant. It is replaced by 0 where it is infinite, because ∞ − ∞ is NaN.
    #[track_caller]
    fn largest(&self, axis: usize) -> Self {
        self.detach().max_axis(axis).constant_map(|m| if m.is_infinite() { T::zero() } else { m })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grad;
    use ndarray::arr2;

    #[test]
    fn numbers_whose_exponentials_overflow_or_vanish_do_no_harm() {
        let x = Tensor::variable(arr2(&[[1000.0f32, 1000.0], [-1000.0, f32::NEG_INFINITY], [f32::NEG_INFINITY, f32::NEG_INFINITY]]));
        let y = x.log_sum_exp(1);
        assert_eq!(y.data(), [1000.0 + 2f32.ln(), -1000.0, f32::NEG_INFINITY]);
        let share = x.narrow(0, 0, 2).softmax(1);
        assert_eq!(share.data(), [0.5, 0.5, 1.0, 0.0]);
        assert!(share.backward_from(&Tensor::ones(&[2, 2])).array(&x).iter().all(|&g| g == 0.0));
    }

    #[test]
    fn the_norm_of_zero_has_gradient_zero_in_both_orders_and_its_unit_vector_is_zero() {
        let x = Tensor::variable(arr2(&[[0.0f64, 0.0], [3.0, -4.0]]));
        assert_eq!(x.norm(1).data(), [0.0, 5.0]);
        assert_eq!(x.normalize(1).data(), [0.0, 0.0, 0.6, -0.8]);
        let slope = grad(&x.norm(1).sum(), &[&x]).remove(0);
        assert!(slope.data().iter().zip([0.0, 0.0, 0.6, -0.8]).all(|(got, want)| (got - want).abs() < 1e-15), "{slope:?}");
        let curvature = slope.sum().backward().array(&x);
        assert!(curvature.iter().take(2).all(|&g| g == 0.0) && curvature.iter().all(|g| g.is_finite()));
        assert_eq!(x.normalize(1).sum().backward().array(&x).iter().take(2).copied().collect::<Vec<_>>(), [1e12, 1e12]);
    }
}
