//! `plenoxel info`: describes a run, a checkpoint or a dataset, and the machine.

mod cameras;

use super::capture::CaptureFlags;
use crate::images;
use crate::progress::Console;
use clap::{Args, ValueHint};
use plenoxel::camera::lens::Lens;
use plenoxel::camera::placement::Placement;
use plenoxel::checkpoint::{self, Header};
use plenoxel::dataset::{self, Dataset, OpenOptions, Split};
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::files;
use plenoxel::geometry::Aabb;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::{self, plenoxels};
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::{RunFolder, RunKind};
use plenoxel::run::machine;
use plenoxel::run::memory::{self, bytes};
use plenoxel::space::Space;
use plenoxel::tensor_file::TensorFile;
use plenoxel::text::clock;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel info                                    describe this machine
  plenoxel info data/lego                          describe a dataset
  plenoxel info runs/lego                          describe a run
  plenoxel info runs/lego/checkpoint.safetensors   describe a trained grid";

/// Describe a run, a checkpoint or a dataset: format, sizes, conventions and memory
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct InfoArgs {
    /// Run folder, checkpoint or dataset folder [default: describe the machine only]
    #[arg(value_hint = ValueHint::AnyPath)]
    path: Option<PathBuf>,

    /// Write a picture of the cameras of a dataset, from above and from the side, as PNG
    #[arg(long, value_name = "FILE", requires = "path", value_hint = ValueHint::FilePath)]
    cameras: Option<PathBuf>,

    #[command(flatten)]
    capture: CaptureFlags,
}

/// Prints the description of a path.
pub fn run(args: &InfoArgs, console: &Console<'_>) -> Result<()> {
    if let Some(path) = &args.path {
        let lines = describe(path, args)?;
        lines.iter().try_for_each(|(key, value)| row(console, key, value))?;
    }
    row(console, "instructions", machine::instruction_set())?;
    row(console, "threads", &machine::threads().to_string())?;
    if let Some(available) = memory::available() {
        row(console, "free memory", &bytes(available))?;
    }
    row(console, "program", crate::PROGRAM)
}

