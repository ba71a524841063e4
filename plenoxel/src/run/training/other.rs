//! Runs that train another model than the voxel grid: one with a table of settings of its own ([`Recipe`]).

use super::started::{NewRun, OldRun};
use super::{Event, Listener, MakeLosses, Outcome, RunOptions, RunSettings, job, with_losses};
use crate::dataset::{Dataset, Split, View};
use crate::error::Result;
use crate::evaluate::Viewer;
use crate::loss::POSES;
use crate::model::plenoxels::config::Config;
use crate::model::plenoxels::objective_of_any;
use crate::model::recipe::Recipe;
use crate::run::data::DataSource;
use crate::run::memory::Estimate;
use crate::run::pace::{self, Begun, Pace};
use crate::space::Region;
use crate::text::clock;
use crate::train::{Trainer, ViewOptions};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Creates the trainer of a run with further losses.
///
/// Errors: a setting is invalid; a loss needs a voxel grid; there are no training views.
fn trainer<R: Recipe>(
    config: &Config,
    recipe: &R,
    region: Region,
    views: Arc<[View]>,
    losses: &MakeLosses<'_>,
) -> Result<Trainer<f32, R::Model>> {
    let objective = recipe.own_losses(with_losses(config, || objective_of_any(config, views.len()), losses)?);
    Trainer::with_model(recipe.model(config, region)?, views, objective, config.train_options())
}

/// Returns the region in which a model of a dataset is trained.
fn region(dataset: &Dataset, config: &Config) -> Region {
    Region::of(dataset.space(), &dataset.cameras(Split::Train), config.half_width)
}

/// Trains a model.
pub fn train<R: Recipe + Clone>(settings: &RunSettings, recipe: &R, losses: &MakeLosses<'_>, on: &mut Listener<'_>) -> Result<Outcome> {
    let mut recipe = recipe.clone();
    let mut run = NewRun::open(settings, on)?;
    let region = region(&run.dataset, &run.config);
    run.check_cameras(region.aabb, on)?;
    let estimate = Estimate::of_recipe(&run.config, &recipe, &run.dataset, &settings.options);
    on(Event::note(estimate.describe()));
    estimate.check()?;
    run.saved = estimate.saved();
    run.read(on)?;
    let (mut begun, mut pace) = (None, None);
    if let Some(time) = run.time_budget(1.0) {
        on(Event::note("measuring the speed of this machine"));
        let NewRun { config, views, clocks, dataset, .. } = &mut run;
        let begin = |recipe: &R| trainer(config, recipe, region, views.clone(), losses);
        // The schedule of the poses counts all steps of the run.
        let adjusts = !config.losses.contains_key(POSES);
        let planned = clocks.train.time(|| pace::plan(&recipe, time, adjusts, begin))?;
        let asked = planned.asked;
        (recipe, begun) = (planned.recipe, planned.begun);
        let stages = recipe.stages().into_iter().map(|stage| match stage.resolution {
            Some(resolution) => format!("{} at up to {resolution}³", stage.steps),
            None => stage.steps.to_string(),
        });
        on(Event::note(format!(
            "planned for {}{}: steps {}",
            clock(time.seconds),
            settings.included(),
            stages.collect::<Vec<_>>().join(", ")
        )));
        recipe.clone().set(config);
        pace = adjusts.then(|| {
            let (view, evaluated) = (ViewOptions::over(config.background), job::test_cameras(dataset, &settings.options));
            let evaluation = move |model: &R::Model| {
                let start = Instant::now();
                let viewer = Viewer::of(model, &view);
                start.elapsed().as_secs_f64() + viewer.seconds_for(&evaluated)
            };
            Pace::new(recipe.clone(), asked, config.clone(), time, settings.with_evaluation.then(|| Box::new(evaluation) as _))
        });
    }
    let NewRun { config, views, clocks, .. } = &mut run;
    let begun = match begun {
        Some(begun) => begun,
        None => Begun::new(clocks.train.time(|| trainer(config, &recipe, region, views.clone(), losses))?),
    };
    // What includes the evaluation includes everything from the beginning.
    let began = run.began;
    let spent = |training: f64| if settings.with_evaluation { began.elapsed().as_secs_f64() } else { training };
    run.learn(begun, &mut |trainer, seconds| pace.as_mut()?.after_step(trainer, spent(seconds)), on)
}

/// Resumes a run.
pub fn resume<R: Recipe>(
    path: &Path,
    recipe: &R,
    data: Option<DataSource>,
    options: &RunOptions,
    losses: &MakeLosses<'_>,
    on: &mut Listener<'_>,
) -> Result<Outcome> {
    let mut run = OldRun::open(path, data, options, on)?;
    let estimate = Estimate::of_recipe(&run.config, recipe, &run.dataset, options);
    on(Event::note(estimate.describe()));
    estimate.check()?;
    run.read(on)?;
    let region = region(&run.dataset, &run.config);
    let trainer = trainer(&run.config, recipe, region, run.views.clone(), losses)?;
    run.learn(trainer, on)
}
