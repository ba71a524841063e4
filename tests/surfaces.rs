//! Exports as another program reads them: .vox files through an independent parser, meshes by what must be true of a surface.

use autograd::{Lattice, Tensor};
use dot_vox::{DotVoxData, SceneNode};
use glam::DVec3;
use plenoxel::export::mesh::{Mesh, MeshOptions, mesh};
use plenoxel::export::mesh_file::MeshFormat;
use plenoxel::export::vox::{Vox, VoxOptions, vox};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::random::{Purpose, uniform};
use std::collections::{BTreeMap, HashMap};

/// A trilinear grid of RGB colors in the cube ±1.5 whose density and color are functions of a voxel's centre.
fn grid(resolution: usize, density: impl Fn(DVec3) -> f64, color: impl Fn(DVec3) -> [f64; 3]) -> VoxelGrid<f64> {
    let shape = GridShape::new(resolution, 1.5, Interpolation::Trilinear, Color::Rgb);
    let n = resolution;
    let centers: Vec<DVec3> = (0..n * n * n).map(|v| shape.center([v / (n * n), v / n % n, v % n].map(|k| k as isize))).collect();
    let densities = centers.iter().map(|&p| density(p)).collect();
    let colors = centers.iter().flat_map(|&p| color(p)).collect();
    VoxelGrid::from_row_major(shape, &Tensor::from_vec(densities, &[n * n * n, 1]), &Tensor::from_vec(colors, &[n * n * n, 3]))
}

/// A sparse grid of opaque voxels, each with its own color.
fn sparse(resolution: usize, voxels: &[([usize; 3], [u8; 3])]) -> VoxelGrid<f64> {
    let shape = GridShape::new(resolution, 1.0, Interpolation::Nearest, Color::Rgb);
    let lattice = Lattice::bricks_where([resolution; 3], |node| voxels.iter().any(|(voxel, _)| *voxel == node));
    let rows = lattice.rows();
    let (mut density, mut color) = (vec![0.0; rows], vec![0.0; 3 * rows]);
    for (voxel, rgb) in voxels {
        let row = lattice.row(*voxel).unwrap() as usize;
        density[row] = 1e4;
        color[3 * row..3 * row + 3].copy_from_slice(&rgb.map(|c| f64::from(c) / 255.0));
    }
    VoxelGrid::with_lattice(shape, lattice, Tensor::from_vec(density, &[rows, 1]), Tensor::from_vec(color, &[rows, 3]))
}

/// What a program that knows the format reads.
fn parse(model: &Vox) -> DotVoxData {
    dot_vox::load_bytes(&model.to_bytes().unwrap()).unwrap()
}

/// The voxels of a scene with their colors.
fn scene(file: &DotVoxData) -> BTreeMap<[i32; 3], [u8; 3]> {
    let mut seen = BTreeMap::new();
    let SceneNode::Transform { child: 1, .. } = &file.scenes[0] else { panic!("{:?}", file.scenes[0]) };
    let SceneNode::Group { children, .. } = &file.scenes[1] else { panic!("{:?}", file.scenes[1]) };
    for &child in children {
        let SceneNode::Transform { frames, child, .. } = &file.scenes[child as usize] else { panic!("a place") };
        let SceneNode::Shape { models, .. } = &file.scenes[*child as usize] else { panic!("a shape") };
        let place = frames[0].position().unwrap();
        let tile = &file.models[models[0].model_id as usize];
        let half = [tile.size.x, tile.size.y, tile.size.z].map(|side| (side / 2) as i32);
        for voxel in &tile.voxels {
            let at =
                [place.x - half[0] + i32::from(voxel.x), place.y - half[1] + i32::from(voxel.y), place.z - half[2] + i32::from(voxel.z)];
            let color = &file.palette[usize::from(voxel.i)];
            assert_eq!(color.a, 255);
            assert_eq!(seen.insert(at, [color.r, color.g, color.b]), None, "{at:?} twice");
        }
    }
    seen
}

