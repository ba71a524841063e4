//! Checks of the values of a configuration.

use super::{Config, Hull, OptimizerConfig, Sampling, Stage, Weight};
use crate::carve::CarveConfig;
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::GridShape;
use crate::loss;
use crate::model::plenoxels::KIND;
use crate::model::plenoxels::objective::{LEARNED_LOSSES, LOSSES};
use crate::model::recipe::Recipe;
use crate::train;

/// Largest number of stages of a run.
const MOST_STAGES: usize = 100;

/// Settings that only a voxel grid has.
const OF_GRID: [&str; 19] = [
    "stages",
    "scout",
    "init_from",
    "interpolation",
    "color",
    "sh_degree",
    "sh_reduction",
    "sh_offset",
    "optimizer",
    "initial",
    "rays_per_step",
    "stop_below",
    "group_in_pictures",
    "aim",
    "project",
    "pixels_per_voxel",
    "prune_from_stage",
    "prune_below",
    "prune_unseen_below",
];

impl Config {
    /// Errors if the config has no stage to train.
    pub fn check_stages(&self) -> Result<()> {
        demand(self.trains(), "stages", "there is no stage", "set at least one")
    }

    /// Checks every value. An error names the key as it is spelled in the file.
    pub fn validate(&self) -> Result<()> {
        check((1..=64).contains(&self.downscale), "downscale", self.downscale, "1 to 64")?;
        check(self.validation_every != 1, "validation_every", 1, "2 or more, or 0 for none")?;
        self.capture.validate().map_err(|e| e.with_key(|key| format!("capture.{key}")))?;
        check(
            self.background.iter().all(|c| (0.0..=1.0).contains(c)),
            "background",
            format!("{:?}", self.background),
            "three numbers in [0, 1]",
        )?;
        let half_widths = "a number from 1e-9 to 1e9";
        check(GridShape::HALF_WIDTHS.contains(&self.half_width), "half_width", self.half_width, half_widths)?;
        check(self.sh_degree <= sh::MAX_DEGREE, "sh_degree", self.sh_degree, "0 to 3")?;
        check((1..=64).contains(&self.sh_reduction), "sh_reduction", self.sh_reduction, "1 to 64")?;
        color("sh_offset", self.sh_offset)?;
        check((0.0..=1e6).contains(&self.pixels_per_voxel), "pixels_per_voxel", self.pixels_per_voxel, "0 to 1e6")?;
        check((1..=1 << 22).contains(&self.rays_per_step), "rays_per_step", self.rays_per_step, "1 to 4194304")?;
        let floor = self.contrast_floor;
        check(floor == 0.0 || (0.005..=1.0).contains(&floor), "contrast_floor", floor, "0.005 to 1, or 0 for none")?;
        check((1..=64).contains(&self.patch_size), "patch_size", self.patch_size, "1 to 64")?;
        decay("stop_below", self.stop_below)?;
        decay("group_in_pictures", self.group_in_pictures)?;
        density("prune_below", self.prune_below)?;
        check((0.0..=1.0).contains(&self.prune_unseen_below), "prune_unseen_below", self.prune_unseen_below, "a number in [0, 1]")?;
        let nowhere = self.init_from.as_ref().is_some_and(|path| path.as_os_str().is_empty());
        check(!nowhere, "init_from", "\"\"", "the folder of a run")?;
        density("initial.density", self.initial.density)?;
        color("initial.color", self.initial.color)?;
        self.check_optimizer()?;
        self.losses.iter().try_for_each(|(name, weight)| check_loss(name, *weight))?;
        self.check_loss_rates()?;
        self.check_scout()?;
        self.check_stage_lists()?;
        sampling("evaluation", self.evaluation)?;
        if self.losses.contains_key(loss::POSES) && !self.recipe().is_some_and(Recipe::tracks_rays) {
            return Err(train::no_gradients(self.recipe().map_or(KIND, Recipe::kind)));
        }
        self.recipe().map_or(Ok(()), |recipe| self.validate_other(recipe))?;
        self.check_carving()
    }

    fn check_optimizer(&self) -> Result<()> {
        let epsilon = |key: &str, value: f64| check((1e-30..=1e30).contains(&value), key, value, "1e-30 to 1e30");
        match self.optimizer {
            OptimizerConfig::Sgd => Ok(()),
            OptimizerConfig::Momentum { decay: share } => decay("optimizer.decay", share),
            OptimizerConfig::RmsProp { beta, epsilon: least } => {
                decay("optimizer.beta", beta)?;
                epsilon("optimizer.epsilon", least)
            }
            OptimizerConfig::LazyAdam { beta1, beta2, epsilon: least } => {
                decay("optimizer.beta1", beta1)?;
                decay("optimizer.beta2", beta2)?;
                epsilon("optimizer.epsilon", least)
            }
        }
    }

