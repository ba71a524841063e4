//! Carving: an opaque colored grid from photographs, without gradients.
//!
//! 1. [`mod@visual_hull`]: carves voxels outside of the silhouettes of the views.
//! 2. [`mod@photo_hull`], optional: carves voxels whose colors in the views do not agree.
//! 3. [`light`]: computes which voxels a pixel shows, and their weights.
//! 4. [`color`]: fits colors or harmonics to the pixels.
//!
//! [`Carving`] runs these steps. The result is an ordinary grid: it can be rendered, and training can start from it.

pub mod color;
pub mod light;
pub mod photo_hull;
pub mod visual_hull;

use crate::dataset::{View, has_alpha};
use crate::error::{Error, Result};
use crate::field::sh;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::geometry::Aabb;
use autograd::{Buffer, Lattice, Tensor};
use color::{Fitted, Seen};
use light::Opaque;
use photo_hull::PhotoConfig;
use serde::{Deserialize, Serialize};

/// Settings of carving.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CarveConfig {
    /// Number of voxels along each axis.
    pub resolution: usize,
    /// Carving rule of the visual hull.
    pub rule: Rule,
    /// Margin in pixels around a voxel's projection that must be background too, for the rule `footprint`. After a stage of a scout, pixels
    /// are those of the images as reduced in that stage.
    pub margin: f64,
    /// Optical depth of a remaining voxel along its side, σ · side.
    pub depth: f64,
    /// Settings of the photo hull; `None` to carve by silhouettes only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photo: Option<PhotoConfig>,
    /// Method for fitting colors.
    pub fit: Fit,
    /// Ridge penalty on harmonics of degree 1 and more, relative to the total weight of the voxel in the pixels.
    pub ridge: f64,
    /// Number of joint sweeps over all voxels, after each voxel was solved on its own.
    pub sweeps: usize,
}

/// Rule for carving a voxel by silhouettes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// A voxel is carved if some view shows all of it on background.
    Footprint,
    /// A voxel is carved if the ray of a background pixel passes through it, as in the source paper.
    Rays,
}

/// Method for fitting colors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// Least squares, for each voxel on its own and then jointly.
    Exact,
    /// Stochastic gradient descent of the source paper.
    Sgd,
}

impl Default for CarveConfig {
    fn default() -> Self {
        CarveConfig {
            resolution: 256,
            rule: Rule::Footprint,
            // Alpha is sampled: a pixel with alpha 0 may still contain a small part of the object.
            margin: 0.5,
            // The source paper's density of 40 per unit length at 128 voxels to a side of 2.8. On held-out training views of lego, 0.5 and
            // 1.5 are 0.4 and 0.2 dB worse.
            depth: 0.875,
            photo: None,
            fit: Fit::Exact,
            // On the same views with degree 2: 0.01 and 0.03 are 0.1 and 0.4 dB worse; three sweeps are as good as one, ten are worse.
            ridge: 0.003,
            sweeps: 1,
        }
    }
}

/// Complete options of a carving run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarveOptions {
    /// Half the side of the carved cube around the origin, world length.
    pub half_width: f64,
    /// Color representation.
    pub color: Color,
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Seed of all random numbers: the order of the pixels in [`Fit::Sgd`].
    pub seed: u64,
    /// Settings of carving.
    pub config: CarveConfig,
}

/// Box carved to its hull, before colors are fitted.
#[derive(Debug)]
pub struct Carving<'a> {
    views: &'a [View],
    options: CarveOptions,
    lattice: Lattice,
}

/// Progress of carving.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Number of views whose silhouettes were processed.
    Views(usize),
    /// End of a round of the photo hull.
    Round {
        /// Number of the round, from 1.
        round: usize,
        /// Number of voxels carved in the round.
        carved: usize,
        /// Number of remaining voxels.
        left: usize,
    },
}

/// Carved grid with colors.
#[derive(Debug)]
pub struct Colored {
    /// Grid whose voxels are those of the hull.
    pub grid: VoxelGrid<f32>,
    /// Fraction of object pixels that show no voxel.
    pub missed: f64,
}

/// Estimates the number of voxels that silhouettes will leave, from a coarse hull that takes little time; `None` if there are no
/// silhouettes.
pub fn voxels_expected(views: &[View], options: &CarveOptions) -> Option<f64> {
    const COARSE: usize = 64;
    let CarveOptions { half_width, config: CarveConfig { resolution, margin, .. }, .. } = *options;
    let hull =
        has_alpha(views).then(|| visual_hull::by_footprint(views, Aabb::cube(half_width), [COARSE.min(resolution); 3], margin, &|_| ()));
    hull.map(|hull| hull.fraction() * (resolution as f64).powi(3))
}

