//! Everything that reads a file or a command line, as a function of bytes, with valid inputs to begin from: what `tests/properties.rs` and the
//! fuzz targets of `tests/fuzz` call. One more parser is one more entry of `PARSERS`, and a target there.

#[path = "capture_parsers.rs"]
mod capture_parsers;

use super::memory::peak_of;
use ::image::{DynamicImage, ImageBuffer, ImageFormat};
use glam::DVec3;
use ndarray::{Array2, Array3};
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::camera_path::CameraPath;
use plenoxel::checkpoint::{self, Header};
use plenoxel::dataset::View;
use plenoxel::dataset::image::{self, RgbaImage};
use plenoxel::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use plenoxel::formats::plenoctree::{self, OctreeOptions};
use plenoxel::formats::{self, svox2};
use plenoxel::model::plenoxels::Trainer;
use plenoxel::model::plenoxels::config::{ColorKind, Config, OptimizerConfig, Stage};
use plenoxel::point_cloud::filter::{Filters, Noise, NoiseError, Outliers};
use plenoxel::point_cloud::ply::{PlyFile, encode};
use plenoxel::point_cloud::{PointCloud, ScalarField};
use plenoxel_cli::parsers;
use std::io::Cursor;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// What is to be done with what was read: writing it again, say.
type Then = Box<dyn FnOnce()>;

/// A reader of bytes.
pub struct Parser {
    /// The file's name in messages, which have to have it.
    pub name: &'static str,
    /// Inputs with nothing wrong.
    pub valid: fn() -> Vec<Vec<u8>>,
    /// Reads, or refuses with a message.
    pub read: fn(&Path, &[u8]) -> Result<Then, String>,
    /// Lengths and checksums set right, so that damage elsewhere comes through.
    pub repair: fn(&mut [u8]),
    /// The most memory that reading may take: so many bytes, and so many for each of the input.
    pub memory: [usize; 2],
}

const MIB: usize = 1 << 20;

/// All of them.
pub fn parsers() -> impl Iterator<Item = &'static Parser> {
    PARSERS.iter().chain(&capture_parsers::PARSERS)
}

const PARSERS: [Parser; 11] = [
    Parser { name: "path.json", valid: paths, read: read_path, repair: |_| (), memory: [2 * MIB, 400] },
    // Deflate makes 1032 of one byte, RGBA 32 of one that has 8 pixels; a row; and what stands beside the pixels.
    Parser { name: "image.png", valid: images, read: read_image, repair: repair_image, memory: [64 * MIB, 1032 * 32] },
    Parser { name: "cloud.ply", valid: clouds, read: read_cloud, repair: |_| (), memory: [MIB, 64] },
    // The bricks of 1024³ voxels.
    Parser { name: "checkpoint", valid: checkpoints, read: read_checkpoint, repair: repair_tensors, memory: [1200 * MIB, 64] },
    // The same bricks; and zeros that deflate makes of a byte are links of voxels that all have one row.
    Parser { name: "ckpt.npz", valid: svox2_checkpoints, read: read_archive, repair: repair_archive, memory: [1200 * MIB, 1032 * 64] },
    Parser { name: "tree.npz", valid: octrees, read: read_archive, repair: repair_archive, memory: [1200 * MIB, 1032 * 64] },
    Parser { name: "training", valid: states, read: read_state, repair: repair_tensors, memory: [4 * MIB, 64] },
    Parser { name: "config.toml", valid: configs, read: read_config, repair: |_| (), memory: [2 * MIB, 400] },
    Parser { name: "assignments", valid: assignments, read: read_assignments, repair: |_| (), memory: [2 * MIB, 400] },
    Parser { name: "metrics.jsonl", valid: metrics, read: read_metrics, repair: |_| (), memory: [MIB, 64] },
    Parser { name: "run.json", valid: records, read: read_record, repair: |_| (), memory: [MIB, 64] },
];

/// Reads bytes with the parser of a name. Panics if that panics, takes too much memory, refuses without a name, or reads again something else
/// than it read. True if the bytes were accepted.
pub fn try_out(name: &str, bytes: &[u8]) -> bool {
    let parser = parsers().find(|parser| parser.name == name).expect("the name of a parser");
    let (read, peak) = peak_of(|| (parser.read)(Path::new(name), bytes));
    let [base, each] = parser.memory;
    assert!(peak <= base + each * bytes.len(), "{name}: {peak} bytes of memory for {} of input", bytes.len());
    match read {
        Ok(then) => then(),
        Err(message) => {
            assert!(message.contains(name), "no name in: {message}");
            return false;
        }
    }
    true
}

