//! `plenoxel filter`: CloudCompare's filters for any point cloud.

use super::as_flag;
use super::cloud_filters::{CloudFilters, UnitLengths, check_not_empty, describe, points};
use crate::progress::Console;
use clap::{Args, ValueHint};
use plenoxel::error::{Error, Result};
use plenoxel::point_cloud::filter::Filters;
use plenoxel::point_cloud::ply::{Kind, PlyFile};
use plenoxel::text::brief;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel filter scan.ply --out clean.ply --sor-neighbours 6 --sor-sigma 1
  plenoxel filter scan.ply --out clean.ply --noise-radius 0.05 --remove-isolated
  plenoxel filter runs/lego/exports/cloud.ply --out clean.ply --min-value 0.5 --value-field opacity

The filters are those of CloudCompare, applied in this order: bbox, value, noise, SOR. With the same settings, the value and SOR filters keep \
the same points as CloudCompare. The noise filter may differ for points whose neighbors have no unique plane, and for points exactly at the \
maximum distance: they are kept here, while in CloudCompare rounding decides. Points of voxel grids are often such points. The output has the \
encoding of the input, and all properties of the kept points unchanged. Faces and other elements are left out, because they refer to points by \
index.";

/// Largest number of left out elements to name.
const OTHERS: usize = 10;

/// Clean a point cloud with CloudCompare's filters
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct FilterArgs {
    /// PLY file to read, text or binary, from any program
    #[arg(value_hint = ValueHint::FilePath)]
    cloud: PathBuf,

    /// PLY file to write
    #[arg(long, short, value_name = "FILE", help_heading = "Output", value_hint = ValueHint::FilePath)]
    out: PathBuf,

    #[command(flatten)]
    filters: CloudFilters,
}

/// Filters a cloud.
pub fn run(args: &FilterArgs, console: &Console<'_>) -> Result<()> {
    let file = PlyFile::open(&args.cloud)?;
    let side = file.header().remarks.iter().find_map(|line| line.strip_prefix("comment voxel_side ")?.trim().parse().ok());
    let side = side.filter(|side: &f64| side.is_finite() && *side > 0.0);
    let filters = args.filters.filters(UnitLengths { voxel: side, world: 1.0 })?;
    if filters == Filters::default() {
        return Err(Error::usage(
            "filters",
            "no filter is given",
            "give at least one of --bbox, --min-value, --max-value, --noise-radius, --sor-neighbours, --sor-sigma",
        ));
    }
    file.check_memory(&filters)?;
    let lists = file.element().properties.iter().filter(|p| matches!(p.kind, Kind::List(..))).count();
    let counted = |count: usize, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let mut facts = vec![counted(file.len(), "point")];
    facts.extend(
        Some(file.field_names().join(", ")).filter(|names| !names.is_empty()).map(|names| format!("scalar fields: {}", brief(&names))),
    );
    facts.extend(Some(lists).filter(|lists| *lists > 0).map(|lists| counted(lists, "list")));
    console.note(&format!("{}: {}", args.cloud.display(), facts.join("; ")));
    if filters.noise.is_some() {
        let unit = side.map_or("units of the file".to_owned(), |side| format!("units of the file, in which the side of a voxel is {side}"));
        console.note(&format!("noise radius: {} in {unit}", filters.noise.map_or(0.0, |noise| noise.radius)));
    }
    let others = || file.others().filter(|element| element.count > 0);
    for element in others().take(OTHERS) {
        let rows = counted(element.count, "row");
        console.note(&format!("left out {rows} of element `{}`, which may refer to points by index", brief(&element.name)));
    }
    if let more @ 1.. = others().skip(OTHERS).count() {
        console.note(&format!("left out {}", counted(more, "more element")));
    }
    let field = args.filters.value_field(&file.field_names())?;
    let values = field.as_deref().map(|name| file.values(name)).transpose()?;
    let (left, report) = filters.apply(&file.positions()?, values.as_deref()).map_err(as_flag)?;
    let report = describe(file.len(), &report);
    check_not_empty(left.len(), &report)?;
    console.write_file(&args.out, &file.chosen(&left, &format!("filtered by {}: {report}", crate::PROGRAM)))?;
    console.wrote(&args.out, &format!("wrote {} to {} ({report})", points(left.len()), args.out.display()))
}
