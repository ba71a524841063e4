//! All settings of a run: their meanings, their units, and the sources of their defaults.
//!
//! [`Config`] is the content of a run's `config.toml` and of a preset. Command-line flags change it.

use crate::camera::{Camera, mean_pixel_width};
use crate::carve::{CarveConfig, CarveOptions};
use crate::dataset::normalize::CaptureOptions;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::model::{dvgo, nerf, ngp, tensorf};
use crate::render::{Engine, RenderOptions};
use crate::sampling::{Jitter, Spacing};
use crate::train::TrainOptions;
use autograd::Real;
use autograd::optim::{Exponential, Piecewise, Schedule};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

mod checks;

/// Complete settings of a run. The same config and the same data give bit-identical results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Factor by which images are reduced, with a box filter.
    pub downscale: usize,
    /// Interval at which training views are held out for validation, if the dataset has no validation split: every n-th view. 0 holds out
    /// none.
    pub validation_every: usize,
    /// Background color, sRGB in [0, 1]. Published figures use white.
    pub background: [f32; 3],
    /// Half the side of the cube that contains the scene, in units of the dataset.
    pub half_width: f64,
    /// Interpolation between voxel centres.
    pub interpolation: Interpolation,
    /// Color representation of a voxel.
    pub color: ColorKind,
    /// Degree of the spherical harmonics, 0 to 3. Used if `color = "sh"`.
    pub sh_degree: usize,
    /// Side of the blocks of voxels that share harmonics of degree 1 and more. The coefficient of degree 0 is stored for each voxel. 1
    /// stores all coefficients for each voxel. It has no effect without such harmonics. Carving ignores it and fits all coefficients for
    /// each voxel.
    #[serde(default = "one")]
    pub sh_reduction: usize,
    /// Color of zero coefficients: 0.5 in svox2, 0 in the source paper.
    pub sh_offset: f64,
    /// Renderer that computes the pixels.
    pub engine: Engine,
    /// Transmittance below which training rays end; 0 never ends them early. The engine `graph` ignores it.
    pub stop_below: f64,
    /// In pictures, consecutive samples of a ray have one color, that of the last of them, until their weights sum to more than this. 0: each sample whose
    /// color can change an 8-bit value has its own. A ray whose weights sum to less has the color of the background. The engine `graph` and nearest look-up ignore it.
    #[serde(default)]
    pub group_in_pictures: f64,
    /// Number of rays per training step.
    pub rays_per_step: usize,
    /// Floor f of the contrast in proportion to which training pixels are drawn: √(σ² + f²), where σ² is the variance of the colors of the
    /// 3 x 3 pixels around a pixel. Losses of rays have the weights that make their expectation the mean over all pixels. 0 draws all pixels
    /// equally often.
    #[serde(default)]
    pub contrast_floor: f64,
    /// Side of the square patches in which training pixels are drawn, for losses that compare a pixel with its neighbours; 1 draws single pixels. A step has
    /// n / `patch_size`² patches, rounded down, where n is the number of rays of the stage. Pixels are listed patch after patch and row after row. Every position
    /// of a patch inside a view is equally likely, so pixels near the border are drawn less often. `contrast_floor`, `aim` and silhouettes do not restrict patches.
    #[serde(default = "one")]
    pub patch_size: u32,
    /// Draw training rays only from pixels on or around the projection of the remaining voxels, because other rays cross empty space only.
    /// A stage that begins without empty space draws from all pixels. Needs no alpha channel.
    ///
    /// A loss of rays is the mean over the drawn rays. Against a loss of the grid, such as total variation, it therefore counts more than a mean over all pixels
    /// would, by 1 / (share of the pixels that are drawn). Measured on lego, preset `fast`, held-out training views, seeds 42 and 43: 32.17 and 32.13 dB with
    /// `tv_color_sampled` = 1e-2; 32.03 and 31.87 dB with 2.5 times that weight; 32.13 and 32.05 dB with 0.4 times.
    #[serde(default)]
    pub aim: bool,
    /// Shift the samples of each training ray by a random fraction of a step.
    pub jitter: bool,
    /// Clamp densities to >= 0 and RGB colors to [0, 1] after each step.
    pub project: bool,
    /// Smallest width of a voxel in pixels; 0 for no bound. It limits the resolution of the stages. The width is computed for a cube of the
    /// configured half width at the mean distance of the cameras. Silhouettes and a scout shrink the cube later, and its voxels with it.
    /// See [`Config::fitted_to`].
    #[serde(default)]
    pub pixels_per_voxel: f64,
    /// First stage that begins with pruning, counted from 0. Pruning removes a voxel if its density, and the density of all its neighbours,
    /// is at most `prune_below`. Removed voxels stay empty and are not sampled.
    pub prune_from_stage: Option<usize>,
    /// Density below which pruning treats a voxel as empty, in 1 / world length.
    pub prune_below: f64,
    /// Also prune voxels whose largest rendering weight over the training rays is below this; 0 disables it. A voxel stays if a voxel at
    /// most two away has a larger weight. The rays are a subset of the training pixels with at least eight rays per voxel. svox2 uses 0.256 /
    /// resolution.
    pub prune_unseen_below: f64,
    /// Short run before the first stage that finds the voxels of the grid. It is used if neither silhouettes nor an initial run determine
    /// them. It keeps its voxels that are worth keeping, and the visual hull of their silhouettes. The cube shrinks to the kept voxels, and
    /// again at each finer stage that prunes. Training then starts from `initial`. Needs no alpha channel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scout: Option<Scout>,
    /// Folder of the run whose grid initializes training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_from: Option<PathBuf>,
    /// Use of silhouettes, if images have an alpha channel.
    #[serde(default)]
    pub hull: Hull,
    /// Values before the first step.
    pub initial: Initial,
    /// Optimizer and its parameters.
    pub optimizer: OptimizerConfig,
    /// Weight of each loss: a number, `{ weight, until }` for a loss that ends, or `{ from, to, steps }` for a weight that changes
    /// exponentially.
    pub losses: BTreeMap<String, Weight>,
    /// Learning rates of losses with parameters (`robust`, `exposure`, `poses`, `outlier_views`), by name of the loss. They replace the loss's own rates. That of
    /// `poses` falls to 1 % of it over the run.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub loss_rates: BTreeMap<String, f64>,
    /// Training stages, coarse to fine.
    pub stages: Vec<Stage>,
    /// Sampling of rendered images and of evaluation.
    pub evaluation: Sampling,
    /// Settings of carving.
    #[serde(default)]
    pub carve: CarveConfig,
    /// Settings of a factored field. If they are set, the run trains this field and no voxel grid; `stages` is then empty, and the other settings of the
    /// grid have no effect.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tensorf: Option<tensorf::Config>,
    /// Settings of DirectVoxGO, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dvgo: Option<dvgo::Config>,
    /// Settings of NeRF, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nerf: Option<nerf::Config>,
    /// Settings of Instant-NGP, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ngp: Option<ngp::Config>,
    /// Choices about a capture: which of its files are read, where its scene is, and which views are for testing.
    #[serde(default)]
    pub capture: CaptureOptions,
}

