//! The source of the views of a run: a dataset folder or the built-in scene. A run records it so that it can be evaluated later.

use crate::camera::placement::Placement;
use crate::dataset::memory::Photographs;
use crate::dataset::procedural::ProceduralOptions;
use crate::dataset::{self, Dataset, OpenOptions, Split, image};
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use crate::model::plenoxels::config::Config;
use crate::space::Space;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Source of views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum DataSource {
    /// A dataset folder.
    Folder {
        /// Absolute path, so that the run can be evaluated from any directory.
        path: PathBuf,
    },
    /// The procedural scene.
    BuiltIn {
        /// Image width before any reduction, pixels.
        width: usize,
        /// Image height before any reduction, pixels.
        height: usize,
        /// Training views.
        train: usize,
        /// Validation views.
        val: usize,
        /// Test views.
        test: usize,
    },
    /// Photographs in the memory of a program. A run records only their number, so they must be given again to resume or to evaluate it.
    Memory {
        /// Number of views.
        views: usize,
        /// The photographs; `None` if this source was read from the record of a run.
        #[serde(skip)]
        photographs: Option<Arc<Photographs>>,
    },
    /// No views: the grid was imported without a dataset.
    None,
}

impl fmt::Display for DataSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DataSource::Folder { path } => write!(f, "{}", path.display()),
            DataSource::BuiltIn { width, height, train, val, test } => {
                write!(f, "built in, {width} x {height}, {train} train, {val} val, {test} test views")
            }
            DataSource::Memory { views, .. } => write!(f, "arrays, {views} views"),
            DataSource::None => f.write_str("none"),
        }
    }
}

impl DataSource {
    /// A dataset folder given on the command line.
    pub fn folder(path: &Path) -> Self {
        // A folder that does not exist keeps its name, for the error when it is opened.
        let absolute = path.canonicalize().or_else(|_| std::path::absolute(path));
        DataSource::Folder { path: absolute.unwrap_or_else(|_| path.to_owned()) }
    }

    /// Returns the folder with the views; `None` for the built-in scene, for views in memory and without views.
    pub fn path(&self) -> Option<&Path> {
        match self {
            DataSource::Folder { path } => Some(path),
            DataSource::BuiltIn { .. } | DataSource::Memory { .. } | DataSource::None => None,
        }
    }

    /// The dataset folder, or the built-in scene with its defaults if `None`.
    pub fn of(folder: Option<&Path>) -> Self {
        folder.map_or_else(|| DataSource::built_in(&ProceduralOptions::default()), DataSource::folder)
    }

    /// The built-in scene.
    pub fn built_in(options: &ProceduralOptions) -> Self {
        DataSource::BuiltIn { width: options.width, height: options.height, train: options.train, val: options.val, test: options.test }
    }

    /// Photographs in memory.
    pub fn memory(photographs: Arc<Photographs>) -> Self {
        DataSource::Memory { views: photographs.views.len(), photographs: Some(photographs) }
    }

    /// The command-line arguments for this source, each preceded by a space.
    pub fn arguments(&self) -> String {
        let plain = |c: char| c.is_alphanumeric() || "/._-+=:,@%".contains(c);
        match self {
            DataSource::Folder { path } if path.to_str().is_some_and(|path| path.chars().all(plain)) => format!(" {}", path.display()),
            // Quoted and escaped, so that it fits into a comment of a file.
            DataSource::Folder { path } => format!(" {path:?}"),
            // A placeholder: no argument names the memory of a program.
            DataSource::Memory { .. } => " DATA".to_owned(),
            DataSource::None => String::new(),
            built_in if *built_in == DataSource::of(None) => String::new(),
            DataSource::BuiltIn { width, height, train, val, test } => {
                format!(" --scene-size {width}x{height} --scene-views {train},{val},{test}")
            }
        }
    }

    /// Checks the poses of the training cameras against the box `aabb`, in world coordinates. Returns warnings as sentences. Other spaces than
    /// [`Space::Box`] are made from the cameras.
    ///
    /// Errors: nothing can be learned from these cameras in this box.
    pub fn check_cameras(&self, dataset: &Dataset, aabb: Aabb) -> Result<Vec<String>> {
        if dataset.space() != Space::Box {
            return Ok(Vec::new());
        }
        let Placement { hopeless, warnings } = Placement::of(&dataset.cameras(Split::Train), aabb);
        match hopeless {
            Some([found, remedy]) => Err(Error::input(self.to_string(), found, remedy)),
            None => Ok(warnings),
        }
    }

    /// Opens the dataset with the image reduction and the validation split of a configuration. The built-in scene is rendered directly at the
    /// reduced size.
    pub fn open(&self, config: &Config) -> Result<Dataset> {
        let downscale = config.downscale;
        let validation_every = match config.validation_every {
            0 => None,
            every => Some(every),
        };
        let options = OpenOptions { downscale, validation_every, capture: config.capture };
        match self {
            DataSource::Folder { path } => {
                if path.to_str().is_none() {
                    let found = "the name of this folder is not UTF-8, so a run cannot record it";
                    return Err(Error::input(path, found, "rename it, or use a symbolic link with a UTF-8 name"));
                }
                dataset::open(path, &options)
            }
            DataSource::Memory { photographs: Some(photographs), .. } => photographs.open(&options),
            DataSource::Memory { photographs: None, .. } => {
                let found = "the views of this run were in the memory of the program that trained it";
                Err(Error::usage("--data", found, "give the views again, or a folder with the same views"))
            }
            &DataSource::BuiltIn { width, height, train, val, test } => {
                image::check_downscale(downscale, (width, height))?;
                Dataset::procedural(ProceduralOptions {
                    width: width / downscale,
                    height: height / downscale,
                    train,
                    val,
                    test,
                    ..ProceduralOptions::default()
                })
            }
            DataSource::None => {
                let found = "the run has no views: its grid was imported without a dataset";
                Err(Error::usage("--data", found, "give the folder with the views"))
            }
        }
    }

    /// Opens the dataset that a run recorded. If the folder no longer exists, the error names the flag for its new path.
    pub fn reopen(&self, config: &Config) -> Result<Dataset> {
        match self {
            DataSource::Folder { path } if !path.exists() => {
                Err(Error::input(path, "the dataset of this run no longer exists", "give its new path with --data DIR"))
            }
            _ => self.open(config),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_named_by_arguments_that_a_remark_in_a_file_can_hold() {
        let folder = |path: &str| DataSource::Folder { path: path.into() }.arguments();
        assert_eq!(folder("/data/lego-1_ä"), " /data/lego-1_ä");
        assert_eq!(folder("/my data/a\nb\u{7f}"), " \"/my data/a\\nb\\u{7f}\"");
        assert_eq!(DataSource::of(None).arguments(), "");
        let small = ProceduralOptions { width: 8, val: 0, ..ProceduralOptions::default() };
        assert_eq!(DataSource::built_in(&small).arguments(), " --scene-size 8x200 --scene-views 100,0,25");
    }
}
