//! Cameras: intrinsics and poses as arrays.

use crate::arrays::{finite, triple};
use crate::errors::{array, invalid, raised};
use glam::{DAffine3, DVec3};
use ndarray::{Array2, ArrayD};
use numpy::{PyArray2, ToPyArray};
use plenoxel::camera::lens::Lens;
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::dataset::blender::rigid;
use plenoxel::error::Error;
use plenoxel::geometry::Similarity;
use pyo3::prelude::*;

/// A pinhole camera.
///
/// Args:
///     camera_to_world: `[4, 4]` or `[3, 4]`, a rotation and the position of the camera, in the coordinates of the dataset.
///     intrinsics: `[3, 3]`, the matrix K, or `(fx, fy, cx, cy)`, in pixels. The centre of the first pixel is at (0.5, 0.5).
///     width: Width of the image, pixels.
///     height: Height of the image, pixels.
///     axes: Axes of the camera: "opengl" (x right, y up, z backwards) or "opencv" (x right, y down, z forwards).
///
/// Raises:
///     ArrayError: A matrix has another shape, a number that is not finite, or is not a rotation.
#[pyclass(name = "Camera", module = "plenoxel", frozen, eq, from_py_object)]
#[derive(Clone, PartialEq)]
pub struct PyCamera(pub Camera);

/// Axes of camera coordinates.
#[derive(Clone, Copy, PartialEq)]
pub enum Axes {
    OpenGl,
    OpenCv,
}

impl Axes {
    pub fn parse(text: &str) -> PyResult<Self> {
        match text {
            "opengl" => Ok(Axes::OpenGl),
            "opencv" => Ok(Axes::OpenCv),
            _ => Err(invalid(
                "axes",
                format!("\"{text}\""),
                "\"opengl\" (x right, y up, z backwards) or \"opencv\" (x right, y down, z forwards)",
            )),
        }
    }
}

/// Returns the pose of a matrix `[4, 4]` or `[3, 4]`, with OpenGL axes.
///
/// Errors: the matrix is not a rotation and a translation.
pub fn pose(matrix: &ArrayD<f64>, axes: Axes, name: &str) -> PyResult<DAffine3> {
    const EXPECTED: &str = "expected [4, 4] or [3, 4]";
    let shape = matrix.shape();
    if !matches!(shape, [4, 4] | [3, 4]) {
        return Err(array(name, format!("the matrix has the shape {shape:?}"), EXPECTED));
    }
    let row = |i: usize| std::array::from_fn(|j| if i < shape[0] { matrix[[i, j]] } else { [0.0, 0.0, 0.0, 1.0][j] });
    let rigid = rigid(std::array::from_fn(row));
    let mut pose = rigid.map_err(|(found, remedy)| array(name, format!("the matrix {found}"), remedy))?;
    if axes == Axes::OpenCv {
        pose.matrix3.y_axis *= -1.0;
        pose.matrix3.z_axis *= -1.0;
    }
    Ok(pose)
}

