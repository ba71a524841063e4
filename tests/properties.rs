//! Any bytes of a file and any words of a command line are read, or refused with an error that names them. Nothing panics, and memory stays in
//! proportion to the input.
//!
//! Inputs are valid ones that are damaged, and some made up; always the same. `PROPTEST_CASES=100000` tries more, `PROPTEST_RNG_SEED=7`
//! others. For coverage-guided search of the same parsers see `tests/fuzz`.

#[path = "support/memory.rs"]
mod memory;
#[path = "support/parsers.rs"]
mod parsers;

use memory::peak_of;
use parsers::{Parser, try_arguments, try_out};
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, image};
use plenoxel::evaluate;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::plenoxels::grid_viewer;
use plenoxel::run::memory::{Estimate, Stored};
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::test_runner::{RngSeed, TestError, TestRunner};
use std::io::Write;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Numbers at the ends of what types hold, and what is none.
const EXTREMES: [&str; 24] = [
    "0",
    "-1",
    "1",
    "2",
    "255",
    "65536",
    "2147483648",
    "4294967295",
    "4294967296",
    "9223372036854775807",
    "9223372036854775808",
    "18446744073709551615",
    "18446744073709551616",
    "1e308",
    "-1e308",
    "1e400",
    "1e-320",
    "-0.0",
    "0.5",
    "NaN",
    "nan",
    "inf",
    "\"\"",
    "null",
];