/// Use of silhouettes in training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Hull {
    /// Silhouettes determine the size of the cube and which voxels exist, if images have an alpha channel.
    Auto,
    /// Silhouettes are not used. Alpha is used for compositing over the background only.
    #[default]
    Off,
}

/// Color representation of a voxel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ColorKind {
    /// Red, green, blue.
    Rgb,
    /// Spherical harmonics.
    Sh,
}

/// Values of the grid before the first step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Initial {
    /// Density, 1 / world length.
    pub density: f64,
    /// Value of every color channel or coefficient.
    pub color: f64,
    /// Draw each number uniformly from [0, value) instead.
    pub random: bool,
}

/// Optimizer and its parameters. Learning rates belong to the stages.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum OptimizerConfig {
    /// Stochastic gradient descent: θ ← θ − rate · g.
    Sgd,
    /// Stochastic gradient descent with momentum.
    Momentum {
        /// Factor by which the velocity is multiplied in each step.
        decay: f64,
    },
    /// RMSProp as in svox2.
    RmsProp {
        /// Decay of the running mean of squared gradients.
        beta: f64,
        /// Term added to the root of the mean square.
        epsilon: f64,
    },
    /// Adam that updates only rows with a gradient.
    LazyAdam {
        /// Decay of the running mean of gradients.
        beta1: f64,
        /// Decay of the running mean of squared gradients.
        beta2: f64,
        /// Term added to the root of the mean square.
        epsilon: f64,
    },
}

