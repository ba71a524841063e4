//! Stochastic pruning of cotangents (Ye et al. 2020, "Accelerating CNN Training by Pruning Activation Gradients").
//!
//! The adjoint of a sample costs the same for a small gradient as for a large one, and most gradients are far below the mean. With a threshold τ, a row g with
//! |g| = Σ |gᵢ| < τ becomes τ g / |g| with the probability |g| / τ, and 0 otherwise. Its expectation is g.

use autograd::random::Stream;
use autograd::{Buffer, Real};

/// Prunes rows of `width` cotangents with τ = `share` · mean |g|, and returns the numbers of the rows that are not 0. Without random numbers, τ is 0.
pub fn prune<T: Real>(g: &mut [T], width: usize, share: f64, random: Option<Stream>) -> Vec<u32> {
    let size = |row: &[T]| row.iter().map(|g| g.abs()).sum::<T>();
    let threshold = T::lit(share) * size(g) / T::lit((g.len() / width).max(1) as f64);
    let mut kept = Vec::new();
    for (i, row) in g.chunks_exact_mut(width).enumerate() {
        let own = size(row);
        if let Some(random) = random
            && own < threshold
        {
            let probability = own / threshold;
            let scale = if T::lit(random.uniform(i as u64)) < probability { T::one() / probability } else { T::zero() };
            row.iter_mut().for_each(|g| *g *= scale);
        }
        // NaN is kept: it must not look like no gradient.
        if row.iter().any(|&g| g != T::zero()) {
            kept.push(i as u32);
        }
    }
    kept
}

/// Returns the rows of `width` values with these numbers.
pub fn rows<T: Real>(all: &[T], width: usize, numbers: &[u32]) -> Buffer<T> {
    // Without rows, the width may be unknown.
    if numbers.is_empty() {
        return Buffer::stale(0);
    }
    let mut rows = Buffer::stale(numbers.len() * width);
    for (row, &i) in rows.chunks_exact_mut(width).zip(numbers) {
        row.copy_from_slice(&all[i as usize * width..][..width]);
    }
    rows
}
