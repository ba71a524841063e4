//! Pixels of pictures: many rays are led through the table of densities together ([`lanes`](crate::field::lanes)), and only samples with a weight are kept.

use super::densities::Densities;
use super::forward::{Block, Scene, cells_per_length};
use crate::field::lanes::{Bent, Guide, Shown, Straight};
use crate::render::along::COLUMNS;
use crate::sampling::{RAYS_OF_PACKET, Spacing};
use autograd::Real;
use glam::DVec3;

/// Number of rays that one task renders.
pub const BLOCK: usize = 4 * RAYS_OF_PACKET;

impl<T: Real> Scene<'_, T> {
    /// Computes the pixels of rays from `first` on, one for each [`COLUMNS`] entries of `pixels`. Returns the number of samples.
    pub fn show(&self, densities: &Densities<T>, first: usize, pixels: &mut [T]) -> usize {
        let pixels = pixels.as_chunks_mut::<COLUMNS>().0;
        let rays = &self.rays[first..first + pixels.len()];
        let factor = cells_per_length(self.batch.nodes, &self.options.aabb);
        let to_cells: [DVec3; 2] = [factor, -self.options.aabb.min * factor];
        let guide = Guide { matter: densities, options: self.options, cells: densities.cells(), to_cells, merged: 0.0, group: 0.0 };
        let mut shown: Shown<T, 6> = match self.options.spacing {
            Spacing::Contracted(_) => guide.lead::<T, Bent<T>, 6>(rays),
            Spacing::Step(_) | Spacing::Points { .. } => guide.lead::<T, Straight<T>, 6>(rays),
        };
        let offsets = shown.sort();
        let [mut x, mut y, mut z, weight, t, delta] = shown.columns.each_mut().map(std::mem::take);
        // Outside of the box, a field is as at the nearest face.
        for (places, nodes) in [&mut x, &mut y, &mut z].into_iter().zip(self.batch.nodes) {
            let most = T::lit(nodes as f64 - 1.0);
            places.iter_mut().for_each(|place| *place = place.max(T::zero()).min(most));
        }
        let mut block = Block::of_weights(first, offsets, [x, y, z], weight, [t, delta]);
        self.compute_colors(&mut block, true);
        shown.write(block.weight(), block.color(), self.batch.background, pixels);
        shown.looked_at
    }
}

#[cfg(test)]
mod tests {
    use super::super::{render, render_picture};
    use super::*;
    use crate::camera::{Camera, Intrinsics, Ray};
    use crate::field::encoding::Directions;
    use crate::field::factored::{Factored, Shape};
    use crate::field::grouping::Grouping;
    use crate::geometry::Aabb;
    use crate::render::{Engine, RenderOptions, Rendered};
    use crate::sampling::{Jitter, Occupancy, sample};
    use autograd::random::Stream;
    use autograd::{Module, Param, Tensor};

    /// A field of matter and empty space, with a reach of scattered cubes of cells.
    fn field<T: Real>(half_width: f64) -> Factored<T> {
        let shape = Shape {
            density_components: 16,
            appearance_components: 16,
            features: 4,
            hidden: 8,
            feature_octaves: 0,
            directions: Directions::Harmonics(1),
        };
        let aabb = Aabb::cube(half_width);
        let mut field = Factored::new(shape, aabb, [61, 45, 53], &Stream::new(3));
        field.visit_mut(&mut |param: &mut Param<T>| {
            let factor = if param.name().starts_with("density") { 9.0 } else { 3.0 };
            *param = Param::from_tensor(param.name(), param.tensor() * factor);
        });
        const CELLS: usize = 25;
        const CUBES: usize = 5;
        let cubes = Stream::new(9).uniform_tensor::<f64>(&[CUBES.pow(3)], 0.0, 1.0);
        let reached = (0..CELLS.pow(3)).map(|cell| {
            let [i, j, k] = [cell / CELLS.pow(2), cell / CELLS % CELLS, cell % CELLS].map(|place| place * CUBES / CELLS);
            cubes.data()[(i * CUBES + j) * CUBES + k] < 0.2
        });
        field.occupied = Some(Occupancy::new(aabb, [CELLS; 3], &reached.collect::<Vec<_>>()));
        field.grouping_in_pictures = Grouping { weight: 0.05, above: 1e-3, compact: true };
        field
    }