/// Weight of a loss over the steps of the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum Weight {
    /// Constant weight.
    Constant(f64),
    /// Constant weight up to a step, and 0 from then on.
    Until {
        /// Weight before step `until`.
        weight: f64,
        /// First step without the loss.
        until: u64,
    },
    /// Weight that changes log-linearly from `from` to `to`, then stays constant.
    Exponential {
        /// Weight at step 0.
        from: f64,
        /// Weight from step `steps` on.
        to: f64,
        /// Number of steps of the change.
        steps: u64,
    },
}

impl Weight {
    /// Returns the weight at a step.
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

/// Training stage: a resolution, its length and its rates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Number of voxels along each axis.
    pub resolution: usize,
    /// Length in epochs over all training pixels. A stage has exactly one of `epochs` and `steps`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epochs: Option<f64>,
    /// Length in training steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Sampling along training rays.
    pub sampling: Sampling,
    /// Factor by which images are reduced during the stage, with a box filter; the largest factor up to this that divides both sides is
    /// used. One ray then covers many pixels, which is enough for large voxels. The length of an epoch counts the pixels of the original
    /// images.
    #[serde(default = "one")]
    pub image_reduction: usize,
    /// Learning rate of the density at the start of the stage.
    pub density_rate: f64,
    /// Learning rate of the colors at the start of the stage.
    pub color_rate: f64,
    /// Learning rate of reduced harmonics at the start of the stage. Defaults to `color_rate`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub harmonics_rate: Option<f64>,
    /// Number of steps over which the learning rate of the density rises from 1% to its full value, along a quarter of a sine (svox2's
    /// delay). 0 disables the warm-up.
    #[serde(default)]
    pub density_warm_up: u64,
    /// Factor that all learning rates reach at the end of the stage, by exponential decay. 1 keeps them constant.
    #[serde(default = "one")]
    pub rate_decay: f64,
    /// Factor that the learning rates of colors and harmonics reach at the end of the stage. Defaults to `rate_decay`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color_decay: Option<f64>,
}

/// Settings of the scout, a short run that finds where matter is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scout {
    /// Density before the first step, 1 / world length. It must be low enough that light passes through the cube.
    pub density: f64,
    /// Threshold of rendering weight for keeping a voxel after each stage. It replaces the config's `prune_unseen_below`; `prune_below`
    /// applies too.
    pub prune_unseen_below: f64,
    /// Stages, coarse to fine. Each starts from `density` again, on the voxels that the previous stage kept.
    pub stages: Vec<Stage>,
}

fn one<N: From<u8>>() -> N {
    N::from(1)
}

/// Positions of samples along a ray.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
pub enum Sampling {
    /// Steps of constant length through the box.
    Step {
        /// Length of a step, in voxel sides.
        step: f64,
    },
    /// Sampling of the source paper: points evenly spaced over t ∈ [0, far], along the direction whose camera z is −1.
    Points {
        /// Number of points on the whole ray, inside or outside of the box.
        samples: usize,
        /// Largest t.
        far: f64,
    },
}

impl Sampling {
    /// Returns the largest number of samples that a ray can take through a grid.
    fn most(self, resolution: usize) -> f64 {
        match self {
            Sampling::Step { step } => 3f64.sqrt() * resolution as f64 / step + 2.0,
            Sampling::Points { samples, .. } => samples as f64,
        }
    }

    /// Returns a length that samples of a ray through a grid do not exceed. Points of wide lenses may be up to twice as long.
    pub(super) fn longest(self, shape: &GridShape) -> f64 {
        match self {
            Sampling::Step { step } => shape.coordinates.step(step * shape.voxel_side()),
            Sampling::Points { samples, far } => far / (samples.max(2) - 1) as f64,
        }
    }

