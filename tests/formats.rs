//! Grids in the files of svox2 and PlenOctrees: written, read again, and read from files that NumPy wrote (`tests/support/formats.py`).

use crate::command;
use approx::assert_relative_eq;
use command::{Folder, plenoxel, train};
use glam::DVec3;
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::error::Error;
use plenoxel::field::sh::Y0;
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::formats::npz::NpzWriter;
use plenoxel::formats::plenoctree::{self, OctreeOptions};
use plenoxel::formats::{self, Imported, svox2};
use plenoxel::metrics::psnr;
use plenoxel::model::plenoxels::config::Sampling;
use plenoxel::model::plenoxels::grid_viewer;
use plenoxel::render::Engine;
use serde_json::Value;
use std::fs;
use std::io::Cursor;
use std::path::Path;

const NAME: &str = "grid.npz";

fn read(bytes: &[u8], scale: f64) -> Result<Imported, Error> {
    formats::read(Path::new(NAME), Cursor::new(bytes), scale)
}

fn shape(resolution: usize, interpolation: Interpolation, color: Color) -> GridShape {
    GridShape::new(resolution, 1.5, interpolation, color)
}

fn harmonics(degree: usize, offset: f64) -> Color {
    Color::Sh { degree, offset }
}

/// A ball of random voxels.
fn ball(shape: GridShape, color: f64) -> VoxelGrid<f32> {
    let grid = VoxelGrid::random(shape, 6.0, color, 3);
    let inside = grid.voxels_where(|row| {
        let node = grid.lattice().node(row as u32).map(|node| shape.center(node.map(|k| k as isize)));
        node.is_some_and(|center| center.length() < 1.1)
    });
    grid.pruned(&inside)
}

/// PSNR of the pictures of two grids, in dB, with steps of the same world length.
fn between(a: &VoxelGrid<f32>, b: &VoxelGrid<f32>, step: f64) -> f64 {
    let camera = Camera::look_at(DVec3::new(2.5, -3.0, 1.5), DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(40, 40, 0.7));
    let [a, b] = [a, b].map(|grid| {
        let sampling = Sampling::Step { step: step / grid.shape().voxel_side() };
        grid_viewer(grid, sampling, Engine::Fused, [1.0, 0.9, 0.8]).see(&camera).rgb.mapv(|c| c.clamp(0.0, 1.0))
    });
    psnr(a.view(), b.view())
}

#[test]
fn a_checkpoint_of_svox2_shows_the_same_picture() {
    use Interpolation::Trilinear;
    let whole = |color| VoxelGrid::random(shape(9, Trilinear, color), 2.0, 0.3, 5);
    let reduced = |reduction| ball(GridShape { sh_reduction: reduction, ..shape(12, Trilinear, harmonics(2, 0.5)) }, 0.4);
    for (what, grid, least) in [
        ("whole", whole(harmonics(2, 0.5)), 60.0),
        ("a ball", ball(shape(12, Trilinear, harmonics(2, 0.5)), 0.4), 60.0),
        ("another offset", ball(shape(12, Trilinear, harmonics(1, 0.0)), 0.9), 60.0),
        ("degree 0", ball(shape(12, Trilinear, harmonics(0, 0.25)), 0.9), 60.0),
        ("RGB", ball(shape(12, Trilinear, Color::Rgb), 1.0), 60.0),
        ("an odd reduction", reduced(3), 60.0),
        ("an even reduction", reduced(2), 40.0),
    ] {
        for scale in [1.0, svox2::BLENDER_SCALE] {
            let bytes = svox2::encode(Path::new(NAME), &grid, scale).unwrap().0;
            let again = read(&bytes, scale).unwrap();
            assert!(again.warnings.is_empty(), "{what}: {:?}", again.warnings);
            assert_relative_eq!(again.grid.shape().half_width, 1.5, max_relative = 1e-6);
            let psnr = between(&grid, &again.grid, 0.02);
            assert!(psnr > least, "{what} at scale {scale}: {psnr} dB");
            // The bytes do not change any more.
            let twice = svox2::encode(Path::new(NAME), &again.grid, scale).unwrap().0;
            let third = read(&twice, scale).unwrap().grid;
            assert_eq!(third.color.tensor().data(), again.grid.color.tensor().data(), "{what}");
        }
    }
    // Without the scale the grid is in the world of svox2's cameras: smaller, and denser.
    let grid = whole(harmonics(0, 0.5));
    let there = read(&svox2::encode(Path::new(NAME), &grid, 0.5).unwrap().0, 1.0).unwrap().grid;
    assert_eq!(there.shape().half_width, 0.75);
    assert_eq!(there.density_at([1, 2, 3]), 2.0 * grid.density_at([1, 2, 3]));
}

