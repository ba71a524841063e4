//! Fields that are written in Python.

mod training;

pub use training::{TrainedField, train_field};

use crate::errors::{array, dtype, invalid};
use crate::loss::{Failure, Param, check_names};
use crate::tensor::{PyTensor, Values};
use autograd::optim::{Adam, AdamMode, Exponential, Optimizer, Rates};
use autograd::{Module, Param as TrainedParam, Tensor};
use plenoxel::camera::Ray;
use plenoxel::error::{Error, Result};
use plenoxel::geometry::Aabb;
use plenoxel::render::{Engine, Field, Radiance, RenderOptions, Rendered, render};
use plenoxel::sampling::{Occupancy, Refresh, RunningOccupancy, Samples, Spacing};
use plenoxel::tensor_file::{TensorFile, TensorWriter};
use plenoxel::train::{Model, Pass, PlannedStage, read_params};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Opacity of a step in a cell above which the cell is always sampled.
const OCCUPIED_ABOVE: f64 = 0.01;
/// Factor of the learning rates at the last step; they decay exponentially.
const LAST_RATE: f64 = 0.1;

/// How a field is sampled.
#[derive(Clone, Copy, PartialEq)]
struct Sampling {
    /// Half of the side of the box, world length.
    half_width: f64,
    /// Number of samples on the side of the box.
    samples: usize,
    /// Number of cells along each axis; those of low density are skipped. 0 samples everywhere.
    cells: usize,
}

impl Sampling {
    fn aabb(&self) -> Aabb {
        Aabb::cube(self.half_width)
    }

    /// Distance between samples, world length.
    fn step(&self) -> f64 {
        2.0 * self.half_width / self.samples as f64
    }
}

/// A field written in Python as a model of the library: `density(positions, params)` and `radiance(positions, directions, params)`.
struct PyField {
    object: Py<PyAny>,
    params: Vec<TrainedParam<f32>>,
    rates: Vec<f64>,
    sampling: Sampling,
    /// Densities of the cells; `None` if all are sampled.
    running: Option<RunningOccupancy>,
    occupied: Option<Occupancy>,
    seed: u64,
    failure: Failure,
    stop: Arc<AtomicBool>,
}

impl PyField {
    /// Creates a model with the initial values of `params`. `failure` takes the first exception of the functions, which then return NaN. After it, or once `stop`
    /// is true, pictures are empty, so that an evaluation ends soon.
    fn new(object: Py<PyAny>, params: &[Py<Param>], sampling: Sampling, seed: u64, failure: Failure, stop: Arc<AtomicBool>) -> Self {
        let trained = |param: &Py<Param>| TrainedParam::from_tensor(param.get().name.clone(), param.get().tensor());
        let refresh = Refresh { decay: 0.95, limit: OCCUPIED_ABOVE / sampling.step(), every: 16, warm_up: 256 };
        let running = (sampling.cells > 0).then(|| RunningOccupancy::new(Occupancy::full(sampling.aabb(), [sampling.cells; 3]), refresh));
        PyField {
            object,
            params: params.iter().map(trained).collect(),
            rates: params.iter().map(|param| param.get().rate).collect(),
            sampling,
            running,
            occupied: None,
            seed,
            failure,
            stop,
        }
    }

    /// Selects the cells that are sampled. If the density is low and the same everywhere, no cell is above the mean, and all are sampled.
    fn occupy(&mut self) {
        self.occupied = self.running.as_ref().map(RunningOccupancy::occupied).filter(|cells| cells.fraction() > 0.0);
    }

    /// Calls a function of the field with tensors and the parameters. Returns tensors of the shapes that are expected; NaN after an exception.
    fn call<const N: usize>(&self, function: &str, arguments: &[Tensor<f32>], expected: [&[usize]; N]) -> [Tensor<f32>; N] {
        let called = Python::attach(|py| {
            let params = PyDict::new(py);
            for param in &self.params {
                params.set_item(param.name(), single(param.tensor().clone()))?;
            }
            let arguments = arguments.iter().map(|tensor| Bound::new(py, single(tensor.clone())).map(Bound::into_any));
            let arguments = arguments.chain([Ok(params.into_any())]).collect::<PyResult<Vec<_>>>()?;
            let result = self.object.bind(py).getattr(function)?.call1(pyo3::types::PyTuple::new(py, arguments)?)?;
            results(&result, &format!("field.{function}"), expected)
        });
        called.unwrap_or_else(|error| {
            self.failure.set(error);
            expected.map(|shape| Tensor::full(shape, f64::NAN))
        })
    }
}

fn single(tensor: Tensor<f32>) -> PyTensor {
    PyTensor(Values::Single(tensor))
}