/// Something that happens to a file. Places are shares of its length.
#[derive(Clone, Debug)]
enum Damage {
    Cut(Index),
    Flip(Index, u8),
    Insert(Index, Vec<u8>),
    Remove(Index, usize),
    Double(Index, usize),
    /// One of the numbers in the text becomes another.
    Number(Index, &'static str),
    /// One of the words of the text becomes another, or one of its own.
    Word(Index, Index, Option<&'static str>),
    /// Bytes of a binary number, least first or last.
    Binary(Index, u64, usize, bool),
}

fn damage() -> impl Strategy<Value = Damage> {
    let at = any::<Index>;
    let ends = select(vec![0, 1, 0x7f, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 32, 1 << 53, i64::MAX as u64, u64::MAX]);
    let words = select(vec!["x", "", "ä", "scalar_", "list", "ascii", "binary_little_endian", "plenoxel 9", "[]", "{}", "[[[[", "\u{0}"]);
    prop_oneof![
        1 => at().prop_map(Damage::Cut),
        3 => (at(), 0..8u8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        1 => (at(), proptest::collection::vec(any::<u8>(), 1..9)).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        1 => (at(), 1..40usize).prop_map(|(at, n)| Damage::Remove(at, n)),
        1 => (at(), 1..200usize).prop_map(|(at, n)| Damage::Double(at, n)),
        4 => (at(), select(&EXTREMES)).prop_map(|(at, number)| Damage::Number(at, number)),
        2 => (at(), at(), proptest::option::of(words)).prop_map(|(at, other, word)| Damage::Word(at, other, word)),
        2 => (at(), ends, select(vec![1, 2, 4, 8]), any::<bool>()).prop_map(|(at, value, size, first)| Damage::Binary(at, value, size, first)),
    ]
}

/// Where the longest runs of some bytes are.
fn runs(bytes: &[u8], of: impl Fn(u8) -> bool) -> Vec<std::ops::Range<usize>> {
    let mut runs: Vec<std::ops::Range<usize>> = Vec::new();
    for at in (0..bytes.len()).filter(|&at| of(bytes[at])) {
        match runs.last_mut() {
            Some(run) if run.end == at => run.end += 1,
            _ => runs.push(at..at + 1),
        }
    }
    runs
}

impl Damage {
    fn befall(&self, bytes: &mut Vec<u8>) {
        let n = bytes.len();
        match self {
            Damage::Insert(at, new) => drop(bytes.splice(at.index(n + 1)..at.index(n + 1), new.iter().copied())),
            _ if n == 0 => {}
            Damage::Cut(at) => bytes.truncate(at.index(n)),
            Damage::Flip(at, bit) => bytes[at.index(n)] ^= 1 << bit,
            Damage::Remove(at, length) => drop(bytes.drain(at.index(n)..(at.index(n) + length).min(n))),
            Damage::Double(at, length) => {
                let part = bytes[at.index(n)..(at.index(n) + length).min(n)].to_vec();
                drop(bytes.splice(at.index(n)..at.index(n), part));
            }
            Damage::Number(at, number) => {
                let numbers = runs(bytes, |b| b.is_ascii_digit() || b"+-.".contains(&b));
                if !numbers.is_empty() {
                    drop(bytes.splice(at.get(&numbers).clone(), number.bytes()));
                }
            }
            Damage::Word(at, other, word) => {
                let words = runs(bytes, |b| b.is_ascii_alphanumeric() || b == b'_');
                if !words.is_empty() {
                    let new = word.map_or_else(|| bytes[other.get(&words).clone()].to_vec(), |word| word.into());
                    drop(bytes.splice(at.get(&words).clone(), new));
                }
            }
            Damage::Binary(at, value, size, least_first) => {
                let value = if *least_first { value.to_le_bytes()[..*size].to_vec() } else { value.to_be_bytes()[8 - size..].to_vec() };
                let at = at.index(n);
                let end = (at + size).min(n);
                bytes[at..end].copy_from_slice(&value[..end - at]);
            }
        }
    }
}

/// Keeps other tests waiting, for memory is counted for the whole process: that for the inputs of another test too.
fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    ONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs a property on the same inputs each time.
fn hold<S: Strategy>(strategy: S, property: impl Fn(S::Value)) {
    let mut config = ProptestConfig { failure_persistence: None, ..ProptestConfig::default() };
    if config.rng_seed == RngSeed::Random {
        config.rng_seed = RngSeed::Fixed(1);
    }
    let held = TestRunner::new(config).run(&strategy, |value| {
        property(value);
        Ok(())
    });
    match held {
        // On one line: inputs are lists of bytes.
        Err(TestError::Fail(reason, value)) => panic!("{reason}, of the smallest input found: {value:?}"),
        held => held.unwrap_or_else(|e| panic!("{e}")),
    }
}

/// Valid inputs are read, and damaged ones in some way.
fn survives_damage(name: &str) {
    let _alone = alone();
    let parser: &Parser = parsers::parsers().find(|parser| parser.name == name).expect("a parser");
    let valid = (parser.valid)();
    for bytes in &valid {
        assert!(try_out(name, bytes), "a valid input is refused: {:?}", (parser.read)(name.as_ref(), bytes).err());
    }
    let strategy = (any::<Index>(), proptest::collection::vec(damage(), 1..4), any::<bool>());
    hold(strategy, |(which, damages, repaired)| {
        let mut bytes = which.get(&valid).clone();
        damages.iter().for_each(|damage| damage.befall(&mut bytes));
        if repaired {
            (parser.repair)(&mut bytes);
        }
        try_out(name, &bytes);
    });
}

macro_rules! damaged {
    ($($test:ident: $name:literal,)*) => {$(
        #[test]
        fn $test() {
            survives_damage($name);
        }
    )*};
}

damaged! {
    damaged_cameras_are_read_or_refused: "transforms.json",
    damaged_camera_paths_are_read_or_refused: "path.json",
    damaged_images_are_read_or_refused: "image.png",
    damaged_clouds_are_read_or_refused: "cloud.ply",
    damaged_checkpoints_are_read_or_refused: "checkpoint",
    damaged_checkpoints_of_svox2_are_read_or_refused: "ckpt.npz",
    damaged_octrees_are_read_or_refused: "tree.npz",
    damaged_states_are_read_or_refused: "training",
    damaged_configurations_are_read_or_refused: "config.toml",
    damaged_assignments_are_read_or_refused: "assignments",
    damaged_metrics_are_read_or_refused: "metrics.jsonl",
    damaged_records_are_read_or_refused: "run.json",
    damaged_cameras_of_colmap_are_read_or_refused: "cameras.bin",
    damaged_images_of_colmap_are_read_or_refused: "images.bin",
    damaged_points_of_colmap_are_read_or_refused: "points3D.bin",
    damaged_cameras_in_text_are_read_or_refused: "cameras.txt",
    damaged_images_in_text_are_read_or_refused: "images.txt",
    damaged_points_in_text_are_read_or_refused: "points3D.txt",
    damaged_poses_of_llff_are_read_or_refused: "poses_bounds.npy",
    damaged_intrinsics_of_nsvf_are_read_or_refused: "intrinsics.txt",
    damaged_poses_of_nsvf_are_read_or_refused: "pose.txt",
}

#[test]
#[ignore = "writes the files that fuzzing begins from"]
fn seeds_for_fuzzing() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus");
    let write = |name: &str, inputs: &[Vec<u8>]| {
        // Text and binary forms of one file have one target.
        let folder = corpus.join(name.split('.').next().unwrap_or(name));
        std::fs::create_dir_all(&folder).expect("a folder");
        for (i, bytes) in inputs.iter().enumerate() {
            std::fs::write(folder.join(format!("{name}-{i}")), bytes).expect("it is written");
        }
    };
    parsers::parsers().for_each(|parser| write(parser.name, &(parser.valid)()));
    let lines = ["train data --time 5m --max-memory 8GiB", "filter a --out b --bbox 0,0,0,1,1,1", "train --scene-size 32x24 --set seed=3"];
    write("arguments", &lines.map(|line| line.replace(' ', "\n").into_bytes()));
}

#[test]
fn every_parser_is_tried() {
    let _alone = alone();
    // The list above is by name.
    let tried = include_str!("properties.rs");
    assert!(parsers::parsers().all(|parser| tried.contains(&format!("refused: \"{}\"", parser.name))));
}

#[test]
fn an_image_takes_the_memory_of_its_pixels_at_8_bits_and_to_look_at_it_takes_none() {
    let _alone = alone();
    // 16-bit RGBA, with something behind its end: 32 MiB when it is not compressed.
    let side = 2048_usize;
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    let row = vec![0; 1 + 8 * side];
    (0..side).try_for_each(|_| zlib.write_all(&row)).expect("compressed");
    let chunk = |name: &[u8], data: &[u8]| [&(data.len() as u32).to_be_bytes(), name, data, &[0; 4]].concat();
    let size = (side as u32).to_be_bytes();
    let header = [&size[..], &size, &[16, 6, 0, 0, 0]].concat();
    let data = zlib.finish().expect("compressed");
    let mut png = [b"\x89PNG\r\n\x1a\n".to_vec(), chunk(b"IHDR", &header), chunk(b"IDAT", &data), chunk(b"IEND", b"")].concat();
    parsers::repair_image(&mut png);
    png.extend([0; 1000]);
    let path = std::env::temp_dir().join(format!("plenoxel-properties-{}.png", std::process::id()));
    std::fs::write(&path, png).expect("it is written");
    let (looked, peak) = peak_of(|| image::size(&path));
    assert!(looked.is_ok_and(|size| size == (side, side)) && peak < 1 << 20, "{peak} bytes to look at it");
    let (read, peak) = peak_of(|| image::read(&path));
    assert!(read.is_ok_and(|image| image.width() == 2048) && peak < 4 * side * side + (1 << 20), "{peak} bytes to read it");
    std::fs::remove_file(path).expect("it is there");
}

#[test]
fn what_comparing_large_views_takes_is_estimated() {
    let _alone = alone();
    let options = ProceduralOptions { width: 700, height: 700, train: 1, val: 0, test: 1, supersample: 1 };
    let dataset = Dataset::procedural(options).expect("the scene");
    let views = dataset.load(Split::Test, &|_, _| ()).expect("its view");
    let config = Config::default();
    let grid = VoxelGrid::<f32>::random(config.grid_shape(8), 1.0, 0.1, 1);
    let stored = Stored::Grid { shape: *grid.shape(), voxels: 512 };
    let estimate = Estimate::of_evaluation(&config, config.evaluation, &stored, Some((&dataset, Split::Test, usize::MAX)));
    let viewer = grid_viewer(&grid, config.evaluation, config.engine, config.background);
    let (scores, peak) = peak_of(|| viewer.compare(&views, |_, _, _, _| Ok(())).expect("scores"));
    assert!(scores.psnr().is_some() && peak as u64 <= estimate.step + (20 << 20), "{peak} bytes, and {} estimated", estimate.step);
    let (mean, peak) = peak_of(|| evaluate::mean_image(&views, [1.0; 3]));
    assert!(mean.is_some() && peak <= 12 * 700 * 700 + (1 << 20), "{peak} bytes for the mean image");
}

#[test]
fn clouds_with_any_header_are_read_or_refused() {
    let _alone = alone();
    let number = || select(vec!["char", "uint8", "short", "ushort", "int", "uint32", "float", "double"]);
    let name = || select(vec!["x", "y", "z", "red", "nx", "scalar_a", "quality", "vertex_indices"]);
    let property = prop_oneof![
        4 => (number(), name()).prop_map(|(number, name)| format!("property {number} {name}\n")),
        1 => (number(), number(), name()).prop_map(|(count, item, name)| format!("property list {count} {item} {name}\n")),
    ];
    let count = prop_oneof![4 => (0..5u64).prop_map(|n| n.to_string()), 1 => select(&EXTREMES).prop_map(str::to_owned)];
    let some = proptest::collection::vec(property, 0..6).prop_map(|properties| properties.concat());
    let element = (select(vec!["vertex", "face", "points", "empty"]), count, some)
        .prop_map(|(name, count, properties)| format!("element {name} {count}\n{properties}"));
    // Most files have points with coordinates.
    let points = (number(), 0..4usize)
        .prop_map(|(number, n)| format!("element vertex {n}\nproperty {number} x\nproperty {number} y\nproperty {number} z\n"));
    let elements = proptest::collection::vec(prop_oneof![element, points], 1..4).prop_map(|elements| elements.concat());
    let words = proptest::collection::vec(select(&EXTREMES), 0..40).prop_map(|words| words.join(" ").into_bytes());
    let body = prop_oneof![words, proptest::collection::vec(prop_oneof![3 => 0..4u8, 1 => any::<u8>()], 0..120)];
    let encoding = select(vec!["ascii", "binary_little_endian", "binary_big_endian"]);
    hold((encoding, elements, body), |(encoding, elements, body)| {
        let header = format!("ply\nformat {encoding} 1.0\n{elements}end_header\n").into_bytes();
        try_out("cloud.ply", &[header, body].concat());
    });
}

#[test]
fn assignments_of_any_value_to_any_key_are_taken_or_refused() {
    let _alone = alone();
    let complete = toml::to_string(&plenoxel::model::plenoxels::config::Config::default()).expect("TOML");
    let mut keys: Vec<String> = complete.lines().filter_map(|line| Some(line.split_once(" = ")?.0.to_owned())).collect();
    let below = [
        "stages[0].",
        "stages[*].",
        "stages[9].",
        "stages[18446744073709551615].",
        "scout.",
        "losses.",
        "losses.mse.",
        "carve.",
        "initial.",
        "optimizer.",
        "evaluation.",
    ];
    keys.extend(below.map(str::to_owned));
    let more =
        ["resolution", "steps", "epochs", "sampling.step", "sampling.samples", "kind", "beta", "from", "until", "weight", "photo.noise"];
    let key = (select(keys), proptest::option::of(select(more.to_vec()))).prop_map(|(key, more)| key + more.unwrap_or(""));
    let value = prop_oneof![
        4 => select(&EXTREMES).prop_map(str::to_owned),
        1 => select(&EXTREMES).prop_map(|x| format!("[{x}, {x}, {x}]")),
        1 => select(&EXTREMES).prop_map(|x| format!("{{ step = {x} }}")),
        1 => "\\PC{0,12}",
    ];
    hold(proptest::collection::vec((key, value), 1..4), |assignments| {
        let lines: Vec<String> = assignments.iter().map(|(key, value)| format!("{key}={value}")).collect();
        try_out("assignments", lines.join("\n").as_bytes());
    });
}

#[test]
fn values_of_flags_are_taken_or_refused() {
    let _alone = alone();
    let flags = vec![
        "train --time",
        "train --checkpoint-every",
        "train --scene-size",
        "train --scene-views",
        "train --seed",
        "train --downscale",
        "train --background",
        "train --half-width",
        "train --sh-degree",
        "train --sh-reduction",
        "train --tv",
        "train --set",
        "train --max-memory",
        "train --threads",
        "carve --set",
        "export ply run --min-alpha",
        "export svox2 run --scene-scale",
        "export plenoctree run --subdivide",
        "import a --scene-scale",
        "export mesh run --threshold",
        "evaluate run --split",
        "render run --view",
        "render run --samples",
        "filter a --out b --bbox",
        "filter a --out b --sor-neighbours",
        "filter a --out b --sor-sigma",
        "filter a --out b --noise-radius",
        "filter a --out b --min-value",
    ];
    let unit = select(vec!["", "s", "m", "min", "h", "GB", "MiB", "gib", "x320", ",1", ",1,2", ",0,0,0,0,0", "ä", " "]);
    let number = prop_oneof![select(&EXTREMES).prop_map(str::to_owned), "[0-9]{1,3}(\\.[0-9]{0,2})?"];
    let value = prop_oneof![4 => (number, unit).prop_map(|(number, unit)| number + unit), 1 => "\\PC{0,12}"];
    hold((select(flags), value), |(flags, value)| {
        let words = ["plenoxel"].into_iter().chain(flags.split(' ')).chain([&value[..]]);
        try_arguments(&words.collect::<Vec<_>>());
    });
    let accepted = |line: &str| try_arguments(&line.split(' ').collect::<Vec<_>>());
    assert!(accepted("plenoxel train --time 5m --max-memory 8GiB --scene-size 32x24") && !accepted("plenoxel train --time 5d"));
}
