//! `plenoxel harmonics`: draws the spherical harmonics.

mod lobes;
mod text;

use super::whole;
use crate::progress::Console;
use clap::{Args, ValueHint};
use lobes::Lobes;
use plenoxel::dataset::image;
use plenoxel::error::Result;
use plenoxel::field::sh;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  plenoxel harmonics                                   draw degrees 0 to 3 to harmonics.png
  plenoxel harmonics --degree 2 --out degree-2.png     draw the nine functions of --sh-degree 2
  plenoxel harmonics --size 400

Each row has the functions of one degree l, from m = -l to m = l, as in a checkpoint. The distance of a surface from the middle of its cell is \
the absolute value of the function in that direction. Positive values are blue, negative values are orange, and all cells have the same scale. \
z points up, x to the lower left, and y to the right. Order and signs are those of svox2; degree 1 is -y, z, -x.";

/// Draw the spherical harmonics, the basis of view-dependent color, as a PNG picture
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct HarmonicsArgs {
    /// Largest degree to draw, 0 to 3
    #[arg(long, value_name = "N", default_value_t = sh::MAX_DEGREE, value_parser = whole::<usize>(0, sh::MAX_DEGREE as u64), allow_negative_numbers = true)]
    degree: usize,

    /// Width and height of a cell in pixels, 16 to 1024; each cell shows one function
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = whole::<usize>(16, 1024), allow_negative_numbers = true)]
    size: usize,

    /// Picture to write, replacing an existing file; - for stdout
    #[arg(long, short, value_name = "FILE", help_heading = "Output", default_value = "harmonics.png", value_hint = ValueHint::FilePath)]
    out: PathBuf,
}

/// Draws the functions.
pub fn run(args: &HarmonicsArgs, console: &Console<'_>) -> Result<()> {
    let picture = Lobes { degree: args.degree, size: args.size }.picture();
    console.write_file(&args.out, &image::rgb_as_png(&args.out, picture.view())?)?;
    let (height, width, _) = picture.dim();
    let functions = sh::count(args.degree);
    let what = if functions == 1 { "1 function".to_owned() } else { format!("{functions} functions") };
    console.wrote(&args.out, &format!("wrote {}: {what}, {width} x {height} pixels", args.out.display()))
}