/// An L that stands: no rotation but the identity, and no reflection, maps it to itself.
const L: [([usize; 3], [u8; 3]); 6] = [
    ([1, 2, 0], [255, 0, 0]),
    ([1, 2, 1], [0, 255, 0]),
    ([1, 2, 2], [0, 0, 255]),
    ([1, 2, 3], [1, 2, 3]),
    ([2, 2, 0], [250, 251, 252]),
    ([1, 3, 0], [0, 0, 0]),
];

#[test]
fn a_vox_file_has_the_voxels_of_the_grid_where_they_were_and_as_they_were() {
    // The earlier export lost the voxels of its first color, had every other one shifted by one, and laid the model on its side.
    let model = vox(&sparse(6, &L), &VoxOptions::default()).unwrap();
    let file = parse(&model);
    assert_eq!((file.version, file.models.len(), file.palette.len()), (150, 1, 256));
    let voxels = file.models[0].voxels.iter().map(|v| ([v.x, v.y, v.z].map(usize::from), &file.palette[usize::from(v.i)]));
    let mut voxels: Vec<_> = voxels.map(|(place, color)| (place, [color.r, color.g, color.b])).collect();
    voxels.sort_unstable();
    let mut want = L.to_vec();
    want.sort_unstable();
    assert_eq!(voxels, want);
    assert!(file.scenes.is_empty(), "a single model stands where MagicaVoxel puts it");
}

#[test]
fn a_grid_of_300_voxels_a_side_becomes_tiles_that_meet() {
    let colors = |i: usize| [i as u8 * 7, 255 - i as u8, 40];
    let places = [[0, 0, 0], [255, 255, 255], [256, 255, 255], [255, 256, 255], [255, 255, 256], [299, 299, 299], [12, 280, 3]];
    let voxels: Vec<_> = places.into_iter().enumerate().map(|(i, place)| (place, colors(i))).collect();
    let file = parse(&vox(&sparse(300, &voxels), &VoxOptions::default()).unwrap());
    // Of the eight tiles those with two coordinates beyond 256 are empty, and are not there.
    assert_eq!(file.models.len(), 5);
    assert!(file.models.iter().all(|tile| [tile.size.x, tile.size.y, tile.size.z].iter().all(|side| *side == 256 || *side == 44)));
    let want = voxels.into_iter().map(|([x, y, z], color)| ([x as i32 - 150, y as i32 - 150, z as i32], color)).collect();
    assert_eq!(scene(&file), want);
}

#[test]
fn indices_are_1_to_255_and_the_palette_is_of_the_voxels_that_are_written() {
    // 600 colors on a plane, and 216 more inside of a solid cube that nobody sees.
    let noise = |v: usize| (255.0 * uniform(7, Purpose::Initial, 0, v as u64)) as u8;
    let mut voxels: Vec<_> = (0..600).map(|v| ([v % 30, v / 30, 15], [noise(v), noise(v + 600), 0])).collect();
    voxels.extend((0..512).map(|v| {
        let place = [v / 64, v / 8 % 8, v % 8];
        let shell = place.iter().any(|c| *c == 0 || *c == 7);
        (place, if shell { [0; 3] } else { [255; 3] })
    }));
    let grid = sparse(32, &voxels);
    let model = vox(&grid, &VoxOptions::default()).unwrap();
    assert_eq!((model.palette.len(), model.voxels.len()), (255, 600 + 512 - 216));
    assert!(model.voxels.iter().all(|&(_, index)| index > 0));
    let file = parse(&model);
    let colors = |v: &dot_vox::Voxel| file.palette[usize::from(v.i)];
    let seen: BTreeMap<_, _> = file.models[0].voxels.iter().map(|v| ([v.x, v.y, v.z].map(usize::from), colors(v))).collect();
    for (place, color) in &voxels[..600] {
        let shown = [seen[place].r, seen[place].g, seen[place].b];
        let error: i32 = color.iter().zip(shown).map(|(a, b)| (i32::from(*a) - i32::from(b)).pow(2)).sum();
        // 254 cells of a square of 255 x 255 have sides of 16: a corner is 8 √2 from the middle.
        assert!(error < 16 * 16, "{color:?} shown as {shown:?}");
    }
    assert!(seen.values().all(|color| color.b < 100), "the white inside is not in the palette");
    let solid = vox(&grid, &VoxOptions { solid: true, ..VoxOptions::default() }).unwrap();
    assert_eq!(solid.voxels.len(), 600 + 512);
}