type Lines = Vec<(&'static str, String)>;

fn row(console: &Console<'_>, key: &str, value: &str) -> Result<()> {
    console.result(&format!("{key:14} {value}"))
}

fn describe(path: &Path, args: &InfoArgs) -> Result<Lines> {
    let is_run = files::is_there(&path.join("run.json"));
    if let (Some(_), true) = (&args.cameras, is_run || path.is_file()) {
        return Err(Error::usage("--cameras", format!("{} is no dataset folder", path.display()), "give the folder of a dataset"));
    }
    if path.is_file() {
        if let Some(lines) = of_other_kind(path)? {
            return Ok(lines);
        }
        let (grid, header) = checkpoint::load(path)?;
        let mut lines = vec![("checkpoint", path.display().to_string())];
        lines.extend(of_grid(&grid, &header));
        return Ok(lines);
    }
    if is_run {
        return of_run(path);
    }
    if !files::is_there(path) {
        return Err(Error::input(path, "this path does not exist", "give a run folder, a dataset folder or a checkpoint"));
    }
    let opened = dataset::open(path, &OpenOptions { capture: args.capture.options()?, ..OpenOptions::default() });
    let dataset = opened.map_err(|e| match e {
        // An error about the folder, not about a file in it.
        Error::Input { path: about, found, remedy } if about == path && path.is_dir() => {
            let found = format!("this is neither a run folder (it has no run.json) nor a dataset ({found})");
            Error::input(about, found, remedy)
        }
        Error::Config { .. } => super::as_flag(e),
        other => other,
    })?;
    let mut lines = of_dataset(path, &dataset);
    if let Some(out) = &args.cameras {
        super::check_replaceable(out, &[], Some(path)).map_err(|e| e.with_key(|_| "--cameras".to_owned()))?;
        images::write(out, &cameras::picture(&dataset))?;
        lines.push(("picture", format!("{}, from above on the left and from the side on the right", out.display())));
    }
    Ok(lines)
}

/// Describes the checkpoint of a custom model: its kind and its parameters. Returns `None` for a voxel grid.
fn of_other_kind(path: &Path) -> Result<Option<Lines>> {
    let kind = model::kind(path)?;
    if kind == plenoxels::KIND {
        return Ok(None);
    }
    let about = match model::KINDS.contains(&&kind[..]) {
        true => "no voxel grid; `evaluate` and `render` read it",
        false => "a custom model; the program that trained it can render and evaluate it",
    };
    let file = TensorFile::open(path)?;
    let mut lines = vec![("checkpoint", path.display().to_string()), ("kind", format!("{kind}: {about}"))];
    lines.extend(file.tensors().into_iter().map(|(name, shape)| ("parameter", format!("{name} {shape:?}"))));
    Ok(Some(lines))
}

fn of_run(path: &Path) -> Result<Lines> {
    let (folder, config, record) = RunFolder::open(path)?;
    let kind = record.kind;
    let mut lines = vec![
        ("run", path.display().to_string()),
        ("scene", format!("{}, {}", record.scene, record.format)),
        ("created by", format!("{} with {}", record.program, record.instruction_set)),
        ("preset", record.preset.unwrap_or_else(|| "none".to_owned())),
    ];
    let data = match &record.data {
        DataSource::Folder { path } if !path.exists() => format!("{}, which no longer exists", path.display()),
        source => source.to_string(),
    };
    lines.push(("data", data));
    let result = folder.result()?;
    // For small images, grids are smaller than configured.
    let trained: Option<Vec<u64>> =
        result.as_ref().and_then(|result| result["stages"].as_array()?.iter().map(|stage| stage["resolution"].as_u64()).collect());
    let stages = trained.unwrap_or_else(|| config.resolutions().map(|resolution| resolution as u64).collect());
    let stages: Vec<String> = stages.iter().map(|resolution| format!("{resolution}³")).collect();
    lines.push(("stages", if kind == RunKind::Trained { stages.join(", ") } else { format!("none: the grid was {}", kind.name()) }));
    lines.extend(record.baked.map(|baked| ("baked from", baked.run.display().to_string())));
    lines.extend(
        record
            .imported
            .map(|from| ("imported from", format!("{}, {}, scene_scale {:.4}", from.file.display(), from.format, from.scene_scale))),
    );
    if folder.checkpoint().exists() {
        match of_other_kind(&folder.checkpoint())? {
            Some(other) => lines.extend(other),
            None => {
                let (grid, header) = checkpoint::load(&folder.checkpoint())?;
                lines.extend(of_grid(&grid, &header));
            }
        }
    } else {
        lines.push(("grid", "none: the run is not finished".to_owned()));
    }
    if kind == RunKind::Trained && folder.existing_state().is_ok() {
        lines.push(("resume with", format!("plenoxel train --resume {}", path.display())));
    }
    if let Some(result) = result {
        let number = |key: &str| result[key].as_f64();
        if let (Some(psnr), Some(seconds)) = (number("psnr"), number("seconds")) {
            let ssim = number("ssim").map_or(String::new(), |ssim| format!(", SSIM {ssim:.4}"));
            lines.push(("test", format!("PSNR {psnr:.2} dB{ssim}, {} in {}", kind.name(), clock(seconds))));
        }
    }
    Ok(lines)
}

fn steps(count: u64) -> String {
    if count == 0 { "no: carved".to_owned() } else { format!("{count} steps") }
}

fn of_grid(grid: &VoxelGrid<f32>, header: &Header) -> Lines {
    let shape = grid.shape();
    let n = shape.resolution;
    let color = match header.sh_degree {
        None => "RGB".to_owned(),
        Some(degree) => {
            let means = if shape.is_reduced() {
                format!(", degree 1 and higher on a {} times coarser grid", shape.sh_reduction)
            } else {
                String::new()
            };
            format!("spherical harmonics of degree {degree}, offset {}{means}", header.sh_offset)
        }
    };
    let density = grid.density.tensor().data();
    let (present, all) = (grid.lattice().present() as f64, shape.voxels() as f64);
    let matter = grid.voxels_where(|row| density[row] > 0.0).fraction();
    let largest = density.iter().copied().fold(0.0, f32::max);
    let of_space = match shape.coordinates.space {
        Space::Box => String::new(),
        other => format!(" of the space `{other}`"),
    };
    vec![
        ("grid", format!("{n}³ voxels of side {:.5} in [-{w}, {w}]³{of_space}", shape.voxel_side(), w = shape.half_width)),
        ("convention", header.convention.clone()),
        ("interpolation", format!("{:?}", shape.interpolation).to_lowercase()),
        ("color", color),
        ("stored", format!("{present} voxels, {:.1} % of the box", 100.0 * present / all)),
        ("density", format!("above 0 in {:.1} % of the box, at most {largest:.1} per unit length", 100.0 * matter)),
        ("background", format!("{:?}", header.background)),
        ("memory", bytes(grid.params().map(|table| size_of_val(table.tensor().data()) as u64).sum())),
        ("trained", format!("{}, {}, seed {}, by {}", steps(header.step), header.scene, header.seed, header.writer)),
    ]
}

fn lens(lens: &Lens) -> &'static str {
    match lens {
        Lens::Pinhole => "pinhole",
        Lens::Perspective(_) => "perspective with distortion",
        Lens::Fisheye(_) => "fisheye",
        Lens::Fov { .. } => "field-of-view model",
    }
}

