use super::*;
use crate::camera::Ray;
use crate::field::voxel_grid::Color;
use crate::field::voxel_grid::fused::{largest_weights, seen};
use crate::field::voxel_grid::{GridShape, Interpolation};
use crate::render::{Engine, RenderOptions};
use crate::sampling::{Jitter, Spacing};
use autograd::Tensor;

const SHAPE: GridShape = GridShape::new(8, 2.0, Interpolation::Nearest, Color::Sh { degree: 1, offset: 0.5 });

/// Creates a grid from functions of density and coefficients.
fn grid(shape: GridShape, density: impl Fn([usize; 3]) -> f64, color: impl Fn([usize; 3], usize) -> f64) -> VoxelGrid<f64> {
    let n = shape.resolution;
    let voxels: Vec<[usize; 3]> = (0..n * n * n).map(|v| [v / (n * n), v / n % n, v % n]).collect();
    let channels = shape.color.channels();
    let density: Vec<f64> = voxels.iter().map(|&v| density(v)).collect();
    let color: Vec<f64> = voxels.iter().flat_map(|&v| (0..channels).map(|c| color(v, c)).collect::<Vec<_>>()).collect();
    VoxelGrid::from_row_major(shape, &Tensor::from_vec(density, &[n * n * n, 1]), &Tensor::from_vec(color, &[n * n * n, channels]))
}

fn options() -> VoxelOptions<'static> {
    VoxelOptions { coordinates: Coordinates::World, color: ColorFrom::Mean, min_alpha: 0.0, visible: None }
}

/// Returns parallel rays along −z over the whole front, or along +z over the whole back, one through the centre of each column of voxels.
fn rays(sign: f64) -> Vec<Ray> {
    let at = |k: usize| (k as f64 + 0.5) * 0.5 - 2.0;
    let ray = |i: usize| Ray { origin: DVec3::new(at(i / 8), at(i % 8), -4.0 * sign), direction: DVec3::Z * sign, stretch: 1.0 };
    (0..64).map(ray).collect()
}

fn look(grid: &VoxelGrid<f64>) -> RenderOptions<'static> {
    RenderOptions {
        aabb: grid.aabb(),
        spacing: Spacing::Step(0.5),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::Fused,
        stop_below: 0.0,
    }
}

#[test]
fn points_are_the_centers_of_dense_voxels_with_opacity_and_density() {
    // Two voxels, one of them thin, and one with a negative raw density, which counts as 0.
    let grid = grid(
        SHAPE,
        |v| match v {
            [1, 2, 3] => 4.0,
            [1, 2, 4] => 0.1,
            [5, 5, 5] => -3.0,
            _ => 0.0,
        },
        |_, c| if c % 4 == 0 { (c / 4) as f64 } else { 9.0 },
    );
    let cloud = points(&grid, &options());
    // The side is 0.5: (1 + ½) ½ − 2 = −1.25.
    assert_eq!(cloud.positions, [DVec3::new(-1.25, -0.75, -0.25), DVec3::new(-1.25, -0.75, 0.25)]);
    let alpha = |sigma: f64| (1.0 - (-0.5 * sigma).exp()) as f32;
    assert_eq!(cloud.field("opacity"), Some(&[alpha(4.0), alpha(0.1)][..]));
    assert_eq!(cloud.field("density"), Some(&[4.0, 0.1][..]));
    assert_eq!(cloud.field("weight"), None);
    // ½ + Y₀ c for c = 0, 1, 2, whatever the other coefficients: 0.5, 0.782, 1.06.
    assert_eq!(cloud.colors, Some(vec![[128, 199, 255]; 2]));
    // Along +z only the second coefficient has an effect, 0.4886 z: 0.5 + 9 · 0.4886 is above white.
    let toward = points(&grid, &VoxelOptions { color: ColorFrom::Direction(DVec3::Z), ..options() });
    assert_eq!(toward.colors.unwrap()[0], [255, 255, 255]);
    let away = points(&grid, &VoxelOptions { color: ColorFrom::Direction(-DVec3::Z), ..options() });
    assert_eq!(away.colors.unwrap()[0], [0, 0, 0]);

    let thick = VoxelOptions { coordinates: Coordinates::Grid, min_alpha: 0.5, ..options() };
    assert_eq!(points(&grid, &thick).positions, [DVec3::new(1.0, 2.0, 3.0)]);
}

#[test]
fn a_color_along_a_direction_is_what_a_ray_shows_and_not_what_a_voxel_holds_alone() {
    // A thin black voxel in front of an opaque white one: ½ ± Y₀ · 1.7725.
    let density = |v: [usize; 3]| match v {
        [1, 2, 3] => 0.1,
        [1, 2, 4] => 1000.0,
        _ => 0.0,
    };
    let grid = grid(SHAPE, density, |[.., z], c| if c % 4 > 0 { 0.0 } else { (z as f64 - 3.5) * 2.0 * 1.772_453_85 });
    let color = |color| points(&grid, &VoxelOptions { color, ..options() }).colors.unwrap()[0];
    assert_eq!(color(ColorFrom::Mean), [0; 3]);
    // The black voxel transmits e^(-0.1 · 0.5) = 0.951. From the other side the white voxel hides it.
    assert_eq!(color(ColorFrom::Direction(DVec3::Z)), [243; 3]);
    assert_eq!(color(ColorFrom::Direction(-DVec3::Z)), [255; 3]);
}