/// The sides of all triangles: closed if each has its opposite, once.
fn assert_closed(mesh: &Mesh) {
    let mut sides: HashMap<[u32; 2], u32> = HashMap::new();
    for [a, b, c] in &mesh.triangles {
        for side in [[*a, *b], [*b, *c], [*c, *a]] {
            assert_ne!(side[0], side[1]);
            *sides.entry(side).or_default() += 1;
        }
    }
    assert!(sides.iter().all(|(&[a, b], &count)| count == 1 && sides.get(&[b, a]) == Some(&1)));
    assert_eq!(mesh.triangles.iter().flatten().max().map(|v| *v as usize + 1), Some(mesh.positions.len()), "no vertex without a triangle");
}

fn area(mesh: &Mesh) -> f64 {
    let corner = |v: u32| DVec3::from(mesh.positions[v as usize].map(f64::from));
    mesh.triangles.iter().map(|t| t.map(corner)).map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0).sum()
}

#[test]
fn a_ball_has_a_closed_outward_surface_of_its_volume_area_normals_and_colors() {
    let (center, radius) = (DVec3::new(0.2, -0.1, 0.3), 0.9);
    // Density 50 on the sphere, falling by 100 per unit length: negative outside, as raw densities may be.
    let color = |p: DVec3| (p - center).to_array().map(|c| if c > 0.0 { 1.0 } else { 0.2 });
    let ball = grid(40, |p| 50.0 + 100.0 * (radius - p.distance(center)), color);
    let surface = mesh(&ball, &MeshOptions { level: Some(50.0), ..MeshOptions::default() }).unwrap();
    assert_closed(&surface);
    // V − E + F = 2 with E = 3 F / 2.
    assert_eq!(surface.positions.len() as i64 - surface.triangles.len() as i64 / 2, 2);
    let (volume, sphere) = (surface.volume(), 4.0 / 3.0 * std::f64::consts::PI * radius.powi(3));
    assert!(volume > 0.0 && (volume / sphere - 1.0).abs() < 0.01, "volume {volume} of {sphere}");
    let sphere = 4.0 * std::f64::consts::PI * radius.powi(2);
    assert!((area(&surface) / sphere - 1.0).abs() < 0.02, "area {} of {sphere}", area(&surface));
    for ((position, normal), rgb) in surface.positions.iter().zip(&surface.normals).zip(&surface.colors) {
        let out = DVec3::from(position.map(f64::from)) - center;
        // A chord of one voxel, 0.075, sags by 0.075² / (8 · 0.9) = 0.0008.
        assert!((out.length() - radius).abs() < 0.0008, "vertex at {}", out.length());
        assert!(out.normalize().dot(DVec3::from(normal.map(f64::from))) > 0.999);
        for (c, axis) in rgb.iter().zip(out.to_array()).filter(|(_, axis)| axis.abs() > 0.15) {
            // Two voxels from where colors change, for a ray goes a voxel deep.
            assert!(c.abs_diff(if axis > 0.0 { 255 } else { 51 }) <= 1);
        }
    }
}

