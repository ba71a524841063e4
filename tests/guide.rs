//! The guide and the other pages: their Rust code runs, the program accepts their command lines, and their links lead somewhere.
//!
//! Code of the guide is taken from the examples of the crates, which have tests of their own, or from this file.

use autograd::optim::Exponential;
use autograd::{Cotangent, Keep, Op, Real, Tensor, Vjp, gradcheck};
use glam::DVec3;
use ndarray::arr1;
use plenoxel::camera::Ray;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{self, Dataset, OpenOptions, Split, image};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::geometry::Aabb;
use plenoxel::loss::{Step, mse};
use plenoxel::model::plenoxels::config::{Config, Stage};
use plenoxel::model::plenoxels::{Objective, Trainer};
use plenoxel::render::{Engine, Field, Radiance, RenderOptions, render};
use plenoxel::sampling::{Jitter, Samples, Spacing};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

// Code that pages show.

/// y = arctan x.   ∂L/∂x = ∂L/∂y / (1 + x²)
fn arctan<T: Real>(x: &Tensor<T>) -> Tensor<T> {
    let values: Vec<T> = x.data().iter().map(|x| x.atan()).collect();
    Tensor::from_op(values.into(), x.shape(), &[x], Arctan)
}

#[derive(Debug)]
struct Arctan;
impl<T: Real> Op<T> for Arctan {
    fn name(&self) -> &'static str {
        "arctan"
    }
    fn keep(&self) -> Keep {
        Keep::INPUTS
    }
    fn vjp(&self, cx: &Vjp<'_, T>) -> Vec<Option<Cotangent<T>>> {
        vec![cx.wrt(0, || cx.cotangent() / (cx.input(0).square() + 1.0))]
    }
}

fn small_densities<T: Real, M: AsRef<VoxelGrid<T>>>(step: &Step<'_, T, M>) -> Tensor<T> {
    let grid: &VoxelGrid<T> = step.model.as_ref();
    let density = grid.params().into_iter().find(|param| param.name() == "density").expect("every grid has densities");
    density.tensor().square().mean()
}

struct Ball {
    radius: f64,
}

impl Field<f64> for Ball {
    fn density(&self, positions: &Tensor<f64>) -> Tensor<f64> {
        let distance = positions.square().sum_axis(1).sqrt();
        4.0 * (20.0 * (self.radius - distance)).sigmoid()
    }

    fn radiance(&self, samples: &Samples<f64>) -> Radiance<f64> {
        Radiance { sigma: self.density(&samples.positions), rgb: 0.5 + 0.5 * samples.positions.sin() }
    }
}

/// The training PSNR of the first and the last of a few steps on a tiny scene.
fn psnr_of_a_short_training(objective: Objective<f32>) -> (f64, f64) {
    let scene = ProceduralOptions { width: 16, height: 16, train: 6, val: 0, test: 0, supersample: 1 };
    let views = Dataset::procedural(scene).and_then(|scene| scene.load(Split::Train, &|_, _| {})).expect("the built-in scene");
    let config = Config { rays_per_step: 256, stages: vec![Stage::new(12, 40)], ..Config::default() };
    let mut trainer = Trainer::<f32>::with_objective(config, views, objective).expect("valid settings");
    let mut step = || trainer.step().expect("finite numbers").map(|report| report.psnr);
    let first = step().expect("a step");
    (first, std::iter::from_fn(step).last().expect("more steps"))
}

#[test]
fn the_losses_of_the_guide_train() {
    let objective = Objective::<f32>::new()
        .with("mse", 1.0, mse)
        .with("opaque", Exponential::new(1e-2, 1e-4, 200), |step| step.batch.mean(&(1.0 - &step.rendered.opacity)));
    let with_penalty = objective.with("small", 1e-6, small_densities);
    let (first, last) = psnr_of_a_short_training(with_penalty);
    assert!(last > first + 1.0, "{first} dB, then {last} dB");

    let objective = Objective::<f32>::new().with("bounded", 1.0, |step| {
        let error = (&step.prediction - &step.batch.target) * 4.0;
        step.batch.mean(&arctan(&error).square())
    });
    let (first, last) = psnr_of_a_short_training(objective);
    assert!(last > first + 1.0, "{first} dB, then {last} dB");
}