/// Returns the intrinsics of K `[3, 3]` or of (fx, fy, cx, cy) for an image of a size.
///
/// Errors: the array has another shape; a number is impossible.
pub fn intrinsics(k: &ArrayD<f64>, [width, height]: [usize; 2], name: &str) -> PyResult<Intrinsics> {
    let [fx, fy, cx, cy] = match k.shape() {
        [4] => [k[[0]], k[[1]], k[[2]], k[[3]]],
        [3, 3] => {
            if k[[0, 1]].abs() > 1e-6 * k[[0, 0]].abs() {
                return Err(array(name, format!("K has the skew {}", k[[0, 1]]), "undistort the images: skewed pixels are not supported"));
            }
            if [k[[1, 0]], k[[2, 0]], k[[2, 1]]].iter().any(|x| x.abs() > 1e-9) || (k[[2, 2]] - 1.0).abs() > 1e-9 {
                return Err(array(name, "this is not a camera matrix", "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"));
            }
            [k[[0, 0]], k[[1, 1]], k[[0, 2]], k[[1, 2]]]
        }
        shape => return Err(array(name, format!("the array has the shape {shape:?}"), "expected K [3, 3] or (fx, fy, cx, cy)")),
    };
    if !(fx > 0.0 && fy > 0.0) {
        return Err(array(name, format!("the focal lengths are {fx} and {fy}"), "expected pixels above 0"));
    }
    if fx < 0.02 * width as f64 {
        let remedy = "give focal lengths and principal point in pixels, not relative to the size of the image";
        return Err(array(name, format!("the focal length {fx} is tiny for an image of {width} pixels"), remedy));
    }
    Ok(Intrinsics { width, height, fx, fy, cx, cy, lens: Lens::Pinhole })
}

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (camera_to_world, intrinsics, width, height, *, axes = "opengl"))]
    fn new(camera_to_world: &Bound<'_, PyAny>, intrinsics: &Bound<'_, PyAny>, width: usize, height: usize, axes: &str) -> PyResult<Self> {
        let size = checked_size(width, height)?;
        let k = self::intrinsics(&finite(intrinsics, "intrinsics")?, size, "intrinsics")?;
        let pose = pose(&finite(camera_to_world, "camera_to_world")?, Axes::parse(axes)?, "camera_to_world")?;
        Ok(PyCamera(Camera { intrinsics: k, camera_to_world: pose }))
    }

    /// Returns the camera at `eye` with `target` in the middle of its image and `up` pointing up in it.
    ///
    /// `fov_x` is the horizontal field of view in radians; the default is that of the NeRF-synthetic scenes.
    #[staticmethod]
    #[pyo3(signature = (eye, target = None, *, up = None, width = 400, height = 400, fov_x = plenoxel::dataset::procedural::FOV_X))]
    fn look_at(
        eye: &Bound<'_, PyAny>,
        target: Option<&Bound<'_, PyAny>>,
        up: Option<&Bound<'_, PyAny>>,
        width: usize,
        height: usize,
        fov_x: f64,
    ) -> PyResult<Self> {
        let [width, height] = checked_size(width, height)?;
        if !(1e-6..std::f64::consts::PI - 1e-6).contains(&fov_x) {
            return Err(invalid("fov_x", fov_x, "an angle between 0 and π in radians"));
        }
        let or = |given: Option<&Bound<'_, PyAny>>, name, default| given.map_or(Ok(default), |given| triple(given, name).map(DVec3::from));
        let (eye, target, up) = (DVec3::from(triple(eye, "eye")?), or(target, "target", DVec3::ZERO)?, or(up, "up", DVec3::Z)?);
        if eye.distance(target) <= f64::MIN_POSITIVE {
            return Err(raised(Error::usage("eye", "the camera is at its target", "move it away")));
        }
        Ok(PyCamera(Camera::look_at(eye, target, up, Intrinsics::from_fov_x(width, height, fov_x))))
    }

    /// Returns the camera of the same view with other numbers of pixels.
    fn resized(&self, width: usize, height: usize) -> PyResult<Self> {
        let [width, height] = checked_size(width, height)?;
        Ok(PyCamera(Camera { intrinsics: self.0.intrinsics.resized(width, height), ..self.0 }))
    }

    /// Width of the image, pixels.
    #[getter]
    fn width(&self) -> usize {
        self.0.intrinsics.width
    }

    /// Height of the image, pixels.
    #[getter]
    fn height(&self) -> usize {
        self.0.intrinsics.height
    }

    /// The matrix K, `[3, 3]`, pixels. The distortion of a lens is not part of it.
    #[getter]
    fn intrinsics<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let Intrinsics { fx, fy, cx, cy, .. } = self.0.intrinsics;
        ndarray::arr2(&[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]).to_pyarray(py)
    }

    /// The camera-to-world matrix, `[4, 4]`, with OpenGL axes, in the coordinates of the dataset.
    #[getter]
    fn camera_to_world<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        rows_of(&self.0.camera_to_world).to_pyarray(py)
    }

    fn __repr__(&self) -> String {
        let Camera { intrinsics: k, camera_to_world } = &self.0;
        let [x, y, z] = camera_to_world.translation.to_array();
        format!("Camera({} x {} pixels, f {:.1}, at ({x:.3}, {y:.3}, {z:.3}))", k.width, k.height, k.fx)
    }
}

/// The rows of a pose as a matrix `[4, 4]`.
fn rows_of(pose: &DAffine3) -> Array2<f64> {
    let matrix = glam::DMat4::from(*pose).to_cols_array_2d();
    Array2::from_shape_fn((4, 4), |(i, j)| matrix[j][i])
}

/// Returns a similarity as a matrix `[4, 4]`.
pub fn matrix_of(of: &Similarity) -> Array2<f64> {
    rows_of(&DAffine3 { matrix3: of.scale * of.rotation, translation: of.translation })
}

/// Returns the camera in other coordinates.
pub fn moved(camera: &Camera, by: &Similarity) -> Camera {
    Camera { camera_to_world: by.camera(camera.camera_to_world), ..*camera }
}

fn checked_size(width: usize, height: usize) -> PyResult<[usize; 2]> {
    let most = plenoxel::dataset::image::MAX_SIDE as usize;
    for (name, side) in [("width", width), ("height", height)] {
        if !(1..=most).contains(&side) {
            return Err(invalid(name, side, &format!("1 to {most} pixels")));
        }
    }
    Ok([width, height])
}
