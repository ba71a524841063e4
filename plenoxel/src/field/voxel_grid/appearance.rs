//! Properties of single voxels for exports: absorbed light, surface normal, color.

use super::{Color, GridShape, VoxelGrid};
use crate::sampling::Occupancy;
use autograd::{Buffer, Indices, Real, Tensor, no_grad, parallel};
use glam::DVec3;

/// Number of rows whose colors are computed at a time. It bounds the memory for their harmonics.
const RUN: usize = 1 << 16;

impl<T: Real> VoxelGrid<T> {
    /// Returns the voxels with a density above 0 that absorb at least the fraction `min_alpha` of the light
    /// ([`super::GridShape::alpha_of_density`]).
    pub fn voxels_absorbing(&self, min_alpha: f64) -> Occupancy {
        let density = self.density.tensor().data();
        self.voxels_where(|row| density[row] > T::zero() && self.shape().alpha_of_density(density[row].as_f64()) >= min_alpha)
    }

    /// Returns the raw density of a voxel, 1 / length; 0 if it is absent or outside of the grid.
    pub fn density_at(&self, voxel: [isize; 3]) -> f64 {
        let inside = voxel.iter().all(|k| (0..self.shape().resolution as isize).contains(k));
        let row = inside.then(|| self.lattice().row(voxel.map(|k| k as usize))).flatten();
        row.map_or(0.0, |row| self.density.tensor().data()[row as usize].as_f64())
    }

    /// Returns the outward direction of the surface at a voxel, not normalised: −∇α per voxel, where α is the fraction of light that a
    /// voxel absorbs ([`super::GridShape::alpha_of_density`]). The gradient is a 3D Sobel operator: central differences along each axis,
    /// smoothed by 1, 2, 1 along the other two. Zero if the neighbours are symmetric, for example inside solid matter.
    ///
    /// α is used instead of the density because the density of opaque voxels varies: a density of 10⁴ beside 10³ would turn the normal,
    /// although both are opaque. Smoothing is needed because surfaces of opaque voxels are stair-shaped.
    pub fn outward(&self, voxel: [isize; 3]) -> DVec3 {
        const STRIDES: [usize; 3] = [9, 3, 1];
        const SMOOTH: [f64; 3] = [1.0, 2.0, 1.0];
        let alpha: [f64; 27] = std::array::from_fn(|k| {
            let step = STRIDES.map(|stride| (k / stride % 3) as isize - 1);
            self.shape().alpha_of_density(self.density_at([0, 1, 2].map(|axis| voxel[axis] + step[axis])))
        });
        let fall = |axis: usize| -> f64 {
            let [along, a, b] = [0, 1, 2].map(|k| STRIDES[(axis + k) % 3]);
            (0..9)
                .map(|k| (k / 3, k % 3))
                .map(|(i, j)| SMOOTH[i] * SMOOTH[j] * (alpha[i * a + j * b] - alpha[i * a + j * b + 2 * along]))
                .sum()
        };
        // The difference spans two voxels, and the weights add up to 16.
        DVec3::from([0, 1, 2].map(fall)) / 32.0
    }

    /// Returns the grid with the unit normal of each voxel in the world, that of [`VoxelGrid::outward`], in place of its color. Rendered over black, a pixel is
    /// Σ wᵢ nᵢ: the mean normal along the ray times its opacity. Voxels without a direction have normal zero.
    pub fn normals(&self) -> Self {
        let rows = self.lattice().rows();
        let normal = |row: usize| {
            let voxel = self.lattice().node(row as u32).map(|voxel| voxel.map(|k| k as isize));
            voxel.map_or(DVec3::ZERO, |voxel| self.shape().coordinates.gradient_in_world(self.shape().center(voxel), self.outward(voxel)))
        };
        let mut normals = Buffer::stale(3 * rows);
        parallel::for_each_chunk(&mut normals, 3 * RUN, |start, chunk| {
            for (row, to) in (start / 3..).zip(chunk.as_chunks_mut::<3>().0) {
                *to = normal(row).normalize_or_zero().to_array().map(T::lit);
            }
        });
        let shape = GridShape { color: Color::Rgb, ..*self.shape() }.normalised();
        Self::with_lattice(shape, self.lattice().clone(), self.density.tensor().detach(), Tensor::from_buffer(normals, &[rows, 3]))
    }

