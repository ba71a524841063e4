//! Means over neighbouring voxels.

use autograd::{Lattice, Real, parallel};

/// Averages each row of a table `[rows, width]` with the rows of the present neighbours of its voxel, as [`average`] does.
pub(crate) fn smoothed<T: Real>(lattice: &Lattice, table: &[T], width: usize) -> Vec<T> {
    let mut out = vec![T::zero(); table.len()];
    parallel::for_each_rows(&mut out, width, |first, chunk| {
        for (r, out) in chunk.chunks_exact_mut(width).enumerate() {
            if let Some(voxel) = lattice.node((first + r) as u32) {
                average(lattice, table, voxel, |_| true, out);
            }
        }
    });
    out
}

/// Writes the weighted mean of the rows of a voxel and its 26 neighbours into `out`. Only present voxels whose row satisfies `counts`
/// contribute; zero if there is none. Weights are those of the source paper: 6 for the voxel itself, 1 for a neighbour across a face, 1/√2
/// across an edge, 1/√3 across a corner.
pub(crate) fn average<T: Real>(lattice: &Lattice, table: &[T], voxel: [usize; 3], counts: impl Fn(&[T]) -> bool, out: &mut [T]) {
    let (nodes, width) = (lattice.nodes(), out.len());
    let weights = [6.0, 1.0, 0.5_f64.sqrt(), (1.0_f64 / 3.0).sqrt()].map(T::lit);
    out.fill(T::zero());
    let mut total = T::zero();
    for k in 0..27 {
        let step = [k / 9, k / 3 % 3, k % 3];
        let around = [0, 1, 2].map(|a| (voxel[a] + step[a]).wrapping_sub(1));
        if (0..3).any(|a| around[a] >= nodes[a]) {
            continue;
        }
        let row = lattice.row(around).map(|row| &table[row as usize * width..][..width]);
        if let Some(row) = row.filter(|row| counts(row)) {
            let weight = weights[step.iter().filter(|s| **s != 1).count()];
            total += weight;
            out.iter_mut().zip(row).for_each(|(out, x)| *out += weight * *x);
        }
    }
    if total > T::zero() {
        out.iter_mut().for_each(|out| *out /= total);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_count_by_how_they_touch_and_absent_ones_do_not() {
        // A voxel; neighbours across a face, an edge and a corner; and a voxel that is too far away.
        let present = [[1, 1, 1], [2, 1, 1], [0, 0, 1], [2, 2, 2], [1, 1, 4]];
        let lattice = Lattice::bricks_where([5; 3], |voxel| present.contains(&voxel));
        let mut table = vec![f64::NAN; lattice.rows()];
        for (k, voxel) in present.into_iter().enumerate() {
            table[lattice.row(voxel).unwrap() as usize] = 10f64.powi(k as i32);
        }
        let out = smoothed(&lattice, &table, 1);
        let (edge, corner) = (0.5_f64.sqrt(), (1.0_f64 / 3.0).sqrt());
        let want = (6.0 + 10.0 + edge * 100.0 + corner * 1000.0) / (7.0 + edge + corner);
        assert!((out[lattice.row([1, 1, 1]).unwrap() as usize] - want).abs() < 1e-9);
        assert_eq!(out[lattice.row([1, 1, 4]).unwrap() as usize], 10_000.0);
    }
}
