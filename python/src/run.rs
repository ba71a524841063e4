//! Finished runs: pictures, scores, points, meshes and tables.

use crate::camera::{PyCamera, matrix_of, moved};
use crate::errors::{attempt, compute, invalid, raised};
use crate::grid::Grid;
use crate::scene::Scene;
use crate::shapes::{PyMesh, PyPoints};
use crate::tensor::{PyTensor, Values};
use glam::DVec3;
use ndarray::{Array2, Array3};
use numpy::{PyArray2, PyArrayDyn, ToPyArray};
use plenoxel::dataset::{Dataset, Split, View};
use plenoxel::error::{Error, Result};
use plenoxel::evaluate::{ViewScore, Viewer};
use plenoxel::export::mesh::{MeshOptions, mesh};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::geometry::Similarity;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::model::{self, Model};
use plenoxel::point_cloud::filter::{Filters, Outliers};
use plenoxel::point_cloud::from_grid::{self, ColorFrom, Coordinates, LEAST_ALPHA, LEAST_OBJECT, LEAST_WEIGHT, Visible, VoxelOptions};
use plenoxel::run::data::DataSource;
use plenoxel::run::figures::Figures;
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::memory::{Estimate, Stored};
use plenoxel::run::metrics;
use plenoxel::run::visibility::visibility;
use plenoxel::space::Space;
use plenoxel::train::ViewOptions;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// A run folder. Its model is read when it is needed first.
#[pyclass(module = "plenoxel._plenoxel", frozen)]
pub struct TrainedRun {
    folder: RunFolder,
    config: Config,
    record: RunRecord,
    source: DataSource,
    model: Mutex<Option<Arc<Loaded>>>,
}

/// A model in memory.
pub struct Loaded {
    pub model: Box<dyn Model<f32>>,
    path: PathBuf,
}

impl Loaded {
    /// The voxel grid, which is one of the world; `what` needs it.
    pub fn grid(&self, what: &str) -> Result<&VoxelGrid<f32>> {
        let space = self.model.space();
        if space != Space::Box {
            let found = format!("the field is in the coordinates of a capture ({space}), and {what} needs a box of the world");
            return Err(Error::input(&self.path, found, "train with capture.space=\"box\", and a half_width around the object"));
        }
        model::voxel_grid(&*self.model, &self.path, what)
    }
}

/// Opens a run folder; with `best`, with the checkpoint of the best validation PSNR.
#[pyfunction]
pub fn load(py: Python<'_>, folder: PathBuf, scene: Option<&Scene>, best: bool) -> PyResult<TrainedRun> {
    let (folder, config, record) = attempt(py, || RunFolder::open(&folder))?;
    let folder = if best { folder.with_best().map_err(raised)? } else { folder };
    let source = scene.map_or_else(|| record.data.clone(), |scene| scene.source.clone());
    Ok(TrainedRun { folder, config, record, source, model: Mutex::new(None) })
}

impl TrainedRun {
    /// Reads the model, if it was not read before.
    fn loaded(&self) -> Result<Arc<Loaded>> {
        let mut loaded = self.model.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(loaded) = &*loaded {
            return Ok(loaded.clone());
        }
        let path = self.folder.existing_checkpoint()?;
        Estimate::of_evaluation(&self.config, self.config.evaluation, &Stored::read(&path)?, None).check()?;
        let (model, _) = model::open(&path, &self.config)?;
        Ok(loaded.insert(Arc::new(Loaded { model, path })).clone())
    }

    /// From the coordinates of the dataset to the world of the run.
    fn to_world(&self) -> Similarity {
        self.record.to_world.unwrap_or_default()
    }

    fn view_options(&self, background: Option<[f32; 3]>) -> PyResult<ViewOptions> {
        over(background.unwrap_or(self.config.background))
    }
}