#[test]
fn vertices_lie_where_the_density_has_the_level_in_world_coordinates() {
    // Density 10 + 20 x: 16 at x = 0.3. What is denser reaches the face of the box at 1.5.
    let half_space = grid(10, |p| 10.0 + 20.0 * p.x, |_| [0.5; 3]);
    let surface = mesh(&half_space, &MeshOptions { level: Some(16.0), ..MeshOptions::default() }).unwrap();
    assert_closed(&surface);
    // Of 1.2 · 3 · 3, the four edges along x and the eight across are beveled by half a voxel: 28.8 · 0.15² / 2, less where they meet.
    assert!((10.8 - 0.324 - 0.01..10.8 - 0.25).contains(&surface.volume()), "{}", surface.volume());
    for ([x, y, z], normal) in surface.positions.iter().zip(&surface.normals) {
        let on_a_side = [y, z].iter().any(|c| (c.abs() - 1.5).abs() < 1e-6);
        assert!((x - 0.3).abs() < 1e-6 || (x - 1.5).abs() < 1e-6 || on_a_side, "({x}, {y}, {z})");
        assert!(y.abs() <= 1.5 && z.abs() <= 1.5 && *x <= 1.5);
        if (x - 0.3).abs() < 1e-6 && y.abs() < 1.0 && z.abs() < 1.0 {
            assert_eq!(*normal, [-1.0, 0.0, 0.0]);
        }
    }
}

#[test]
fn a_surface_through_noise_is_closed_and_the_same_for_any_number_of_threads() {
    let shape = |interpolation| GridShape::new(14, 1.0, interpolation, Color::Sh { degree: 1, offset: 0.5 });
    for interpolation in [Interpolation::Nearest, Interpolation::Trilinear] {
        let noise = VoxelGrid::<f32>::random(shape(interpolation), 1.0, 1.0, 11);
        let options = MeshOptions { level: Some(0.6), ..MeshOptions::default() };
        let surface = mesh(&noise, &options).unwrap();
        assert_closed(&surface);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        assert_eq!(surface, pool.install(|| mesh(&noise, &options).unwrap()));
        // A sparse grid of the same matter has the same surface, with the density of what is missing being 0.
        let dense = noise.voxels_where(|row| noise.density.tensor().data()[row] > 0.6);
        assert_closed(&mesh(&noise.pruned(&dense), &options).unwrap());
    }
}

#[test]
fn harmonics_are_seen_against_the_normal_or_along_one_direction() {
    // Red grows along the direction of sight, from the coefficient of −x: c = 0.5 + 0.4886 · 0.5 · x.
    let shape = GridShape::new(8, 1.0, Interpolation::Nearest, Color::Sh { degree: 1, offset: 0.5 });
    let n = shape.voxels();
    let inside = |v: usize| [v / 64, v / 8 % 8, v % 8].iter().all(|k| (2..6).contains(k));
    let density = Tensor::from_vec((0..n).map(|v| if inside(v) { 100.0 } else { 0.0 }).collect(), &[n, 1]);
    let color = Tensor::from_vec((0..n).flat_map(|_| [0.0, 0.0, 0.0, -0.5].into_iter().chain([0.0; 8])).collect(), &[n, 12]);
    let grid = VoxelGrid::<f64>::from_row_major(shape, &density, &color);
    let byte = |x: f64| ((0.5 + 0.488_602_5 * 0.5 * x) * 255.0).round() as u8;
    let facing = mesh(&grid, &MeshOptions::default()).unwrap();
    for (normal, rgb) in facing.normals.iter().zip(&facing.colors) {
        assert!(rgb[0].abs_diff(byte(-f64::from(normal[0]))) <= 1 && rgb[1] == 128);
    }
    let along = mesh(&grid, &MeshOptions { direction: Some(DVec3::X), ..MeshOptions::default() }).unwrap();
    assert!(along.colors.iter().all(|rgb| rgb[0] == byte(1.0)));
    let voxels = vox(&grid, &VoxOptions::default()).unwrap();
    let red = |place: [u16; 3]| {
        let (_, index) = voxels.voxels.iter().find(|(voxel, _)| *voxel == place).unwrap();
        voxels.palette[usize::from(*index) - 1][0]
    };
    assert_eq!((red([2, 3, 4]), red([5, 3, 4]), red([3, 3, 5])), (byte(1.0), byte(-1.0), byte(0.0)));
}

