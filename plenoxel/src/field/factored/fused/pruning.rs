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

/// Returns the values with these numbers.
pub fn picked<T: Real>(all: &[T], numbers: &[u32]) -> Buffer<T> {
    let mut picked = Buffer::stale(numbers.len());
    picked.iter_mut().zip(numbers).for_each(|(value, &i)| *value = all[i as usize]);
    picked
}

/// Returns the rows of `width` values with these increasing numbers: a part of `all` if they follow one another, otherwise `copy`, which is overwritten.
pub fn rows<'a, T: Real>(all: &'a [T], width: usize, numbers: &[u32], copy: &'a mut Buffer<T>) -> &'a [T] {
    let [Some(&first), Some(&last)] = [numbers.first(), numbers.last()] else { return &[] };
    if (last - first) as usize + 1 == numbers.len() {
        return &all[first as usize * width..][..numbers.len() * width];
    }
    copy.grow(numbers.len() * width);
    let copy = &mut copy[..numbers.len() * width];
    for (row, &i) in copy.chunks_exact_mut(width).zip(numbers) {
        row.copy_from_slice(&all[i as usize * width..][..width]);
    }
    copy
}
