//! The step that a loss reads.

use crate::errors::{invalid, state};
use crate::tensor::{PyTensor, Values};
use autograd::Tensor;
use ndarray::Array2;
use numpy::{PyArray1, PyArray2};
use plenoxel::loss::Step;
use plenoxel::rays::RayBatch;
use plenoxel::render::Rendered;
use pyo3::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

/// A training step: n rays, their photographed colors, and their rendered columns.
///
/// Gradients flow through `rgb`, `opacity`, `log_transmittance`, `depth`, `sparsity`, `distortion`, `coarse`, `prediction` and `param(name)`. A step is valid
/// during the call of the loss that it is given to. Numbers can be kept as `column.numpy().copy()`.
#[pyclass(name = "Step", module = "plenoxel", frozen)]
pub struct PyStep {
    /// Number of the step, from 0 over the whole run.
    #[pyo3(get)]
    number: u64,
    /// Seed of the run.
    #[pyo3(get)]
    seed: u64,
    /// Longest side of the model's box, world length.
    #[pyo3(get)]
    extent: f64,
    /// Background color, sRGB in [0, 1].
    #[pyo3(get)]
    background: [f32; 3],
    content: Mutex<Option<Arc<Content>>>,
}

struct Content {
    rendered: Rendered<f32>,
    prediction: Tensor<f32>,
    batch: RayBatch<f32>,
    params: Vec<(String, Tensor<f32>)>,
}

fn single(tensor: &Tensor<f32>) -> PyTensor {
    PyTensor(Values::Single(tensor.clone()))
}

impl PyStep {
    /// Copies what a loss may read of a step. Tensors are shared.
    pub fn new(step: &Step<'_, f32, ()>, params: Vec<(String, Tensor<f32>)>) -> Self {
        let content = Content { rendered: step.rendered.clone(), prediction: step.prediction.clone(), batch: step.batch.clone(), params };
        let Step { number, seed, extent, background, .. } = *step;
        PyStep { number, seed, extent, background, content: Mutex::new(Some(Arc::new(content))) }
    }

    /// Drops the tensors.
    pub fn close(&self) {
        self.content.lock().unwrap_or_else(PoisonError::into_inner).take();
    }

    fn content(&self) -> PyResult<Arc<Content>> {
        let content = self.content.lock().unwrap_or_else(PoisonError::into_inner).clone();
        content.ok_or_else(|| {
            state("step", "the call of the loss is over", "read the columns in the loss, and keep numbers as column.numpy().copy()")
        })
    }

    fn column(&self, of: impl FnOnce(&Content) -> Tensor<f32>) -> PyResult<PyTensor> {
        Ok(PyTensor(Values::Single(of(&*self.content()?))))
    }
}

#[pymethods]
impl PyStep {
    /// Rendered colors over the background, `[n, 3]`.
    #[getter]
    fn rgb(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.rgb.clone())
    }

    /// Predicted colors, `[n, 3]`: the rendered ones, unless a loss of the settings changes them, such as `exposure`.
    #[getter]
    fn prediction(&self) -> PyResult<PyTensor> {
        self.column(|x| x.prediction.clone())
    }

    /// Colors of an earlier pass over the same rays, `[n, 3]`; None for models with one pass.
    #[getter]
    fn coarse(&self) -> PyResult<Option<PyTensor>> {
        Ok(self.content()?.rendered.coarse.as_ref().map(single))
    }

    /// Opacity 1 - T, `[n]`, in [0, 1].
    #[getter]
    fn opacity(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.opacity.clone())
    }

    /// Logarithm of the transmittance, `[n]`, 0 or less.
    #[getter]
    fn log_transmittance(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.log_transmittance.clone())
    }

    /// Depth, the sum of weight times distance, `[n]`, world length. It is not divided by the opacity.
    #[getter]
    fn depth(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.depth())
    }

    /// Cauchy sparsity, the sum of ln(1 + 2 σ²) over the samples, `[n]`.
    #[getter]
    fn sparsity(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.sparsity())
    }

    /// Distortion of mip-NeRF 360 (eq. 15), `[n]`, world length.
    #[getter]
    fn distortion(&self) -> PyResult<PyTensor> {
        self.column(|x| x.rendered.distortion())
    }

    /// Photographed colors over the background, `[n, 3]`, sRGB in [0, 1]; a constant.
    #[getter]
    fn target(&self) -> PyResult<PyTensor> {
        self.column(|x| x.batch.target.clone())
    }

    /// Alpha of the photographs, `[n]`, in [0, 1]; a constant.
    #[getter]
    fn alpha(&self) -> PyResult<PyTensor> {
        self.column(|x| x.batch.alpha.clone())
    }

    /// Weights, `[n]`: those of importance sampling, times that of the ray's view (the loss `outlier_views`); None if all are 1. `mean` applies them.
    #[getter]
    fn weight(&self) -> PyResult<Option<PyTensor>> {
        Ok(self.content()?.batch.weight.as_ref().map(single))
    }

    /// Number of each ray's view among the training views, `[n]`.
    #[getter]
    fn view<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u32>>> {
        Ok(PyArray1::from_slice(py, &self.content()?.batch.view))
    }

    /// Column and row of each ray's pixel, `[n, 2]`.
    #[getter]
    fn pixel<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        let content = self.content()?;
        let pixels = &content.batch.pixel;
        Ok(PyArray2::from_owned_array(py, Array2::from_shape_fn((pixels.len(), 2), |(i, c)| pixels[i][c])))
    }

    /// Origins of the rays, `[n, 3]`, world.
    #[getter]
    fn origins<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let content = self.content()?;
        let rays = &content.batch.rays;
        Ok(PyArray2::from_owned_array(py, Array2::from_shape_fn((rays.len(), 3), |(i, c)| rays[i].origin[c])))
    }

    /// Unit directions of the rays, `[n, 3]`, world.
    #[getter]
    fn directions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let content = self.content()?;
        let rays = &content.batch.rays;
        Ok(PyArray2::from_owned_array(py, Array2::from_shape_fn((rays.len(), 3), |(i, c)| rays[i].direction[c])))
    }

    /// Returns a parameter of the losses by its name.
    fn param(&self, name: &str) -> PyResult<PyTensor> {
        let content = self.content()?;
        let found = content.params.iter().find(|(known, _)| known == name).map(|(_, tensor)| single(tensor));
        found.ok_or_else(|| {
            let known: Vec<&str> = content.params.iter().map(|(name, _)| name.as_str()).collect();
            invalid("param", format!("`{name}`"), &format!("one of {known:?}, which are given with params=[...]"))
        })
    }

    /// Returns the mean over rays and further axes of values `[n, ...]`, with the weights of the rays.
    fn mean(&self, py: Python<'_>, values: &PyTensor) -> PyResult<PyTensor> {
        let (content, values) = (self.content()?, values.single("mean")?);
        if values.shape().first() != Some(&content.batch.len()) {
            let found = format!("the values have the shape {:?}", values.shape());
            return Err(crate::errors::array("mean", found, format!("expected one row for each of {} rays", content.batch.len())));
        }
        crate::errors::compute(py, || single(&content.batch.mean(&values)))
    }

    /// Number of rays.
    fn __len__(&self) -> PyResult<usize> {
        Ok(self.content()?.batch.len())
    }

    fn __repr__(&self) -> String {
        format!("Step({})", self.number)
    }
}