/// Options for pictures over a background.
///
/// Errors: a value is outside of [0, 1].
pub fn over(background: [f32; 3]) -> PyResult<ViewOptions> {
    match background.iter().all(|value| (0.0..=1.0).contains(value)) {
        true => Ok(ViewOptions::over(background)),
        false => Err(invalid("background", format!("{background:?}"), "three values in [0, 1]")),
    }
}

/// Renders the image of a camera in the coordinates of the dataset.
pub fn see(model: &dyn Model<f32>, camera: &PyCamera, to_world: &Similarity, options: &ViewOptions) -> Picture {
    let camera = moved(&camera.0, to_world);
    let picture = Viewer::of(model, options).see(&camera);
    let depth = picture.distances(&camera, model.space()) / to_world.scale as f32;
    Picture { rgb: picture.rgb, depth, opacity: picture.opacity }
}

/// The scores of a model on views of a split, as JSON.
pub fn scores(
    model: &dyn Model<f32>,
    views: &[View],
    split: Split,
    dataset: &Dataset,
    config: &Config,
    options: &ViewOptions,
) -> Result<String> {
    #[derive(Serialize)]
    struct Evaluation {
        #[serde(flatten)]
        figures: Figures,
        per_view: Vec<ViewScore>,
    }
    let scores = Viewer::of(model, options).compare(views, |_, _, _, _| Ok(()))?;
    let figures = Figures::new(&scores, split, dataset, config, model, options);
    plenoxel::json::line(&Evaluation { figures, per_view: scores.per_view })
}

#[pymethods]
impl TrainedRun {
    /// The folder.
    #[getter]
    fn folder(&self) -> PathBuf {
        self.folder.path().to_owned()
    }

    /// Path of report.html, which may not exist.
    #[getter]
    fn report(&self) -> PathBuf {
        self.folder.report()
    }

    /// Name of the scene.
    #[getter]
    fn scene(&self) -> &str {
        &self.record.scene
    }

    /// Kind of the model.
    #[getter]
    fn model(&self) -> &str {
        &self.record.model
    }

    /// The settings, the text of config.toml.
    #[getter]
    fn config(&self) -> PyResult<String> {
        self.folder.settings().map_err(raised)
    }

    /// The final figures as JSON; None before the run has ended.
    fn figures(&self, py: Python<'_>) -> PyResult<Option<String>> {
        attempt(py, || Ok(self.folder.figures()?.map(|figures| figures.to_string())))
    }

    /// The metrics of training, one line of JSON per step.
    fn metrics(&self, py: Python<'_>) -> PyResult<String> {
        attempt(py, || metrics::read(&self.folder.metrics()))
    }