#[test]
fn a_checkpoint_that_numpy_wrote_has_the_numbers_of_svox2() {
    let grid = read(include_bytes!("support/ckpt.npz"), svox2::BLENDER_SCALE).unwrap().grid;
    let shape = GridShape { half_width: 1.5, ..shape(4, Interpolation::Trilinear, harmonics(1, 0.5)) };
    assert_eq!((grid.shape().resolution, grid.shape().color, grid.shape().interpolation), (4, shape.color, shape.interpolation));
    assert_relative_eq!(grid.shape().half_width, 1.5, max_relative = 1e-6);
    for voxel in (0..64).map(|v| [v / 16, v / 4 % 4, v % 4]) {
        let [x, y, z] = voxel.map(|k| k as f32);
        let Some(row) = grid.lattice().row(voxel) else {
            assert!((voxel[0] + voxel[1] + voxel[2]) % 3 == 0, "{voxel:?}");
            continue;
        };
        // A density per unit of svox2 is 2/3 of one per world unit.
        let density = ((100.0 * x + 10.0 * y + z) / 64.0 - 1.0) * 2.0 / 3.0;
        assert_relative_eq!(grid.density.tensor().data()[row as usize], density, max_relative = 1e-6);
        let numbers = [x, y, z, x - y, y - z, z - x, x + y, y + z, z + x, x * y, y * z, z * x].map(|number| number / 16.0);
        assert_eq!(grid.color.tensor().data()[12 * row as usize..][..12], numbers, "{voxel:?}");
    }
}

/// A checkpoint of 2³ voxels with rows of three numbers.
struct Checkpoint {
    radius: [f32; 3],
    center: [f32; 3],
    links: ([usize; 3], Vec<i32>),
    density: Vec<f32>,
    harmonics: (usize, f32),
    basis: Option<i64>,
    more: Option<&'static str>,
}

impl Default for Checkpoint {
    fn default() -> Self {
        Checkpoint {
            radius: [1.0; 3],
            center: [0.0; 3],
            links: ([2; 3], vec![0, 1, -1, -1, -2, 1, -1, 0]),
            density: vec![1.0, 2.0],
            harmonics: (3, 0.5),
            basis: Some(1),
            more: None,
        }
    }
}

impl Checkpoint {
    fn write(self) -> Vec<u8> {
        let mut file = NpzWriter::new(false);
        let (rows, (width, value)) = (self.density.len(), self.harmonics);
        file.floats("radius", &[3], &self.radius).unwrap();
        file.floats("center", &[3], &self.center).unwrap();
        file.integers("links", &self.links.0, &self.links.1).unwrap();
        file.floats("density_data", &[rows, 1], &self.density).unwrap();
        file.floats("sh_data", &[rows, width], &vec![value; rows * width]).unwrap();
        if let Some(basis) = self.basis {
            file.integer("basis_type", basis).unwrap();
        }
        if let Some(name) = self.more {
            file.floats(name, &[1], &[0.0]).unwrap();
        }
        file.finish().unwrap()
    }
}