/// Reads a command line's words, of which the last is one of the input's; nothing is carried out.
pub fn try_arguments(words: &[&str]) -> bool {
    let (read, peak) = peak_of(|| parsers::arguments(words));
    assert!(peak <= 8 * MIB + 100 * words.concat().len(), "{peak} bytes of memory for {words:?}");
    read.map_err(|message| assert!(!message.is_empty())).is_ok()
}

/// The bytes of a file that `write` makes.
fn written(write: impl FnOnce(&Path)) -> Vec<u8> {
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    let name = format!("plenoxel-parsers-{}-{}", std::process::id(), COUNT.fetch_add(1, Relaxed));
    // In memory where the system has such a folder: what is written is synced, and there is much of it.
    let folder = Some(Path::new("/dev/shm")).filter(|folder| folder.is_dir()).map_or_else(std::env::temp_dir, Path::to_owned);
    let path = folder.join(name);
    write(&path);
    let bytes = std::fs::read(&path).expect("it was written");
    std::fs::remove_file(&path).expect("it is there");
    bytes
}

fn text(e: impl std::fmt::Display) -> String {
    e.to_string()
}

fn nothing() -> Then {
    Box::new(|| ())
}

fn transforms() -> Vec<Vec<u8>> {
    let frame = |k: usize| {
        let pose = format!("[[1, 0, 0.0, 0], [0, 0.8, -0.6, -2.5e-1], [0, 0.6, 0.8, {}], [0, 0, 0, 1]]", 4 + k);
        format!("{{ \"file_path\": \"./train/r_{k}\", \"rotation\": 0.1, \"transform_matrix\": {pose} }}")
    };
    let frames: Vec<String> = (0..3).map(frame).collect();
    let whole = |frames: &str| format!("{{\"camera_angle_x\": 0.6911112070083618, \"frames\": [{frames}]}}");
    let stated = whole(&frames.join(",")).replace(": 0.1,", ": 0.1, \"fl_x\": 11.11, \"w\": 8, \"cy\": 4.0,").replacen(
        ", ",
        ", \"camera_angle_y\": 0.69, \"k1\": 0, \"camera_model\": \"OPENCV\", \"is_fisheye\": false, ",
        1,
    );
    let utf16 = format!("\u{feff}{stated}").encode_utf16().flat_map(u16::to_be_bytes).collect();
    vec![whole(&frames.join(",\n")).into_bytes(), format!("\u{feff}{}", whole("")).into_bytes(), stated.into_bytes(), utf16]
}