    fn rays(distance: f64, width: f64, side: usize) -> Vec<Ray> {
        let eye = distance * DVec3::new(0.5, -0.7, 0.5).normalize();
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(side, side, width));
        (0..side * side).map(|i| camera.ray((i % side) as f64 + 0.5, (i / side) as f64 + 0.5)).collect()
    }

    fn options(half_width: f64, spacing: Spacing) -> RenderOptions<'static> {
        RenderOptions {
            aabb: Aabb::cube(half_width),
            spacing,
            jitter: Jitter::None,
            background: [1.0, 0.5, 0.0],
            occupancy: None,
            engine: Engine::Fused,
            stop_below: 1e-3,
        }
    }

    fn picture<T: Real>(field: &Factored<T>, rays: &[Ray], options: &RenderOptions<'_>) -> Rendered<T> {
        render_picture(field, &Densities::new(field, 0.0).expect("a small table"), rays, options)
    }

    fn largest<A: Real, B: Real>(a: &Tensor<A>, b: &Tensor<B>) -> f64 {
        a.data().iter().zip(b.data()).map(|(a, b)| (a.as_f64() - b.as_f64()).abs()).fold(0.0, f64::max)
    }

    /// Field of view of pictures of a few cells.
    const NARROW: f64 = 0.03;

    /// Spacings, with the half width of the box, the distance of the camera and its field of view.
    const CASES: [(Spacing, [f64; 3]); 7] = [
        (Spacing::Step(0.06), [1.1, 3.0, 0.8]),
        (Spacing::Points { samples: 80, far: 5.0 }, [1.1, 3.0, 0.8]),
        (Spacing::Step(0.06), [1.1, 300.0, 0.008]),
        (Spacing::Contracted(0.05), [2.0, 0.3, 1.5]),
        // A box smaller than the contracted space.
        (Spacing::Contracted(0.05), [1.4, 0.3, 1.5]),
        (Spacing::Contracted(0.05), [2.0, 3.0, 1.5]),
        // Many groups for each node, where the linear part of the color network is computed.
        (Spacing::Step(0.06), [1.1, 3.0, NARROW]),
    ];

    #[test]
    fn pictures_are_those_of_the_other_renderer() {
        for (spacing, [half_width, distance, width]) in CASES {
            for compact in [true, false] {
                let mut field = field::<f64>(half_width);
                field.grouping_in_pictures.compact = compact;
                let (rays, options) = (rays(distance, width, 40), options(half_width, spacing));
                let [want, found] = [render(&field, &rays, &options), picture(&field, &rays, &options)];
                for (of_want, of_found) in [
                    (&want.rgb, &found.rgb),
                    (&want.opacity, &found.opacity),
                    (&want.log_transmittance, &found.log_transmittance),
                    (&want.depth(), &found.depth()),
                    (&want.distortion(), &found.distortion()),
                ] {
                    assert!(largest(of_want, of_found) < 1e-8, "{spacing:?}: {}", largest(of_want, of_found));
                }
                let opacity = found.opacity.data();
                if width == NARROW {
                    assert!(opacity.iter().any(|&o| o > 0.1), "{spacing:?}");
                    continue;
                }
                assert!(opacity.iter().any(|&o| o > 0.9) && opacity.iter().any(|&o| o < 0.5), "{spacing:?}");
                // The look-ups of empty bricks are left out.
                let all = sample::<f32>(&rays, &options.aabb, spacing, Jitter::None, None).len();
                assert!(found.sample_count < all * 9 / 10, "{spacing:?}: {} of {all}", found.sample_count);
            }
        }
    }

    #[test]
    fn single_precision_changes_no_color_by_a_tenth_of_a_step() {
        for (spacing, [half_width, distance, width]) in CASES {
            let (mut double, mut single) = (field::<f64>(half_width), field::<f32>(half_width));
            // Whether a sample ends a group, or lies in a cell, may depend on its rounding.
            (double.grouping_in_pictures, single.grouping_in_pictures) = (Grouping::NONE, Grouping::NONE);
            (double.occupied, single.occupied) = (None, None);
            let (rays, options) = (rays(distance, width, 40), options(half_width, spacing));
            let (want, found) = (render(&double, &rays, &options), picture(&single, &rays, &options));
            let [rgb, opacity] = [largest(&want.rgb, &found.rgb), largest(&want.opacity, &found.opacity)];
            assert!(rgb > 0.0 && rgb.max(opacity) < 0.1 / 255.0, "{spacing:?}: {rgb} and {opacity}");
        }
    }

    #[test]
    fn pictures_have_the_same_bits_for_any_number_of_threads() {
        for (spacing, [half_width, distance, width]) in CASES {
            let (field, rays, options) = (field::<f32>(half_width), rays(distance, width, 48), options(half_width, spacing));
            let bits = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
                pool.install(|| {
                    let rendered = picture(&field, &rays, &options);
                    rendered.rgb.data().iter().chain(rendered.depth().data()).map(|x| x.to_bits()).collect::<Vec<_>>()
                })
            };
            assert!(bits(1) == bits(2) && bits(1) == bits(3), "{spacing:?}");
        }
    }
}
