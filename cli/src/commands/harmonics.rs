//! `plenoxel harmonics`: a picture of the spherical harmonics that colors are made of.

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
  plenoxel harmonics                                   degrees 0 to 3, into harmonics.png
  plenoxel harmonics --degree 2 --out degree-2.png     the nine functions of --sh-degree 2
  plenoxel harmonics --size 400

A row for each degree l, with its functions from m = -l to m = l, which is also their order in a checkpoint. A surface is as far from the
middle of its cell as the function is large in that direction: blue where it is positive, orange where it is negative. All cells have the same
scale. z points up, x to the lower left and y to the right. Order and signs are those of svox2: of degree 1, -y, z and -x.";

/// Draw the spherical harmonics that view-dependent colors are made of, as a PNG picture
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct HarmonicsArgs {
    /// Draw all functions up to this degree, 0 to 3
    #[arg(long, value_name = "N", default_value_t = sh::MAX_DEGREE, value_parser = whole::<usize>(0, sh::MAX_DEGREE as u64), allow_negative_numbers = true)]
    degree: usize,

    /// Width and height of the cell of a function in pixels, 16 to 1024
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = whole::<usize>(16, 1024), allow_negative_numbers = true)]
    size: usize,

    /// Picture to write, replacing what is there; - for stdout
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