    /// The similarity from the coordinates of the dataset to the world of the run, `[4, 4]`.
    #[getter(to_world)]
    fn to_world_matrix<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        matrix_of(&self.to_world()).to_pyarray(py)
    }

    /// Renders the image of a camera.
    fn render(&self, py: Python<'_>, camera: &PyCamera, background: Option<[f32; 3]>) -> PyResult<Picture> {
        let options = self.view_options(background)?;
        attempt(py, || Ok(see(&*self.loaded()?.model, camera, &self.to_world(), &options)))
    }

    /// Scores of the views of a split, as JSON.
    fn evaluate(&self, py: Python<'_>, split: &str, downscale: Option<usize>, background: Option<[f32; 3]>) -> PyResult<String> {
        let split: Split = split.parse().map_err(raised)?;
        let options = self.view_options(background)?;
        let config = Config { downscale: downscale.unwrap_or(self.config.downscale), ..self.config.clone() };
        attempt(py, || {
            let dataset = self.source.reopen(&config)?;
            if dataset.count(split) == 0 {
                return Err(Error::usage("split", format!("the scene has no {split} views"), "choose another split"));
            }
            let stored = Stored::read(&self.folder.existing_checkpoint()?)?;
            Estimate::of_evaluation(&config, config.evaluation, &stored, Some((&dataset, split, usize::MAX))).check()?;
            let loaded = self.loaded()?;
            let views = dataset.load(split, &|_, _| ())?;
            scores(&*loaded.model, &views, split, &dataset, &config, &options)
        })
    }

    /// The parameters of the model as read-only arrays, without a copy.
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let loaded = attempt(py, || self.loaded())?;
        let mut tensors = Vec::new();
        loaded.model.visit(&mut |param| tensors.push((param.name().to_owned(), param.tensor().detach())));
        let parameters = PyDict::new(py);
        for (name, tensor) in tensors {
            parameters.set_item(name, shown(py, tensor)?)?;
        }
        Ok(parameters)
    }

    /// The voxel grid.
    fn grid(&self, py: Python<'_>) -> PyResult<Grid> {
        attempt(py, || {
            let loaded = self.loaded()?;
            loaded.grid("a table of voxels")?;
            Ok(Grid { loaded })
        })
    }

    /// The voxels as a point cloud.
    #[expect(clippy::too_many_arguments, reason = "they are the arguments of a function of Python")]
    fn points(
        &self,
        py: Python<'_>,
        min_alpha: Option<f64>,
        min_weight: Option<f64>,
        min_object: Option<f64>,
        seen: bool,
        sor_sigma: Option<f64>,
        sor_neighbours: usize,
    ) -> PyResult<PyPoints> {
        let share = |key: &str, value: Option<f64>, default: f64, most: f64| match value.unwrap_or(default) {
            value if (0.0..=most).contains(&value) => Ok(value),
            value => Err(invalid(key, value, &format!("0 to {most}"))),
        };
        let min_alpha = share("min_alpha", min_alpha, LEAST_ALPHA, 1.0 - f64::EPSILON)?;
        let min_weight = share("min_weight", min_weight, LEAST_WEIGHT, 1.0)?;
        let min_object = share("min_object", min_object, LEAST_OBJECT, 1.0)?;
        let filters = Filters { outliers: sor_sigma.map(|sigma| Outliers { neighbours: sor_neighbours, sigma }), ..Filters::default() };
        attempt(py, || {
            let loaded = self.loaded()?;
            let grid = loaded.grid("a point cloud")?;
            let visible = seen.then(|| self.visibility(grid)).transpose()?;
            let options = VoxelOptions {
                coordinates: Coordinates::World,
                color: visible.as_ref().map_or(ColorFrom::Mean, ColorFrom::Seen),
                min_alpha,
                visible: visible.as_ref().map(|seen| Visible { seen, min_weight, min_object }),
            };
            let to_world = self.to_world();
            let mut cloud = from_grid::points(grid, &options).moved(&to_world.inverse());
            for density in cloud.fields.iter_mut().filter(|field| field.name == "density").flat_map(|field| &mut field.values) {
                *density *= to_world.scale as f32;
            }
            let (kept, _) = filters.apply(&cloud.positions, None)?;
            Ok(PyPoints::new(cloud.chosen(&kept), grid.shape().voxel_side() / to_world.scale))
        })
    }

    /// The surface on which the density has a level.
    fn mesh(
        &self,
        py: Python<'_>,
        level: Option<f64>,
        min_part: usize,
        smooth: usize,
        max_triangles: Option<usize>,
        direction: Option<[f64; 3]>,
    ) -> PyResult<PyMesh> {
        let to_world = self.to_world();
        if smooth > 100 {
            return Err(invalid("smooth", smooth, "0 to 100 passes"));
        }
        if let Some(level) = level.filter(|level| !(level.is_finite() && *level > 0.0)) {
            return Err(invalid("level", level, "a density above 0"));
        }
        let unit =
            |direction: [f64; 3]| DVec3::from(direction).try_normalize().ok_or_else(|| invalid("direction", "0", "a vector that is not 0"));
        let direction = direction.map(unit).transpose()?.map(|direction| to_world.rotation * direction);
        let options = MeshOptions { level: level.map(|level| level / to_world.scale), direction, min_part, smooth, max_triangles };
        attempt(py, || {
            let loaded = self.loaded()?;
            Ok(PyMesh::new(mesh(loaded.grid("a mesh")?, &options)?.moved(&to_world.inverse())))
        })
    }
}

