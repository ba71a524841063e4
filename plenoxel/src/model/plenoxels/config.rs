//! Every setting of a run: its meaning, its unit, and where its default comes from.
//!
//! The same struct is the file `config.toml` of a run, a preset, and what flags change.

use super::objective::{LEARNED_LOSSES, LOSSES};
use crate::camera::Camera;
use crate::carve::{CarveConfig, CarveOptions};
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::render::{Engine, RenderOptions};
use crate::sampling::{Jitter, Spacing};
use crate::train::TrainOptions;
use autograd::Real;
use autograd::optim::{Exponential, Piecewise, Schedule};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The most stages of a run.
const MOST_STAGES: usize = 100;

/// A run, completely: the same config and the same data give the same bits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Seed of everything random.
    pub seed: u64,
    /// Images are reduced by this factor, with a box filter.
    pub downscale: usize,
    /// Where a dataset has no validation file, every n-th training view is held out for validation; 0 holds out none.
    pub validation_every: usize,
    /// Color behind the scene, sRGB in [0, 1]. White is what published figures use.
    pub background: [f32; 3],
    /// Half the side of the cube in which the scene lies, in the dataset's units.
    pub half_width: f64,
    /// Look-up between voxel centres.
    pub interpolation: Interpolation,
    /// Meaning of a voxel's color.
    pub color: ColorKind,
    /// Degree of the harmonics, 0 to 3, where `color = "sh"`.
    pub sh_degree: usize,
    /// Harmonics of degree 1 and more are stored for every so many voxels along each axis, the mean color for each; 1 for all coefficients in
    /// every voxel. Where there are no such harmonics it means nothing, and carving finds all coefficients for each voxel.
    #[serde(default = "one")]
    pub sh_reduction: usize,
    /// Color of zero coefficients: 0.5 in svox2, 0 in the source paper.
    pub sh_offset: f64,
    /// What computes the pixels.
    pub engine: Engine,
    /// Training rays end where less than this share of the light comes from behind; 0 for never. (The graph never does.)
    pub stop_below: f64,
    /// Rays in a step.
    pub rays_per_step: usize,
    /// Draw no rays that see nothing but empty space: only those of pixels around the projections of what is left of the grid. Where a stage
    /// begins without empty space, all are drawn. Needs no alpha.
    #[serde(default)]
    pub aim: bool,
    /// Shift the samples of each training ray by a random fraction of a step.
    pub jitter: bool,
    /// Clamp densities to >= 0 and RGB colors to [0, 1] after each step.
    pub project: bool,
    /// Stages have no more voxels than would be this many pixels wide in a cube of the configured half width, seen from as far as the mean camera is;
    /// 0 for no such bound. Silhouettes and a scout shrink the cube afterwards, and with it the voxels. See [`Config::fitted_to`].
    #[serde(default)]
    pub pixels_per_voxel: f64,
    /// From this stage on (counted from 0), voxels that at the stage's start have, with all their neighbours, a density of at most
    /// `prune_below` are taken out of the grid: they are empty from then on, and are not looked at.
    pub prune_from_stage: Option<usize>,
    /// Density, 1 / world length, at which a voxel counts as empty when pruning.
    pub prune_below: f64,
    /// When pruning, voxels go too that no training ray sees: those whose largest weight, and that of all voxels within two, is below this
    /// share of a pixel. Of the pixels as many are looked along as make eight rays through every voxel. 0 for none; svox2: 0.256 / voxels a side.
    pub prune_unseen_below: f64,
    /// A short run before the first stage, where no silhouettes and no other run say which voxels exist: those of its grid that are worth
    /// keeping do, and those of the visual hull of their silhouettes; the cube becomes as small as the first allow, again at each finer stage
    /// that prunes, and training starts from `initial`. Needs no alpha.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scout: Option<Scout>,
    /// Folder of the run whose grid training starts from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_from: Option<PathBuf>,
    /// What silhouettes may decide where images have alpha.
    #[serde(default)]
    pub hull: Hull,
    /// Values before the first step.
    pub initial: Initial,
    /// How gradients change the grid.
    pub optimizer: OptimizerConfig,
    /// Weight of each loss: a number, `{ weight, until }` for one that ends, or `{ from, to, steps }` for an exponential change over the run.
    pub losses: BTreeMap<String, Weight>,
    /// Learning rates of losses that have parameters (`robust`, `exposure`), by the name of the loss, where they differ from the loss's own.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub loss_rates: BTreeMap<String, f64>,
    /// Coarse to fine.
    pub stages: Vec<Stage>,
    /// Where samples lie when images are rendered for pictures and figures.
    pub evaluation: Sampling,
    /// How to carve, where a run does.
    #[serde(default)]
    pub carve: CarveConfig,
}

