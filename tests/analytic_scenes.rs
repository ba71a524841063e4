//! The specification against closed forms.

use crate::support::{ray, rays};
use approx::assert_relative_eq;
use autograd::{Tensor, no_grad, value_and_grad};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::field::{Field, Radiance};
use plenoxel::geometry::Aabb;
use plenoxel::render::{Engine, RenderOptions, Rendered, render};
use plenoxel::sampling::{Jitter, Samples, Spacing};

const CUBE: f64 = 1.0;

fn options(spacing: Spacing, jitter: Jitter) -> RenderOptions<'static> {
    RenderOptions {
        aabb: Aabb::cube(CUBE),
        spacing,
        jitter,
        background: [0.2, 0.4, 0.6],
        occupancy: None,
        engine: Engine::default(),
        stop_below: 0.0,
    }
}

/// Density σ and color c in the whole box.
struct Fog {
    sigma: f64,
    color: [f64; 3],
}

impl Field<f64> for Fog {
    fn density(&self, positions: &Tensor<f64>) -> Tensor<f64> {
        Tensor::full(&[positions.shape()[0]], self.sigma)
    }
    fn radiance(&self, samples: &Samples<f64>) -> Radiance<f64> {
        let rgb = Tensor::from_vec(self.color.to_vec(), &[1, 3]).broadcast_to(&[samples.len(), 3]);
        Radiance { sigma: self.density(&samples.positions), rgb }
    }
}

#[test]
fn a_slab_of_fog_shows_its_closed_form_for_any_number_of_samples() {
    // Over a chord D: opacity 1 − e^{−σD}, color c (1 − e^{−σD}) + b e^{−σD}, whatever the steps.
    let fog = Fog { sigma: 0.7, color: [0.9, 0.1, 0.5] };
    for jitter in [Jitter::None, Jitter::PerRay { seed: 3, step: 9 }] {
        for step in [5.0, 0.31, 0.01] {
            let rendered = render(&fog, &rays(), &options(Spacing::Step(step), jitter));
            for (r, ray) in rays().iter().enumerate() {
                let chord = Aabb::cube(CUBE).intersect(ray.origin, ray.direction).map_or(0.0, |(near, far)| far - near);
                let clear = (-0.7 * chord).exp();
                assert_relative_eq!(rendered.opacity.data()[r], 1.0 - clear, epsilon = 1e-12);
                assert_relative_eq!(rendered.log_transmittance.data()[r], -0.7 * chord, epsilon = 1e-12);
                for c in 0..3 {
                    let background = f64::from([0.2f32, 0.4, 0.6][c]);
                    assert_relative_eq!(rendered.rgb.value()[[r, c]], fog.color[c] * (1.0 - clear) + background * clear, epsilon = 1e-12);
                }
            }
        }
    }
}

#[test]
fn a_voxel_grid_with_one_value_is_a_slab_of_fog() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let shape = GridShape::new(5, CUBE, interpolation, Color::Rgb);
        let grid = VoxelGrid::<f64>::uniform(shape, 0.7, 0.25);
        let rendered = render(&grid, &rays(), &options(Spacing::Step(0.1), Jitter::None));
        let fog = render(&Fog { sigma: 0.7, color: [0.25; 3] }, &rays(), &options(Spacing::Step(10.0), Jitter::None));
        for (a, b) in rendered.rgb.data().iter().zip(fog.rgb.data()) {
            assert_relative_eq!(a, b, epsilon = 1e-12);
        }
    }
}

#[test]
fn the_depth_of_fog_tends_to_its_closed_form() {
    // ∫ σ e^{−σ s} (t₀ + s) ds over s in [0, D] = (t₀ + 1/σ)(1 − e^{−σD}) − D e^{−σD}.
    let (sigma, ray) = (1.3, ray([-3.0, 0.2, 0.1], [1.0, 0.2, 0.1]));
    let rendered = render(&Fog { sigma, color: [1.0; 3] }, &[ray], &options(Spacing::Step(1e-4), Jitter::None));
    let (near, chord) = (2.0, 2.0);
    let clear = f64::exp(-sigma * chord);
    let want = (near + 1.0 / sigma) * (1.0 - clear) - chord * clear;
    assert_relative_eq!(rendered.depth().data()[0], want, epsilon = 1e-7);
}

