//! `plenoxel export ply`: exports the voxels of a run as a colored point cloud.

use super::{ColorChoice, Exported, MIN_ALPHA, Opened, color, min_alpha};
use crate::commands::cloud_filters::{CloudFilters, UnitLengths, check_not_empty, describe, points};
use crate::commands::new_run::load;
use crate::commands::{MOST_REDUCTION, as_flag, check_split, whole};
use crate::progress::Console;
use clap::{Args, ValueEnum, ValueHint};
use plenoxel::dataset::Split;
use plenoxel::error::{Error, Result};
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::field::voxel_grid::fused::Seen;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::point_cloud::from_grid::{self, ColorFrom, Coordinates, LEAST_ALPHA, LEAST_OBJECT, LEAST_WEIGHT, Visible, VoxelOptions};
use plenoxel::point_cloud::ply::encode;
use plenoxel::run::data::DataSource;
use plenoxel::run::folder::RunRecord;
use plenoxel::run::memory::Estimate;
use plenoxel::run::visibility::visibility;
use std::cell::RefCell;
use std::path::PathBuf;

/// Memory per voxel in bytes: positions, rows, normals and colors.
const BYTES_PER_VOXEL: u64 = 100;

const EXAMPLES: &str = "\
Examples:
  plenoxel export ply runs/lego                                visible voxels, to runs/lego/exports/cloud.ply
  plenoxel export ply runs/lego --sor-sigma 2                  also without outliers
  plenoxel export ply runs/lego --min-alpha 0 --min-weight 0 --min-object 0
  plenoxel export ply runs/lego --min-value 2 --noise-radius 1.28 --sor-neighbours 6 --sor-sigma 0.2

The last example has the filters of the source paper: value (density), noise and SOR filter of CloudCompare, in this order. They are meant for \
solid clouds; combine them with the zeros of the example above, because points of a surface one voxel thick have few neighbours. Coordinates \
are those of the dataset, or voxel indices with --coords grid.";

/// Export the voxels of a run as a colored point cloud
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct PlyArgs {
    #[command(flatten)]
    exported: Exported,

    /// Coordinates of the points: those of the dataset (world), or voxel indices from 0 (grid)
    #[arg(long, help_heading = "Output", default_value = "world")]
    coords: Coords,

    /// View direction for view-dependent color: seen, the mean over the training views; mean, the mean over all directions; or one direction
    /// X,Y,Z for all points, from the viewer into the scene
    #[arg(long, value_name = "seen|mean|X,Y,Z", help_heading = "Colors", default_value = "seen", allow_hyphen_values = true,
          value_parser = color(&[("seen", ColorChoice::Seen), ("mean", ColorChoice::Mean)]))]
    color: ColorChoice,

    #[arg(long, value_name = "A", help_heading = "Voxels", help = MIN_ALPHA, default_value_t = LEAST_ALPHA, value_parser = min_alpha, allow_negative_numbers = true)]
    min_alpha: f64,

    /// Minimum of the largest rendering weight of a voxel in the pixels of the training views; 0 also keeps invisible voxels
    #[arg(long, value_name = "W", help_heading = "Voxels", default_value_t = LEAST_WEIGHT, value_parser = share, allow_negative_numbers = true)]
    min_weight: f64,

    /// Minimum share of a voxel's pixels in the training views that show the object; floaters in the background color have 0. Objects are
    /// identified by alpha, or by their color if no image has transparent pixels
    #[arg(long, value_name = "S", help_heading = "Voxels", default_value_t = LEAST_OBJECT, value_parser = share, allow_negative_numbers = true)]
    min_object: f64,

    /// Dataset folder, if it has moved [default: that of the training]
    #[arg(long, value_name = "DIR", help_heading = "Scene", value_hint = ValueHint::DirPath)]
    data: Option<PathBuf>,

    /// Downscale the training images by this factor [default: that of the training]
    #[arg(long, value_name = "K", help_heading = "Scene", value_parser = whole::<usize>(1, MOST_REDUCTION), allow_negative_numbers = true)]
    downscale: Option<usize>,

    #[command(flatten)]
    filters: CloudFilters,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Coords {
    World,
    Grid,
}

fn share(text: &str) -> std::result::Result<f64, String> {
    text.parse().ok().filter(|s| (0.0..=1.0).contains(s)).ok_or_else(|| "expected a number from 0 to 1".to_owned())
}