#[test]
fn what_a_grid_cannot_express_is_refused_or_said() {
    let whole = Checkpoint::default;
    assert!(read(&whole().write(), 1.0).unwrap().warnings.is_empty());
    assert!(read(&Checkpoint { basis: None, ..whole() }.write(), 1.0).is_ok(), "old files have no basis_type");
    let spheres = read(&Checkpoint { more: Some("background_data"), ..whole() }.write(), 1.0).unwrap();
    assert!(spheres.warnings[0].contains("the background spheres of the file are left out"));
    for (file, words) in [
        (Checkpoint { links: ([1, 2, 4], whole().links.1), ..whole() }, "1 x 2 x 4 voxels"),
        (Checkpoint { radius: [1.0, 1.0, 0.5], ..whole() }, "the box has the radii 1, 1, 0.5"),
        (Checkpoint { center: [0.0, 0.1, 0.0], ..whole() }, "center at 0, 0.1, 0"),
        (Checkpoint { center: [f32::NAN; 3], ..whole() }, "center at NaN"),
        (Checkpoint { radius: [f32::NAN; 3], ..whole() }, "the radii NaN"),
        (Checkpoint { radius: [0.0; 3], ..whole() }, "half the side of the grid is 0"),
        (Checkpoint { basis: Some(4), ..whole() }, "learned (a 3D texture)"),
        (Checkpoint { basis: Some(255), ..whole() }, "learned (a network)"),
        (Checkpoint { basis: None, more: Some("basis_data"), ..whole() }, "learned (a texture)"),
        (Checkpoint { harmonics: (6, 0.5), ..whole() }, "rows of harmonics have 6 numbers"),
        (Checkpoint { harmonics: (3, f32::INFINITY), ..whole() }, "not finite"),
        (Checkpoint { links: ([2; 3], vec![2; 8]), ..whole() }, "a voxel has row 2 of 2"),
        (Checkpoint { links: ([2; 3], vec![-1; 8]), ..whole() }, "all voxels of the grid are empty"),
        (Checkpoint { density: vec![f32::NAN; 2], ..whole() }, "not finite"),
    ] {
        let error = read(&file.write(), 1.0).unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains(words), "{error}, without {words}");
        assert!(error.to_string().starts_with(NAME), "{error}");
    }
    assert_eq!(read(&whole().write(), 0.0).unwrap_err().exit_code(), 2);
    // What svox2 cannot render is not written.
    let refused =
        |interpolation, color| svox2::encode(Path::new(NAME), &ball(shape(4, interpolation, color), 1.0), 1.0).unwrap_err().to_string();
    assert!(refused(Interpolation::Nearest, Color::Rgb).contains("constant voxels"));
    assert!(refused(Interpolation::Trilinear, harmonics(3, 0.5)).contains("harmonics of degree 3"));
}

#[test]
fn old_checkpoints_have_density_and_color_in_one_table() {
    let mut file = NpzWriter::new(true);
    file.integers("links", &[2; 3], &[0, 1, -1, -1, -1, -1, -1, -1]).unwrap();
    file.halves("data", &[2, 4], &[1.5, 0.25, 0.5, 0.75, -2.0, 0.0, 1.0, -1.0]).unwrap();
    let grid = read(&file.finish().unwrap(), 1.0).unwrap().grid;
    // Without a radius it is 1.
    assert_eq!((grid.shape().half_width, grid.density_at([0, 0, 0]), grid.density_at([0, 0, 1])), (1.0, 1.5, -2.0));
    let row = grid.lattice().row([0, 0, 1]).unwrap() as usize;
    assert_eq!(grid.color.tensor().data()[3 * row..][..3], [0.0, 1.0, -1.0]);
}