    /// Returns the colors of rows of the tables, each seen along a unit direction from the viewer into the scene. The color is that of
    /// [`super::Color::activate`] for a sample at the centre of the voxel. A zero direction gives the mean over all directions (before the
    /// maximum with 0), because all harmonics but the first have mean zero. Colors are sRGB, not clamped.
    ///
    /// Panics if the numbers of rows and directions differ, or if a row is not in the tables.
    pub fn colors_of(&self, rows: &[u32], directions: &[DVec3]) -> Vec<[f64; 3]> {
        assert_eq!(rows.len(), directions.len(), "colors_of: the number of directions must be the number of rows");
        let runs = rows.chunks(RUN).zip(directions.chunks(RUN));
        let colors = runs.flat_map(|(rows, directions)| {
            let m = rows.len();
            let directions = directions.iter().flat_map(|d| d.to_array().map(T::lit)).collect();
            let directions = Tensor::from_vec(directions, &[m, 3]);
            let numbers = self.numbers_of(rows);
            let rgb = no_grad(|| self.shape().color.shade(&numbers, |degree| crate::field::sh::basis(&directions, degree)));
            let rgb: Vec<[f64; 3]> = rgb.data().as_chunks::<3>().0.iter().map(|c| c.map(T::as_f64)).collect();
            rgb
        });
        colors.collect()
    }

    /// Returns all color numbers at the voxel centres of rows, `[rows, channels]`, without gradient. Rows without a voxel get arbitrary
    /// values.
    pub(super) fn numbers_of(&self, rows: &[u32]) -> Tensor<T> {
        let color = self.color.tensor().detach().gather_rows(&Indices::from(rows.to_vec()));
        let Some(harmonics) = &self.harmonics else { return color };
        let centers = rows.iter().flat_map(|&row| self.lattice().node(row).unwrap_or_default().map(|k| T::lit(k as f64))).collect();
        no_grad(|| self.layout().whole_colors(color, Some(harmonics.tensor()), &Tensor::from_vec(centers, &[rows.len(), 3])))
    }
}

#[cfg(test)]
mod tests {
    use super::super::Interpolation;
    use super::*;
    use crate::camera::Ray;
    use crate::field::Field;
    use crate::random::{Purpose, uniform};
    use crate::render::{Engine, RenderOptions, render};
    use crate::sampling::{Jitter, Samples, Spacing};

    /// Returns the shape with harmonics reduced by 2, if it has any.
    fn reduced(color: Color) -> GridShape {
        GridShape { sh_reduction: 2, ..shape(color) }.normalised()
    }

    fn shape(color: Color) -> GridShape {
        GridShape::new(4, 1.0, Interpolation::Nearest, color)
    }

    #[test]
    fn a_row_has_the_color_that_a_ray_finds_at_its_voxel() {
        let harmonics = Color::Sh { degree: 2, offset: 0.5 };
        for shape in [shape(Color::Rgb), shape(harmonics), reduced(harmonics)] {
            let grid = VoxelGrid::<f64>::random(shape, 1.0, 1.0, 3);
            let (voxel, direction) = ([2, 0, 3], DVec3::new(0.48, -0.6, 0.64));
            let samples = Samples {
                t: Tensor::zeros(&[1]),
                delta: Tensor::full(&[1], 1.0),
                positions: Tensor::from_vec(grid.shape().center(voxel).to_array().to_vec(), &[1, 3]),
                directions: Tensor::from_vec(direction.to_array().to_vec(), &[1, 3]),
                offsets: Indices::from(vec![0, 1]),
            };
            let row = grid.lattice().row(voxel.map(|k| k as usize)).unwrap();
            assert_eq!(grid.colors_of(&[row], &[direction])[0].as_slice(), grid.radiance(&samples).rgb.data());
        }
    }

    #[test]
    fn a_direction_of_zero_gives_the_mean_of_all_directions() {
        let grid = VoxelGrid::<f64>::random(shape(Color::Sh { degree: 3, offset: 2.0 }), 1.0, 0.1, 5);
        let mean = grid.colors_of(&[7], &[DVec3::ZERO])[0];
        // The 26 directions of a cube's corners, edges and faces with weights 27, 32 and 40 of 840 integrate polynomials of degree 7 exactly.
        let mut sum = DVec3::ZERO;
        for (x, y, z) in
            (0..27).map(|c| (f64::from(c / 9 - 1), f64::from(c / 3 % 3 - 1), f64::from(c % 3 - 1))).filter(|d| *d != (0.0, 0.0, 0.0))
        {
            let d = DVec3::new(x, y, z);
            let weight = [40.0, 32.0, 27.0][d.length_squared() as usize - 1] / 840.0;
            sum += weight * DVec3::from(grid.colors_of(&[7], &[d.normalize()])[0]);
        }
        assert!((sum - DVec3::from(mean)).length() < 1e-12, "{sum} against {mean:?}");
    }

