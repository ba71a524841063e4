//! The tables of a voxel grid.

use crate::errors::{attempt, compute};
use crate::run::{Loaded, shown};
use ndarray::Array2;
use numpy::{PyArray2, PyArrayDyn};
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::VoxelGrid;
use pyo3::prelude::*;
use std::sync::Arc;

/// A voxel grid: tables with one row per voxel. Arrays are read-only views of the model, without a copy.
///
/// The centre of voxel (i, j, k) is at (index + 0.5) * voxel_side - half_width in the world of the run.
#[pyclass(module = "plenoxel", frozen)]
pub struct Grid {
    pub loaded: Arc<Loaded>,
}

impl Grid {
    fn grid(&self) -> Result<&VoxelGrid<f32>> {
        self.loaded.grid("a table of voxels")
    }

    fn read<R: Send>(&self, py: Python<'_>, of: impl FnOnce(&VoxelGrid<f32>) -> R + Send) -> PyResult<R> {
        attempt(py, || Ok(of(self.grid()?)))
    }
}

#[pymethods]
impl Grid {
    /// Number of voxels along each axis.
    #[getter]
    fn resolution(&self, py: Python<'_>) -> PyResult<usize> {
        self.read(py, |grid| grid.shape().resolution)
    }

    /// Half the side of the box, world length.
    #[getter]
    fn half_width(&self, py: Python<'_>) -> PyResult<f64> {
        self.read(py, |grid| grid.shape().half_width)
    }

    /// Side of a voxel, world length.
    #[getter]
    fn voxel_side(&self, py: Python<'_>) -> PyResult<f64> {
        self.read(py, |grid| grid.shape().voxel_side())
    }

    /// Degree of the spherical harmonics; None for constant colors.
    #[getter]
    fn sh_degree(&self, py: Python<'_>) -> PyResult<Option<usize>> {
        use plenoxel::field::voxel_grid::Color;
        self.read(py, |grid| if let Color::Sh { degree, .. } = grid.shape().color { Some(degree) } else { None })
    }

    /// Raw densities, `[rows, 1]`, 1 / world length. A density is max(0, x) after interpolation.
    #[getter]
    fn density<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        shown(py, self.read(py, |grid| grid.density.tensor().detach())?)
    }

    /// Colors or coefficients of harmonics, `[rows, width]`; those of degree 0 if harmonics are stored on a coarser grid.
    #[getter]
    fn color<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        shown(py, self.read(py, |grid| grid.color.tensor().detach())?)
    }

    /// Coefficients of degree 1 and more on a coarser grid, `[rows of that grid, width]`; None if they are in `color`.
    #[getter]
    fn harmonics<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArrayDyn<f32>>>> {
        let tensor = self.read(py, |grid| grid.harmonics.as_ref().map(|param| param.tensor().detach()))?;
        tensor.map(|tensor| shown(py, tensor)).transpose()
    }

    /// Index (i, j, k) of the voxel of each row of `density` and `color`, `[rows, 3]`; -1 for rows of no voxel.
    fn voxels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i32>>> {
        let loaded = &self.loaded;
        let voxels = compute(py, || {
            loaded.grid("a table of voxels").map(|grid| {
                let lattice = grid.lattice();
                let mut voxels = Array2::from_elem((lattice.rows(), 3), -1);
                for (row, mut voxel) in voxels.rows_mut().into_iter().enumerate() {
                    if let Some(node) = lattice.node(row as u32) {
                        voxel.iter_mut().zip(node).for_each(|(to, side)| *to = side as i32);
                    }
                }
                voxels
            })
        })?;
        Ok(PyArray2::from_owned_array(py, voxels.map_err(crate::errors::raised)?))
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        self.read(py, |grid| format!("Grid({0}³, {1} voxels)", grid.shape().resolution, grid.lattice().present()))
    }
}
