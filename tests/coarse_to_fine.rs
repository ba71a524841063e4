//! Reading a field at another resolution.

mod support;

use approx::assert_relative_eq;
use autograd::{Tensor, no_grad};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::render::fused::largest_weights;
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::sampling::{Jitter, Spacing};
use support::{numbers, rays};

/// Voxel centres of a grid of n³ in the cube ±1.
fn centers(n: usize) -> Vec<[f64; 3]> {
    let c = |k: usize| (k as f64 + 0.5) * 2.0 / n as f64 - 1.0;
    (0..n * n * n).map(|r| [c(r / (n * n)), c(r / n % n), c(r % n)]).collect()
}

fn sampled(n: usize, f: impl Fn([f64; 3]) -> f64) -> VoxelGrid<f64> {
    let shape = GridShape { resolution: n, half_width: 1.0, interpolation: Interpolation::Trilinear, color: Color::Rgb, sh_reduction: 1 };
    let values: Vec<f64> = centers(n).into_iter().map(f).collect();
    let color =
        Tensor::stack(&[0.1, 0.2, 0.3].map(|s| Tensor::from_vec(values.iter().map(|v| s * v).collect(), &[n * n * n])).each_ref(), 1);
    VoxelGrid::from_row_major(shape, &Tensor::from_vec(values, &[n * n * n, 1]), &color)
}

#[test]
fn resampling_a_trilinear_function_is_exact_between_the_old_centres() {
    // f is trilinear over the whole cube, so it equals its interpolation inside the hull of the centres of any grid.
    let f = |[x, y, z]: [f64; 3]| 2.0 + 0.3 * x - 0.2 * y + 0.1 * z + 0.4 * x * y - 0.3 * y * z + 0.2 * x * z + 0.25 * x * y * z;
    let old = sampled(5, f);
    for n in [3, 5, 8, 10] {
        let new = old.resample(n);
        // The hull of the old centres is ±0.8; beyond it the field repeats its border.
        let [density, color] = new.to_row_major();
        for (at, &got) in centers(n).into_iter().zip(density.data()) {
            assert_relative_eq!(got, f(at.map(|x| x.clamp(-0.8, 0.8))), epsilon = 1e-12);
        }
        for (row, &d) in color.data().chunks(3).zip(density.data()) {
            assert_relative_eq!(row[2], 0.3 * d, epsilon = 1e-12);
        }
    }
}

#[test]
fn upsampling_keeps_a_nearest_field_everywhere_and_a_trilinear_one_at_the_old_centres() {
    // Three new voxels in each old one: the middle one has the old one's centre.
    for (interpolation, offsets) in [(Interpolation::Nearest, 0..3), (Interpolation::Trilinear, 1..2)] {
        let old = VoxelGrid::<f64>::random(GridShape { resolution: 4, half_width: 1.3, interpolation, color: Color::Rgb, sh_reduction: 1 }, 1.0, 1.0, 3);
        let new = old.resample(12);
        let at = |grid: &VoxelGrid<f64>, voxel| grid.density.tensor().data()[grid.lattice().row(voxel).expect("present") as usize];
        for voxel in 0..4 * 4 * 4 {
            let [i, j, k] = [voxel / 16, voxel / 4 % 4, voxel % 4];
            for o in offsets.clone() {
                let new_voxel = [3 * i + o, 3 * j + offsets.start, 3 * k + offsets.end - 1];
                assert_relative_eq!(at(&new, new_voxel), at(&old, [i, j, k]), epsilon = 1e-12);
            }
        }
    }
}

#[test]
fn a_sparse_nearest_grid_of_twice_the_resolution_has_eight_voxels_for_each() {
    let shape = GridShape { resolution: 8, half_width: 1.0, interpolation: Interpolation::Nearest, color: Color::Rgb, sh_reduction: 1 };
    let old = VoxelGrid::<f32>::random(shape, 1.0, 1.0, 4);
    let old = old.pruned(&old.occupancy(0.6));
    let new = old.resample(16);
    assert!(old.lattice().present() < 300);
    assert_eq!(new.lattice().present(), 8 * old.lattice().present());
    for row in 0..new.lattice().rows() as u32 {
        if let Some(voxel) = new.lattice().node(row) {
            let from = old.lattice().row(voxel.map(|c| c / 2)).expect("present") as usize;
            assert_eq!(new.density.tensor().data()[row as usize], old.density.tensor().data()[from]);
        }
    }
}