/// What silhouettes may decide in training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Hull {
    /// Where images have alpha: the size of the cube, and which voxels exist.
    Auto,
    /// Nothing: alpha is for compositing over the background only.
    #[default]
    Off,
}

/// Meaning of a voxel's color.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorKind {
    /// Red, green, blue.
    Rgb,
    /// Spherical harmonics.
    Sh,
}

/// Values before the first step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Initial {
    /// Density, 1 / world length.
    pub density: f64,
    /// Every color number.
    pub color: f64,
    /// Draw uniformly from [0, value) instead.
    pub random: bool,
}

/// How gradients change the grid. Rates are of the stages.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum OptimizerConfig {
    /// θ ← θ − rate · g
    Sgd,
    /// Momentum of this decay.
    Momentum {
        /// Share of the velocity that stays.
        decay: f64,
    },
    /// svox2's.
    RmsProp {
        /// Decay of the mean square.
        beta: f64,
        /// Added to its root.
        epsilon: f64,
    },
    /// Adam on touched rows only.
    LazyAdam {
        /// Decay of the mean.
        beta1: f64,
        /// Decay of the mean square.
        beta2: f64,
        /// Added to its root.
        epsilon: f64,
    },
}

/// A weight of a loss over the steps of the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum Weight {
    /// The same all the time.
    Constant(f64),
    /// The same up to a step, and nothing from then on.
    Until {
        /// Before `until`.
        weight: f64,
        /// The first step without it.
        until: u64,
    },
    /// Log-linear from one to the other over so many steps, then constant.
    Exponential {
        /// At step 0.
        from: f64,
        /// From `steps` on.
        to: f64,
        /// Length of the change.
        steps: u64,
    },
}

impl Weight {
    /// The weight at a step.
    pub fn at(&self, step: u64) -> f64 {
        match *self {
            Weight::Constant(weight) => weight,
            Weight::Until { weight, until } => Piecewise::new(weight).then(until, 0.0).at(step),
            Weight::Exponential { from, to, steps } => Exponential::new(from, to, steps).at(step),
        }
    }
}

impl Schedule for Weight {
    fn at(&self, step: u64) -> f64 {
        self.at(step)
    }
}

/// A resolution, and how long it is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Voxels along each axis.
    pub resolution: usize,
    /// Length in epochs over all training pixels; exactly one of `epochs` and `steps` is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs: Option<f64>,
    /// Length in steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Where samples lie.
    pub sampling: Sampling,
    /// Images are reduced by this factor while the stage lasts, or by the largest below it that divides their sides: one ray then says what
    /// many pixels show, which is all that large voxels can tell. An epoch is of the images as they were.
    #[serde(default = "one")]
    pub image_reduction: usize,
    /// Learning rate of the density, at the stage's start.
    pub density_rate: f64,
    /// Learning rate of the colors, at the stage's start.
    pub color_rate: f64,
    /// Learning rate of harmonics that are reduced, at the stage's start; without it `color_rate`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub harmonics_rate: Option<f64>,
    /// Steps over which the density's rate rises from a hundredth of itself, along a quarter of a sine (svox2's delay); 0 for none.
    #[serde(default)]
    pub density_warm_up: u64,
    /// All rates fall exponentially to this share of themselves at the stage's end; 1 keeps them.
    #[serde(default = "one")]
    pub rate_decay: f64,
    /// The same for the rates of colors and harmonics, if they fall otherwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color_decay: Option<f64>,
}

/// How to find out where matter is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scout {
    /// Density before the first step, 1 / world length: thin enough that light gets through the cube.
    pub density: f64,
    /// What is worth keeping after each stage: as in pruning, with the config's `prune_below` and this.
    pub prune_unseen_below: f64,
    /// What is trained, coarse to fine, each from `density` again in what the one before left.
    pub stages: Vec<Stage>,
}

fn one<N: From<u8>>() -> N {
    N::from(1)
}

