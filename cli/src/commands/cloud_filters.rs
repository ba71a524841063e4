//! The flags of CloudCompare's filters, for `export ply` and `filter`.

use super::{number, numbers, whole};
use clap::{ArgGroup, Args, ValueEnum};
use glam::DVec3;
use plenoxel::error::{Error, Result};
use plenoxel::geometry::Aabb;
use plenoxel::point_cloud::filter::{Filters, Kept, Noise, NoiseError, Outliers, Range};

/// Defaults of CloudCompare.
const NEIGHBOURS: usize = 6;
const SIGMA: f64 = 1.0;

/// Filters of a point cloud, in the order of their application: box, value, noise, outliers.
#[derive(Debug, Args)]
#[command(next_help_heading = "Filters", group = ArgGroup::new("values").args(["min_value", "max_value"]).multiple(true))]
pub struct CloudFilters {
    /// Keep points in the box XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX, in coordinates of the output file
    #[arg(long, value_name = "BOX", value_parser = bounds, allow_hyphen_values = true)]
    bbox: Option<Aabb>,

    /// Minimum value of a point in the scalar field of --value-field
    #[arg(long, value_name = "V", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    min_value: Option<f64>,

    /// Maximum value of a point in the scalar field of --value-field
    #[arg(long, value_name = "V", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    max_value: Option<f64>,

    /// Scalar field for --min-value and --max-value [default: density or sigma, or the only field]
    #[arg(long, value_name = "NAME", requires = "values")]
    value_field: Option<String>,

    /// Noise filter: radius for the neighbors of a point. Points too far from the plane of their neighbors are removed. Distances between voxels are
    /// 1, 1.41, 1.73, 2 ... voxel sides; choose a radius between these
    #[arg(long, value_name = "R", value_parser = number(f64::MIN_POSITIVE), allow_negative_numbers = true)]
    noise_radius: Option<f64>,

    /// Noise filter: maximum distance from the plane, as a length
    #[arg(long, value_name = "D", value_parser = number(0.0), requires = "noise_radius", conflicts_with = "noise_relative", allow_negative_numbers = true)]
    noise_error: Option<f64>,

    /// Noise filter: maximum distance from the plane, in standard deviations of the neighbors' distances [default: 1]
    #[arg(long, value_name = "N", value_parser = number(0.0), requires = "noise_radius", allow_negative_numbers = true)]
    noise_relative: Option<f64>,

    /// Noise filter: also remove points with fewer than three neighbors
    #[arg(long, requires = "noise_radius")]
    remove_isolated: bool,

    /// Statistical outlier removal (SOR): number of nearest points for the mean distance, including the point itself
    /// [default: 6 with --sor-sigma]
    #[arg(long, value_name = "K", value_parser = whole::<usize>(2, 1000), allow_negative_numbers = true)]
    sor_neighbours: Option<usize>,

    /// Statistical outlier removal: maximum mean distance of a point, in standard deviations above the mean over all points
    /// [default: 1 with --sor-neighbours]
    #[arg(long, value_name = "N", value_parser = number(f64::NEG_INFINITY), allow_hyphen_values = true)]
    sor_sigma: Option<f64>,

    /// Unit of --noise-radius and --noise-error: the side of a voxel, or the world unit [default: voxel; world for a file without a
    /// voxel_side comment]
    #[arg(long)]
    units: Option<Units>,
}

/// Units of length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Units {
    Voxel,
    World,
}

/// Units of length in the coordinates of a cloud.
#[derive(Clone, Copy, Debug)]
pub struct UnitLengths {
    /// The side of a voxel, if there are voxels.
    pub voxel: Option<f64>,
    /// The world unit.
    pub world: f64,
}

impl CloudFilters {
    /// Returns the filters for a cloud.
    ///
    /// Errors: the lengths are in voxels, but the size of a voxel is unknown.
    pub fn filters(&self, lengths: UnitLengths) -> Result<Filters> {
        let unit = match (self.units, lengths.voxel) {
            (Some(Units::World), _) | (None, None) => lengths.world,
            (_, Some(side)) => side,
            (Some(Units::Voxel), None) => {
                let found = "the file has no line `comment voxel_side`, so the side of its voxels is unknown";
                return Err(Error::usage("--units", found, "use world"));
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

    /// Chooses the scalar field of the value filter from the fields of a cloud; `None` without a value filter.
    ///
    /// Errors: the cloud has no fields, several fields, or not the requested one.
    pub fn value_field(&self, names: &[&str]) -> Result<Option<String>> {
        if !self.looks_at_values() {
            return Ok(None);
        }
        let known = |name: &str| names.iter().find(|n| **n == name.trim_start_matches("scalar_")).map(|n| (*n).to_owned());
        let list = names.join(", ");
        let flag = if self.min_value.is_some() { "--min-value" } else { "--max-value" };
        match (&self.value_field, names) {
            (_, []) => Err(Error::usage(flag, "the cloud has no scalar fields", "leave it out, or use a cloud with a scalar field")),
            (Some(name), _) => known(name).map(Some).ok_or_else(|| Error::config("--value-field", format!("`{name}`"), list)),
            (None, [only]) => Ok(Some((*only).to_owned())),
            (None, _) => known("density")
                .or_else(|| known("sigma"))
                .map(Some)
                .ok_or_else(|| Error::usage(flag, "the cloud has several scalar fields", format!("choose one with --value-field: {list}"))),
        }
    }

    fn looks_at_values(&self) -> bool {
        self.min_value.is_some() || self.max_value.is_some()
    }
}

/// Parses a box.
fn bounds(text: &str) -> std::result::Result<Aabb, String> {
    let [a, b, c, d, e, f] = numbers::<6>(text)?;
    let (min, max) = (DVec3::new(a, b, c), DVec3::new(d, e, f));
    let expected = "expected XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX with no minimum above its maximum";
    if min.cmple(max).all() { Ok(Aabb { min, max }) } else { Err(expected.to_owned()) }
}

/// Formats a number of points.
pub fn points(count: usize) -> String {
    format!("{count} point{}", if count == 1 { "" } else { "s" })
}

/// Summarizes the filters: the numbers of points before, and after each filter, such as "5000 points, value 4000, sor 3900".
pub fn describe(before: usize, report: &[Kept]) -> String {
    let steps: String = report.iter().map(|kept| format!(", {} {}", kept.filter, kept.after)).collect();
    format!("{}{steps}", points(before))
}

/// Checks that some points are left.
pub fn check_not_empty(left: usize, report: &str) -> Result<()> {
    if left > 0 {
        return Ok(());
    }
    Err(Error::usage("filters", format!("no point is left ({report})"), "use a larger box, a lower minimum, or a larger radius or sigma"))
}