    /// Returns the spacing of samples in a grid.
    pub fn spacing(self, shape: &GridShape) -> Spacing {
        match self {
            Sampling::Step { step } => shape.coordinates.spacing(step * shape.voxel_side()),
            Sampling::Points { samples, far } => Spacing::Points { samples, far },
        }
    }
}

impl Stage {
    /// Returns a plain stage of `steps` steps at a resolution: samples half a voxel apart (svox2), images of full size, and constant
    /// learning rates, 1 for the density and 0.03 for colors.
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

    /// Limits the resolution to `finest`, but at least 2. The learning rate of the density is reduced by the same factor.
    pub fn at_most(self, finest: usize) -> Self {
        let resolution = self.resolution.min(finest.max(2));
        let density_rate = self.density_rate * resolution as f64 / self.resolution as f64;
        Stage { resolution, density_rate, ..self }
    }

    /// Limits the resolution to `finest`, and the reduction of images to `finest / resolution`.
    fn fitted(self, finest: f64) -> Self {
        let stage = self.at_most(finest as usize);
        let image_reduction = stage.image_reduction.min((finest / stage.resolution as f64) as usize).max(1);
        Stage { image_reduction, ..stage }
    }

    /// Returns the factor that the learning rates of colors and harmonics reach at the end of the stage.
    pub fn color_decay(&self) -> f64 {
        self.color_decay.unwrap_or(self.rate_decay)
    }

    /// Returns the number of steps of this stage if an epoch has `rays` rays.
    pub fn step_count(&self, rays: u64, rays_per_step: usize) -> u64 {
        match (self.steps, self.epochs) {
            (Some(steps), _) => steps,
            (None, Some(epochs)) => ((epochs * rays as f64 / rays_per_step as f64).round() as u64).max(1),
            (None, None) => 0,
        }
    }
}

/// Settings for small scenes of about unit size, photographed from all sides over white. Presets and files change them.
impl Default for Config {
    fn default() -> Self {
        Config {
            seed: 42,
            downscale: 1,
            validation_every: 20,
            background: [1.0; 3],
            // World units: svox2 and nerfstudio use this on NeRF-synthetic scenes.
            half_width: 1.5,
            interpolation: Interpolation::Trilinear,
            color: ColorKind::Sh,
            // svox2 uses degree 2, and zero coefficients are gray.
            sh_degree: 2,
            sh_reduction: 1,
            sh_offset: 0.5,
            engine: Engine::Fused,
            stop_below: 0.0,
            group_in_pictures: 0.0,
            rays_per_step: 4096,
            contrast_floor: 0.0,
            patch_size: 1,
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
            // Thin gray fog, as in svox2.
            initial: Initial { density: 0.1, color: 0.0, random: false },
            // Gradients of a mean over 4096 rays are small. The usual epsilon of 1e-8 would damp them.
            optimizer: OptimizerConfig::LazyAdam { beta1: 0.9, beta2: 0.99, epsilon: 1e-12 },
            losses: BTreeMap::from([("mse".to_owned(), Weight::Constant(1.0))]),
            loss_rates: BTreeMap::new(),
            // Our choice, not tuned. Densities change by about one unit per step, so that a voxel becomes opaque or empty within a few
            // dozen steps. Colors change by about 0.03 per step. The rates of the last stage decay so that it settles.
            stages: vec![
                Stage::new(16, 200),
                Stage::new(32, 200),
                Stage { density_rate: 1.5, ..Stage::new(64, 300) },
                Stage { density_rate: 2.0, rate_decay: 0.2, ..Stage::new(128, 600) },
            ],
            evaluation: Sampling::Step { step: 0.5 },
            carve: CarveConfig::default(),
            tensorf: None,
            dvgo: None,
            nerf: None,
            ngp: None,
            capture: CaptureOptions::default(),
        }
    }
}

