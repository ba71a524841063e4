//! Scenes: photographs with cameras, from a folder, from arrays, or built in.

use crate::arrays::{entries, finite, image, numbers};
use crate::camera::{Axes, PyCamera, intrinsics, matrix_of, moved, pose};
use crate::errors::{array, attempt, raised};
use ndarray::{Array3, ArrayD, Axis};
use numpy::{PyArray2, PyArray3, ToPyArray};
use plenoxel::camera::Camera;
use plenoxel::dataset::mask::Mask;
use plenoxel::dataset::memory::{Photograph, Photographs};
use plenoxel::dataset::normalize::looked_at;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Error;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::data::DataSource;
use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

/// Photographs with known cameras, in a train, a validation and a test split.
///
/// `open`, `dataset` and `procedural` make scenes. Images are read when they are needed.
#[pyclass(name = "Scene", module = "plenoxel", frozen)]
pub struct Scene {
    pub source: DataSource,
    /// The dataset with the default settings; a run may reduce its images, or move it otherwise.
    dataset: Dataset,
}

impl Scene {
    fn of(py: Python<'_>, source: DataSource) -> PyResult<Self> {
        let dataset = attempt(py, || source.open(&Config::default()))?;
        Ok(Scene { source, dataset })
    }
}

/// Opens a dataset folder. All metadata is checked now; images are read when a run starts.
#[pyfunction]
pub fn open(py: Python<'_>, folder: PathBuf) -> PyResult<Scene> {
    Scene::of(py, DataSource::folder(&folder))
}

/// Returns the built-in scene with images of `width` x `height` pixels.
#[pyfunction]
pub fn procedural(py: Python<'_>, width: usize, height: usize, train: usize, val: usize, test: usize) -> PyResult<Scene> {
    Scene::of(py, DataSource::built_in(&ProceduralOptions { width, height, train, val, test, ..ProceduralOptions::default() }))
}

/// The views of `dataset`, before they are checked.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they are the arguments of a function of Python")]
pub fn dataset(
    py: Python<'_>,
    images: &Bound<'_, PyAny>,
    k: &Bound<'_, PyAny>,
    poses: &Bound<'_, PyAny>,
    masks: Option<&Bound<'_, PyAny>>,
    names: Option<Vec<String>>,
    splits: Option<Vec<Option<String>>>,
    axes: &str,
    normalize: bool,
    name: String,
) -> PyResult<Scene> {
    let axes = Axes::parse(axes)?;
    let images = entries(images, "images")?;
    let n = images.len();
    let counted = |what: &str, found: usize| match found == n {
        true => Ok(()),
        false => Err(array(what, format!("there are {found} for {n} images"), "give one for each image")),
    };
    let k = each(finite(k, "intrinsics")?, n, &[4], &[3, 3], "intrinsics")?;
    let matrices = finite(poses, "camera_to_world")?;
    if matrices.ndim() != 3 {
        return Err(array("camera_to_world", format!("the array has the shape {:?}", matrices.shape()), "expected [n, 4, 4] or [n, 3, 4]"));
    }
    counted("camera_to_world", matrices.shape()[0])?;
    let masks = masks.map(|masks| entries(masks, "masks")).transpose()?;
    masks.as_ref().map_or(Ok(()), |masks| counted("masks", masks.len()))?;
    names.as_ref().map_or(Ok(()), |names| counted("names", names.len()))?;
    splits.as_ref().map_or(Ok(()), |splits| counted("splits", splits.len()))?;
    let mut views = Vec::with_capacity(n);
    for (number, pixels) in images.iter().enumerate() {
        let of = |what: &str| format!("{what}[{number}]");
        let image = image(pixels, &of("images"))?;
        let size = [image.width() as usize, image.height() as usize];
        let intrinsics = intrinsics(&k[number], size, &of("intrinsics"))?;
        let camera_to_world = pose(&matrices.index_axis(Axis(0), number).to_owned(), axes, &of("camera_to_world"))?;
        let mask = masks.as_ref().map(|masks| mask(&masks[number], size, &of("masks"))).transpose()?;
        let split = splits.as_ref().and_then(|splits| splits[number].as_deref());
        let split = split.map(str::parse::<Split>).transpose().map_err(raised)?;
        let name =
            names.as_ref().map_or_else(|| format!("view_{number:0width$}", width = n.to_string().len()), |names| names[number].clone());
        views.push(Photograph { name, image, mask, camera: Camera { intrinsics, camera_to_world }, split });
    }
    warn_about_axes(py, &views, axes)?;
    Scene::of(py, DataSource::memory(Arc::new(Photographs { scene: name, views, normalize })))
}

