//! Training of a field that is written in Python.

use super::{PyField, Sampling, check_params};
use crate::camera::{PyCamera, matrix_of};
use crate::errors::{attempt, compute, invalid, raised};
use crate::events::Message;
use crate::loss::{Failure, Losses, Param};
use crate::run::{Picture, over, scores, see};
use crate::scene::{Scene, split_of};
use crate::training::{Extras, in_background, seconds};
use numpy::{PyArray2, ToPyArray};
use plenoxel::dataset::normalize::SpaceChoice;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Result;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::evenly_spaced;
use plenoxel::train::{TrainOptions, Trainer, ViewOptions};
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// Arguments of `train_field` besides the scene, the field and those of [`Extras`].
#[derive(FromPyObject)]
pub struct FieldOptions {
    #[pyo3(item)]
    params: Vec<Py<Param>>,
    #[pyo3(item)]
    steps: i64,
    #[pyo3(item)]
    rays_per_step: i64,
    #[pyo3(item)]
    samples: i64,
    #[pyo3(item)]
    cells: i64,
    #[pyo3(item)]
    half_width: f64,
    #[pyo3(item)]
    seed: i64,
    #[pyo3(item)]
    background: [f32; 3],
    #[pyo3(item)]
    downscale: i64,
    #[pyo3(item)]
    out: Option<PathBuf>,
    #[pyo3(item)]
    force: bool,
    #[pyo3(item)]
    resume: bool,
}

impl FieldOptions {
    /// Errors if a value is out of range.
    fn check(&self) -> PyResult<()> {
        check_params(&self.params)?;
        let numbers = [
            ("steps", self.steps, 1, 1_000_000_000),
            ("rays_per_step", self.rays_per_step, 1, 1 << 20),
            ("samples", self.samples, 1, 4096),
            ("cells", self.cells, 0, 256),
            ("seed", self.seed, 0, i64::MAX),
            ("downscale", self.downscale, 1, 64),
        ];
        if let Some((key, value, least, most)) = numbers.into_iter().find(|&(_, value, least, most)| !(least..=most).contains(&value)) {
            return Err(invalid(key, value, &format!("{least} to {most}")));
        }
        match &self.out {
            None if self.resume => return Err(invalid("resume", "True", "out, the file to resume")),
            Some(file) if file.exists() && !(self.resume || self.force) => {
                return Err(invalid("out", file.display(), "a file that does not exist, or resume=True or force=True"));
            }
            Some(file) if file.parent().is_some_and(|folder| !(folder.as_os_str().is_empty() || folder.is_dir())) => {
                return Err(invalid("out", file.display(), "a file in a folder that exists"));
            }
            _ => {}
        }
        self.config().validate().map_err(raised)
    }

    /// The settings of a run that a field shares: how images are read, drawn and rendered.
    fn config(&self) -> Config {
        let mut config = Config {
            half_width: self.half_width,
            background: self.background,
            seed: self.seed as u64,
            rays_per_step: self.rays_per_step as usize,
            downscale: self.downscale as usize,
            ..Config::default()
        };
        config.capture.space = SpaceChoice::Box;
        config
    }

    fn train_options(&self) -> TrainOptions {
        TrainOptions { steps: self.steps as u64, ..self.config().train_options() }
    }
}

/// A trained field.
#[pyclass(module = "plenoxel._plenoxel", frozen)]
pub struct TrainedField {
    model: PyField,
    /// Locked while the field is rendered, so that an exception is that of the call that raised it.
    rendering: Mutex<()>,
    dataset: Dataset,
    config: Config,
    /// Scores of the test views, as JSON.
    #[pyo3(get)]
    scores: Option<String>,
    /// Number of steps taken.
    #[pyo3(get)]
    steps: u64,
}