impl Config {
    /// Returns the shape of the grid at a resolution.
    pub fn grid_shape(&self, resolution: usize) -> GridShape {
        let color = match self.color {
            ColorKind::Rgb => Color::Rgb,
            ColorKind::Sh => Color::Sh { degree: self.sh_degree, offset: self.sh_offset },
        };
        let Config { half_width, interpolation, sh_reduction, .. } = *self;
        GridShape { sh_reduction, ..GridShape::new(resolution, half_width, interpolation, color) }.normalised()
    }

    /// Returns the number of stages that are left out if training starts from a grid of this resolution: the first ones that are coarser, but not the last.
    pub(crate) fn stages_left_out(&self, resolution: usize) -> usize {
        let coarser = self.stages.iter().take_while(|stage| stage.resolution < resolution).count();
        coarser.min(self.stages.len().saturating_sub(1))
    }

    /// Returns the options of carving with these settings.
    pub fn carve_options(&self) -> CarveOptions {
        let Config { half_width, background, seed, carve, .. } = *self;
        CarveOptions { half_width, color: self.grid_shape(carve.resolution).color, background, seed, config: carve }
    }

    /// Returns a config whose stages fit the images of some cameras. In voxels smaller than a pixel, small images leave the colors
    /// undetermined, and the grid would overfit single views.
    ///
    /// A pixel of a camera is p = max(d, w) / f wide, where d is the camera's distance from the middle of the cube, w the half width of the
    /// cube and f the focal length in pixels. The finest grid has n = 2 w / (`pixels_per_voxel` p) voxels per axis, with p averaged over
    /// all cameras and w as configured. Finer stages get n voxels per axis, and the learning rate of their density is reduced by the same
    /// factor.
    ///
    /// The reduction of images in a stage is at most n / resolution. The bound therefore holds for reduced pixels too.
    pub fn fitted_to<'c>(&self, cameras: impl IntoIterator<Item = &'c Camera>) -> Self {
        let pixel = mean_pixel_width(cameras, DVec3::ZERO, self.half_width);
        let finest = 2.0 * self.half_width / (self.pixels_per_voxel * pixel);
        let mut fitted = self.clone();
        // Without cameras or without a bound it is NaN or infinite.
        if finest.is_finite() {
            let of_scout = fitted.scout.iter_mut().flat_map(|scout| &mut scout.stages);
            fitted.stages.iter_mut().chain(of_scout).for_each(|stage| *stage = stage.fitted(finest));
        }
        fitted
    }

    /// Returns the options for rendering a grid with a given sampling.
    pub(super) fn render_options<T: Real>(&self, grid: &VoxelGrid<T>, sampling: Sampling, jitter: Jitter) -> RenderOptions<'static> {
        RenderOptions {
            aabb: grid.aabb(),
            spacing: sampling.spacing(grid.shape()),
            jitter,
            background: self.background,
            occupancy: None,
            engine: self.engine,
            stop_below: self.stop_below,
        }
    }

    /// Returns the values before the first step of the scout, or of the training itself.
    pub(super) fn initial_of(&self, scout: bool) -> Initial {
        let density = self.scout.as_ref().filter(|_| scout).map_or(self.initial.density, |scout| scout.density);
        Initial { density, ..self.initial }
    }

    /// Returns the settings of the trainer, which do not depend on the model.
    pub fn train_options(&self) -> TrainOptions {
        let Config { seed, background, rays_per_step, jitter, contrast_floor, patch_size, .. } = *self;
        TrainOptions { seed, background, rays_per_step, jitter, contrast_floor, patch_size, ..TrainOptions::default() }
    }

    /// Returns true if the config has a stage to train; without one it is a config for carving.
    pub fn trains(&self) -> bool {
        !self.stages.is_empty() || self.recipe().is_some()
    }

    /// Returns the resolution of each stage.
    pub fn resolutions(&self) -> impl Iterator<Item = usize> + '_ {
        let of_other = self.recipe().into_iter().flat_map(|recipe| recipe.stages()).filter_map(|stage| stage.resolution);
        self.stages.iter().map(|stage| stage.resolution).chain(of_other)
    }
}