impl<'a> Carving<'a> {
    /// Carves a box to the visual hull, if images have alpha, and then to the photo hull, if the config asks for it.
    ///
    /// Errors if no pixel of the views is transparent although only silhouettes are used; if all pixels are transparent; if a camera is
    /// inside of the box; if no voxel is left; or if no voxel is carved.
    pub fn new(views: &'a [View], options: &CarveOptions, progress: &dyn Fn(Progress)) -> Result<Self> {
        let CarveOptions { half_width, config: CarveConfig { resolution, rule, margin, photo, .. }, .. } = *options;
        let images = |found: &str, remedy: &str| Err(Error::input("the training images", found, remedy));
        if !has_alpha(views) && photo.is_none() {
            let remedy = "use images whose alpha channel is 0 on the background, or --photo-consistency, which needs no alpha channel";
            return images("they have no transparent pixel", remedy);
        }
        if views.iter().all(|view| view.image.pixels().all(|pixel| pixel.0[3] == 0)) {
            return images("they are transparent all over", "use images that show an object");
        }
        let (aabb, voxels) = (Aabb::cube(half_width), [resolution; 3]);
        // No image shows the voxel that contains its camera: the voxel would not be carved, and would hide everything.
        if let Some(view) = views.iter().find(|view| aabb.contains(view.camera.position())) {
            let nearest = views.iter().map(|view| view.camera.position().abs().max_element()).fold(f64::INFINITY, f64::min);
            let found = format!("the camera of {} is inside the box of half width {half_width}", view.name);
            return Err(Error::usage("half_width", found, format!("use a box around the object only, below {nearest:.3}")));
        }
        let mut hull = match rule {
            Rule::Footprint => visual_hull::by_footprint(views, aabb, voxels, margin, &|views| progress(Progress::Views(views))),
            Rule::Rays => visual_hull::by_rays(views, aabb, voxels, &|views| progress(Progress::Views(views))),
        };
        if hull.fraction() == 0.0 {
            let found = format!("the silhouettes leave no voxel of the box of half width {half_width}");
            return Err(Error::usage("half_width", found, "use a box that contains the object"));
        }
        if let Some(photo) = &photo {
            hull = photo_hull::photo_hull(views, &hull, photo, &|round, carved, left| progress(Progress::Round { round, carved, left }))?;
        }
        match hull.fraction() {
            0.0 => {
                let noise = photo.map_or(0.0, |photo| photo.noise);
                Err(Error::usage("carve.photo.noise", format!("photo carving with a noise of {noise} removes every voxel"), "increase it"))
            }
            1.0 => {
                let found = format!("at {resolution} voxels per axis, no image shows a whole voxel as background, so nothing is carved");
                Err(Error::usage("carve.resolution", found, "use more voxels per axis, a larger half_width, or a smaller carve.margin"))
            }
            _ => Ok(Carving { views, options: *options, lattice: Lattice::from_masks(voxels, hull.masks().to_vec()) }),
        }
    }

    /// Returns the number of remaining voxels.
    pub fn voxels(&self) -> usize {
        self.lattice.present()
    }

    /// Returns the number of table rows of the remaining voxels.
    pub fn rows(&self) -> usize {
        self.lattice.rows()
    }

    /// Fits the colors. `progress(passes)` is called after each pass over the pixels.
    pub fn color(&self, progress: &dyn Fn(usize)) -> Colored {
        let CarveOptions { half_width, color, background, seed, config } = self.options;
        let (lattice, rows) = (&self.lattice, self.lattice.rows());
        // Colors are fitted for nearest look-up and without reduction, whatever training uses.
        let shape = GridShape::new(config.resolution, half_width, Interpolation::Nearest, color);
        let density = config.depth / shape.voxel_side();
        let opaque = Opaque::new(lattice, Aabb::cube(shape.half_width), density);
        let (degree, offset) = color.harmonics();
        let seen = Seen { opaque: &opaque, lattice, views: self.views, background, degree, offset: offset as f32 };
        let Fitted { mut table, missed } = match config.fit {
            Fit::Exact => color::fit_exactly(&seen, config.ridge as f32, config.sweeps, progress),
            Fit::Sgd => color::fit_by_descent(&seen, seed, progress),
        };
        if color == Color::Rgb {
            table.iter_mut().for_each(|x| *x = (*x * sh::Y0 as f32).clamp(0.0, 1.0));
        }
        let color = Tensor::from_buffer(Buffer::from(table), &[rows, color.channels()]);
        let grid = VoxelGrid::with_lattice(shape, lattice.clone(), Tensor::full(&[rows, 1], density), color);
        Colored { grid, missed }
    }
}