#[test]
fn an_octree_has_the_constant_voxels_of_a_grid() {
    use Interpolation::Nearest;
    for (what, grid, least) in [
        ("RGB", ball(shape(8, Nearest, Color::Rgb), 1.0), 55.0),
        ("an odd number of voxels", ball(shape(7, Nearest, Color::Rgb), 1.0), 55.0),
        ("degree 0", ball(shape(12, Nearest, harmonics(0, 0.0)), 3.0), 55.0),
        ("colors that depend on the direction", ball(shape(12, Nearest, harmonics(2, 0.3)), 0.2), 45.0),
    ] {
        let (bytes, leaves) = plenoctree::encode(Path::new(NAME), &grid, &OctreeOptions::default(), &|_, _| ()).unwrap();
        assert_eq!(leaves, grid.lattice().present(), "{what}");
        let again = read(&bytes, 1.0).unwrap();
        assert_eq!(again.warnings.len(), usize::from(grid.shape().color.channels() > 3), "{what}: {:?}", again.warnings);
        assert_relative_eq!(again.grid.shape().voxel_side(), grid.shape().voxel_side(), max_relative = 1e-5);
        assert_eq!(again.grid.lattice().present(), leaves, "{what}");
        // The grid that was read is smaller, and samples of its rays are at other places in a voxel.
        let psnr = between(&grid, &again.grid, 0.002);
        assert!(psnr > least, "{what}: {psnr} dB");
    }
    let grid = ball(shape(8, Nearest, Color::Rgb), 1.0);
    let encode = |subdivide| plenoctree::encode(Path::new(NAME), &grid, &OctreeOptions { subdivide, scene_scale: 1.0 }, &|_, _| ());
    assert_eq!([encode(2), encode(3)].map(|refused| refused.unwrap_err().exit_code()), [2, 2]);
}

#[test]
fn more_leaves_show_an_interpolated_grid_better() {
    // Smooth: a random grid at eight times its resolution.
    let grid = ball(shape(6, Interpolation::Trilinear, harmonics(0, 0.5)), 0.5).resample(24);
    let psnr = |subdivide| {
        let options = OctreeOptions { subdivide, scene_scale: 1.0 };
        let (bytes, _) = plenoctree::encode(Path::new(NAME), &grid, &options, &|_, _| ()).unwrap();
        between(&grid, &read(&bytes, 1.0).unwrap().grid, 0.02)
    };
    let [one, four] = [psnr(1), psnr(4)];
    assert!(one > 25.0 && four > one + 6.0, "{one} and {four} dB");
}

#[test]
fn an_octree_that_numpy_wrote_has_the_leaves_of_svox() {
    let grid = read(include_bytes!("support/tree.npz"), 1.0).unwrap().grid;
    // The root has the side 4, the finest leaves the side 1.
    assert_eq!((grid.shape().resolution, grid.shape().half_width, grid.shape().interpolation), (4, 2.0, Interpolation::Nearest));
    assert_eq!(grid.lattice().present(), 8 + 1);
    let at = |voxel: [usize; 3]| {
        let row = grid.lattice().row(voxel).expect("a leaf") as usize;
        let colors: [f32; 3] = std::array::from_fn(|c| 0.5 + Y0 as f32 * grid.color.tensor().data()[3 * row + c]);
        (grid.density.tensor().data()[row], colors)
    };
    let sigmoid = |x: f32| 1.0 / (1.0 + (-Y0 as f32 * x).exp());
    for (voxel, density, numbers) in
        [([0, 2, 2], 3.0, [1.0, -2.0, 0.5]), ([1, 3, 3], 3.0, [1.0, -2.0, 0.5]), ([2, 0, 3], 0.25, [-1.0, 0.0, 4.0])]
    {
        let (found, colors) = at(voxel);
        assert_eq!(found, density);
        (0..3).for_each(|c| assert_relative_eq!(colors[c], sigmoid(numbers[c]), max_relative = 1e-5));
    }
    // Twice as large with half the scale, and half as dense.
    let larger = read(include_bytes!("support/tree.npz"), 0.5).unwrap().grid;
    assert_eq!((larger.shape().half_width, larger.density_at([0, 2, 2])), (4.0, 1.5));
}

