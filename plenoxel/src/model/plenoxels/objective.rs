//! Losses of a voxel grid by name, and the objective that a config describes.

use super::config::{Config, Weight};
use super::{Objective, single};
use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::loss::{self, Cells, EXPOSURE, OUTLIER_VIEWS, POSE_RATE, POSES, tv_color, tv_density};
use autograd::Real;
use autograd::optim::Schedule;
use autograd::single::{cast, is_single};

/// Names of the losses that read the voxel grid.
const OF_GRID: [&str; 4] = ["tv_density", "tv_color", "tv_density_sampled", "tv_color_sampled"];

/// Names of all losses that a config may use: the losses of any model ([`loss::NAMES`]) and the losses that read the voxel grid.
pub const LOSSES: [&str; loss::NAMES.len() + OF_GRID.len()] = {
    let mut all = [""; loss::NAMES.len() + OF_GRID.len()];
    let mut i = 0;
    while i < all.len() {
        all[i] = if i < loss::NAMES.len() { loss::NAMES[i] } else { OF_GRID[i - loss::NAMES.len()] };
        i += 1;
    }
    all
};

/// Names of the losses with parameters, whose learning rate a config may set.
pub const LEARNED_LOSSES: [&str; 4] = ["robust", EXPOSURE, POSES, OUTLIER_VIEWS];

/// Adds a loss by its name in [`LOSSES`] to an objective of a model with a voxel grid. `views` is the number of training views.
///
/// Errors if the name is unknown.
pub fn with_loss<T: Real, M: AsRef<VoxelGrid<T>> + 'static>(
    objective: loss::Objective<T, M>,
    name: &str,
    weight: impl Schedule + 'static,
    views: usize,
) -> Result<loss::Objective<T, M>> {
    Ok(match name {
        "tv_density" => objective.with(name, weight, tv_density(Cells::Whole)),
        "tv_color" => objective.with(name, weight, tv_color(Cells::Whole)),
        "tv_density_sampled" => objective.with(name, weight, tv_density(Cells::SAMPLED)),
        "tv_color_sampled" => objective.with(name, weight, tv_color(Cells::SAMPLED)),
        _ if loss::NAMES.contains(&name) => objective.with_named(name, weight, views)?,
        _ => return Err(Error::usage(format!("losses.{name}"), "unknown loss", format!("expected one of {}", LOSSES.join(", ")))),
    })
}

/// Creates the objective that a config describes. `views` is the number of training views.
pub fn objective<T: Real>(config: &Config, views: usize) -> Result<Objective<T>> {
    if const { is_single::<T>() } { single::objective(config, views).map(cast) } else { of_config(config, views) }
}

pub(super) fn of_config<T: Real>(config: &Config, views: usize) -> Result<Objective<T>> {
    named(config, |objective, name, weight| with_loss(objective, name, weight, views))
}

/// Creates the objective of a model without a voxel grid that a config describes. `views` is the number of training views.
///
/// Errors if a loss reads a voxel grid.
pub fn objective_of_any<T: Real, M: 'static>(config: &Config, views: usize) -> Result<loss::Objective<T, M>> {
    named(config, |objective, name, weight| objective.with_named(name, weight, views))
}

fn named<T: Real, M>(
    config: &Config,
    with: impl Fn(loss::Objective<T, M>, &str, Weight) -> Result<loss::Objective<T, M>>,
) -> Result<loss::Objective<T, M>> {
    // Weights of views alone give no gradient to the model.
    if config.losses.keys().all(|name| name == OUTLIER_VIEWS) {
        return Err(Error::usage("losses", "there is no loss", "set at least one, such as `mse = 1.0`"));
    }
    let all = config.losses.iter().try_fold(loss::Objective::new(), |objective, (name, weight)| with(objective, name, *weight))?;
    let all = config.loss_rates.iter().fold(all, |objective, (loss, &rate)| {
        let of_loss = |name: &&str| *name == loss || name.strip_prefix(loss.as_str()).is_some_and(|rest| rest.starts_with('.'));
        let params: Vec<String> = objective.params().iter().map(|p| p.name()).filter(of_loss).map(str::to_owned).collect();
        params.into_iter().fold(objective, |objective, name| objective.with_rate(&name, rate))
    });
    Ok(match config.recipe().filter(|_| all.param(POSES).is_some()) {
        Some(recipe) => {
            let rate = config.loss_rates.get(POSES).copied().unwrap_or(POSE_RATE);
            all.with_pose_rate(rate, recipe.stages().iter().map(|stage| stage.steps).sum())
        }
        None => all,
    })
}
