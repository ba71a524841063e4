//! Pixels from samples, and gradients of samples from cotangents of pixels, along one ray: the part that fused kernels have in common.
//!
//! With Gᵢ = ∂L/∂wᵢ and G_b = ∂L/∂T_N, for any loss on the columns:
//!
//! ∂L/∂σᵢ = δᵢ (Gᵢ Tᵢ₊₁ − Σ_{j>i} wⱼ Gⱼ − T_N G_b − ∂L/∂ln T_N),   ∂L/∂cᵢ = wᵢ ∂L/∂rgb.
//!
//! Gᵢ = cᵢ · ∂L/∂rgb + tᵢ ∂L/∂depth + ∂L/∂distortion · (2 Σⱼ wⱼ |tᵢ − tⱼ| + ⅔ wᵢ δᵢ),   G_b = background · ∂L/∂rgb − ∂L/∂opacity.

use autograd::Real;
use std::ops::Range;

/// Number of columns of a pixel.
pub const COLUMNS: usize = 7;

/// Indices of the columns; rgb has 0..3.
pub mod column {
    pub const DEPTH: usize = 3;
    pub const OPACITY: usize = 4;
    pub const LOG_TRANSMITTANCE: usize = 5;
    pub const DISTORTION: usize = 6;
}

/// Samples of some rays, one entry per sample.
#[derive(Clone, Copy)]
pub struct Along<'a, T> {
    /// Distance from the origin of the ray.
    pub t: &'a [T],
    /// Length of the interval.
    pub delta: &'a [T],
    /// wᵢ = Tᵢ (1 − exp(−σᵢδᵢ))
    pub weight: &'a [T],
    /// Tᵢ₊₁
    pub after: &'a [T],
}

/// Sums over the samples of `N` rays so far, front to back.
#[derive(Clone, Copy)]
pub struct Sums<T, const N: usize = 1> {
    depth: [T; N],
    opacity: [T; N],
    optical_depth: [T; N],
    distortion: [T; N],
}

impl<T: Real, const N: usize> Sums<T, N> {
    /// Sums over no samples.
    pub fn new() -> Self {
        let none = [T::zero(); N];
        Sums { depth: none, opacity: none, optical_depth: none, distortion: none }
    }

    /// Adds a sample of weight w to each ray.
    #[inline(always)]
    pub fn add(&mut self, w: [T; N], t: [T; N], delta: [T; N], sigma: [T; N]) {
        for i in 0..N {
            self.distortion[i] += w[i] * (T::lit(2.0) * (t[i] * self.opacity[i] - self.depth[i]) + w[i] * delta[i] * T::lit(1.0 / 3.0));
            self.depth[i] += w[i] * t[i];
            self.opacity[i] += w[i];
            self.optical_depth[i] += sigma[i] * delta[i];
        }
    }

    /// Moves a ray to other sums, and leaves the sums over no samples.
    pub fn take(&mut self, ray: usize) -> Sums<T> {
        let mut taken = Sums::new();
        let all = [&mut self.depth, &mut self.opacity, &mut self.optical_depth, &mut self.distortion];
        let own = [&mut taken.depth, &mut taken.opacity, &mut taken.optical_depth, &mut taken.distortion];
        own.into_iter().zip(all).for_each(|(own, all)| std::mem::swap(&mut own[0], &mut all[ray]));
        taken
    }
}

impl<T: Real> Sums<T> {
    /// Returns the columns of the pixel, from Σ wᵢ cᵢ and the transmittance to the background.
    #[inline(always)]
    pub fn pixel(&self, rgb: [T; 3], left: T, background: [T; 3]) -> [T; COLUMNS] {
        let mut pixel = [T::zero(); COLUMNS];
        (0..3).for_each(|c| pixel[c] = rgb[c] + left * background[c]);
        [pixel[column::DEPTH]] = self.depth;
        [pixel[column::OPACITY]] = self.opacity;
        pixel[column::LOG_TRANSMITTANCE] = -self.optical_depth[0];
        [pixel[column::DISTORTION]] = self.distortion;
        pixel
    }
}

impl<T: Real> Along<'_, T> {
    /// Computes the columns of the pixel of a ray with samples `own`. `sigma(i)` is σᵢ, `color(i)` is cᵢ.
    #[inline(always)]
    pub fn pixel(
        &self,
        own: Range<usize>,
        background: [T; 3],
        sigma: impl Fn(usize) -> T,
        color: impl Fn(usize) -> [T; 3],
    ) -> [T; COLUMNS] {
        let left = if own.is_empty() { T::one() } else { self.after[own.end - 1] };
        let (mut columns, mut rgb) = (Sums::<T>::new(), [T::zero(); 3]);
        for i in own {
            let w = self.weight[i];
            let c = color(i);
            (0..3).for_each(|a| rgb[a] += w * c[a]);
            columns.add([w], [self.t[i]], [self.delta[i]], [sigma(i)]);
        }
        columns.pixel(rgb, left, background)
    }

    /// Computes ∂L/∂σᵢ of the samples `own` of a ray, from back to front, from the cotangent g of its pixel.
    #[inline(always)]
    pub fn sigma_adjoint(&self, own: Range<usize>, background: [T; 3], g: &[T; COLUMNS], color: impl Fn(usize) -> [T; 3], sigma: &mut [T]) {
        let Some(last) = own.clone().next_back() else { return };
        let (g_depth, g_distortion) = (g[column::DEPTH], g[column::DISTORTION]);
        let g_background = (0..3).map(|c| background[c] * g[c]).sum::<T>() - g[column::OPACITY];
        let mut behind = self.after[last] * g_background + g[column::LOG_TRANSMITTANCE];
        // Sums of w and of w t, over all samples and over the samples behind the current one.
        let (mut all, mut all_t) = (T::zero(), T::zero());
        if g_distortion != T::zero() {
            for i in own.clone() {
                all += self.weight[i];
                all_t += self.weight[i] * self.t[i];
            }
        }
        let (mut back, mut back_t) = (T::zero(), T::zero());
        for i in own.rev() {
            let (w, t, delta) = (self.weight[i], self.t[i], self.delta[i]);
            let c = color(i);
            let mut own = c[0] * g[0] + c[1] * g[1] + c[2] * g[2] + t * g_depth;
            if g_distortion != T::zero() {
                let (front, front_t) = (all - back - w, all_t - back_t - w * t);
                let spread = t * front - front_t + back_t - t * back;
                own += g_distortion * (T::lit(2.0) * spread + T::lit(2.0 / 3.0) * w * delta);
                back += w;
                back_t += w * t;
            }
            sigma[i] = delta * (own * self.after[i] - behind);
            behind += w * own;
        }
    }
}

/// Returns ln(1 + 2σ²), the Cauchy sparsity of a sample.
#[inline(always)]
pub fn sparsity<T: Real>(sigma: T) -> T {
    (T::one() + T::lit(2.0) * sigma * sigma).ln()
}

/// Returns the derivative of [`sparsity`].
#[inline(always)]
pub fn sparsity_slope<T: Real>(sigma: T) -> T {
    T::lit(4.0) * sigma / (T::one() + T::lit(2.0) * sigma * sigma)
}