/// A ball of density σ, color 0.5 everywhere.
struct Ball {
    radius: f64,
    sigma: f64,
}

impl Field<f64> for Ball {
    fn density(&self, positions: &Tensor<f64>) -> Tensor<f64> {
        let inside: Vec<f64> = positions
            .data()
            .chunks(3)
            .map(|p| if p.iter().map(|x| x * x).sum::<f64>() <= self.radius * self.radius { self.sigma } else { 0.0 })
            .collect();
        let m = inside.len();
        Tensor::from_vec(inside, &[m])
    }
    fn radiance(&self, samples: &Samples<f64>) -> Radiance<f64> {
        Radiance { sigma: self.density(&samples.positions), rgb: Tensor::full(&[samples.len(), 3], 0.5) }
    }
}

#[test]
fn a_ball_shows_the_chord_through_it() {
    // A ray at distance h from the centre crosses 2 √(R² − h²); with steps s the sampled chord is off by at most s at each end.
    let ball = Ball { radius: 0.8, sigma: 2.0 };
    let step = 1e-4;
    for h in [0.0, 0.3, 0.6, 0.79, 0.9] {
        let rendered = render(&ball, &[ray([-3.0, h, 0.0], [3.0, h, 0.0])], &options(Spacing::Step(step), Jitter::None));
        let chord = 2.0 * (0.64f64 - h * h).max(0.0).sqrt();
        assert_relative_eq!(rendered.opacity.data()[0], 1.0 - (-2.0 * chord).exp(), epsilon = 2.0 * 2.0 * step);
    }
}

#[test]
fn an_empty_box_and_a_missed_box_show_the_background() {
    let empty = VoxelGrid::<f64>::uniform(GridShape::new(4, CUBE, Interpolation::Trilinear, Color::Rgb), 0.0, 0.7);
    let rendered: Rendered<f64> = no_grad(|| render(&empty, &rays(), &options(Spacing::Step(0.05), Jitter::None)));
    for pixel in rendered.rgb.data().chunks(3) {
        for c in 0..3 {
            assert_relative_eq!(pixel[c], f64::from([0.2f32, 0.4, 0.6][c]));
        }
    }
    assert!(rendered.opacity.data().iter().chain(rendered.depth().data()).all(|&x| x == 0.0));
    let missed = render(
        &Fog { sigma: 9.0, color: [0.0; 3] },
        &[ray([-3.0, 2.0, 0.0], [3.0, 2.0, 0.0])],
        &options(Spacing::Step(0.05), Jitter::None),
    );
    assert_eq!(missed.opacity.data(), [0.0]);
    assert_relative_eq!(missed.rgb.data()[1], f64::from(0.4f32));
}

#[test]
fn distortion_in_linear_time_equals_the_double_sum() {
    let grid = VoxelGrid::<f64>::random(GridShape::new(4, CUBE, Interpolation::Trilinear, Color::Rgb), 2.0, 1.0, 5);
    let options = RenderOptions { engine: Engine::Graph, ..options(Spacing::Step(0.2), Jitter::None) };
    let rendered = render(&grid, &rays(), &options);
    let s = rendered.samples().expect("the graph keeps them");
    let (w, t, d) = (s.weights.data(), s.samples.t.data(), s.samples.delta.data());
    for r in 0..rays().len() {
        let own = s.samples.offsets[r] as usize..s.samples.offsets[r + 1] as usize;
        let pairs: f64 = own.clone().flat_map(|i| own.clone().map(move |j| (i, j))).map(|(i, j)| w[i] * w[j] * (t[i] - t[j]).abs()).sum();
        let alone: f64 = own.map(|i| w[i] * w[i] * d[i] / 3.0).sum();
        assert_relative_eq!(rendered.distortion().data()[r], pairs + alone, epsilon = 1e-12);
    }
}

