//! `plenoxel bake`: turns the field of a model without voxels into a voxel grid, as a new run.

use super::new_run::loading;
use super::{beside, whole};
use crate::images;
use crate::progress::Console;
use crate::report::Report;
use clap::{Args, ValueHint};
use ndarray::Array3;
use plenoxel::bake::{BakeOptions, OFFSET, Source, bake};
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::{Error, Result};
use plenoxel::evaluate::{Scores, ViewScore, Viewer};
use plenoxel::field::voxel_grid::Interpolation;
use plenoxel::loss::POSES;
use plenoxel::model::plenoxels::Plenoxels;
use plenoxel::model::plenoxels::config::{ColorKind, Config, OptimizerConfig, Sampling, Stage};
use plenoxel::model::{self, Model};
use plenoxel::run::data::DataSource;
use plenoxel::run::evenly_spaced;
use plenoxel::run::figures::Figures;
use plenoxel::run::folder::{Baked, NewFolder, RunFolder, RunKind, RunRecord};
use plenoxel::run::memory::{self, Estimate, Stored};
use plenoxel::run::training::Stopwatch;
use plenoxel::space::Space;
use plenoxel::train::{About, ViewOptions};
use serde::Serialize;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel bake runs/field                       write runs/field-baked
  plenoxel bake runs/field --resolution 256      with fewer voxels
  plenoxel export mesh runs/field-baked
  plenoxel train data/lego --config runs/field-baked/config.toml --init-from runs/field-baked --time 2m
                                                 train the grid on the photographs

The result is a run folder for evaluate, render, view, report and, if its space is a box of the world, export. A grid has smoother colors than the field: the command prints the PSNR of both \
on up to 25 test views. If stdout is not a terminal, its last line is a JSON object with the results.";

/// Most voxels of a grid whose resolution is not given.
const MOST_VOXELS: usize = 8_000_000;
/// Sampling of the grids of captures. The usual step of half a voxel has twice the samples, and 0.03 dB more on bonsai.
const STEP_OF_CAPTURES: Sampling = Sampling::Step { step: 1.0 };
/// Stage of a run that starts from the grid, about two minutes on two cores. Held-out views of bonsai after 500 steps (4.1 M rays), from 25.20 dB: 26.22 dB with a
/// color rate of 6e-3, 26.16 dB with 3e-3; 26.15 dB with a density rate of 6; 26.0 dB with harmonics of 27 voxels together.
const FINE_TUNING: Stage = Stage {
    resolution: 0,
    epochs: None,
    steps: Some(1500),
    sampling: Sampling::Step { step: 1.0 },
    image_reduction: 1,
    density_rate: 0.0,
    color_rate: 5e-3,
    harmonics_rate: None,
    density_warm_up: 0,
    rate_decay: 0.15,
    color_decay: None,
};
/// Learning rate of densities in that stage, for each voxel per side: the density of an opaque voxel grows with them.
const DENSITY_RATE: f64 = 7.5e-3;
/// Most test views on which the field and the grid are compared.
const COMPARED: usize = 25;

/// Turn the field of a model (presets quality, photos, tensorf, dvgo, ngp, nerf) into a voxel grid with spherical harmonics, for exports and faster pictures
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct BakeArgs {
    /// Run folder of the model, written by `plenoxel train`
    #[arg(value_hint = ValueHint::DirPath)]
    run: PathBuf,

    /// Use best.safetensors, the checkpoint with the best validation PSNR, instead of the final field
    #[arg(long)]
    best: bool,

    /// Voxels per side of the box [default: as many as the field has cells, at most 512; fewer if more than 8 million voxels would be opaque]
    #[arg(long, value_name = "N", help_heading = "Model", value_parser = whole::<usize>(2, 1024), allow_negative_numbers = true)]
    resolution: Option<usize>,

    /// Degree of spherical harmonics for view-dependent color, 0 to 3
    #[arg(long, value_name = "N", help_heading = "Model", default_value_t = 2, value_parser = whole::<usize>(0, 3), allow_negative_numbers = true)]
    sh_degree: usize,

    /// Dataset folder, if it has moved [default: that of the training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Run folder to write [default: RUN-baked]
    #[arg(long, short, help_heading = "Output", value_hint = ValueHint::DirPath)]
    out: Option<PathBuf>,

    /// Overwrite an existing run in the folder
    #[arg(long, help_heading = "Output")]
    force: bool,

    /// Write no report.html
    #[arg(long, help_heading = "Output")]
    no_report: bool,
}