/// Where samples lie along a ray.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum Sampling {
    /// Steps of this many voxel sides through the box.
    Step {
        /// In voxel sides.
        step: f64,
    },
    /// The source paper's: so many points over t ∈ [0, far] along the direction whose camera z is −1.
    Points {
        /// On the whole ray, in the box or not.
        samples: usize,
        /// Largest t.
        far: f64,
    },
}

impl Sampling {
    /// The most samples that a ray can take through a grid.
    fn most(self, resolution: usize) -> f64 {
        match self {
            Sampling::Step { step } => 3f64.sqrt() * resolution as f64 / step + 2.0,
            Sampling::Points { samples, .. } => samples as f64,
        }
    }

    /// The spacing for voxels of a side.
    pub fn spacing(self, voxel_side: f64) -> Spacing {
        match self {
            Sampling::Step { step } => Spacing::Step(step * voxel_side),
            Sampling::Points { samples, far } => Spacing::Points { samples, far },
        }
    }
}

impl Stage {
    /// So many steps at a resolution, and all else as plain as it can be: samples half a voxel apart (svox2), whole images, the density's rate 1
    /// and that of colors 0.03 to the end.
    pub fn new(resolution: usize, steps: u64) -> Self {
        Stage {
            resolution,
            epochs: None,
            steps: Some(steps),
            sampling: Sampling::Step { step: 0.5 },
            image_reduction: 1,
            density_rate: 1.0,
            color_rate: 0.03,
            harmonics_rate: None,
            density_warm_up: 0,
            rate_decay: 1.0,
            color_decay: None,
        }
    }

    /// The same with at most `finest` voxels a side, but 2 at least, and a rate of the density that is less by as much.
    pub fn at_most(self, finest: usize) -> Self {
        let resolution = self.resolution.min(finest.max(2));
        let density_rate = self.density_rate * resolution as f64 / self.resolution as f64;
        Stage { resolution, density_rate, ..self }
    }

    /// The same with at most `finest` voxels a side, and images that are reduced by as little.
    fn fitted(self, finest: f64) -> Self {
        let stage = self.at_most(finest as usize);
        let image_reduction = stage.image_reduction.min((finest / stage.resolution as f64) as usize).max(1);
        Stage { image_reduction, ..stage }
    }

    /// The share of their first rates that colors and harmonics end with.
    pub fn color_decay(&self) -> f64 {
        self.color_decay.unwrap_or(self.rate_decay)
    }

    /// Steps of this stage when an epoch has `rays` rays.
    pub fn step_count(&self, rays: u64, rays_per_step: usize) -> u64 {
        match (self.steps, self.epochs) {
            (Some(steps), _) => steps,
            (None, Some(epochs)) => ((epochs * rays as f64 / rays_per_step as f64).round() as u64).max(1),
            (None, None) => 0,
        }
    }
}

/// A recipe for small scenes of about unit size, photographed from all sides over white: what presets and files change.
impl Default for Config {
    fn default() -> Self {
        Config {
            seed: 42,
            downscale: 1,
            validation_every: 20,
            background: [1.0; 3],
            // World units: svox2 and nerfstudio on NeRF-synthetic scenes.
            half_width: 1.5,
            interpolation: Interpolation::Trilinear,
            color: ColorKind::Sh,
            // svox2: degree 2, and zero coefficients are gray.
            sh_degree: 2,
            sh_reduction: 1,
            sh_offset: 0.5,
            engine: Engine::Fused,
            stop_below: 0.0,
            rays_per_step: 4096,
            aim: false,
            jitter: true,
            project: false,
            pixels_per_voxel: 0.0,
            prune_from_stage: None,
            prune_below: 0.2,
            prune_unseen_below: 0.0,
            scout: None,
            init_from: None,
            hull: Hull::Off,
            // svox2's start: thin gray fog.
            initial: Initial { density: 0.1, color: 0.0, random: false },
            // Gradients of a mean over 4096 rays are small: the usual 1e-8 would damp them.
            optimizer: OptimizerConfig::LazyAdam { beta1: 0.9, beta2: 0.99, epsilon: 1e-12 },
            losses: BTreeMap::from([("mse".to_owned(), Weight::Constant(1.0))]),
            loss_rates: BTreeMap::new(),
            // Ours, a first guess and not tuned: densities move by about one unit a step, so that a voxel is opaque or
            // empty within a few dozen steps, colors by 0.03; the last stage settles.
            stages: vec![
                Stage::new(16, 200),
                Stage::new(32, 200),
                Stage { density_rate: 1.5, ..Stage::new(64, 300) },
                Stage { density_rate: 2.0, rate_decay: 0.2, ..Stage::new(128, 600) },
            ],
            evaluation: Sampling::Step { step: 0.5 },
            carve: CarveConfig::default(),
        }
    }
}