#[test]
fn small_parts_are_left_out_and_the_others_are_as_they_were() {
    let ball = |p: DVec3| 50.0 + 100.0 * (0.6 - p.length());
    // Two voxels by themselves, with eight triangles each, and a ball.
    let specks = [DVec3::new(1.21875, 1.21875, 0.28125), DVec3::new(-1.21875, 0.28125, 1.21875)];
    let color = |p: DVec3| p.to_array().map(|c| 0.5 + c / 4.0);
    let with_specks = grid(16, |p| if specks.iter().any(|speck| p.distance(*speck) < 1e-6) { 60.0 } else { ball(p) }, color);
    let options = |min_part| MeshOptions { level: Some(50.0), min_part, ..MeshOptions::default() };
    let [all, least, large] = [0, 8, 9].map(|min_part| mesh(&with_specks, &options(min_part)).unwrap());
    assert_eq!(all, least);
    assert_eq!((all.parts_left_out, large.parts_left_out), (0, 2));
    assert_eq!(all.triangles.len(), large.triangles.len() + 2 * 8);
    assert_closed(&large);
    assert_eq!(large, Mesh { parts_left_out: 2, ..mesh(&grid(16, ball, color), &options(0)).unwrap() });
    // What is done by itself, and a bound that no part reaches: the largest part stays.
    assert_eq!(large, mesh(&with_specks, &MeshOptions { level: Some(50.0), ..MeshOptions::default() }).unwrap());
    assert_eq!(large, mesh(&with_specks, &options(1 << 20)).unwrap());
}

/// A ball of radius 0.9 as carving leaves it: voxels are opaque or not there.
fn opaque_ball(center: DVec3) -> VoxelGrid<f64> {
    let solid = grid(48, |p| if p.distance(center) < 0.9 { 1e4 } else { 0.0 }, |_| [0.5; 3]);
    let shape = GridShape { interpolation: Interpolation::Nearest, ..*solid.shape() };
    VoxelGrid::with_lattice(shape, solid.lattice().clone(), solid.density.tensor().clone(), solid.color.tensor().clone())
}

/// How far a surface is from a sphere of radius 0.9: the mean of its vertices' distances, their standard deviation, and the mean angles in degrees of the
/// triangles' and of the vertices' normals.
fn off_the_sphere(surface: &Mesh, center: DVec3) -> [f64; 4] {
    let places: Vec<DVec3> = surface.positions.iter().map(|p| DVec3::from(p.map(f64::from)) - center).collect();
    let count = places.len() as f64;
    let mean = places.iter().map(|p| p.length() - 0.9).sum::<f64>() / count;
    let variance = places.iter().map(|p| (p.length() - 0.9 - mean).powi(2)).sum::<f64>() / count;
    let faces = surface.triangles.iter().map(|triangle| {
        let [a, b, c] = triangle.map(|v| places[v as usize]);
        (b - a).cross(c - a).angle_between(a + b + c)
    });
    let faces = faces.sum::<f64>() / surface.triangles.len() as f64;
    let normals = places.iter().zip(&surface.normals).map(|(p, n)| p.angle_between(DVec3::from(n.map(f64::from)))).sum::<f64>() / count;
    [mean, variance.sqrt(), faces.to_degrees(), normals.to_degrees()]
}

#[test]
fn voxels_of_a_nearest_grid_end_at_their_faces_and_smoothing_takes_their_steps_away() {
    let center = DVec3::new(0.013, -0.021, 0.017);
    let ball = opaque_ball(center);
    let [steps, smooth] = [0, 10].map(|smooth| mesh(&ball, &MeshOptions { smooth, ..MeshOptions::default() }).unwrap());
    assert_closed(&smooth);
    assert_eq!(steps.triangles, smooth.triangles);
    let side = ball.shape().voxel_side();
    let [mean, spread, faces, normals] = off_the_sphere(&steps, center);
    assert!(mean.abs() < 0.01 * side && faces > 20.0 && normals > 6.0, "{mean} {spread} {faces}° {normals}°");
    let [mean, smooth_spread, smooth_faces, smooth_normals] = off_the_sphere(&smooth, center);
    assert!(mean.abs() < 0.02 * side, "{mean}");
    assert!(
        smooth_spread < 0.6 * spread && smooth_faces < 0.4 * faces && smooth_normals < 0.7 * normals,
        "{smooth_spread} {smooth_faces}°"
    );
    let moved = |surface: &Mesh| {
        let ways = surface.positions.iter().zip(&steps.positions).flat_map(|(a, b)| [0, 1, 2].map(|axis| (a[axis] - b[axis]).abs()));
        f64::from(ways.fold(0.0, f32::max))
    };
    assert!(moved(&smooth) <= side / 2.0 + 1e-6);
    let much = mesh(&ball, &MeshOptions { smooth: 300, ..MeshOptions::default() }).unwrap();
    assert!(moved(&much) <= side / 2.0 + 1e-6);
}