/// Bakes a field and writes a run folder.
pub fn run(args: &BakeArgs, console: &Console<'_>) -> Result<()> {
    let (source, config, record) = RunFolder::open(&args.run)?;
    let source = if args.best { source.with_best()? } else { source };
    let path = source.existing_checkpoint()?;
    if model::kind(&path)? == model::plenoxels::KIND {
        return Err(Error::input(&path, "this is a voxel grid already", "export it without `plenoxel bake`"));
    }
    let stored = Stored::read(&path)?;
    let data = args.data.as_deref().map_or(record.data, DataSource::folder);
    let dataset = data.reopen(&config)?;
    let out = args.out.clone().map_or_else(|| beside(&args.run, "baked"), Ok)?;
    let folder = NewFolder::choose(Some(&out), dataset.name(), args.force)?;
    let estimate = Estimate::of_evaluation(&config, config.evaluation, &stored, Some((&dataset, Split::Test, COMPARED)));
    console.note(&estimate.describe());
    estimate.check()?;
    let (trained, about) = model::open(&path, &config)?;
    let Some(field) = Source::of(&*trained) else {
        return Err(Error::input(
            &path,
            format!("a model of kind `{}` cannot be baked", trained.kind()),
            "use a run of preset quality, photos, tensorf, dvgo, ngp or nerf",
        ));
    };

    let options = BakeOptions {
        resolution: args.resolution.unwrap_or_else(|| field.resolution()),
        most_voxels: if args.resolution.is_some() { usize::MAX } else { MOST_VOXELS },
        degree: args.sh_degree,
        least_weight: field.least_weight(),
    };
    let mut clock = Stopwatch::default();
    let count = console.count("baking, voxel", 1);
    let cameras = dataset.cameras(Split::Train);
    let grid = clock.time(|| bake(field, &options, &cameras, &|done, all| count.at(done, all)))?;
    drop(count);
    let (voxels, resolution) = (grid.lattice().present(), grid.shape().resolution);
    if resolution < options.resolution {
        let wanted = options.resolution;
        console.note(&format!(
            "{resolution} voxels per side instead of {wanted}: most of the box is opaque, and a grid has at most {MOST_VOXELS} voxels unless --resolution is given"
        ));
    }
    console.note(&format!("baked {voxels} voxels at {resolution}³ in {:.1} s", clock.seconds()));

    let folder = folder.create()?;
    let config = config_of_grid(config, &field, &options, resolution);
    let from = source.path().canonicalize().unwrap_or_else(|_| source.path().to_owned());
    let baked = Baked { run: from, resolution, sh_degree: options.degree };
    let new = RunRecord::new(RunKind::Baked, &dataset, record.preset.as_deref(), &data);
    let record = RunRecord { baked: Some(baked), to_world: record.to_world.or(new.to_world), ..new };
    folder.describe(&config, &record)?;
    let model = Plenoxels::of_grid(&config, grid);
    folder.save(&model, &About { step: about.step, seed: about.seed, scene: about.scene, background: config.background })?;

    let view = ViewOptions::over(config.background);
    let Compared { of_field, of_grid } = compare(&*trained, &model, &dataset, &data, &folder, console)?;
    let summary = Summary {
        figures: Figures::new(&of_grid, Split::Test, &dataset, &config, &model, &view),
        psnr_of_field: of_field.psnr(),
        seconds: clock.seconds(),
        peak_memory_bytes: memory::peak(),
        voxels,
        scene: dataset.name().to_owned(),
        run: folder.path().display().to_string(),
        per_view: of_grid.per_view,
    };
    folder.write_result(&summary)?;
    console.result(&summary.sentence())?;
    console.result(&format!("run folder: {}", folder.path().display()))?;
    console.record(&summary)?;
    let [grid, settings] = [folder.path().to_owned(), folder.path().join("config.toml")].map(|path| DataSource::folder(&path).arguments());
    let data = data.arguments();
    console.note(&format!("to train the grid on the photographs: plenoxel train{data} --config{settings} --init-from{grid} --time 2m"));
    if !args.no_report {
        let report = Report { folder: &folder, config: &config, record: &record, dataset: &dataset, model: Some(&model) };
        console.note(&report.write(console)?);
    }
    Ok(())
}