impl Config {
    /// The grid of a stage.
    pub fn grid_shape(&self, resolution: usize) -> GridShape {
        let color = match self.color {
            ColorKind::Rgb => Color::Rgb,
            ColorKind::Sh => Color::Sh { degree: self.sh_degree, offset: self.sh_offset },
        };
        let Config { half_width, interpolation, sh_reduction, .. } = *self;
        GridShape { resolution, half_width, interpolation, color, sh_reduction }.normalised()
    }

    /// What a carving run with these settings carves, and how.
    pub fn carve_options(&self) -> CarveOptions {
        let Config { half_width, background, seed, carve, .. } = *self;
        CarveOptions { half_width, color: self.grid_shape(carve.resolution).color, background, seed, config: carve }
    }

    /// The same with stages that images of some cameras have pixels for. Small images say nothing of small voxels, which would learn what
    /// single views show and no other.
    ///
    /// A pixel of a camera is p = d / f wide, for its distance d from the middle of the cube, or the cube's half width w if that is more, and
    /// its focal length f in pixels. The finest grid has n = 2 w / (`pixels_per_voxel` p) voxels a side, p in the mean of all cameras and w as
    /// configured. Stages that are finer get that many, and a rate of the density that is less by as much. Images are reduced by no more than k where a stage has n / k voxels a side, so that what is true of voxels
    /// and pixels is true of theirs.
    pub fn fitted_to<'c>(&self, cameras: impl IntoIterator<Item = &'c Camera>) -> Self {
        let pixel = |camera: &Camera| camera.position().length().max(self.half_width) / camera.intrinsics.fx.min(camera.intrinsics.fy);
        let (sum, count) = cameras.into_iter().map(pixel).fold((0.0, 0.0), |(sum, count), pixel| (sum + pixel, count + 1.0));
        let finest = 2.0 * self.half_width / (self.pixels_per_voxel * sum / count);
        let mut fitted = self.clone();
        // Without cameras, or a bound, it is no number, or infinite.
        if finest.is_finite() {
            let of_scout = fitted.scout.iter_mut().flat_map(|scout| &mut scout.stages);
            fitted.stages.iter_mut().chain(of_scout).for_each(|stage| *stage = stage.fitted(finest));
        }
        fitted
    }

    /// How a grid is rendered with samples at these places.
    pub(super) fn render_options<T: Real>(&self, grid: &VoxelGrid<T>, sampling: Sampling, jitter: Jitter) -> RenderOptions<'static> {
        RenderOptions {
            aabb: grid.aabb(),
            spacing: sampling.spacing(grid.shape().voxel_side()),
            jitter,
            background: self.background,
            occupancy: None,
            engine: self.engine,
            stop_below: self.stop_below,
        }
    }

    /// Values before the first step, of the scout or of the training itself.
    pub(super) fn initial_of(&self, scout: bool) -> Initial {
        let density = self.scout.as_ref().filter(|_| scout).map_or(self.initial.density, |scout| scout.density);
        Initial { density, ..self.initial }
    }

    /// Settings of the trainer, which do not depend on the model.
    pub fn train_options(&self) -> TrainOptions {
        let Config { seed, background, rays_per_step, jitter, .. } = *self;
        TrainOptions { seed, background, rays_per_step, jitter, ..TrainOptions::default() }
    }

    /// Checks that there is something to train.
    pub fn check_stages(&self) -> Result<()> {
        demand(!self.stages.is_empty(), "stages", "there is no stage", "set at least one")
    }

    /// Checks every value; an error names the key as the file spells it.
    pub fn validate(&self) -> Result<()> {
        // What single precision can square and add up.
        let density = |key: &str, value: f64| check((0.0..=1e12).contains(&value), key, value, "0 to 1e12");
        let color = |key: &str, value: f64| check((-1e6..=1e6).contains(&value), key, value, "-1e6 to 1e6");
        let decay = |key: &str, value: f64| check((0.0..1.0).contains(&value), key, value, "a number in [0, 1)");
        let epsilon = |key: &str, value: f64| check((1e-30..=1e30).contains(&value), key, value, "1e-30 to 1e30");
        check((1..=64).contains(&self.downscale), "downscale", self.downscale, "1 to 64")?;
        check(self.validation_every != 1, "validation_every", 1, "2 or more, or 0 for none")?;
        check(
            self.background.iter().all(|c| (0.0..=1.0).contains(c)),
            "background",
            format!("{:?}", self.background),
            "three numbers in [0, 1]",
        )?;
        let half_widths = "a number above 0, from 1e-9 to 1e9";
        check(GridShape::HALF_WIDTHS.contains(&self.half_width), "half_width", self.half_width, half_widths)?;
        check(self.sh_degree <= sh::MAX_DEGREE, "sh_degree", self.sh_degree, "0 to 3")?;
        check((1..=64).contains(&self.sh_reduction), "sh_reduction", self.sh_reduction, "1 to 64")?;
        color("sh_offset", self.sh_offset)?;
        check((0.0..=1e6).contains(&self.pixels_per_voxel), "pixels_per_voxel", self.pixels_per_voxel, "0 to 1e6")?;
        check((1..=1 << 22).contains(&self.rays_per_step), "rays_per_step", self.rays_per_step, "1 to 4194304")?;
        decay("stop_below", self.stop_below)?;
        density("prune_below", self.prune_below)?;
        check((0.0..=1.0).contains(&self.prune_unseen_below), "prune_unseen_below", self.prune_unseen_below, "a number in [0, 1]")?;
        let nowhere = self.init_from.as_ref().is_some_and(|path| path.as_os_str().is_empty());
        check(!nowhere, "init_from", "\"\"", "the folder of a run")?;
        density("initial.density", self.initial.density)?;
        color("initial.color", self.initial.color)?;
        match self.optimizer {
            OptimizerConfig::Sgd => {}
            OptimizerConfig::Momentum { decay: share } => decay("optimizer.decay", share)?,
            OptimizerConfig::RmsProp { beta, epsilon: least } => {
                decay("optimizer.beta", beta)?;
                epsilon("optimizer.epsilon", least)?;
            }
            OptimizerConfig::LazyAdam { beta1, beta2, epsilon: least } => {
                decay("optimizer.beta1", beta1)?;
                decay("optimizer.beta2", beta2)?;
                epsilon("optimizer.epsilon", least)?;
            }
        }
        for (name, weight) in &self.losses {
            demand(
                LOSSES.contains(&name.as_str()),
                &format!("losses.{name}"),
                "unknown loss",
                &format!("expected one of {}", LOSSES.join(", ")),
            )?;
            let key = |part: &str| format!("losses.{name}{part}");
            let fits = |part: &str, weight: f64| check((0.0..=1e12).contains(&weight), &key(part), weight, "0 to 1e12");
            let changes = |part: &str, weight: f64| check((1e-30..=1e12).contains(&weight), &key(part), weight, "1e-30 to 1e12");
            let lasts = |part: &str, steps: u64| check(steps > 0, &key(part), steps, "1 or more steps");
            match *weight {
                Weight::Constant(weight) => fits("", weight)?,
                Weight::Until { weight, until } => fits(".weight", weight).and_then(|()| lasts(".until", until))?,
                Weight::Exponential { from, to, steps } => {
                    changes(".from", from)?;
                    changes(".to", to)?;
                    lasts(".steps", steps)?;
                }
            }
        }
        for (name, rate) in &self.loss_rates {
            let key = format!("loss_rates.{name}");
            let learned: Vec<&str> = LEARNED_LOSSES.into_iter().filter(|loss| self.losses.contains_key(*loss)).collect();
            let remedy = match learned.is_empty() {
                true => "remove it: only the losses robust and exposure have parameters".to_owned(),
                false => format!("expected a rate for {}", learned.join(", ")),
            };
            demand(learned.contains(&name.as_str()), &key, "this loss has no parameters here", &remedy)?;
            check((1e-12..=1e6).contains(rate), &key, rate, "1e-12 to 1e6")?;
        }
        if let Some(scout) = &self.scout {
            check(scout.density > 0.0, "scout.density", scout.density, "above 0 to 1e12")?;
            density("scout.density", scout.density)?;
            let least = scout.prune_unseen_below;
            check((0.0..=1.0).contains(&least), "scout.prune_unseen_below", least, "a number in [0, 1]")?;
            demand(!scout.stages.is_empty(), "scout.stages", "there is no stage", "set at least one, or remove the scout")?;
        }
        let longest = self.stages.len().max(self.scout.as_ref().map_or(0, |scout| scout.stages.len()));
        check(longest <= MOST_STAGES, "stages", longest, "at most 100")?;
        let stages = self.stages.iter().enumerate().map(|(i, stage)| (format!("stages[{i}]"), stage));
        let of_scout = self.scout.iter().flat_map(|scout| scout.stages.iter().enumerate());
        for (place, stage) in stages.chain(of_scout.map(|(i, stage)| (format!("scout.stages[{i}]"), stage))) {
            let key = |name: &str| format!("{place}.{name}");
            check((2..=1024).contains(&stage.resolution), &key("resolution"), stage.resolution, "2 to 1024 voxels a side")?;
            match (stage.epochs, stage.steps) {
                (Some(epochs), None) => check(epochs > 0.0 && epochs <= 1e6, &key("epochs"), epochs, "above 0 to 1e6")?,
                (None, Some(steps)) => check((1..=1_000_000_000).contains(&steps), &key("steps"), steps, "1 to 1e9")?,
                (Some(_), Some(_)) => demand(false, &key("steps"), "both `epochs` and `steps` are set", "set one of them")?,
                (None, None) => demand(false, &key("steps"), "neither `epochs` nor `steps` is set", "set one of them")?,
            }
            sampling(&key("sampling"), stage.sampling)?;
            let harmonics_rate = stage.harmonics_rate.unwrap_or(stage.color_rate);
            for (name, rate) in [("density_rate", stage.density_rate), ("color_rate", stage.color_rate), ("harmonics_rate", harmonics_rate)]
            {
                check(rate == 0.0 || (1e-30..=1e30).contains(&rate), &key(name), rate, "0, or 1e-30 to 1e30")?;
            }
            check((1..=64).contains(&stage.image_reduction), &key("image_reduction"), stage.image_reduction, "1 to 64")?;
            for (name, decay) in [("rate_decay", stage.rate_decay), ("color_decay", stage.color_decay())] {
                check((1e-6..=1e6).contains(&decay), &key(name), decay, "1e-6 to 1e6")?;
            }
            // Samples of a batch are counted in 32 bits.
            let samples = stage.sampling.most(stage.resolution) * self.rays_per_step as f64;
            demand(
                samples < f64::from(u32::MAX),
                &key("sampling"),
                &format!("a training step has up to {samples:.0} samples, which is more than 4294967294"),
                "use a larger sampling step, or a smaller rays_per_step",
            )?;
        }
        sampling("evaluation", self.evaluation)?;
        let CarveConfig { resolution, margin, depth, photo, ridge, sweeps, .. } = self.carve;
        let noise = photo.map_or(1.0, |photo| photo.noise);
        check((1e-6..=1.0).contains(&noise), "carve.photo.noise", noise, "1e-6 to 1")?;
        check((2..=1024).contains(&resolution), "carve.resolution", resolution, "2 to 1024 voxels a side")?;
        check((0.0..=1e3).contains(&margin), "carve.margin", margin, "0 to 1000 pixels")?;
        check((1e-3..=1e3).contains(&depth), "carve.depth", depth, "0.001 to 1000")?;
        check((0.0..=1e6).contains(&ridge), "carve.ridge", ridge, "0 to 1e6")?;
        check(sweeps <= 1000, "carve.sweeps", sweeps, "0 to 1000")
    }
}

fn sampling(key: &str, sampling: Sampling) -> Result<()> {
    match sampling {
        Sampling::Step { step } => check((0.01..=100.0).contains(&step), &format!("{key}.step"), step, "0.01 to 100 voxel sides"),
        Sampling::Points { samples, far } => {
            check((2..=100_000).contains(&samples), &format!("{key}.samples"), samples, "2 to 100000")?;
            check((1e-6..=1e6).contains(&far), &format!("{key}.far"), far, "1e-6 to 1e6")
        }
    }
}

/// Checks a condition other than the range of a value.
fn demand(holds: bool, key: &str, problem: &str, remedy: &str) -> Result<()> {
    if holds { Ok(()) } else { Err(Error::usage(key, problem, remedy)) }
}

fn check(fits: bool, key: &str, found: impl ToString, accepted: &str) -> Result<()> {
    if fits {
        return Ok(());
    }
    let found = found.to_string();
    // 1e300 would be written with all its zeros.
    let short = if found.len() > 20 { found.parse().ok().map(|number: f64| format!("{number:e}")) } else { None };
    Err(Error::config(key, short.unwrap_or(found), accepted))
}