#[test]
fn an_octree_that_is_none_is_refused() {
    let tree = |child: &[i32], format: &str, width: usize, density: f32| {
        let nodes = child.len() / 8;
        let mut data = vec![0.25; nodes * 8 * width];
        data.chunks_exact_mut(width).for_each(|row| row[width - 1] = density);
        let mut file = NpzWriter::new(true);
        file.integers("child", &[nodes, 2, 2, 2], child).unwrap();
        file.halves("data", &[nodes, 2, 2, 2, width], &data).unwrap();
        file.floats("invradius", &[], &[0.5]).unwrap();
        file.floats("offset", &[3], &[0.5; 3]).unwrap();
        file.text("data_format", format).unwrap();
        read(&file.finish().unwrap(), 1.0)
    };
    let root = [0; 8];
    assert_eq!(tree(&root, "RGBA", 4, 1.0).unwrap().grid.lattice().present(), 8);
    assert_eq!(tree(&root, "SH4", 13, 1.0).unwrap().warnings.len(), 1);
    let with = |at: usize, child: i32| std::array::from_fn::<i32, 16, _>(|k| if k == at || k == 1 { child } else { 0 });
    for (read, words) in [
        (tree(&root, "SH4", 4, 1.0), "format `SH4` with 4 numbers"),
        (tree(&root, "SG25", 76, 1.0), "format `SG25`"),
        (tree(&root, "SH25", 76, 1.0), "format `SH25`"),
        (tree(&root, "SH1", 4, -1.0), "no leaf of the octree has a density"),
        (tree(&root, "SH1", 4, f32::NAN), "no leaf of the octree has a density"),
        (tree(&with(1, 7), "SH1", 4, 1.0), "a child beyond the 2 nodes"),
        (tree(&with(1, -1), "SH1", 4, 1.0), "a child beyond the 2 nodes"),
        (tree(&with(2, 1), "SH1", 4, 1.0), "two parents"),
    ] {
        let error = read.unwrap_err().to_string();
        assert!(error.starts_with(NAME) && error.contains(words), "{error}, without {words}");
    }
}

#[test]
fn a_file_that_is_cut_short_or_lies_is_refused() {
    let whole = Checkpoint::default().write();
    for length in (0..whole.len()).step_by(7) {
        let error = read(&whole[..length], 1.0).unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains("not a complete .npz file"), "{length}: {error}");
    }
    // A header that announces more numbers than there are, without memory for them.
    let lie = |shape: &[usize], kind: &str| {
        let mut file = NpzWriter::new(true);
        file.add("links", kind, shape, [vec![0; 32]]).unwrap();
        read(&file.finish().unwrap(), 1.0).unwrap_err().to_string()
    };
    assert!(lie(&[1024; 3], "<i4").contains("array `links`: the shape (1024, 1024, 1024) does not fit into its"));
    assert!(lie(&[usize::MAX; 3], "<i4").contains("does not fit"));
    assert!(lie(&[1, 2, 2], "<i4").contains("more numbers than its shape"));
    assert!(lie(&[2, 2, 2], "<f4").contains("expected integers"));
    assert!(lie(&[2, 2, 2], "|O").contains("of type '|O'"));
    let mut other = NpzWriter::new(false);
    other.integer("a", 1).unwrap();
    let error = read(&other.finish().unwrap(), 1.0).unwrap_err().to_string();
    assert!(error.contains("the file has the arrays a; expected `links` of svox2 or `child` of PlenOctrees"), "{error}");
}