#[test]
fn a_decimated_surface_is_closed_and_near_what_it_was() {
    let center = DVec3::new(0.013, -0.021, 0.017);
    let ball = grid(48, |p| 50.0 + 100.0 * (0.9 - p.distance(center)), |p| p.to_array().map(|c| 0.5 + c / 4.0));
    let options = MeshOptions { level: Some(50.0), ..MeshOptions::default() };
    let whole = mesh(&ball, &options).unwrap();
    let decimated = |most| mesh(&ball, &MeshOptions { max_triangles: Some(most), ..options }).unwrap();
    assert_eq!(decimated(whole.triangles.len()), whole);
    let tenth = decimated(whole.triangles.len() / 10);
    assert!(tenth.triangles.len() <= whole.triangles.len() / 10 && tenth.triangles.len() + 2 > whole.triangles.len() / 10);
    assert_closed(&tenth);
    let side = ball.shape().voxel_side();
    let [mean, spread, faces, normals] = off_the_sphere(&tenth, center);
    assert!(mean.abs() < 0.06 * side && spread < 0.03 * side && faces < 3.0 && normals < 3.0, "{mean} {spread} {faces}° {normals}°");
    // Colors are those of where a vertex is now.
    for (position, rgb) in tenth.positions.iter().zip(&tenth.colors) {
        assert!(
            position.iter().zip(rgb).all(|(p, c)| (f64::from(*c) / 255.0 - 0.5 - f64::from(*p) / 4.0).abs() < 0.03),
            "{position:?} {rgb:?}"
        );
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    assert_eq!(tenth, pool.install(|| decimated(whole.triangles.len() / 10)));
    // A closed surface has four triangles at least.
    assert_eq!(decimated(4).triangles.len(), 4);
}

#[test]
fn a_decimated_surface_through_noise_is_closed_and_never_empty() {
    let shape = GridShape::new(14, 1.0, Interpolation::Trilinear, Color::Sh { degree: 1, offset: 0.5 });
    let noise = VoxelGrid::<f32>::random(shape, 1.0, 1.0, 11);
    let options = MeshOptions { level: Some(0.6), min_part: 0, ..MeshOptions::default() };
    let whole = mesh(&noise, &options).unwrap().triangles.len();
    for most in [whole / 2, whole / 4, whole / 20, 4] {
        match mesh(&noise, &MeshOptions { max_triangles: Some(most), ..options }) {
            Ok(surface) => assert_closed(&surface),
            Err(error) => assert!(error.exit_code() == 2 && error.to_string().contains("--min-part"), "{error}"),
        }
    }
}

#[test]
fn selections_that_hold_nothing_are_refused_with_what_would_do() {
    let thin = grid(4, |_| 0.1, |_| [0.0; 3]);
    for (level, part) in [(None, "below 0.1"), (Some(-1.0), "above 0"), (Some(f64::NAN), "above 0"), (Some(0.2), "below 0.1")] {
        let error = mesh(&thin, &MeshOptions { level, ..MeshOptions::default() }).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains(part), "{error}");
    }
    for (min_alpha, part) in [(0.5, "smaller"), (1.0, "in [0, 1)"), (-0.1, "in [0, 1)"), (f64::NAN, "in [0, 1)")] {
        let error = vox(&thin, &VoxOptions { min_alpha, ..VoxOptions::default() }).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains(part), "{error}");
    }
    let empty = grid(4, |_| -1.0, |_| [0.0; 3]);
    assert!(mesh(&empty, &MeshOptions::default()).unwrap_err().to_string().contains("empty"));
}

