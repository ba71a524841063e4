//! Runs that train a factored field (`tensorf` in the config).

use super::{Event, Listener, NewRun, OldRun, Outcome, RunOptions, RunSettings, clock};
use crate::dataset::View;
use crate::error::Result;
use crate::geometry::Aabb;
use crate::model::plenoxels::config::Config;
use crate::model::plenoxels::objective_of_any;
use crate::model::tensorf::{self, Tensorf};
use crate::run::budget;
use crate::run::data::DataSource;
use crate::run::memory::Estimate;
use crate::train::Trainer;
use std::path::Path;
use std::sync::Arc;

/// Creates the trainer of a run.
///
/// Errors: a setting is invalid; a loss needs a voxel grid; there are no training views.
fn trainer(config: &Config, tensorf: &tensorf::Config, views: Arc<[View]>) -> Result<Trainer<f32, Tensorf<f32>>> {
    let mut model = Tensorf::new(tensorf.clone(), Aabb::cube(config.half_width), config.seed)?.with_hull(config.hull);
    model.engine = config.engine;
    let objective = objective_of_any(config, views.len())?;
    Trainer::with_model(model, views, objective, config.train_options())
}

/// Trains a factored field.
pub fn train(settings: &RunSettings, tensorf: &tensorf::Config, on: &mut Listener<'_>) -> Result<Outcome> {
    let mut tensorf = tensorf.clone();
    let mut run = NewRun::open(settings, on)?;
    run.check_cameras(Aabb::cube(run.config.half_width), on)?;
    let estimate = Estimate::of_factored(&run.config, &tensorf, &run.dataset, &settings.options);
    on(Event::note(estimate.describe()));
    estimate.check()?;
    run.saved = estimate.saved();
    run.read(on)?;
    if let Some(seconds) = settings.time {
        on(Event::note("measuring the speed of this machine"));
        let NewRun { config, views, clocks, .. } = &mut run;
        let begin = |tensorf: tensorf::Config| trainer(config, &tensorf, views.clone());
        tensorf = clocks.train.time(|| budget::factored_on_time(tensorf, seconds, begin))?;
        let stages = tensorf.stages.iter().map(|stage| format!("{} at {}³", stage.steps, stage.resolution));
        on(Event::note(format!("planned for {}: steps {}", clock(seconds), stages.collect::<Vec<_>>().join(", "))));
        config.tensorf = Some(tensorf.clone());
    }
    let NewRun { config, views, clocks, .. } = &mut run;
    let trainer = clocks.train.time(|| trainer(config, &tensorf, views.clone()))?;
    run.learn(trainer, on)
}

/// Resumes a run that trains a factored field.
pub fn resume(
    path: &Path,
    tensorf: &tensorf::Config,
    data: Option<DataSource>,
    options: &RunOptions,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    let mut run = OldRun::open(path, data, options, on)?;
    let estimate = Estimate::of_factored(&run.config, tensorf, &run.dataset, options);
    on(Event::note(estimate.describe()));
    estimate.check()?;
    run.read(on)?;
    let trainer = trainer(&run.config, tensorf, run.views.clone())?;
    run.learn(trainer, on)
}