#[test]
fn a_run_becomes_a_checkpoint_and_a_checkpoint_a_run() {
    let folder = Folder::new("formats");
    let [run, again, tree, file] = ["run", "again", "tree", "ckpt.npz"].map(|name| folder.path(name));
    train("8,1,2", &run, &["--no-report", "--no-images"]).done();
    let answer = plenoxel(&["export", "svox2", &run, "--out", &file]).done();
    assert!(answer.contains("voxels at scene_scale 1.0000"), "{answer}");
    plenoxel(&["export", "svox2", &run]).done();
    assert!(fs::read(folder.path("run/exports/ckpt.npz")).unwrap() == fs::read(&file).unwrap());
    plenoxel(&["export", "svox2", &run, "--out", "ckpt.ply"]).refused(2, &["does not end in .npz"]);

    let result = plenoxel(&["import", &file, "--out", &again]).json();
    assert_eq!(
        (&result["resolution"], &result["format"], &result["scene"]),
        (&Value::from(12), &"svox2 checkpoint".into(), &"ckpt".into())
    );
    let about = plenoxel(&["info", &again]).done();
    assert!(about.contains("none: the grid was imported") && about.contains(&file), "{about}");
    let path = ["--path", "orbit", "--frames", "2", "--size", "24", "--format", "npy"];
    for run in [&run, &again] {
        // The cameras of the run would be another path.
        plenoxel(&[&["render", run, "--data", "/nowhere"][..], &path].concat()).refused(3, &["/nowhere"]);
    }
    plenoxel(&[&["render", &again][..], &path].concat()).done();
    assert!(folder.0.join("again/renders/orbit/frame_0001.npy").exists());
    plenoxel(&["evaluate", &again]).refused(2, &["--data: the run has no views", "give the folder with the views"]);
    plenoxel(&["export", "mesh", &again, "--level", "1"]).done();
    plenoxel(&["train", "--resume", &again]).refused(3, &["an imported run cannot be resumed"]);
    plenoxel(&["import", &file, "--out", &again]).refused(2, &["is not empty", "--force"]);

    // The command in the settings repeats the run.
    let checkpoint = || fs::read(folder.path("again/checkpoint.safetensors")).unwrap();
    let (before, settings) = (checkpoint(), fs::read_to_string(folder.path("again/config.toml")).unwrap());
    let line = settings.lines().find_map(|line| line.strip_prefix("# plenoxel ")).unwrap();
    let words: Vec<&str> = line.split_whitespace().chain(["--out", &again, "--force"]).collect();
    plenoxel(&words).done();
    assert!(checkpoint() == before);

    plenoxel(&["export", "plenoctree", &again, "--subdivide", "1", "--out", &file]).done();
    let imported = plenoxel(&["import", &file, "--out", &tree]);
    assert!(imported.err.contains("warning: colors of the octree are logistic"), "{}", imported.err);
    assert_eq!(imported.json()["format"], "PlenOctree");
    plenoxel(&["export", "svox2", &tree]).refused(3, &["constant voxels", "export plenoctree"]);
    plenoxel(&["import", &folder.path("run/run.json"), "--out", &folder.path("other")]).refused(3, &["not a complete .npz file"]);
    assert!(!folder.0.join("other").exists());
}

#[test]
fn with_its_dataset_an_imported_run_has_the_scores_of_the_trained_run() {
    let folder = Folder::new("formats-data");
    let [data, run, again] = ["scene", "run", "again"].map(|name| folder.path(name));
    plenoxel(&["scene", &data, "--size", "24", "--train", "8", "--val", "1", "--test", "2"]).done();
    let settings = ["--set", command::SHORT, "--set=rays_per_step=256", "--no-report", "--no-images"];
    plenoxel(&[&["train", &data, "--preset=demo", "--out", &run][..], &settings].concat()).done();
    // The cameras of svox2 are scaled by 2/3.
    let answer = plenoxel(&["export", "svox2", &run]).done();
    assert!(answer.contains("scene_scale 0.6667"), "{answer}");
    plenoxel(&["import", &folder.path("run/exports/ckpt.npz"), "--data", &data, "--out", &again]).done();
    let [trained, imported] = [&run, &again].map(|run| plenoxel(&["evaluate", run]).json()["psnr"].as_f64().unwrap());
    assert!((trained - imported).abs() < 0.01, "{trained} and {imported} dB");
    assert!(fs::read_to_string(folder.path("again/report.html")).unwrap().contains("<figure id=\"viewer\">"));
}