#[test]
fn nearest_look_up_reads_the_voxel_a_point_lies_in() {
    let shape = GridShape { resolution: 4, half_width: 2.0, interpolation: Interpolation::Nearest, color: Color::Rgb, sh_reduction: 1 };
    let grid = VoxelGrid::from_tables(shape, Tensor::constant(numbers(&[64, 1], 0.0, 1.0, 1)), Tensor::zeros(&[64, 3]));
    // Voxels are 1 wide: (−1.99, 0.5, 1.99) lies in (0, 2, 3); its faces belong to the next voxel.
    for (at, row) in [([-1.99, 0.5, 1.99], 11), ([-2.0, -2.0, -2.0], 0), ([-1.0, 0.0, 1.0], 16 + 8 + 3), ([2.0, 2.0, 2.0], 63)] {
        let read = no_grad(|| {
            use plenoxel::field::Field;
            grid.density(&Tensor::from_vec(at.to_vec(), &[1, 3]))
        });
        assert_eq!(read.data()[0], grid.density.tensor().data()[row], "at {at:?}");
    }
}

#[test]
fn pruning_keeps_what_is_visible_and_a_pruned_grid_resamples_to_the_same_field() {
    let grid = sampled(8, |[x, y, z]| if x * x + y * y + z * z < 0.3 { 3.0 } else { 0.01 });
    let kept = grid.occupancy(0.1);
    let pruned = grid.pruned(&kept);
    let [before, after] = [&grid, &pruned].map(|g| g.to_row_major()[0].data().to_vec());
    for (b, a) in before.iter().zip(&after) {
        assert!(a == b || *a == 0.0 && *b <= 0.1);
    }
    assert!(pruned.lattice().present() < 400 && pruned.lattice().rows() >= pruned.lattice().present());
    // A voxel beside a full one stays as it was: trilinear look-up reads it.
    assert!(after.contains(&0.01));
    // Where everything read is present, the finer grids are the same.
    let [whole, sparse] = [&grid, &pruned].map(|g| g.resample(16));
    assert!(sparse.lattice().present() < 16 * 16 * 16 && !sparse.lattice().is_full());
    let (whole, sparse) = (whole.to_row_major()[0].data().to_vec(), sparse.to_row_major()[0].data().to_vec());
    let mut equal = 0;
    for (w, s) in whole.iter().zip(&sparse) {
        assert!(s <= w);
        equal += usize::from(s == w && *w > 0.02);
    }
    assert!(equal > 500, "{equal}");
}

#[test]
fn the_largest_weight_of_a_voxel_is_that_of_the_samples_that_read_it() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let shape = GridShape { resolution: 6, half_width: 1.0, interpolation, color: Color::Rgb, sh_reduction: 1 };
        let grid = VoxelGrid::<f64>::random(shape, 3.0, 1.0, 5);
        let options = RenderOptions {
            aabb: grid.aabb(),
            spacing: Spacing::Step(0.13),
            jitter: Jitter::None,
            background: [1.0; 3],
            occupancy: None,
            engine: Engine::Graph,
            stop_below: 0.0,
        };
        let mut want = vec![0.0; grid.lattice().rows()];
        let rendered = no_grad(|| render(&grid, &rays(), &options));
        let samples = rendered.samples().expect("the graph knows every sample");
        let voxels = grid.world_to_voxels(&samples.samples.positions);
        for (u, &w) in voxels.data().chunks(3).zip(samples.weights.data()) {
            let at = [0, 1, 2].map(|a: usize| u[a].clamp(0.0, 5.0));
            for corner in 0..8 {
                let voxel = [0, 1, 2].map(|a: usize| match interpolation {
                    Interpolation::Nearest => (at[a] + 0.5).floor(),
                    Interpolation::Trilinear if corner >> a & 1 == 1 => at[a].ceil(),
                    Interpolation::Trilinear => at[a].floor(),
                });
                let row = grid.lattice().row(voxel.map(|v| v as usize)).expect("present") as usize;
                want[row] = f64::max(want[row], w);
            }
        }
        let (first, rest) = (rays()[..2].to_vec(), rays()[2..].to_vec());
        let got = largest_weights(&grid, [first, rest], &options);
        assert!(want.iter().any(|&w| w > 0.2) && want.contains(&0.0));
        for (got, want) in got.iter().zip(&want) {
            assert_relative_eq!(f64::from(*got), *want, epsilon = 1e-7);
        }
    }
}