/// Reads the density, or the pair of density and color, that a function returned.
///
/// Errors: it is something else; a shape is another; a density is negative or NaN.
fn results<const N: usize>(result: &Bound<'_, PyAny>, place: &str, expected: [&[usize]; N]) -> PyResult<[Tensor<f32>; N]> {
    let wanted = if N == 1 { "return a Tensor [n], the density" } else { "return two Tensors, the density [n] and the color [n, 3]" };
    let other = || PyResult::Ok(dtype(place, format!("the function returned a {}", result.get_type().name()?), wanted));
    let returned: Vec<PyTensor> = match result.extract::<PyTensor>() {
        Ok(tensor) => vec![tensor],
        Err(_) => match result.extract::<Vec<PyTensor>>() {
            Ok(tensors) => tensors,
            Err(_) => return Err(other()?),
        },
    };
    if returned.len() != N {
        return Err(array(place, format!("the number of returned tensors is {}", returned.len()), wanted));
    }
    let tensors = returned.iter().map(|tensor| tensor.single(place)).collect::<PyResult<Vec<_>>>()?;
    for (tensor, shape) in tensors.iter().zip(expected) {
        if tensor.shape() != shape {
            let found = format!("the function returned the shape {:?} for {} positions", tensor.shape(), shape[0]);
            return Err(array(place, found, format!("expected {shape:?}; {wanted}")));
        }
    }
    if let Some(density) = tensors[0].data().iter().find(|density| density.is_nan() || **density < 0.0) {
        return Err(array(place, format!("a density is {density}"), "expected 0 or more, such as softplus of a number"));
    }
    Ok(std::array::from_fn(|k| tensors[k].clone()))
}

impl Field<f32> for PyField {
    fn density(&self, positions: &Tensor<f32>) -> Tensor<f32> {
        let [sigma] = self.call("density", std::slice::from_ref(positions), [&positions.shape()[..1]]);
        sigma
    }

    fn radiance(&self, samples: &Samples<f32>) -> Radiance<f32> {
        let n = samples.len();
        if n == 0 {
            return Radiance { sigma: Tensor::zeros(&[0]), rgb: Tensor::zeros(&[0, 3]) };
        }
        let directions = samples.directions.segment_repeat(&samples.offsets);
        let [sigma, rgb] = self.call("radiance", &[samples.positions.clone(), directions], [&[n], &[n, 3]]);
        Radiance { sigma, rgb }
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.occupied.as_ref()
    }
}

impl Module<f32> for PyField {
    fn visit(&self, f: &mut dyn FnMut(&TrainedParam<f32>)) {
        self.params.iter().for_each(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut TrainedParam<f32>)) {
        self.params.iter_mut().for_each(f);
    }
}

impl Model<f32> for PyField {
    fn kind(&self) -> &'static str {
        "python"
    }

    fn aabb(&self) -> Aabb {
        self.sampling.aabb()
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<f32> {
        let is_picture = pass.stage.is_none();
        let ended = is_picture && (self.stop.load(Relaxed) || self.failure.is_set());
        let nothing = ended.then(|| Occupancy::new(self.aabb(), [1; 3], &[false]));
        let options = RenderOptions {
            aabb: self.aabb(),
            spacing: Spacing::Step(self.sampling.step()),
            jitter: pass.jitter,
            background: pass.background,
            occupancy: nothing.as_ref(),
            engine: Engine::Graph,
            stop_below: 0.0,
        };
        render(self, rays, &options)
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<f32>> {
        let decaying = |rate: f64| Exponential::new(rate, LAST_RATE * rate, stage.steps);
        // A schedule cannot fall from 0, which is the rate of all others.
        let trained = self.params.iter().zip(&self.rates).filter(|(_, rate)| **rate > 0.0);
        let rates = trained.fold(Rates::new(0.0), |rates, (param, &rate)| rates.with(param.name(), decaying(rate)));
        Box::new(Adam::new(rates, AdamMode::Dense).betas(0.9, 0.99))
    }

    fn begin_step(&mut self, in_stage: u64) -> Result<()> {
        // `density` borrows the whole field, so the estimates are taken out while they change.
        if let Some(mut running) = self.running.take_if(|running| running.refresh().is_due(in_stage)) {
            running.update(self.seed, in_stage, |at| self.density(at));
            self.running = Some(running);
            self.occupy();
        }
        match self.failure.is_set() {
            // The exception replaces this error.
            true => Err(Error::usage("field", "a function of the field failed", "see its exception")),
            false => Ok(()),
        }
    }

    fn settings(&self) -> Value {
        let Sampling { half_width, samples, cells } = self.sampling;
        json!({ "half_width": half_width, "samples": samples, "cells": cells, "rates": self.rates })
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
        if let Some(running) = &self.running {
            file.numbers(ESTIMATES, &[running.estimates().len()], running.estimates());
        }
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        read_params(self, file)?;
        if let Some(running) = &mut self.running {
            let estimates = file.tensor::<f32>(ESTIMATES, &[running.estimates().len()])?;
            running.set_estimates(estimates.data().to_vec());
            self.occupy();
        }
        Ok(())
    }
}

/// Name of the estimates of the cells' densities in a file.
const ESTIMATES: &str = "occupancy.estimates";

/// Errors if there is no parameter, two have the same name, or a name means something else in the file of a training.
fn check_params(params: &[Py<Param>]) -> PyResult<()> {
    check_names(params)?;
    let taken = |name: &str| name == ESTIMATES || name == "__metadata__" || name.starts_with("loss.") || name.contains(".optimizer.");
    match params.iter().map(|param| &param.get().name).find(|name| taken(name)) {
        Some(name) => Err(invalid("field.params", format!("a parameter `{name}`"), "another name; the file of a training has this one")),
        None if params.is_empty() => Err(invalid("field.params", "[]", "at least one Param")),
        None => Ok(()),
    }
}