/// Exports the voxels of a run.
pub fn run(args: &PlyArgs, console: &Console<'_>) -> Result<()> {
    let Opened { folder, mut config, record, header, grid } = args.exported.open(console, "ply", BYTES_PER_VOXEL)?;
    config.downscale = args.downscale.unwrap_or(config.downscale);
    let side = header.shape().voxel_side();
    let coordinates = match args.coords {
        Coords::World => Coordinates::World,
        Coords::Grid => Coordinates::Grid,
    };
    let to_world = record.to_world.unwrap_or_default();
    let voxel_side = side / to_world.scale;
    let lengths = match coordinates {
        Coordinates::World => UnitLengths { voxel: Some(voxel_side), world: 1.0 },
        Coordinates::Grid => UnitLengths { voxel: Some(1.0), world: 1.0 / voxel_side },
    };
    // Filters are checked before the training views are rendered, which may take minutes.
    let filters = args.filters.filters(lengths)?;
    let chooses = args.min_weight > 0.0 || args.min_object > 0.0;
    let looks = chooses || args.color == ColorChoice::Seen;
    let field = args.filters.value_field(from_grid::field_names(looks))?;
    let seen = if looks { Some(look(args, &config, record, &grid, console)?) } else { None };

    let color = match (args.color, &seen) {
        (ColorChoice::Seen, Some(seen)) => ColorFrom::Seen(seen),
        (ColorChoice::Along(direction), _) => ColorFrom::Direction(to_world.rotation * direction),
        _ => ColorFrom::Mean,
    };
    let (min_weight, min_object) = (args.min_weight, args.min_object);
    let visible = seen.as_ref().filter(|_| chooses).map(|seen| Visible { seen, min_weight, min_object });
    let mut cloud = from_grid::points(&grid, &VoxelOptions { coordinates, color, min_alpha: args.min_alpha, visible });
    if coordinates == Coordinates::World {
        cloud = cloud.moved(&to_world.inverse());
    }
    // Density is per length.
    for density in cloud.fields.iter_mut().filter(|field| field.name == "density").flat_map(|field| &mut field.values) {
        *density *= to_world.scale as f32;
    }

    let values = field.as_deref().and_then(|name| cloud.field(name));
    let (left, report) = filters.apply(&cloud.positions, values).map_err(as_flag)?;
    let report = describe(cloud.len(), &report);
    check_not_empty(left.len(), &report)?;

    let (n, half) = (grid.shape().resolution, grid.shape().half_width);
    let frame = match coordinates {
        Coordinates::World => "those of the dataset".to_owned(),
        Coordinates::Grid => format!("voxel indices; world of the run = (index + 0.5) * {side} - {half}"),
    };
    let comments = [
        format!("{} voxels per side, scene {}, {} steps", n, header.scene, header.step),
        format!("coordinates: {frame}"),
        format!("voxel_side {}", lengths.voxel.unwrap_or(1.0)),
        "opacity = 1 - exp(-density * side of a voxel in world units); weight: largest rendering weight in the training views; object: share of its pixels that show the object".to_owned(),
        report.clone(),
    ];
    let file = args.exported.write(&folder, "cloud.ply", &encode(&cloud.chosen(&left), &comments), console)?;
    console.wrote(&file, &format!("wrote {} to {} ({report})", points(left.len()), file.display()))
}

/// Visibility and color of the voxels in the training views.
fn look(args: &PlyArgs, config: &Config, record: RunRecord, grid: &VoxelGrid<f32>, console: &Console<'_>) -> Result<Seen> {
    let source = args.data.as_deref().map_or(record.data, DataSource::folder);
    let without = "or export without the dataset: --min-weight 0 --min-object 0 --color mean";
    let dataset = source.reopen(config).map_err(|e| match e {
        Error::Input { path, found, remedy } => Error::input(path, found, format!("{remedy}, {without}")),
        other => other,
    })?;
    check_split(&dataset, Split::Train)?;
    let estimate = Estimate::of_visibility(config, grid, &dataset);
    console.note(&estimate.describe());
    estimate.check()?;
    let views = load(console, &dataset, Split::Train, usize::MAX, &source)?;
    // The number of batches is known at the first one.
    let count = RefCell::new(None);
    Ok(visibility(grid, views, config, &|done, total| {
        count.borrow_mut().get_or_insert_with(|| console.count("rendering the training rays, batch", total)).at(done, total);
    }))
}