/// Returns one array for each view: the entries of the first axis, or the same array for all views.
fn each(all: ArrayD<f64>, n: usize, vector: &[usize], matrix: &[usize], name: &str) -> PyResult<Vec<ArrayD<f64>>> {
    let shape = all.shape().to_vec();
    if shape == vector || shape == matrix {
        return Ok(vec![all; n]);
    }
    if shape.first() == Some(&n) && (shape[1..] == *vector || shape[1..] == *matrix) {
        return Ok(all.outer_iter().map(|one| one.to_owned()).collect());
    }
    Err(array(
        name,
        format!("the array has the shape {shape:?}"),
        format!("expected K [3, 3] or (fx, fy, cx, cy), or one for each of {n} images"),
    ))
}

/// Reads a mask: pixels that are not 0 are used.
fn mask(values: &Bound<'_, PyAny>, [width, height]: [usize; 2], name: &str) -> PyResult<Mask> {
    let values = numbers::<f64>(values, name)?;
    if values.shape() != [height, width] {
        let found = format!("the mask has the shape {:?}, but its image {height} x {width} pixels", values.shape());
        return Err(array(name, found, "expected [height, width], true where a pixel is used"));
    }
    Ok(Mask::new([width, height], |x, y| values[[y, x]] != 0.0))
}

/// Warns if the cameras look away from the scene, and would look at it with the other axes.
fn warn_about_axes(py: Python<'_>, views: &[Photograph], axes: Axes) -> PyResult<()> {
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let mut turned = cameras.clone();
    for camera in &mut turned {
        camera.camera_to_world.matrix3.y_axis *= -1.0;
        camera.camera_to_world.matrix3.z_axis *= -1.0;
    }
    if cameras.len() < 3 || looked_at(&cameras).is_some() || looked_at(&turned).is_none() {
        return Ok(());
    }
    let other = if axes == Axes::OpenGl { "opencv" } else { "opengl" };
    let message =
        format!("camera_to_world: the cameras look away from each other's middle; if they stand around an object, give axes=\"{other}\"");
    PyErr::warn(py, &py.get_type::<PyUserWarning>(), &std::ffi::CString::new(message).unwrap_or_default(), 2)
}

/// Parses the name of a split, of which a scene must have views.
pub fn split_of(dataset: &Dataset, text: &str) -> PyResult<Split> {
    let split: Split = text.parse().map_err(raised)?;
    if dataset.count(split) == 0 {
        let found = format!("the scene has no {split} views");
        return Err(raised(Error::usage("split", found, "choose another split")));
    }
    Ok(split)
}

#[pymethods]
impl Scene {
    /// Name of the scene.
    #[getter]
    fn name(&self) -> &str {
        self.dataset.name()
    }

    /// The recognized format.
    #[getter]
    fn format(&self) -> &str {
        self.dataset.format()
    }

    /// Largest width and largest height of the images, pixels.
    #[getter]
    fn size(&self) -> (usize, usize) {
        self.dataset.size()
    }

    /// Remarks on the files for the user, as sentences.
    #[getter]
    fn notes(&self) -> Vec<String> {
        self.dataset.notes().to_vec()
    }

    /// The similarity from the coordinates of the dataset to the world in which a field is trained, `[4, 4]`.
    #[getter]
    fn to_world<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        matrix_of(&self.dataset.normalization().to_world).to_pyarray(py)
    }

    /// Returns the number of views in a split: "train", "val" or "test".
    fn count(&self, split: &str) -> PyResult<usize> {
        Ok(self.dataset.count(split.parse().map_err(raised)?))
    }

    /// Returns the names of the views of a split.
    fn names(&self, split: &str) -> PyResult<Vec<String>> {
        let split = split.parse().map_err(raised)?;
        Ok(self.dataset.view_names(split).into_iter().map(str::to_owned).collect())
    }

    /// Returns the cameras of a split, in the coordinates of the dataset.
    fn cameras(&self, split: &str) -> PyResult<Vec<PyCamera>> {
        let cameras = self.dataset.cameras(split.parse().map_err(raised)?);
        let back = self.dataset.to_input();
        Ok(cameras.iter().map(|camera| PyCamera(moved(camera, &back))).collect())
    }

    /// Returns the images of a split, `[h, w, 4]` each, uint8 sRGB with straight alpha. Images are read or rendered now.
    fn images<'py>(&self, py: Python<'py>, split: &str) -> PyResult<Vec<Bound<'py, PyArray3<u8>>>> {
        let split = split_of(&self.dataset, split)?;
        let views = attempt(py, || self.dataset.load(split, &|_, _| ()))?;
        let array = |view: plenoxel::dataset::View| {
            let [width, height] = view.size();
            let pixels = Array3::from_shape_vec((height, width, 4), view.image.into_raw());
            PyArray3::from_owned_array(py, pixels.unwrap_or_default())
        };
        Ok(views.into_iter().map(array).collect())
    }

    fn __repr__(&self) -> String {
        let [train, val, test] = Split::ALL.map(|split| self.dataset.count(split));
        let (width, height) = self.dataset.size();
        format!("Scene({}, {}, {train} train, {val} val, {test} test views of {width} x {height})", self.name(), self.format())
    }
}
