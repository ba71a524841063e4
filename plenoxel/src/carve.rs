//! Carving: from photographs to an opaque colored grid, without gradients.
//!
//! 1. [`mod@visual_hull`]: what the silhouettes of all views leave of the box;
//! 2. [`mod@photo_hull`], if asked for: what the colors of all views leave of that;
//! 3. [`light`]: which voxels a pixel shows, and how much of it each is;
//! 4. [`color`]: the colors, or their harmonics, that explain the pixels best.
//!
//! [`Carving`] does one after the other. What comes out is a grid like any other: it renders, and training can start from it.

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

/// How to carve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CarveConfig {
    /// Voxels along each axis.
    pub resolution: usize,
    /// What makes a voxel go.
    pub rule: Rule,
    /// By footprint, pixels around a voxel's projection that must be background too. After a stage of a scout, pixels of the images as that stage had them.
    pub margin: f64,
    /// Optical depth of a voxel along its side, σ · side: how opaque what is left is.
    pub depth: f64,
    /// Carve on, away from what the photographs contradict.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photo: Option<PhotoConfig>,
    /// How colors are found.
    pub fit: Fit,
    /// Pull on the harmonics above the mean, as a share of what a voxel weighs in the pixels.
    pub ridge: f64,
    /// Sweeps over all voxels together, after each was solved by itself.
    pub sweeps: usize,
}

/// What makes a voxel go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// Some view shows all of it on background.
    Footprint,
    /// The ray of a background pixel passes through it: the source paper's.
    Rays,
}

/// How colors are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// Least squares, voxel by voxel and then together.
    Exact,
    /// The source paper's stochastic gradient descent.
    Sgd,
}

impl Default for CarveConfig {
    fn default() -> Self {
        CarveConfig {
            resolution: 256,
            rule: Rule::Footprint,
            // Alpha is sampled: a pixel without any may still hold a little of the object.
            margin: 0.5,
            // The source paper's 40 per unit length at 128 voxels to 2.8. On held-out training views of lego, 0.5 and 1.5 are 0.4 and 0.2 dB worse.
            depth: 0.875,
            photo: None,
            fit: Fit::Exact,
            // On the same views, of degree 2: 0.01 and 0.03 are 0.1 and 0.4 dB worse, three sweeps as good as one, ten worse.
            ridge: 0.003,
            sweeps: 1,
        }
    }
}

/// A carving run, completely: what to carve, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarveOptions {
    /// Half the side of the cube around the origin that is carved, world length.
    pub half_width: f64,
    /// Meaning of the colors to find.
    pub color: Color,
    /// Color behind the scene, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Seed of everything random: the order of the pixels in [`Fit::Sgd`].
    pub seed: u64,
    /// How to carve.
    pub config: CarveConfig,
}

/// A box carved to the visual hull.
#[derive(Debug)]
pub struct Carving<'a> {
    views: &'a [View],
    options: CarveOptions,
    lattice: Lattice,
}

/// How far carving has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Views whose silhouettes have carved.
    Views(usize),
    /// A round of the photo hull is over.
    Round {
        /// Its number, from 1.
        round: usize,
        /// Voxels that went in it.
        carved: usize,
        /// Voxels that are left.
        left: usize,
    },
}

/// A carved grid with its colors.
#[derive(Debug)]
pub struct Colored {
    /// Its voxels are those of the hull.
    pub grid: VoxelGrid<f32>,
    /// The share of object pixels that show none of them.
    pub missed: f64,
}

/// About how many voxels silhouettes will leave, told by a coarse hull in no time; `None` if there are no silhouettes.
pub fn voxels_expected(views: &[View], options: &CarveOptions) -> Option<f64> {
    const COARSE: usize = 64;
    let CarveOptions { half_width, config: CarveConfig { resolution, margin, .. }, .. } = *options;
    let hull =
        has_alpha(views).then(|| visual_hull::by_footprint(views, Aabb::cube(half_width), [COARSE.min(resolution); 3], margin, &|_| ()));
    hull.map(|hull| hull.fraction() * (resolution as f64).powi(3))
}

impl<'a> Carving<'a> {
    /// Carves a box: to the visual hull where images have alpha, and on to the photo hull if the config asks for it.
    ///
    /// Errors: no view has a transparent pixel (and only silhouettes are asked for), or one that is not; nothing is left of the box, or
    /// nothing goes.
    pub fn new(views: &'a [View], options: &CarveOptions, progress: &dyn Fn(Progress)) -> Result<Self> {
        let CarveOptions { half_width, config: CarveConfig { resolution, rule, margin, photo, .. }, .. } = *options;
        let images = |found: &str, remedy: &str| Err(Error::input("the training images", found, remedy));
        if !has_alpha(views) && photo.is_none() {
            let remedy = "silhouettes need an alpha channel that is 0 on the background; --photo-consistency carves without";
            return images("they have no transparent pixel", remedy);
        }
        if views.iter().all(|view| view.image.pixels().all(|pixel| pixel.0[3] == 0)) {
            return images("they are transparent all over", "give images that show an object");
        }
        let (aabb, voxels) = (Aabb::cube(half_width), [resolution; 3]);
        // No image shows the voxel that its camera stands in, so it would stay and hide everything.
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
                let found = format!("no voxel is left with {}", photo.map_or(0.0, |photo| photo.noise));
                Err(Error::usage("carve.photo.noise", found, "increase it"))
            }
            1.0 => {
                let found = format!("at {resolution}, no image shows a whole voxel on background, so nothing is carved");
                Err(Error::usage("carve.resolution", found, "use more voxels per side, a larger half_width, or a smaller carve.margin"))
            }
            _ => Ok(Carving { views, options: *options, lattice: Lattice::from_masks(voxels, hull.masks().to_vec()) }),
        }
    }

    /// Voxels that are left.
    pub fn voxels(&self) -> usize {
        self.lattice.present()
    }

    /// Rows that their tables have.
    pub fn rows(&self) -> usize {
        self.lattice.rows()
    }

    /// Finds the colors. `progress(passes)` is called after each pass over the pixels.
    pub fn color(&self, progress: &dyn Fn(usize)) -> Colored {
        let CarveOptions { half_width, color, background, seed, config } = self.options;
        let (lattice, rows) = (&self.lattice, self.lattice.rows());
        // Colors are found for what one sees in the voxel that a point lies in, and for each voxel by itself, whatever training would do.
        let shape = GridShape { resolution: config.resolution, half_width, interpolation: Interpolation::Nearest, color, sh_reduction: 1 };
        let density = config.depth / shape.voxel_side();
        let opaque = Opaque::new(lattice, Aabb::cube(shape.half_width), density);
        let (degree, offset) = match color {
            Color::Rgb => (0, 0.0),
            Color::Sh { degree, offset } => (degree, offset as f32),
        };
        let seen = Seen { opaque: &opaque, lattice, views: self.views, background, degree, offset };
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