/// Returns the config of the grid of a field, with which its training can go on (`init_from`).
fn config_of_grid(config: Config, field: &Source<'_>, options: &BakeOptions, resolution: usize) -> Config {
    let in_box = field.space == Space::Box;
    let mut config = Config {
        color: ColorKind::Sh,
        sh_degree: options.degree,
        sh_offset: OFFSET,
        sh_reduction: 1,
        interpolation: Interpolation::Trilinear,
        group_in_pictures: config.tensorf.as_ref().filter(|_| !in_box).map_or(0.0, |recipe| recipe.group_in_pictures),
        evaluation: if in_box { config.evaluation } else { STEP_OF_CAPTURES },
        stages: vec![Stage { resolution, density_rate: DENSITY_RATE * resolution as f64, ..FINE_TUNING }],
        optimizer: OptimizerConfig::LazyAdam { beta1: 0.5, beta2: 0.99, epsilon: 1e-12 },
        rays_per_step: 8192,
        stop_below: 1e-3,
        // Of 0.04 and 0.1, the larger weight leaves three quarters of the voxels and the same PSNR.
        prune_from_stage: Some(0),
        prune_unseen_below: 0.1,
        scout: None,
        tensorf: None,
        dvgo: None,
        ngp: None,
        nerf: None,
        ..config
    };
    // Voxels have no gradients of poses.
    config.losses.remove(POSES);
    config.loss_rates.remove(POSES);
    config
}

/// Scores on the same test views.
struct Compared {
    of_field: Scores,
    of_grid: Scores,
}

/// Compares the field and the baked grid with test views, and draws the first of them.
fn compare(
    field: &dyn Model<f32>,
    grid: &Plenoxels<f32>,
    dataset: &Dataset,
    data: &DataSource,
    folder: &RunFolder,
    console: &Console<'_>,
) -> Result<Compared> {
    let chosen = evenly_spaced(dataset.count(Split::Test), COMPARED);
    let count = console.count(&loading(Split::Test, data), chosen.len());
    let views = dataset.load_views(Split::Test, &chosen, &|done, all| count.at(done, all))?;
    drop(count);
    let view = ViewOptions::over(grid.config().background);
    let mut strip: Vec<Array3<f32>> = Vec::new();
    let mut scores = |model: &dyn Model<f32>, what: &str| {
        let count = console.count(&format!("evaluating the {what}"), views.len());
        Viewer::of(model, &view).compare(&views, |i, _: &View, target, picture| {
            count.at(i + 1, views.len());
            if i == 0 {
                strip.extend(strip.is_empty().then(|| target.clone()));
                strip.push(picture.rgb.clone());
            }
            Ok(())
        })
    };
    let compared = Compared { of_field: scores(field, "field")?, of_grid: scores(grid, "baked grid")? };
    if !strip.is_empty() {
        folder.create_images()?;
        images::write(&folder.image("baked.png"), &images::strip(&strip.iter().collect::<Vec<_>>()))?;
    }
    Ok(compared)
}

/// Final figures. `seconds` is the time of baking alone.
#[derive(Debug, Serialize)]
struct Summary {
    #[serde(flatten)]
    figures: Figures,
    /// Mean PSNR of the field on the same views.
    psnr_of_field: Option<f64>,
    seconds: f64,
    peak_memory_bytes: Option<u64>,
    voxels: usize,
    scene: String,
    run: String,
    per_view: Vec<ViewScore>,
}

impl Summary {
    /// The quality in one sentence, with what baking costs.
    fn sentence(&self) -> String {
        let sentence = self.figures.sentence();
        match (self.psnr_of_field, self.figures.psnr()) {
            (Some(field), Some(grid)) => {
                let (difference, side) = ((field - grid).abs(), if grid <= field { "below" } else { "above" });
                format!("{sentence}; {difference:.1} dB {side} the field, which has {field:.2} dB")
            }
            _ => sentence,
        }
    }
}