/// The sizes of the images, the most frequent first.
fn sizes(dataset: &Dataset) -> String {
    const SHOWN: usize = 4;
    let sizes = dataset.sizes();
    if let [((width, height), _)] = sizes[..] {
        return format!("{width} x {height} pixels");
    }
    let shown: Vec<String> = sizes.iter().take(SHOWN).map(|((width, height), count)| format!("{count} of {width} x {height}")).collect();
    let more = if sizes.len() > SHOWN { format!(", {} more sizes", sizes.len() - SHOWN) } else { String::new() };
    format!("{}{more} pixels", shown.join(", "))
}

fn of_dataset(path: &Path, dataset: &Dataset) -> Lines {
    let (width, height) = dataset.size();
    let views = Split::ALL.map(|split| format!("{} {split}", dataset.count(split)));
    let all: usize = Split::ALL.iter().map(|split| dataset.count(*split)).sum();
    // The world of NDC is the frame of the mean camera.
    let up = if matches!(dataset.space(), Space::Ndc { .. }) { "y up" } else { "z up" };
    let mut lines = vec![
        ("dataset", path.display().to_string()),
        ("scene", dataset.name().to_owned()),
        ("format", dataset.format().to_owned()),
        ("views", views.join(", ")),
        ("size", sizes(dataset)),
        ("memory", format!("{} as 8-bit RGBA", bytes((4 * width * height * all) as u64))),
        ("convention", format!("camera to world; camera axes x right, y up, z backwards (OpenGL); world {up}")),
    ];
    lines.extend(dataset.notes().iter().map(|note| ("note", note.clone())));
    lines.extend(dataset.normalization().describe().iter().cloned());
    if !dataset.points().is_empty() {
        lines.push(("points", format!("{} of structure from motion", dataset.points().len())));
    }
    let cameras: Vec<_> = Split::ALL.iter().flat_map(|split| dataset.cameras(*split)).collect();
    let distances = cameras.iter().map(|camera| camera.position().length());
    let nearest = distances.clone().fold(f64::INFINITY, f64::min);
    let farthest = distances.fold(0.0, f64::max);
    // Only a box can be missed by cameras.
    if dataset.space() == Space::Box {
        let Placement { hopeless, warnings } = Placement::of(&dataset.cameras(Split::Train), Aabb::cube(Config::default().half_width));
        let findings = hopeless.map(|found| found.join("; ")).into_iter().chain(warnings);
        lines.extend(findings.map(|finding| ("warning", finding)));
    }
    let lenses: BTreeSet<&str> = cameras.iter().map(|camera| lens(&camera.intrinsics.lens)).collect();
    lines.push(("lens", lenses.into_iter().collect::<Vec<_>>().join(", ")));
    if let Some(camera) = cameras.first() {
        let k = &camera.intrinsics;
        let fov = k.fov_x().to_degrees();
        lines.push((
            "cameras",
            format!(
                "focal length {:.2} pixels (horizontal field of view {fov:.1}°), distance from the origin {nearest:.3} to {farthest:.3}",
                k.fx
            ),
        ));
    }
    lines
}