fn paths() -> Vec<Vec<u8>> {
    let key = |k: usize| format!(r#"{{"R": [0.9, 0.1, {k}, 0.2], "T": [0.5, 0.6, {k}], "fov": 50.6, "scale": 1.2, "timestamp": {k}}}"#);
    let keys: Vec<String> = (1..5).map(key).collect();
    let ngp = format!(r#"{{"loop": true, "spline_order": 3, "path": [{}]}}"#, keys.join(",\n"));
    let frame =
        |k: usize| format!(r#"{{"camera_to_world": [1,0,0,{k}, 0,0.8,-0.6,-2.5, 0,0.6,0.8,4, 0,0,0,1], "fov": 40.5, "aspect": 1.5}}"#);
    let frames: Vec<String> = (0..3).map(frame).collect();
    let head = r#""camera_type": "perspective", "render_height": 20, "render_width": 30, "fps": 24, "seconds": 2"#;
    let studio = format!(r#"{{{head}, "camera_path": [{}]}}"#, frames.join(", "));
    [ngp.into_bytes(), studio.into_bytes()].into_iter().chain(transforms().into_iter().take(1)).collect()
}

fn read_path(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let read = CameraPath::parse(path, bytes).map_err(text)?;
    Ok(Box::new(move || {
        for shot in read.shots(7) {
            let ray = shot.camera((8, 6)).ray(0.5, 0.5);
            assert!(ray.direction.is_normalized() && ray.origin.is_finite(), "{ray:?}");
        }
    }))
}

fn images() -> Vec<Vec<u8>> {
    let rgba = RgbaImage::from_fn(6, 5, |x, y| [10 * x as u8, y as u8, 200, (50 * x) as u8].into());
    let rgb = Array3::from_shape_fn((5, 7, 3), |(y, x, c)| (y * x + c) as f32 / 40.0);
    let gray = Array2::from_shape_fn((3, 4), |(y, x)| (5000 * y * x) as u16);
    // Pixels of two bits of a palette, in lines that are interlaced.
    let palette = [
        &b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x02\0\0\0\x02\x02\x03\0\0\x01\0\0\0\0\0\0\0\x06PLTE\0\x01\x02\xff\xfe\xfd\0\0\0\0\0\0\0\x02tRNS\x80\xff\0\0\0\0"[..],
        b"\0\0\0\x11IDATx\x01\x01\x06\0\xf9\xff\0\0\0\x40\0\x50\0\x9b\0\x91\0\0\0\0\0\0\0\0IEND\xae\x42\x60\x82",
    ];
    let mut palette = palette.concat();
    repair_image(&mut palette);
    vec![
        written(|path| image::write_rgba(path, &rgba).expect("a picture")),
        written(|path| image::write_rgb(path, rgb.view()).expect("a picture")),
        written(|path| image::write_gray16(path, &gray).expect("a picture")),
        palette,
        encoded(&rgba, ImageFormat::WebP),
        encoded(&DynamicImage::ImageRgba8(rgba.clone()).to_luma8(), ImageFormat::Jpeg),
        turned(&encoded(&DynamicImage::ImageRgba8(rgba.clone()).to_rgb8(), ImageFormat::Jpeg)),
    ]
}

fn encoded<P>(picture: &ImageBuffer<P, Vec<u8>>, format: ImageFormat) -> Vec<u8>
where
    P: ::image::PixelWithColorType<Subpixel = u8>,
{
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).expect("a picture");
    bytes.into_inner()
}

/// A JPEG with an EXIF segment: turned by 90 degrees.
fn turned(jpeg: &[u8]) -> Vec<u8> {
    let exif = b"\xff\xe1\0\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
    [&jpeg[..2], exif, &jpeg[2..]].concat()
}

fn read_image(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let picture = image::decode(path, bytes).map_err(text)?;
    assert!(picture.width().max(picture.height()) <= image::MAX_SIDE && !picture.is_empty());
    Ok(nothing())
}

/// The checksums of all chunks of a PNG.
pub fn repair_image(bytes: &mut [u8]) {
    if !bytes.starts_with(b"\x89PNG") {
        return;
    }
    let mut at = 8;
    while let Some(length) = bytes.get(at..at + 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]) as usize) {
        let end = at + 8 + length;
        if end + 4 > bytes.len() {
            return;
        }
        let crc = crc32(&bytes[at + 4..end]);
        bytes[end..end + 4].copy_from_slice(&crc.to_be_bytes());
        at = end + 4;
    }
}

fn clouds() -> Vec<Vec<u8>> {
    let position = |i: usize| DVec3::new(i as f64, 0.5 * (i % 3) as f64, -2.0);
    let cloud = PointCloud {
        positions: (0..7).map(position).collect(),
        colors: Some(vec![[1, 2, 250]; 7]),
        normals: Some(vec![[0.0, 0.0, 1.0]; 7]),
        fields: vec![ScalarField { name: "opacity".into(), values: (0..7).map(|i| i as f32 / 7.0).collect() }],
    };
    let ascii = "ply\nformat ascii 1.0\ncomment by hand\nobj_info one\nelement vertex 3\nproperty double x\nproperty list uchar int links\n\
                 property float y\nproperty float z\nproperty uchar red\nproperty float scalar_h\nelement face 1\nproperty list uchar int v\n\
                 end_header\n1 0 2 3 255 nan\n1.5 2 7 8 0 -1e3 0 0.25\n-4 1 9 5 6 7 1e30\n3 0 1 2\n";
    let mut binary =
        b"ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty list uint short links\nproperty float x\nproperty double y\n\
                       property char z\nend_header\n"
            .to_vec();
    binary.extend(b"\0\0\0\x01\x01\x02\x3f\x80\0\0\x3f\xf0\0\0\0\0\0\0\xff");
    binary.extend(b"\0\0\0\0\x3f\x80\0\0\x3f\xf0\0\0\0\0\0\0\x05");
    vec![encode(&cloud, &["made here".into()]), ascii.into(), binary]
}

fn read_cloud(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let file = PlyFile::parse(path, bytes.to_vec()).map_err(text)?;
    let positions = file.positions().map_err(text)?;
    // A file may have as many fields as it has letters, and each is read past all those before.
    let names: Vec<&str> = file.field_names().into_iter().take(4).collect();
    let fields: Result<Vec<Vec<f32>>, _> = names.iter().map(|name| file.values(name)).collect();
    let fields = fields.map_err(text)?;
    Ok(Box::new(move || {
        let all: Vec<u32> = (0..file.len() as u32).collect();
        let again = PlyFile::parse(Path::new("again"), file.chosen(&all, "again")).expect("it was written here");
        let bits = |p: &[DVec3]| p.iter().map(|p| p.to_array().map(f64::to_bits)).collect::<Vec<_>>();
        assert_eq!(bits(&again.positions().expect("numbers")), bits(&positions));
        for (name, field) in file.field_names().iter().zip(&fields) {
            let again = again.values(name).expect("the same fields");
            assert!(again.iter().zip(field).all(|(a, b)| a.to_bits() == b.to_bits()), "{name}");
        }
        if positions.len() <= 1000 {
            let noise = Noise { radius: 0.75, error: NoiseError::Relative(1.0), remove_isolated: false };
            let outliers = Outliers { neighbours: 2, sigma: 1.0 };
            let filters = Filters { noise: Some(noise), outliers: Some(outliers), ..Filters::default() };
            // Too few points are an error.
            let _ = filters.apply(&positions, fields.first().map(|field| &field[..]));
        }
    }))
}

fn grids() -> [VoxelGrid<f32>; 3] {
    let color = Color::Sh { degree: 1, offset: 0.5 };
    let shape = GridShape::new(5, 1.5, Interpolation::Trilinear, color);
    let whole = VoxelGrid::random(shape, 3.0, 1.0, 9);
    let sparse = whole.pruned(&whole.voxels_where(|row| row % 3 == 1));
    [whole, sparse, VoxelGrid::random(GridShape { sh_reduction: 2, ..shape }, 3.0, 1.0, 9)]
}

fn checkpoints() -> Vec<Vec<u8>> {
    let save = |grid: &VoxelGrid<f32>| {
        let header = Header::new(grid, "still life", [1.0; 3], 42, 1234);
        written(|path| checkpoint::save(path, grid, &header).expect("it is written"))
    };
    grids().iter().map(save).collect()
}

fn read_checkpoint(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let (grid, header) = checkpoint::read::<f32>(path, Cursor::new(bytes)).map_err(text)?;
    Ok(Box::new(move || {
        if grid.shape().resolution > 64 {
            return;
        }
        let again = written(|path| checkpoint::save(path, &grid, &header).expect("it is written"));
        let (again, header_again) = checkpoint::read::<f32>(Path::new("again"), Cursor::new(again)).expect("it is read");
        assert!(header_again == header && again.shape() == grid.shape() && again.lattice().masks() == grid.lattice().masks());
        for (a, b) in again.params().zip(grid.params()) {
            assert!(a.tensor().data() == b.tensor().data(), "{}", a.name());
        }
    }))
}

fn svox2_checkpoints() -> Vec<Vec<u8>> {
    let encode = |grid: &VoxelGrid<f32>| svox2::encode(Path::new("grid"), grid, 1.0).expect("it is interpolated").0;
    grids().iter().map(encode).collect()
}

fn octrees() -> Vec<Vec<u8>> {
    let encode = |grid: &VoxelGrid<f32>| {
        plenoctree::encode(Path::new("grid"), grid, &OctreeOptions::default(), &|_, _| ()).expect("it has leaves").0
    };
    grids().iter().map(encode).collect()
}

fn read_archive(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let grid = formats::read(path, Cursor::new(bytes), 1.0).map_err(text)?.grid;
    Ok(Box::new(move || {
        if grid.shape().resolution > 64 {
            return;
        }
        let again = written(|path| {
            let header = Header::new(&grid, "imported", [1.0; 3], 42, 0);
            checkpoint::save(path, &grid, &header).expect("it is written");
        });
        let (again, _) = checkpoint::read::<f32>(Path::new("again"), Cursor::new(again)).expect("it is read");
        assert!(again.shape() == grid.shape() && again.lattice().masks() == grid.lattice().masks());
    }))
}

/// The checksums of the stored files of a zip archive, in its central directory and before each file.
fn repair_archive(bytes: &mut [u8]) {
    let number = |bytes: &[u8], at: usize, size: usize| {
        let bytes = bytes.get(at..at.checked_add(size)?)?;
        Some(bytes.iter().rev().fold(0usize, |number, byte| number << 8 | usize::from(*byte)))
    };
    let entries: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(b"PK\x01\x02")).collect();
    for entry in entries {
        let sizes = [(10, 2), (20, 4), (42, 4)].map(|(at, size)| number(bytes, entry + at, size));
        let [Some(0), Some(length), Some(file)] = sizes else { continue };
        let [Some(name), Some(extra)] = [26, 28].map(|at| number(bytes, file + at, 2)) else { continue };
        let start = file + 30 + name + extra;
        let Some(crc) = bytes.get(start..start + length).map(crc32) else { continue };
        for at in [entry + 16, file + 14] {
            if let Some(stored) = bytes.get_mut(at..at + 4) {
                stored.copy_from_slice(&crc.to_le_bytes());
            }
        }
    }
}