#[test]
fn the_op_of_the_guide_has_the_right_derivatives() {
    let report = gradcheck(|x| arctan(&x[0]), [arr1(&[-1.5, 0.2, 0.9]).into_dyn()]);
    assert!(report.worst_relative_error < 1e-6, "{}", report.worst_relative_error);
}

#[test]
fn the_field_of_the_guide_is_rendered() {
    let options = RenderOptions {
        aabb: Aabb::cube(1.0),
        spacing: Spacing::Step(0.05),
        jitter: Jitter::None,
        background: [1.0; 3],
        occupancy: None,
        engine: Engine::Graph,
        stop_below: 0.0,
    };
    let ray = Ray { origin: DVec3::new(0.0, 0.0, 4.0), direction: -DVec3::Z, stretch: 1.0 };
    let rendered = render(&Ball { radius: 0.5 }, &[ray], &options);
    // Fog of density 4 over a chord of about 1: 1 − e⁻⁴, less what the soft border lets through.
    let opacity = rendered.opacity.data()[0];
    assert!((opacity - 0.98).abs() < 0.01, "{opacity}");
}

#[test]
fn the_dataset_of_the_guide_is_read() {
    let page = page("docs/guide/your-data.md");
    let json = blocks(&page, "json").into_iter().next().expect("a transforms file");
    let folder = std::env::temp_dir().join(format!("plenoxel-guide-{}", std::process::id()));
    fs::create_dir_all(folder.join("train")).expect("a folder");
    fs::write(folder.join("transforms_train.json"), json).expect("a file");
    image::write_rgba(&folder.join("train/r_0.png"), &image::RgbaImage::new(8, 8)).expect("an image");
    let scene = dataset::open(&folder, &OpenOptions::default()).expect("the guide's own format");
    let views = scene.load(Split::Train, &|_, _| {}).expect("its image");
    // The camera is at (0, −4, 0) and looks at the origin.
    let (position, axis) = (views[0].camera.camera_to_world.translation, views[0].camera.camera_to_world.matrix3 * -DVec3::Z);
    assert_eq!((position, axis), (DVec3::new(0.0, -4.0, 0.0), DVec3::Y));
    fs::remove_dir_all(folder).expect("it was written");
}

// Checks of the pages.

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn page(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// Files of the repository with this ending, in folders that are neither hidden nor built.
fn files(ending: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut folders = vec![root().to_owned()];
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(&folder).expect("a folder").map(|entry| entry.expect("an entry").path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() && !name.starts_with('.') && !["target", "corpus", "data", "runs", "sweeps"].contains(&&*name) {
                folders.push(path);
            } else if path.extension().is_some_and(|found| found == ending) {
                files.push(path);
            }
        }
    }
    files.sort();
    files
}

/// Pages of the guide.
fn guide() -> Vec<PathBuf> {
    files("md").into_iter().filter(|path| path.starts_with(root().join("docs/guide"))).collect()
}

/// Fenced blocks of this language.
fn blocks(page: &str, language: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut lines = page.lines();
    while let Some(line) = lines.next() {
        if let Some(found) = line.strip_prefix("```") {
            let inside: String = lines.by_ref().take_while(|line| !line.starts_with("```")).flat_map(|line| [line, "\n"]).collect();
            if found == language {
                blocks.push(inside);
            }
        }
    }
    blocks
}

#[test]
fn rust_code_of_the_guide_is_taken_from_programs_that_run() {
    let mut programs = vec![page("tests/guide.rs")];
    for folder in ["plenoxel/examples", "autograd/examples"] {
        programs.extend(files("rs").iter().filter(|path| path.starts_with(root().join(folder))).map(|path| page(&path.to_string_lossy())));
    }
    let mut count = 0;
    for path in guide() {
        for block in blocks(&page(&path.to_string_lossy()), "rust") {
            count += 1;
            assert!(
                programs.iter().any(|program| program.contains(&block)),
                "{}: in no example, and not in tests/guide.rs:\n{block}",
                path.display()
            );
        }
    }
    assert!(count > 12, "{count} blocks");
}

