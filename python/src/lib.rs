//! The Python package `plenoxel`: the module `plenoxel._plenoxel`, on which the files of `package/plenoxel` build.
//!
//! Everything that computes runs without the lock of the interpreter ([`errors::compute`]), and long work on a thread of its own ([`background`]). No thread of
//! the library waits for Python, but the one that trains or renders while it calls a loss or a field.
#![deny(unsafe_code)]

mod arrays;
mod background;
mod camera;
mod carving;
mod errors;
mod events;
mod field;
mod grid;
mod loss;
mod run;
mod scene;
mod settings;
mod shapes;
mod step;
mod tensor;
mod training;

use pyo3::prelude::*;

#[pymodule]
mod _plenoxel {
    #[pymodule_export]
    use super::camera::PyCamera;
    #[pymodule_export]
    use super::carving::carve;
    #[pymodule_export]
    use super::errors::after_fork;
    #[pymodule_export]
    use super::field::{TrainedField, train_field};
    #[pymodule_export]
    use super::grid::Grid;
    #[pymodule_export]
    use super::loss::Param;
    #[pymodule_export]
    use super::run::{Picture, TrainedRun, load, psnr};
    #[pymodule_export]
    use super::scene::{Scene, dataset, open, procedural};
    #[pymodule_export]
    use super::settings::presets;
    #[pymodule_export]
    use super::shapes::{PyMesh, PyPoints};
    #[pymodule_export]
    use super::step::PyStep;
    #[pymodule_export]
    use super::tensor::{PyTensor, concat, external, grad, gradcheck, maximum, minimum, stack, where_};
    #[pymodule_export]
    use super::training::{Ended, program, resume, train, write_report};
    /// Version of the package.
    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");
}