#[test]
fn mesh_files_hold_the_mesh() {
    let ball = grid(8, |p| 10.0 - 10.0 * p.length(), |_| [1.0, 0.5, 0.0]);
    let surface = mesh(&ball, &MeshOptions { level: Some(4.0), ..MeshOptions::default() }).unwrap();
    let (vertices, triangles) = (surface.positions.len(), surface.triangles.len());

    let ply = MeshFormat::Ply.encode(&surface, "test").unwrap();
    let end = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(ply[..end].to_vec()).unwrap();
    assert!(
        header.contains(&format!("element vertex {vertices}\n")) && header.contains(&format!("element face {triangles}\n")),
        "{header}"
    );
    assert_eq!(ply.len(), end + vertices * (6 * 4 + 3) + triangles * (1 + 3 * 4));
    assert_eq!(&ply[end + 24..end + 27], &[255, 128, 0]);
    assert_eq!(ply[end..end + 4], surface.positions[0][0].to_le_bytes());

    let obj = String::from_utf8(MeshFormat::Obj.encode(&surface, "test").unwrap()).unwrap();
    let count = |start: &str| obj.lines().filter(|line| line.starts_with(start)).count();
    assert_eq!((count("v "), count("vn "), count("f ")), (vertices, vertices, triangles));
    let first: Vec<f32> = obj.lines().nth(1).unwrap()[2..].split(' ').map(|x| x.parse().unwrap()).collect();
    assert_eq!((&first[..3], &first[3..]), (surface.positions[0].as_slice(), [1.0, 0.502, 0.0].as_slice()));
    let [a, b, c] = surface.triangles[0].map(|v| v + 1);
    assert!(obj.contains(&format!("\nf {a}//{a} {b}//{b} {c}//{c}\n")), "indices from 1");

    let glb = MeshFormat::Glb.encode(&surface, "test").unwrap();
    let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&glb[..4], word(4), word(8), &glb[16..20]), (b"glTF".as_slice(), 2, glb.len(), b"JSON".as_slice()));
    let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + word(12)]).unwrap();
    let binary = 20 + word(12) + 8;
    assert_eq!(json["buffers"][0]["byteLength"], glb.len() - binary);
    assert_eq!(json["accessors"][3]["count"], 3 * triangles);
    // sRGB 128 is 0.2159 of linear light.
    let colors = binary + json["bufferViews"][2]["byteOffset"].as_u64().unwrap() as usize;
    let short = |i: usize| u16::from_le_bytes(glb[colors + 2 * i..colors + 2 * i + 2].try_into().unwrap());
    assert_eq!((short(0), short(2), short(3)), (65535, 0, 65535));
    assert!((f64::from(short(1)) / 65535.0 - 0.2159).abs() < 1e-4);

    let stl = MeshFormat::Stl.encode(&surface, "test").unwrap();
    assert_eq!(stl.len(), 84 + 50 * triangles);
    assert!(stl.starts_with(b"binary STL, test ") && !MeshFormat::Stl.has_colors() && MeshFormat::Glb.has_colors());
    assert_eq!(stl[80..84], (triangles as u32).to_le_bytes());
    for (facet, triangle) in stl[84..].chunks_exact(50).zip(&surface.triangles) {
        let vector = |at: usize| [0, 4, 8].map(|k| f32::from_le_bytes(facet[at + k..at + k + 4].try_into().unwrap()));
        assert_eq!([12, 24, 36].map(vector), triangle.map(|v| surface.positions[v as usize]));
        let [normal, a] = [vector(0), vector(12)].map(|v| DVec3::from(v.map(f64::from)));
        assert!((normal.length() - 1.0).abs() < 1e-6 && normal.dot(a) > 0.0 && facet[48..] == [0, 0]);
    }

    // The node's rotation takes the dataset's z to glTF's y.
    let q: Vec<f64> = json["nodes"][0]["rotation"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    let turned = glam::DQuat::from_array(q.try_into().unwrap()) * DVec3::Z;
    assert!((turned - DVec3::Y).length() < 1e-12);
}