    fn check_loss_rates(&self) -> Result<()> {
        for (name, rate) in &self.loss_rates {
            let key = format!("loss_rates.{name}");
            let learned: Vec<&str> = LEARNED_LOSSES.into_iter().filter(|loss| self.losses.contains_key(*loss)).collect();
            let remedy = match learned.is_empty() {
                true => format!("remove it: only the losses {} have parameters", LEARNED_LOSSES.join(", ")),
                false => format!("expected a rate for {}", learned.join(", ")),
            };
            demand(learned.contains(&name.as_str()), &key, "this loss has no parameters here", &remedy)?;
            check((1e-12..=1e6).contains(rate), &key, rate, "1e-12 to 1e6")?;
        }
        Ok(())
    }

    fn check_scout(&self) -> Result<()> {
        if let Some(scout) = &self.scout {
            check(scout.density > 0.0, "scout.density", scout.density, "a number above 0, up to 1e12")?;
            density("scout.density", scout.density)?;
            let least = scout.prune_unseen_below;
            check((0.0..=1.0).contains(&least), "scout.prune_unseen_below", least, "a number in [0, 1]")?;
            demand(!scout.stages.is_empty(), "scout.stages", "there is no stage", "set at least one, or remove the scout")?;
        }
        Ok(())
    }

    /// Checks the stages of the run and of its scout.
    fn check_stage_lists(&self) -> Result<()> {
        let longest = self.stages.len().max(self.scout.as_ref().map_or(0, |scout| scout.stages.len()));
        demand(longest <= MOST_STAGES, "stages", &format!("there are {longest} stages"), &format!("set at most {MOST_STAGES}"))?;
        let stages = self.stages.iter().enumerate().map(|(i, stage)| (format!("stages[{i}]"), stage));
        let of_scout = self.scout.iter().flat_map(|scout| scout.stages.iter().enumerate());
        let mut all = stages.chain(of_scout.map(|(i, stage)| (format!("scout.stages[{i}]"), stage)));
        all.try_for_each(|(place, stage)| self.check_stage(&place, stage))
    }

    /// Checks a stage, whose settings have the keys `place`.*.
    fn check_stage(&self, place: &str, stage: &Stage) -> Result<()> {
        let key = |name: &str| format!("{place}.{name}");
        check((2..=1024).contains(&stage.resolution), &key("resolution"), stage.resolution, "2 to 1024 voxels per axis")?;
        match (stage.epochs, stage.steps) {
            (Some(epochs), None) => check(epochs > 0.0 && epochs <= 1e6, &key("epochs"), epochs, "a number above 0, up to 1e6")?,
            (None, Some(steps)) => check((1..=1_000_000_000).contains(&steps), &key("steps"), steps, "1 to 1e9")?,
            (Some(_), Some(_)) => demand(false, &key("steps"), "both `epochs` and `steps` are set", "set one of them")?,
            (None, None) => demand(false, &key("steps"), "neither `epochs` nor `steps` is set", "set one of them")?,
        }
        sampling(&key("sampling"), stage.sampling)?;
        let harmonics_rate = stage.harmonics_rate.unwrap_or(stage.color_rate);
        for (name, rate) in [("density_rate", stage.density_rate), ("color_rate", stage.color_rate), ("harmonics_rate", harmonics_rate)] {
            check(rate == 0.0 || (1e-30..=1e30).contains(&rate), &key(name), rate, "0, or 1e-30 to 1e30")?;
        }
        check((1..=64).contains(&stage.image_reduction), &key("image_reduction"), stage.image_reduction, "1 to 64")?;
        for (name, decay) in [("rate_decay", stage.rate_decay), ("color_decay", stage.color_decay())] {
            check((1e-6..=1e6).contains(&decay), &key(name), decay, "1e-6 to 1e6")?;
        }
        // The kernels index samples of a batch with 32 bits.
        let samples = stage.sampling.most(stage.resolution) * self.rays_per_step as f64;
        demand(
            samples < f64::from(u32::MAX),
            &key("sampling"),
            &format!("a training step has up to {samples:.0} samples, which is more than 4294967294"),
            "use a larger sampling step, or a smaller rays_per_step",
        )
    }