    #[test]
    fn a_ball_of_opaque_voxels_faces_away_from_its_center_whatever_densities_it_holds() {
        // Random densities from e² to e⁸ with voxels of side 1/16: half of the voxels absorb nearly all light.
        let shape = GridShape { resolution: 32, ..shape(Color::Rgb) };
        let voxels: Vec<[isize; 3]> = (0..32 * 32 * 32).map(|v| [v / 1024, v / 32 % 32, v % 32]).collect();
        let inside = |voxel: &[isize; 3]| shape.center(*voxel).length() < 0.8;
        let density = |(v, voxel)| if inside(voxel) { (2.0 + 6.0 * uniform(3, Purpose::Initial, 0, v)).exp() } else { 0.0 };
        let density = Tensor::from_vec((0..).zip(&voxels).map(density).collect(), &[32 * 32 * 32, 1]);
        let grid = VoxelGrid::<f64>::from_row_major(shape, &density, &Tensor::zeros(&[32 * 32 * 32, 3]));
        let border =
            |voxel: &&[isize; 3]| inside(voxel) && [0, 1, 2].iter().any(|&a| !inside(&[0, 1, 2].map(|b| voxel[b] + isize::from(a == b))));
        // The normals rendered over black, seen by a ray along -x, point to +x.
        let normals = grid.normals();
        let ray = Ray { origin: DVec3::new(2.0, 0.02, -0.03), direction: DVec3::NEG_X, stretch: 1.0 };
        let options = RenderOptions {
            aabb: normals.aabb(),
            spacing: Spacing::Step(0.01),
            jitter: Jitter::None,
            background: [0.0; 3],
            occupancy: Some(&normals.matter()),
            engine: Engine::Fused,
            stop_below: 1e-4,
        };
        let seen = render(&normals, &[ray], &options);
        let normal = DVec3::from([0, 1, 2].map(|c| seen.rgb.data()[c])) / seen.opacity.data()[0];
        assert!(normal.x > 0.95 && normal.length() <= 1.0 + 1e-12, "{normal}");
        let angles: Vec<f64> =
            voxels.iter().filter(border).map(|&voxel| grid.outward(voxel).angle_between(shape.center(voxel)).to_degrees()).collect();
        let mean = angles.iter().sum::<f64>() / angles.len() as f64;
        // Measured mean: 10 degrees. With smoothed differences of densities: 37; with differences across faces only, of alpha: 26, of
        // densities: 54.
        assert!(angles.len() > 500 && mean < 12.0, "{mean} degrees off");
    }

    #[test]
    fn outward_points_out_of_matter_and_alpha_is_what_a_voxel_absorbs() {
        let shape = shape(Color::Rgb);
        let density = Tensor::from_vec((0..64).map(|v| if v / 16 < 2 { 3.0 } else { 0.0 }).collect(), &[64, 1]);
        let grid = VoxelGrid::<f64>::from_row_major(shape, &density, &Tensor::zeros(&[64, 3]));
        let alpha = 1.0 - (-3.0f64 * 0.5).exp();
        // α before the voxel, 0 behind it, two voxels apart.
        assert!(grid.outward([1, 2, 2]).abs_diff_eq(DVec3::X * alpha / 2.0, 1e-15));
        assert!(grid.outward([0, 2, 2]).abs_diff_eq(DVec3::X * -alpha / 2.0, 1e-15), "there is nothing outside of the box");
        assert!((shape.alpha_of_density(3.0) - alpha).abs() < 1e-12 && shape.alpha_of_density(-3.0) == 0.0);
        assert!((shape.density_of_alpha(alpha) - 3.0).abs() < 1e-12);
        for (min_alpha, fraction) in [(0.0, 0.5), (shape.alpha_of_density(3.0), 0.5), (alpha + 1e-9, 0.0)] {
            assert_eq!(grid.voxels_absorbing(min_alpha).fraction(), fraction, "{min_alpha}");
        }
    }
}