/// The checksum of PNG and zip files.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
    !bytes.iter().fold(!0u32, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), step))
}

/// The safetensors header's length, by its braces.
fn repair_tensors(bytes: &mut [u8]) {
    let (mut depth, mut quoted, mut escaped) = (0usize, false, false);
    for at in 8..bytes.len() {
        match (bytes[at], quoted) {
            _ if escaped => escaped = false,
            (b'\\', true) => escaped = true,
            (b'"', _) => quoted = !quoted,
            (b'{', false) => depth += 1,
            (b'}', false) if depth == 1 => {
                let length = (at + 1 - 8) as u64;
                bytes[..8].copy_from_slice(&length.to_le_bytes());
                return;
            }
            (b'}', false) => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
}

/// A run of three steps in two stages, and what it looks at.
fn run() -> (Config, &'static [View]) {
    static VIEWS: OnceLock<Vec<View>> = OnceLock::new();
    let view = |k: usize| {
        let eye = DVec3::new(4.0, k as f64, 1.0);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(4, 4, 0.7));
        View { name: format!("r_{k}"), camera, image: RgbaImage::from_pixel(4, 4, [90, 80, 70, 255].into()), depth: None, mask: None }
    };
    let config = Config {
        rays_per_step: 8,
        color: ColorKind::Sh,
        sh_degree: 1,
        sh_reduction: 2,
        optimizer: OptimizerConfig::LazyAdam { beta1: 0.9, beta2: 0.99, epsilon: 1e-8 },
        stages: vec![Stage::new(3, 1), Stage::new(5, 2)],
        ..Config::default()
    };
    (config, VIEWS.get_or_init(|| (0..2).map(view).collect()))
}

fn states() -> Vec<Vec<u8>> {
    let (config, views) = run();
    let mut trainer = Trainer::<f32>::new(config, views).expect("a valid config");
    let mut saved = || {
        trainer.step().expect("finite numbers").expect("a step is left");
        written(|path| trainer.save(path, "two pictures").expect("it is written"))
    };
    vec![saved(), saved()]
}

fn read_state(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let (config, views) = run();
    let mut trainer = Trainer::<f32>::new(config, views).expect("a valid config").resumed_from(path, Cursor::new(bytes)).map_err(text)?;
    Ok(Box::new(move || {
        let again = written(|path| trainer.save(path, "two pictures").expect("it is written"));
        let (config, views) = run();
        let fresh = Trainer::<f32>::new(config, views).expect("a valid config");
        let again = fresh.resumed_from(Path::new("again"), Cursor::new(again)).expect("it is read");
        assert_eq!(again.steps_taken(), trainer.steps_taken());
        // Numbers may be beyond all bounds after a step: an error.
        while let Ok(Some(_)) = trainer.step() {}
    }))
}

fn configs() -> Vec<Vec<u8>> {
    let complete = |config: &Config| toml::to_string(config).expect("TOML").into_bytes();
    let layer = "seed = 7 # a layer\nbackground = [0, 0.5, 1]\n[losses]\nmse = 2\nsparsity = { from = 1e-3, to = 1e-5, steps = 100 }\n\
                 [optimizer]\nkind = \"rms_prop\"\nbeta = 0.9\nepsilon = 1e-8\n[[stages]]\nresolution = 16\nepochs = 0.5\n\
                 sampling.step = 0.5\ndensity_rate = 1\ncolor_rate = 1e-2\n[[stages]]\nresolution = 32\nsteps = 10\ndensity_rate = 1\n\
                 color_rate = 0.1\nsampling = { samples = 64, far = 8 }\n[scout]\ndensity = 0.1\nprune_unseen_below = 0.01\n[[scout.stages]]\nresolution = 8\n\
                 steps = 5\nsampling.step = 1\ndensity_rate = 1\ncolor_rate = 1\n";
    vec![complete(&Config::default()), complete(&run().0), layer.into()]
}

fn read_config(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let layered = parsers::layer(path, bytes);
    let alone = parsers::config(path, bytes);
    let read: Vec<Config> = match (layered, alone) {
        (Ok(a), Ok(b)) => vec![a, b],
        (Ok(read), Err(_)) | (Err(_), Ok(read)) => vec![read],
        (Err(e), Err(alone)) => return Err(format!("{alone}, or as a layer: {e}")),
    };
    Ok(Box::new(move || {
        for config in read {
            let again = toml::to_string(&config).expect("TOML");
            assert_eq!(parsers::config(Path::new("again"), again.as_bytes()).expect("it was written here"), config);
        }
    }))
}

fn assignments() -> Vec<Vec<u8>> {
    let lines = "interpolation = trilinear\nstages[*].color_rate=7\nstages[0].epochs=0.5\nevaluation={step=0.25}\nlosses.sparsity.from=1e-3\n\
                 losses.sparsity.to=1e-5\nlosses.sparsity.steps=100\noptimizer={kind=\"momentum\", decay=0.9}\nbackground=[0, 0, 0]\n\
                 prune_from_stage=\nstages[0].sampling.step=1\ncarve.photo.noise=0.1\n";
    vec![lines.into(), b"seed=1\nhalf_width=1e-3".to_vec()]
}

fn read_assignments(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let lines = String::from_utf8_lossy(bytes);
    let read = parsers::assignments(lines.lines()).map_err(|e| format!("{}: {e}", path.display()))?;
    assert_eq!(read.validate().map_err(text), Ok(()));
    Ok(nothing())
}

fn metrics() -> Vec<Vec<u8>> {
    let line = |step: u64| {
        format!(
            "{{\"step\":{step},\"stage\":0,\"resolution\":16,\"ends_stage\":{},\"loss\":0.25,\"losses\":{{\"mse\":0.2,\"a\\\"b\":5e-2}},\"psnr\":12.5,\
             \"rays\":{},\"samples\":99,\"density_rate\":1.0,\"color_rate\":0.03,\"seconds\":1.5}}\n",
            step % 3 == 2,
            8 * step
        )
    };
    vec![(0..6).map(line).collect::<String>().into_bytes(), Vec::new()]
}

fn read_metrics(_: &Path, bytes: &[u8]) -> Result<Then, String> {
    // No line is worth more than to be left out; those that are kept tell the same again.
    let (kept, losses) = parsers::losses(bytes, 1000);
    assert_eq!(parsers::losses(kept.as_bytes(), 1000), (kept.clone(), losses));
    if metrics().iter().any(|valid| valid == bytes) {
        assert_eq!(kept.as_bytes(), bytes, "a valid file keeps its lines");
    }
    Ok(nothing())
}

fn records() -> Vec<Vec<u8>> {
    let record = |data: &str| {
        format!(
            "{{\"program\": \"plenoxel 0.1.0\", \"instruction_set\": \"avx2\", \"threads\": 2, \"scene\": \"lego\", \"format\": \"a\", \
             \"preset\": null, \"data\": {data}}}"
        )
    };
    let folder = record("{\"kind\": \"folder\", \"path\": \"/data/lego\"}");
    let built_in = record("{\"kind\": \"built_in\", \"width\": 20, \"height\": 10, \"train\": 5, \"val\": 0, \"test\": 2}");
    let planned = folder.replace("\"preset\"", "\"seconds_planned\": 9.5, \"asked\": {\"seed\": \"7\"}, \"preset\"");
    vec![folder.into(), built_in.into(), planned.into()]
}

fn read_record(path: &Path, bytes: &[u8]) -> Result<Then, String> {
    let record = parsers::RunRecord::parse(path, bytes).map_err(text)?;
    Ok(Box::new(move || {
        let again = serde_json::to_vec(&record).expect("JSON");
        assert!(parsers::RunRecord::parse(Path::new("again"), &again).expect("it was written here") == record);
        if let parsers::DataSource::BuiltIn { .. } = record.data {
            let (dataset, peak) = peak_of(|| record.data.open(&Config { downscale: 3, ..Config::default() }));
            assert!(peak <= 128 * MIB, "{peak} bytes for {:?}", dataset.map(|dataset| dataset.size()));
        }
    }))
}