#[test]
fn command_lines_of_all_pages_are_accepted() {
    let mut count = 0;
    for path in files("md") {
        for block in blocks(&page(&path.to_string_lossy()), "sh") {
            for line in block.lines() {
                let line = line.split(" #").next().unwrap_or_default();
                let Some(arguments) = line.strip_prefix("plenoxel ").or_else(|| line.strip_prefix("cargo run --release -- ")) else {
                    continue;
                };
                count += 1;
                let words: Vec<&str> = ["plenoxel"].into_iter().chain(arguments.split_whitespace()).collect();
                // Help is an answer too.
                let refused = plenoxel_cli::parsers::arguments(&words).err().filter(|message| message.starts_with("error"));
                assert!(refused.is_none(), "{}: {line}\n{refused:?}", path.display());
            }
        }
    }
    assert!(count > 45, "{count} command lines");
}

/// Anchors of the headings of a page, as GitHub and mdBook make them.
fn anchors(page: &str) -> BTreeSet<String> {
    let mut anchors = BTreeSet::new();
    let mut in_code = false;
    for line in page.lines() {
        in_code ^= line.starts_with("```");
        let heading = line.trim_start_matches('#');
        if in_code || heading.len() == line.len() || !heading.starts_with(' ') {
            continue;
        }
        // The text of a link counts, its target does not.
        let mut parts = heading.trim().split("](");
        let first = parts.next().unwrap_or_default().to_owned();
        let text = parts.fold(first, |text, part| text + part.split_once(')').map_or(part, |(_, rest)| rest));
        // Superscripts are left out: GitHub and mdBook do not agree about them.
        let kept =
            text.to_lowercase().chars().filter(|c| (c.is_alphanumeric() || " -_".contains(*c)) && !"²³".contains(*c)).collect::<String>();
        let anchor = kept.replace(' ', "-");
        let number = (0..).find(|k| !anchors.contains(&numbered(&anchor, *k))).unwrap_or_default();
        anchors.insert(numbered(&anchor, number));
    }
    anchors
}

fn numbered(anchor: &str, number: usize) -> String {
    if number == 0 { anchor.to_owned() } else { format!("{anchor}-{number}") }
}

/// Targets of the links and pictures of a page, outside of code.
fn links(page: &str) -> Vec<String> {
    let mut links = Vec::new();
    let mut in_code = false;
    for line in page.lines() {
        in_code ^= line.starts_with("```");
        if in_code {
            continue;
        }
        // Code in a line stands between backticks; the text of a link may have them.
        let text: String = line.split("`").enumerate().filter(|(i, _)| i % 2 == 0).map(|(_, part)| part).collect();
        links.extend(text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0.to_owned())));
        if let Some((_, target)) = text.strip_prefix('[').and_then(|rest| rest.split_once("]: ")) {
            links.push(target.to_owned());
        }
    }
    links
}

#[test]
fn links_of_all_pages_lead_to_files_and_headings() {
    let mut count = 0;
    let mut broken = Vec::new();
    for path in files("md") {
        let from = page(&path.to_string_lossy());
        for link in links(&from) {
            // Paths of Rust items are checked by `cargo doc`.
            if link.contains("://") || link.contains("::") || link.ends_with("()") {
                continue;
            }
            count += 1;
            let (file, anchor) = link.split_once('#').unwrap_or((&link, ""));
            let target = if file.is_empty() { path.clone() } else { path.parent().expect("a folder").join(file) };
            let is_there = target.exists();
            if !is_there || !anchor.is_empty() && !anchors(&page(&target.to_string_lossy())).contains(anchor) {
                broken.push(format!("{}: {link}", path.strip_prefix(root()).unwrap_or(&path).display()));
            }
        }
    }
    assert!(broken.is_empty(), "broken links:\n{}", broken.join("\n"));
    assert!(count > 100, "{count} links");
}

#[test]
fn the_summary_of_the_guide_lists_every_page() {
    let listed: BTreeSet<String> = links(&page("docs/guide/SUMMARY.md")).into_iter().collect();
    let pages: BTreeSet<String> = guide()
        .iter()
        .filter_map(|path| Some(path.file_name()?.to_string_lossy().into_owned()))
        .filter(|name| name != "SUMMARY.md")
        .collect();
    assert_eq!(listed, pages);
}