impl TrainedRun {
    fn visibility(&self, grid: &VoxelGrid<f32>) -> Result<plenoxel::field::voxel_grid::fused::Seen> {
        let dataset = self.source.reopen(&self.config)?;
        Estimate::of_visibility(&self.config, grid, &dataset).check()?;
        let views = dataset.load(Split::Train, &|_, _| ())?;
        Ok(visibility(grid, views, &self.config, &|_, _| ()))
    }
}

/// A read-only array of a tensor, without a copy.
pub fn shown(py: Python<'_>, tensor: autograd::Tensor<f32>) -> PyResult<Bound<'_, PyArrayDyn<f32>>> {
    let owner = Bound::new(py, PyTensor(Values::Single(tensor.clone())))?;
    Ok(crate::arrays::view(&tensor, owner.into_any()))
}

/// A rendered image.
#[pyclass(module = "plenoxel", frozen)]
pub struct Picture {
    rgb: Array3<f32>,
    depth: Array2<f32>,
    opacity: Array2<f32>,
}

#[pymethods]
impl Picture {
    /// Color, `[h, w, 3]`, sRGB, not clamped.
    #[getter]
    fn rgb<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        self.rgb.to_pyarray(py).into_any()
    }

    /// Distance along each ray to the mean depth, `[h, w]`, in the unit of the dataset; not a number where the picture is empty.
    #[getter]
    fn depth<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        self.depth.to_pyarray(py)
    }

    /// Opacity, `[h, w]`, in [0, 1].
    #[getter]
    fn opacity<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        self.opacity.to_pyarray(py)
    }

    /// The color, for `numpy.asarray` and `matplotlib.pyplot.imshow`.
    #[pyo3(signature = (dtype = None, copy = None))]
    fn __array__<'py>(&self, py: Python<'py>, dtype: Option<&Bound<'py, PyAny>>, copy: Option<bool>) -> PyResult<Bound<'py, PyAny>> {
        // The array is new in any case.
        let _ = copy;
        let rgb = self.rgb(py);
        dtype.map_or(Ok(rgb.clone()), |dtype| rgb.call_method1("astype", (dtype,)))
    }

    /// Writes the color as an 8-bit PNG.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        attempt(py, || plenoxel::dataset::image::write_rgb(&path, self.rgb.view()))
    }

    fn _repr_png_<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        let png = attempt(py, || plenoxel::dataset::image::rgb_as_png("picture".as_ref(), self.rgb.view()))?;
        Ok(PyBytes::new(py, &png))
    }

    fn __repr__(&self) -> String {
        let (height, width, _) = self.rgb.dim();
        format!("Picture({width} x {height} pixels)")
    }
}

/// The PSNR in dB of two images, -10 log10 of their mean squared error; values are clamped to [0, 1].
#[pyfunction]
pub fn psnr(py: Python<'_>, a: &Bound<'_, PyAny>, b: &Bound<'_, PyAny>) -> PyResult<f64> {
    let read = |array: &Bound<'_, PyAny>, name| {
        let array = crate::arrays::numbers::<f32>(array, name)?;
        let found = format!("the image has the shape {:?}", array.shape());
        array.into_dimensionality::<ndarray::Ix3>().map_err(|_| crate::errors::array(name, found, "expected [h, w, channels]"))
    };
    let (a, b) = (read(a, "a")?, read(b, "b")?);
    if a.dim() != b.dim() {
        return Err(crate::errors::array("psnr", format!("the shapes {:?} and {:?} differ", a.dim(), b.dim()), "expected equal shapes"));
    }
    compute(py, || plenoxel::metrics::psnr_of(plenoxel::metrics::mse(a.view(), b.view())))
}