/// Trains a field and evaluates it on the test views.
#[pyfunction]
pub fn train_field(py: Python<'_>, scene: &Scene, field: Py<PyAny>, options: FieldOptions, extras: Extras<'_>) -> PyResult<TrainedField> {
    options.check()?;
    let Extras { losses, params, listener, checkpoint_every, test_views, threads, .. } = extras;
    let (failure, stop) = (Failure::default(), Arc::new(AtomicBool::new(false)));
    let objective = match losses.is_empty() {
        true => Objective::new().with("mse", 1.0, mse),
        false => Objective::new(),
    };
    let objective = objective.joined(Losses::new(py, losses, params, failure.clone())?.objective());
    let sampling = Sampling { half_width: options.half_width, samples: options.samples as usize, cells: options.cells as usize };
    let model = PyField::new(field, &options.params, sampling, options.seed as u64, failure.clone(), stop.clone());
    let (config, every) = (options.config(), seconds("checkpoint_every", &checkpoint_every)?);
    let dataset = attempt(py, || scene.source.open(&config))?;
    let (asked, shown) = (stop.clone(), failure.clone());
    let work = |tell: &(dyn Fn(Message) + Sync)| -> Result<TrainedField> {
        let views = dataset.load(Split::Train, &|_, _| ())?;
        let mut trainer = Trainer::with_model(model, views, objective, options.train_options())?;
        if let Some(file) = options.out.as_ref().filter(|_| options.resume) {
            trainer = trainer.resumed(file)?;
        }
        let save = |trainer: &Trainer<f32, PyField>| match &options.out {
            Some(file) if trainer.steps_taken() > 0 => {
                trainer.save(file, dataset.name())?;
                tell(Message::Saved { steps: trainer.steps_taken() });
                Ok(())
            }
            _ => Ok(()),
        };
        tell(Message::Planned { steps: trainer.total_steps() });
        let (start, mut saved) = (Instant::now(), Instant::now());
        while !asked.load(Relaxed) {
            let Some(report) = trainer.step()? else { break };
            tell(Message::step(&report, None, start.elapsed().as_secs_f64(), Vec::new()));
            if saved.elapsed().as_secs_f64() > every {
                save(&trainer)?;
                saved = Instant::now();
            }
        }
        for (param, trained) in options.params.iter().zip(&trainer.model().params) {
            param.get().set(trained.tensor());
        }
        save(&trainer)?;
        let steps = trainer.steps_taken();
        let model = trainer.into_model();
        let test = evenly_spaced(dataset.count(Split::Test), test_views.unwrap_or(usize::MAX));
        let evaluated = !(test.is_empty() || asked.load(Relaxed));
        let scores = evaluated.then(|| {
            let views = dataset.load_views(Split::Test, &test, &|_, _| ())?;
            scores(&model, &views, Split::Test, &dataset, &config, &ViewOptions::over(config.background))
        });
        let scores = scores.transpose()?;
        Ok(TrainedField { model, rendering: Mutex::new(()), dataset, config, scores, steps })
    };
    let (trained, heard) = in_background(py, listener.as_ref(), threads, &stop, work)?;
    // After an exception of a function, the training has ended with an error of its own, or a picture is empty.
    if let Some(error) = shown.take() {
        return Err(error);
    }
    let trained = trained.map_err(raised)?;
    heard.map_or(Ok(trained), Err)
}

impl TrainedField {
    /// Returns the result of rendering, unless a function of the field has failed.
    fn rendered<R: Send>(&self, py: Python<'_>, render: impl FnOnce() -> Result<R> + Send) -> PyResult<R> {
        let (rendered, failure) = compute(py, || {
            let _alone = self.rendering.lock().unwrap_or_else(PoisonError::into_inner);
            (render(), self.model.failure.take())
        })?;
        failure.map_or_else(|| rendered.map_err(raised), Err)
    }
}

#[pymethods]
impl TrainedField {
    /// The similarity from the coordinates of the dataset to the world of the field, `[4, 4]`.
    #[getter]
    fn to_world<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        matrix_of(&self.dataset.normalization().to_world).to_pyarray(py)
    }

    /// Renders the image of a camera.
    fn render(&self, py: Python<'_>, camera: &PyCamera, background: Option<[f32; 3]>) -> PyResult<Picture> {
        let options = over(background.unwrap_or(self.config.background))?;
        let to_world = self.dataset.normalization().to_world;
        self.rendered(py, || Ok(see(&self.model, camera, &to_world, &options)))
    }

    /// Scores of the views of a split, as JSON.
    fn evaluate(&self, py: Python<'_>, split: &str, background: Option<[f32; 3]>) -> PyResult<String> {
        let (split, options) = (split_of(&self.dataset, split)?, over(background.unwrap_or(self.config.background))?);
        self.rendered(py, || {
            let views = self.dataset.load(split, &|_, _| ())?;
            scores(&self.model, &views, split, &self.dataset, &self.config, &options)
        })
    }
}
