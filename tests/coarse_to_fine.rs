//! Reading a field at another resolution.

use crate::support::{numbers, rays};
use approx::assert_relative_eq;
use autograd::Module;
use autograd::{Tensor, no_grad};
use glam::DVec3;
use plenoxel::field::voxel_grid::fused::largest_weights;
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::render::{Engine, RenderOptions, render};
use plenoxel::sampling::{Jitter, Spacing};

/// Voxel centres of a grid of n³ in the cube ±1.
fn centers(n: usize) -> Vec<[f64; 3]> {
    let c = |k: usize| (k as f64 + 0.5) * 2.0 / n as f64 - 1.0;
    (0..n * n * n).map(|r| [c(r / (n * n)), c(r / n % n), c(r % n)]).collect()
}

fn sampled(n: usize, f: impl Fn([f64; 3]) -> f64) -> VoxelGrid<f64> {
    let shape = GridShape::new(n, 1.0, Interpolation::Trilinear, Color::Rgb);
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
fn a_field_read_in_a_smaller_cube_is_where_it_was() {
    let f = |[x, y, z]: [f64; 3]| 2.0 + 0.3 * x - 0.2 * y + 0.1 * z + 0.4 * x * y - 0.3 * y * z;
    let old = sampled(10, f);
    let new = old.resample_in(8, 0.7);
    assert_eq!((new.shape().resolution, new.shape().half_width), (8, 0.7));
    for (at, &got) in centers(8).into_iter().zip(new.to_row_major()[0].data()) {
        assert_relative_eq!(got, f(at.map(|x| 0.7 * x)), epsilon = 1e-12);
    }
    // And reduced harmonics, whose voxels are twice as wide.
    let shape = GridShape { color: Color::Sh { degree: 1, offset: 0.5 }, ..*old.shape() };
    let harmonic = VoxelGrid::<f64>::random(shape, 1.0, 1.0, 3).with_reduction(2);
    // Each new centre is where eight old ones meet: less than half the cube, voxels of the same width.
    let half = harmonic.resample_in(4, 0.4);
    let row = |grid: &VoxelGrid<f64>, at| grid.harmonics_lattice().and_then(|l| l.row(at)).expect("present") as usize;
    let value = |grid: &VoxelGrid<f64>, at| grid.harmonics.as_ref().expect("reduced").tensor().data()[9 * row(grid, at)];
    let centre = |grid: &VoxelGrid<f64>, k: usize| (k as f64 + 0.5) * 2.0 * grid.shape().voxel_side() - grid.shape().half_width;
    for (new, old) in [([0, 0, 0], [1.5; 3]), ([1, 1, 0], [2.5, 2.5, 1.5])] {
        (0..3).for_each(|a| assert_relative_eq!(centre(&half, new[a]), (old[a] + 0.5) * 0.4 - 1.0, epsilon = 1e-12));
        let around = |k: f64| [k as usize, k as usize + 1];
        let corners = around(old[0]).into_iter().flat_map(|i| around(old[1]).map(|j| [i, j]));
        let corners = corners.flat_map(|[i, j]| around(old[2]).map(|k| [i, j, k]));
        let mean = corners.map(|at| value(&harmonic, at)).sum::<f64>() / 8.0;
        assert_relative_eq!(value(&half, new), mean, epsilon = 1e-12);
    }
}

#[test]
fn upsampling_keeps_a_nearest_field_everywhere_and_a_trilinear_one_at_the_old_centres() {
    // Three new voxels in each old one: the middle one has the old one's centre.
    for (interpolation, offsets) in [(Interpolation::Nearest, 0..3), (Interpolation::Trilinear, 1..2)] {
        let old = VoxelGrid::<f64>::random(GridShape::new(4, 1.3, interpolation, Color::Rgb), 1.0, 1.0, 3);
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
    let shape = GridShape::new(8, 1.0, Interpolation::Nearest, Color::Rgb);
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
    let shape = GridShape::new(4, 2.0, Interpolation::Nearest, Color::Rgb);
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
        let shape = GridShape::new(6, 1.0, interpolation, Color::Rgb);
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

/// A shape whose harmonics of degree 1 are stored for every fourth voxel.
fn reduced(resolution: usize, interpolation: Interpolation) -> GridShape {
    GridShape { sh_reduction: 4, ..GridShape::new(resolution, 1.0, interpolation, Color::Sh { degree: 1, offset: 0.5 }) }
}

/// Pixels of the rays that tests share.
fn pixels(grid: &VoxelGrid<f64>) -> Vec<f64> {
    let options = RenderOptions {
        aabb: grid.aabb(),
        spacing: Spacing::Step(0.05),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::Graph,
        stop_below: 0.0,
    };
    no_grad(|| render(grid, &rays(), &options)).rgb.data().to_vec()
}

#[test]
fn resampled_harmonics_are_read_where_their_larger_voxels_are() {
    // An affine function of the place in each coefficient.
    let f = |at: [f64; 3], k: usize| 0.1 * k as f64 + 0.3 * at[0] - 0.2 * at[1] + 0.4 * at[2];
    let old = VoxelGrid::<f64>::random(reduced(12, Interpolation::Trilinear), 1.0, 1.0, 3);
    let lattice = old.harmonics_lattice().expect("they are reduced").clone();
    // Three of them, 2 / 3 wide.
    let center = |k: usize, n: f64| (k as f64 + 0.5) * 2.0 / n - 1.0;
    let values = (0..lattice.rows() as u32).flat_map(|row| {
        let at = lattice.node(row).map_or([0.0; 3], |node| node.map(|k| center(k, 3.0)));
        (0..9).map(move |k| f(at, k))
    });
    let values = Tensor::from_vec(values.collect(), &[lattice.rows(), 9]);
    let tables = vec![old.density.tensor().detach(), old.color.tensor().detach(), values];
    let old = VoxelGrid::with_tables(*old.shape(), old.lattice().clone(), tables);
    let new = old.resample(24);
    let (table, lattice) = (new.harmonics.as_ref().expect("still reduced"), new.harmonics_lattice().expect("still reduced"));
    assert_eq!(lattice.nodes(), [6; 3]);
    for (row, numbers) in table.tensor().data().chunks(9).enumerate() {
        let Some(node) = lattice.node(row as u32) else { continue };
        let at = node.map(|k| center(k, 6.0).clamp(center(0, 3.0), center(2, 3.0)));
        for (k, &number) in numbers.iter().enumerate() {
            assert_relative_eq!(number, f(at, k), epsilon = 1e-12);
        }
    }
}

#[test]
fn voxels_that_go_leave_the_harmonics_that_others_read() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        for resolution in [13, 16] {
            let full = VoxelGrid::<f64>::random(reduced(resolution, interpolation), 3.0, 0.4, 3);
            // Matter in a ball away from the middle.
            let ball = |[x, y, z]: [i32; 3]| x * x + (y - 4).pow(2) + (z - 6).pow(2) < 40;
            let inside = |row: usize| full.lattice().node(row as u32).is_some_and(|voxel| ball(voxel.map(|k| k as i32)));
            let density = full.density.tensor().data().iter().enumerate().map(|(row, &d)| if inside(row) { d } else { 0.0 });
            let full = full.with_density(Tensor::from_vec(density.collect(), &[full.lattice().rows(), 1]));
            let pruned = full.pruned(&full.occupancy(0.0));
            let count = |grid: &VoxelGrid<f64>| grid.harmonics_lattice().map_or(0, |lattice| lattice.present());
            assert!(count(&pruned) < count(&full), "{interpolation:?}");
            for (a, b) in pixels(&pruned).into_iter().zip(pixels(&full)) {
                assert_relative_eq!(a, b, epsilon = 1e-12);
            }
            assert!(pruned.grown().with_interpolation(Interpolation::Trilinear).resample(2 * resolution).is_finite());
        }
    }
}

#[test]
fn harmonics_that_are_the_same_everywhere_are_so_at_any_reduction() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let shape = GridShape { sh_reduction: 1, ..reduced(13, interpolation) };
        let random = VoxelGrid::<f64>::random(shape, 3.0, 0.4, 3);
        let numbers = random.color.tensor().data().iter().enumerate();
        // The mean of a channel, and three numbers of harmonics.
        let numbers = numbers.map(|(i, &number)| if i % 4 == 0 { number } else { 0.05 * (i % 12) as f64 - 0.2 });
        let color = Tensor::from_vec(numbers.collect(), random.color.shape());
        let whole = VoxelGrid::from_tables(shape, random.density.tensor().detach(), color);
        let whole = whole.pruned(&whole.voxels_where(|row| row % 5 != 0 && row % 64 > 20));
        // At the centres of voxels: between them, the whole one fades out towards those that are not there.
        let rows: Vec<u32> = (0..whole.lattice().rows() as u32).filter(|&row| whole.lattice().node(row).is_some()).collect();
        let colors = |grid: &VoxelGrid<f64>| grid.colors_of(&rows, &vec![DVec3::new(0.48, -0.6, 0.64); rows.len()]);
        let want = colors(&whole);
        let by_four = whole.with_reduction(4);
        assert_eq!(by_four.color.shape()[1], 3);
        let richer = by_four.with_color(Color::Sh { degree: 2, offset: 0.5 }).with_color(shape.color);
        for grid in [by_four.with_reduction(1), by_four.with_reduction(3), by_four, richer] {
            for (a, b) in colors(&grid).into_iter().flatten().zip(want.iter().flatten()) {
                assert_relative_eq!(a, *b, epsilon = 1e-12);
            }
        }
        // Colors that are the same from everywhere have nothing to reduce.
        assert_eq!(whole.with_reduction(4).with_color(Color::Rgb).shape(), whole.with_color(Color::Rgb).shape());
    }
}
