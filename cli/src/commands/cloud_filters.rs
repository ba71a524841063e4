//! The flags of CloudCompare's filters, which `export ply` and `filter` share.

use super::{number, numbers, whole};
use clap::{ArgGroup, Args, ValueEnum};
use glam::DVec3;
use plenoxel::error::{Error, Result};
use plenoxel::geometry::Aabb;
use plenoxel::point_cloud::filter::{Filters, Kept, Noise, NoiseError, Outliers, Range};

/// CloudCompare's own defaults.
const NEIGHBOURS: usize = 6;
const SIGMA: f64 = 1.0;

/// What to remove from a cloud, in this order: box, value, noise, outliers.
#[derive(Debug, Args)]
#[command(next_help_heading = "Filters", group = ArgGroup::new("values").args(["min_value", "max_value"]).multiple(true))]
pub struct CloudFilters {
    /// Keep points in the box XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX, in the coordinates of the file written
    #[arg(long, value_name = "BOX", value_parser = bounds, allow_hyphen_values = true)]
    bbox: Option<Aabb>,

    /// Keep points whose value is at least this
    #[arg(long, value_name = "V", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    min_value: Option<f64>,

    /// Keep points whose value is at most this
    #[arg(long, value_name = "V", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    max_value: Option<f64>,

    /// Scalar field that --min-value and --max-value look at [default: density or sigma, or the only one]
    #[arg(long, value_name = "NAME", requires = "values")]
    value_field: Option<String>,

    /// Noise filter: remove points off the plane of their neighbours within this distance. Between voxels distances are 1, 1.41, 1.73,
    /// 2 ... sides: choose one between those
    #[arg(long, value_name = "R", value_parser = number(f64::MIN_POSITIVE))]
    noise_radius: Option<f64>,

    /// Noise filter: the distance from the plane that is allowed, as a length
    #[arg(long, value_name = "D", value_parser = number(0.0), requires = "noise_radius", conflicts_with = "noise_relative")]
    noise_error: Option<f64>,

    /// Noise filter: the distance from the plane that is allowed, in standard deviations of the neighbours' distances [default: 1]
    #[arg(long, value_name = "N", value_parser = number(0.0), requires = "noise_radius")]
    noise_relative: Option<f64>,

    /// Noise filter: remove points with fewer than three neighbours too
    #[arg(long, requires = "noise_radius")]
    remove_isolated: bool,

    /// Statistical outlier removal (SOR): compare the mean distance to this many nearest points, the point itself being one of them
    /// [default: 6, if there is --sor-sigma]
    #[arg(long, value_name = "K", value_parser = whole::<usize>(2, 1000))]
    sor_neighbours: Option<usize>,

    /// Statistical outlier removal: remove points whose mean distance is more than this many standard deviations above the mean of all
    /// [default: 1, if there is --sor-neighbours]
    #[arg(long, value_name = "N", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    sor_sigma: Option<f64>,

    /// What --noise-radius and --noise-error are measured in: sides of a voxel, or the world's unit of length [default: voxel; world for a
    /// file that does not name the side of its voxels]
    #[arg(long)]
    units: Option<Units>,
}

/// Units of length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Units {
    Voxel,
    World,
}

/// One unit of length in the coordinates of a cloud.
#[derive(Clone, Copy, Debug)]
pub struct UnitLengths {
    /// The side of a voxel, if there are voxels.
    pub voxel: Option<f64>,
    /// The world's unit.
    pub world: f64,
}

impl CloudFilters {
    /// The filters for a cloud.
    ///
    /// Errors: lengths in voxels, where nobody knows how large they are.
    pub fn filters(&self, lengths: UnitLengths) -> Result<Filters> {
        let unit = match (self.units, lengths.voxel) {
            (Some(Units::World), _) | (None, None) => lengths.world,
            (_, Some(side)) => side,
            (Some(Units::Voxel), None) => {
                let found = "voxel, for a file that does not name the side of its voxels in a line `comment voxel_side`,";
                return Err(Error::config("--units", found, "world"));
            }
        };
        let value = self
            .looks_at_values()
            .then(|| Range { low: self.min_value.unwrap_or(f64::NEG_INFINITY), high: self.max_value.unwrap_or(f64::INFINITY) });
        let noise = self.noise_radius.map(|radius| Noise {
            radius: radius * unit,
            error: match self.noise_error {
                Some(error) => NoiseError::Absolute(error * unit),
                None => NoiseError::Relative(self.noise_relative.unwrap_or(1.0)),
            },
            remove_isolated: self.remove_isolated,
        });
        let outliers = (self.sor_neighbours.is_some() || self.sor_sigma.is_some())
            .then(|| Outliers { neighbours: self.sor_neighbours.unwrap_or(NEIGHBOURS), sigma: self.sor_sigma.unwrap_or(SIGMA) });
        Ok(Filters { within: self.bbox, value, noise, outliers })
    }

    /// The scalar field to look at, out of those that a cloud has; `None` if no filter looks at values.
    ///
    /// Errors: the cloud has none, or several, or not the one that was asked for.
    pub fn value_field(&self, names: &[&str]) -> Result<Option<String>> {
        if !self.looks_at_values() {
            return Ok(None);
        }
        let known = |name: &str| names.iter().find(|n| **n == name.trim_start_matches("scalar_")).map(|n| (*n).to_owned());
        let list = names.join(", ");
        let flag = if self.min_value.is_some() { "--min-value" } else { "--max-value" };
        match (&self.value_field, names) {
            (_, []) => Err(Error::config(flag, "a cloud without scalar fields", "a cloud with one")),
            (Some(name), _) => known(name).map(Some).ok_or_else(|| Error::config("--value-field", format!("`{name}`"), list)),
            (None, [only]) => Ok(Some((*only).to_owned())),
            (None, _) => known("density")
                .or_else(|| known("sigma"))
                .map(Some)
                .ok_or_else(|| Error::config(flag, "a cloud with several scalar fields", format!("--value-field with one of {list}"))),
        }
    }

    fn looks_at_values(&self) -> bool {
        self.min_value.is_some() || self.max_value.is_some()
    }
}

/// A box as the command line takes it.
fn bounds(text: &str) -> std::result::Result<Aabb, String> {
    let [a, b, c, d, e, f] = numbers::<6>(text)?;
    let (min, max) = (DVec3::new(a, b, c), DVec3::new(d, e, f));
    let accepted = "XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX with no minimum above its maximum";
    if min.cmple(max).all() { Ok(Aabb { min, max }) } else { Err(accepted.to_owned()) }
}

/// What filters did, in words: "5000 points, value 4000, sor 3900".
pub fn describe(before: usize, report: &[Kept]) -> String {
    let steps: String = report.iter().map(|kept| format!(", {} {}", kept.filter, kept.after)).collect();
    format!("{before} points{steps}")
}

/// Refuses to write a cloud without points.
pub fn check_not_empty(left: usize, report: &str) -> Result<()> {
    if left > 0 {
        return Ok(());
    }
    Err(Error::config(
        "filters",
        format!("what leaves no point ({report})"),
        "settings that keep some: a wider box, a lower minimum, a larger radius or sigma",
    ))
}