    fn check_carving(&self) -> Result<()> {
        let CarveConfig { resolution, margin, depth, photo, ridge, sweeps, .. } = self.carve;
        let noise = photo.map_or(1.0, |photo| photo.noise);
        check((1e-6..=1.0).contains(&noise), "carve.photo.noise", noise, "1e-6 to 1")?;
        check((2..=1024).contains(&resolution), "carve.resolution", resolution, "2 to 1024 voxels per axis")?;
        check((0.0..=1e3).contains(&margin), "carve.margin", margin, "0 to 1000 pixels")?;
        check((1e-3..=1e3).contains(&depth), "carve.depth", depth, "0.001 to 1000")?;
        check((0.0..=1e6).contains(&ridge), "carve.ridge", ridge, "0 to 1e6")?;
        check(sweeps <= 1000, "carve.sweeps", sweeps, "0 to 1000")
    }

    /// Checks the settings of another model than the voxel grid, and that no setting of the grid contradicts them.
    fn validate_other(&self, recipe: &dyn Recipe) -> Result<()> {
        let kind = recipe.kind();
        if let Some(other) = self.recipes().into_iter().flatten().map(Recipe::kind).find(|other| *other != kind) {
            return Err(Error::usage(
                other,
                format!("a run trains one model, and `{kind}` is set"),
                format!("remove `{other}` or `{kind}`"),
            ));
        }
        recipe.validate().map_err(|e| e.with_key(|key| format!("{kind}.{key}")))?;
        let of_grid = |set: bool, key: &str| if set { Err(no_effect(key, kind)) } else { Ok(()) };
        let [own, none] = [self, &Config { stages: Vec::new(), ..Config::default() }].map(|config| serde_json::json!(config));
        OF_GRID.iter().try_for_each(|key| of_grid(own[key] != none[key], key))?;
        if self.hull == Hull::Auto && !recipe.uses_silhouettes() {
            return Err(Error::usage("hull", format!("the model `{kind}` does not use silhouettes"), "set it to off"));
        }
        self.losses.keys().try_for_each(|loss| of_grid(!loss::NAMES.contains(&&loss[..]), &format!("losses.{loss}")))
    }

    /// Checks keys that a user has set. If one has no effect on the model, it is an error even with the default value.
    pub fn check_effect<'a>(&self, mut keys: impl Iterator<Item = &'a str>) -> Result<()> {
        let without_effect = |recipe: &dyn Recipe| Some(no_effect(keys.find(|key| OF_GRID.contains(key))?, recipe.kind()));
        self.recipe().and_then(without_effect).map_or(Ok(()), Err)
    }
}

/// The error for a setting of a voxel grid that another model does not have.
fn no_effect(key: &str, kind: &str) -> Error {
    Error::usage(
        key,
        format!("this setting of a voxel grid has no effect on the model `{kind}`"),
        "leave it out, or choose a preset of a voxel grid, such as voxels",
    )
}

/// Checks the weight of a loss.
fn check_loss(name: &str, weight: Weight) -> Result<()> {
    demand(LOSSES.contains(&name), &format!("losses.{name}"), "unknown loss", &format!("expected one of {}", LOSSES.join(", ")))?;
    let key = |part: &str| format!("losses.{name}{part}");
    let fits = |part: &str, weight: f64| check((0.0..=1e12).contains(&weight), &key(part), weight, "0 to 1e12");
    let changes = |part: &str, weight: f64| check((1e-30..=1e12).contains(&weight), &key(part), weight, "1e-30 to 1e12");
    let lasts = |part: &str, steps: u64| check(steps > 0, &key(part), steps, "1 or more steps");
    match weight {
        Weight::Constant(weight) => fits("", weight),
        Weight::Until { weight, until } => fits(".weight", weight).and_then(|()| lasts(".until", until)),
        Weight::Exponential { from, to, steps } => {
            changes(".from", from)?;
            changes(".to", to)?;
            lasts(".steps", steps)
        }
    }
}

/// Checks a density. Within the limit, squares and sums of densities stay finite in single precision; so do those of [`color`].
fn density(key: &str, value: f64) -> Result<()> {
    check((0.0..=1e12).contains(&value), key, value, "0 to 1e12")
}

fn color(key: &str, value: f64) -> Result<()> {
    check((-1e6..=1e6).contains(&value), key, value, "-1e6 to 1e6")
}

fn decay(key: &str, value: f64) -> Result<()> {
    check((0.0..1.0).contains(&value), key, value, "a number in [0, 1)")
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

/// Checks the range of a value.
fn check(fits: bool, key: &str, value: impl ToString, expected: &str) -> Result<()> {
    if fits {
        return Ok(());
    }
    let value = value.to_string();
    // A number such as 1e300 would otherwise be printed with all its zeros.
    let short = if value.len() > 20 { value.parse().ok().map(|number: f64| format!("{number:e}")) } else { None };
    Err(Error::config(key, short.unwrap_or(value), expected))
}