#[test]
fn leaving_out_empty_voxels_changes_no_pixel() {
    let shape = GridShape::new(12, CUBE, Interpolation::Trilinear, Color::Rgb);
    let random = VoxelGrid::<f64>::random(shape, 1.0, 1.0, 8);
    // Nine voxels in ten are empty, some of them negative.
    let density: Vec<f64> = random.density.tensor().data().iter().map(|&d| if d > 0.9 { 5.0 * d } else { d - 0.95 }).collect();
    let density = Tensor::from_vec(density.into_iter().map(|d| d.max(-0.2)).collect(), &[12 * 12 * 12, 1]);
    let grid = VoxelGrid::from_tables(shape, density, random.color.tensor().detach());
    let occupancy = grid.matter();
    let plain = options(Spacing::Step(0.07), Jitter::None);
    let skipping = RenderOptions { occupancy: Some(&occupancy), ..plain.clone() };
    // And a grid that does not have its empty voxels at all, against one where they are 0.
    let zeros = Tensor::from_vec(grid.density.tensor().data().iter().map(|d| d.max(0.0)).collect(), grid.density.shape());
    let zeros = VoxelGrid::from_tables(shape, zeros, random.color.tensor().detach());
    let sparse = zeros.pruned(&zeros.voxels_where(|row| zeros.density.tensor().data()[row] > 0.0));
    assert!(sparse.lattice().present() < 12 * 12 * 12 / 5);
    for engine in [Engine::Graph, Engine::Fused] {
        let [plain, skipping] = [&plain, &skipping].map(|options| RenderOptions { engine, ..options.clone() });
        let (whole, part) = (render(&grid, &rays(), &plain), render(&grid, &rays(), &skipping));
        assert!(part.sample_count < whole.sample_count);
        for (a, b) in whole.rgb.data().iter().zip(part.rgb.data()) {
            assert_relative_eq!(a, b, epsilon = 1e-14);
        }
        // Its colors are gone too, its densities were nothing.
        let (whole, part) = (render(&zeros, &rays(), &plain), render(&sparse, &rays(), &plain));
        assert!(part.sample_count < whole.sample_count);
        for (a, b) in whole.opacity.data().iter().zip(part.opacity.data()) {
            assert_relative_eq!(a, b, epsilon = 1e-14);
        }
    }
}

#[test]
fn samples_where_nothing_learns_change_no_gradient() {
    for interpolation in [Interpolation::Trilinear, Interpolation::Nearest] {
        let shape = GridShape::new(12, CUBE, interpolation, Color::Rgb);
        let random = VoxelGrid::<f64>::random(shape, 1.0, 1.0, 8);
        // Four voxels in five are below 0, some are 0.
        let density: Vec<f64> =
            random.density.tensor().data().iter().map(|&d| if d < 0.82 { d - 0.9 } else { 9.0 * (d - 0.85).max(0.0) }).collect();
        assert!(density.contains(&0.0));
        let grid = VoxelGrid::from_tables(shape, Tensor::from_vec(density, &[12 * 12 * 12, 1]), random.color.tensor().detach());
        let learning = grid.learning();
        let all = options(Spacing::Step(0.07), Jitter::None);
        let some = RenderOptions { occupancy: Some(&learning), ..all.clone() };
        for engine in [Engine::Graph, Engine::Fused] {
            let [all, some] = [&all, &some].map(|options| {
                let options = RenderOptions { engine, ..options.clone() };
                let mut samples = 0;
                let (loss, gradients) = value_and_grad(|| {
                    let rendered = render(&grid, &rays(), &options);
                    samples = rendered.sample_count;
                    rendered.rgb.square().sum()
                });
                let rows = [&grid.density, &grid.color]
                    .map(|param| gradients.of(param).expect("it is read").to_array().into_raw_vec_and_offset().0);
                (loss, rows.concat(), samples)
            });
            assert!(some.2 < all.2, "{} of {} samples", some.2, all.2);
            assert_relative_eq!(some.0, all.0, epsilon = 1e-13);
            some.1.iter().zip(&all.1).for_each(|(some, all)| assert_relative_eq!(some, all, epsilon = 1e-13));
        }
    }
}
