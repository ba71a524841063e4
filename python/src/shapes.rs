//! Point clouds and meshes.

use crate::errors::{attempt, raised};
use ndarray::Array2;
use numpy::{Element, PyArray1, PyArray2, ToPyArray};
use plenoxel::error::{Error, Result};
use plenoxel::export::mesh::Mesh;
use plenoxel::export::mesh_file::MeshFormat;
use plenoxel::files;
use plenoxel::point_cloud::PointCloud;
use plenoxel::point_cloud::ply::encode;
use plenoxel::run::PROGRAM;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::{Path, PathBuf};

/// A new array `[n, 3]`.
fn table<'py, T: Element + Copy>(py: Python<'py>, rows: &[[T; 3]]) -> Bound<'py, PyArray2<T>> {
    PyArray2::from_owned_array(py, Array2::from_shape_fn((rows.len(), 3), |(i, c)| rows[i][c]))
}

/// The extension of a file in lower case.
fn ending(path: &Path) -> String {
    path.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

/// Voxels as points, in the coordinates of the dataset.
#[pyclass(name = "PointCloud", module = "plenoxel", frozen)]
pub struct PyPoints {
    cloud: PointCloud,
    /// Side of a voxel, in the unit of the dataset.
    #[pyo3(get)]
    voxel_side: f64,
}

impl PyPoints {
    pub fn new(cloud: PointCloud, voxel_side: f64) -> Self {
        PyPoints { cloud, voxel_side }
    }
}

#[pymethods]
impl PyPoints {
    /// Positions, `[n, 3]`.
    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        table(py, &self.cloud.positions.iter().map(|p| p.to_array()).collect::<Vec<_>>())
    }

    /// Colors, `[n, 3]`, uint8 sRGB.
    #[getter]
    fn colors<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray2<u8>>> {
        self.cloud.colors.as_ref().map(|colors| table(py, colors))
    }

    /// Unit normals, `[n, 3]`, out of the surface.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray2<f32>>> {
        self.cloud.normals.as_ref().map(|normals| table(py, normals))
    }

    /// Further values of each point, by name: opacity, density and, if visibility was computed, weight and object.
    #[getter]
    fn fields<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let fields = PyDict::new(py);
        for field in &self.cloud.fields {
            let values: Bound<'_, PyArray1<f32>> = field.values.to_pyarray(py);
            fields.set_item(&field.name, values)?;
        }
        Ok(fields)
    }

    /// Writes a PLY file.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        if ending(&path) != "ply" {
            return Err(raised(Error::usage(
                "path",
                format!("{} does not end in .ply", path.display()),
                "choose a name that ends in .ply",
            )));
        }
        attempt(py, || {
            files::write_atomically(&path, &encode(&self.cloud, &[PROGRAM.to_owned(), format!("voxel_side {}", self.voxel_side)]))
        })
    }

    fn __len__(&self) -> usize {
        self.cloud.len()
    }

    fn __repr__(&self) -> String {
        format!("PointCloud({} points)", self.cloud.len())
    }
}

/// A colored surface, in the coordinates of the dataset.
#[pyclass(name = "Mesh", module = "plenoxel", frozen)]
pub struct PyMesh(Mesh);

impl PyMesh {
    pub fn new(mesh: Mesh) -> Self {
        PyMesh(mesh)
    }
}

#[pymethods]
impl PyMesh {
    /// Positions of the vertices, `[v, 3]`.
    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        table(py, &self.0.positions)
    }

    /// Unit normals of the vertices, `[v, 3]`.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        table(py, &self.0.normals)
    }

    /// Colors of the vertices, `[v, 3]`, uint8 sRGB.
    #[getter]
    fn colors<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<u8>> {
        table(py, &self.0.colors)
    }

    /// Vertices of the triangles, `[t, 3]`, counterclockwise from outside.
    #[getter]
    fn triangles<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<u32>> {
        table(py, &self.0.triangles)
    }

    /// Enclosed volume, in the unit of the dataset cubed.
    #[getter]
    fn volume(&self) -> f64 {
        self.0.volume()
    }

    /// Writes a file in the format of its extension: ply, obj, glb or stl.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let write = || -> Result<()> {
            let format: MeshFormat = ending(&path).parse()?;
            files::write_atomically(&path, &format.encode(&self.0, PROGRAM)?)
        };
        attempt(py, write)
    }

    fn __repr__(&self) -> String {
        format!("Mesh({} vertices, {} triangles)", self.0.positions.len(), self.0.triangles.len())
    }
}