#[test]
fn normals_point_out_of_matter() {
    let solid = |inside: &dyn Fn(DVec3) -> bool| {
        grid(SHAPE, |v| 50.0 * f64::from(u8::from(inside(DVec3::from_array(v.map(|c| c as f64))))), |_, _| 0.0)
    };
    let normal_at = |cloud: &PointCloud, at: DVec3| {
        let i = cloud.positions.iter().position(|p| *p == at).unwrap();
        DVec3::from_array(cloud.normals.as_ref().unwrap()[i].map(f64::from))
    };
    let coordinates = VoxelOptions { coordinates: Coordinates::Grid, ..options() };
    let half = points(&solid(&|v| v.y <= 3.0), &coordinates);
    assert!(normal_at(&half, DVec3::new(4.0, 3.0, 4.0)).abs_diff_eq(DVec3::Y, 1e-6));
    // Inside nothing changes, and outside of the grid space is empty.
    assert_eq!(normal_at(&half, DVec3::new(4.0, 1.0, 4.0)), DVec3::ZERO);
    assert!(normal_at(&half, DVec3::new(4.0, 0.0, 4.0)).abs_diff_eq(-DVec3::Y, 1e-6));
    let slope = points(&solid(&|v| v.x + v.z <= 7.0), &coordinates);
    assert!(normal_at(&slope, DVec3::new(3.0, 4.0, 4.0)).abs_diff_eq(DVec3::new(1.0, 0.0, 1.0).normalize(), 1e-6));
}

#[test]
fn colors_are_those_that_cameras_see_and_voxels_that_nobody_sees_are_left_out() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        // A slab of two opaque layers, z = 3 and 4. Red depends on the direction: 0.5 + 0.4886 z.
        let slab =
            grid(SHAPE.with(interpolation), |[.., z]| if z == 3 || z == 4 { 1000.0 } else { 0.0 }, |_, c| f64::from(u8::from(c == 2)));
        let front = || [(rays(1.0), vec![1.0; 64])];
        let seen_from_front = seen(&slab, front(), &look(&slab));
        let weight = seen_from_front.weight.clone();
        let largest = largest_weights(&slab, [rays(1.0)], &look(&slab));
        assert!(weight.iter().zip(&largest).all(|(a, b)| a == b || *b < 1.0 / 1024.0), "weights are the same where they count");

        let visible = Visible { seen: &seen_from_front, min_weight: 0.5, min_object: 0.5 };
        let cloud = points(
            &slab,
            &VoxelOptions { coordinates: Coordinates::Grid, color: ColorFrom::Seen(&seen_from_front), visible: Some(visible), ..options() },
        );
        assert!(cloud.len() == 64 && cloud.positions.iter().all(|p| p.z == 3.0), "{interpolation:?}: {} points", cloud.len());
        // 0.5 + 0.488603 = 0.9886, and green is 0.5.
        assert!(cloud.colors.unwrap().iter().all(|c| *c == [252, 128, 128]));
        assert!(cloud.fields.iter().any(|f| f.name == "weight" && f.values.iter().all(|w| *w > 0.99)));

        // From both sides, each layer is visible from one side. Voxels in front of background pixels are not objects, whatever their
        // weight.
        let both = seen(&slab, [(rays(1.0), vec![1.0; 64]), (rays(-1.0), vec![0.0; 64])], &look(&slab));
        let of = |min_object: f64| Some(Visible { seen: &both, min_weight: 0.0, min_object });
        assert_eq!(points(&slab, &VoxelOptions { visible: of(0.5), ..options() }).len(), 64, "{interpolation:?}");
        assert_eq!(points(&slab, &VoxelOptions { visible: of(0.0), ..options() }).len(), 128);
    }
}

#[test]
fn reduced_harmonics_are_seen_as_whole_ones_are() {
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        // Arbitrary means, constant harmonics.
        let whole = grid(
            SHAPE.with(interpolation),
            |[x, y, z]| ((x * 7 + y * 3 + z * 5) % 11) as f64 * 0.3,
            |[x, y, z], c| if c % 4 == 0 { ((x + 2 * y + 3 * z) % 13) as f64 * 0.1 } else { 0.02 * c as f64 - 0.1 },
        );
        let [whole, reduced] =
            [whole.with_reduction(1), whole.with_reduction(4)].map(|grid| seen(&grid, [(rays(1.0), vec![1.0; 64])], &look(&grid)));
        assert!(whole.weight == reduced.weight && whole.color.iter().any(|c| c[0] > 0.1));
        for (a, b) in whole.color.iter().flatten().zip(reduced.color.iter().flatten()) {
            assert!((a - b).abs() < 1e-4, "{a} and {b}");
        }
    }
}

impl GridShape {
    fn with(self, interpolation: Interpolation) -> Self {
        GridShape { interpolation, ..self }
    }
}

#[test]
fn what_is_seen_has_the_same_bits_for_any_number_of_threads() {
    let cloudy = grid(
        SHAPE.with(Interpolation::Trilinear),
        |[x, y, z]| ((x * 7 + y * 3 + z * 5) % 11) as f64 * 0.3,
        |[x, y, z], c| ((x + 2 * y + 3 * z + c) % 13) as f64 * 0.1 - 0.5,
    );
    let slanted = || {
        let rays =
            |k: usize| rays(1.0).into_iter().map(move |ray| Ray { direction: DVec3::new(0.01 * k as f64, 0.1, 1.0).normalize(), ..ray });
        (0..9).map(move |k| (rays(k).collect::<Vec<_>>(), (0..64).map(|i| i as f32 / 63.0).collect::<Vec<_>>())).collect::<Vec<_>>()
    };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| seen(&cloudy, slanted(), &look(&cloudy)))
    };
    let one = with(1);
    assert_eq!(one, with(4));
    assert!(one.weight.iter().any(|w| *w > 0.1) && one.color.iter().any(|c| c[0] > 0.1));
}
