//! The commands: a module for each, with its arguments and its implementation.

pub mod bake;
pub mod cameras;
mod capture;
pub mod carve;
mod cloud_filters;
pub mod compare;
pub mod completions;
pub mod evaluate;
pub mod export;
pub mod filter;
pub mod harmonics;
pub mod import;
pub mod info;
pub mod man;
mod new_run;
mod panels;
pub mod presets;
pub mod render;
pub mod report;
pub mod scene;
pub mod sweep;
mod table;
pub mod train;
mod trained_run;
pub mod view;

use plenoxel::dataset::{Dataset, Split};
use plenoxel::error::Error;
use plenoxel::run::folder::RunFolder;
use plenoxel::space::Space;
use std::path::{Path, PathBuf};

/// Checks that the output file `out` is not a file of one of the `runs` or of the dataset folder `data` that a command reads.
pub fn check_replaceable(out: &Path, runs: &[&RunFolder], data: Option<&Path>) -> Result<(), Error> {
    let of_run = runs.iter().any(|run| run.owns(out));
    let of_data = data.is_some_and(|data| {
        out.canonicalize().is_ok_and(|out| out.is_file() && data.canonicalize().is_ok_and(|data| out.starts_with(data)))
    });
    if !of_run && !of_data {
        return Ok(());
    }
    let found = format!("{} belongs to the {} that is read", out.display(), if of_run { "run" } else { "dataset" });
    Err(Error::usage("--out", found, "choose another file"))
}

/// Checks that a split has views.
fn check_split(dataset: &Dataset, split: Split) -> Result<(), Error> {
    if dataset.count(split) > 0 {
        return Ok(());
    }
    let found = format!("{} has no {split} views", dataset.name());
    let others = Split::ALL.into_iter().filter(|split| dataset.count(*split) > 0);
    let others: Vec<String> = others.map(|split| split.to_string()).collect();
    Err(Error::usage("--split", found, format!("choose {}", others.join(" or "))))
}

/// Checks that the field of a checkpoint is one of a box of the world, for commands whose results are.
fn check_box(checkpoint: &Path, space: Space) -> Result<(), Error> {
    if space == Space::Box {
        return Ok(());
    }
    let found = format!("the field is in the coordinates of a capture ({space}), and this command needs a box of the world");
    let remedy =
        "train with `--space box` and a `half_width` around the object; report.html and `plenoxel render --path` show the field as it is";
    Err(Error::input(checkpoint, found, remedy))
}

/// The folder next to `folder`, with `-` and `ending` after its name: the default of `--out`.
fn beside(folder: &Path, ending: &str) -> Result<PathBuf, Error> {
    let whole = folder.canonicalize().map_err(|e| Error::io(folder, e, "reading the folder"))?;
    let name = whole.file_name().map(|name| format!("{}-{ending}", name.to_string_lossy()));
    let name = name.ok_or_else(|| Error::usage("--out", format!("{} has no name", folder.display()), "give the folder to write"))?;
    // A relative path stays relative.
    Ok(if folder.file_name().is_some() { folder.with_file_name(name) } else { whole.with_file_name(name) })
}

/// The error with the name of the flag for its setting.
pub fn as_flag(error: Error) -> Error {
    error.with_key(|key| format!("--{}", key.replace('_', "-")))
}

/// Parses a split.
fn split(text: &str) -> Result<Split, String> {
    text.parse().map_err(|_| "expected train, val or test".to_owned())
}

/// Parses a whole number from `least` to `most`.
pub fn whole<N: TryFrom<u64>>(least: u64, most: u64) -> impl Fn(&str) -> Result<N, String> + Clone {
    move |text| {
        let number = text.parse().ok().filter(|n| (least..=most).contains(n));
        number.and_then(|n| N::try_from(n).ok()).ok_or_else(|| format!("expected a whole number from {least} to {most}"))
    }
}

/// Parses an amount of memory: a number of bytes, or a number with a decimal or binary unit.
pub fn memory_size(text: &str) -> Result<u64, String> {
    let unit = text.trim_start_matches(|c: char| c.is_ascii_digit() || c == '.');
    let bytes_of_unit = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        "mib" => f64::from(1 << 20),
        "gib" => f64::from(1 << 30),
        _ => f64::NAN,
    };
    let number: f64 = text[..text.len() - unit.len()].parse().unwrap_or(f64::NAN);
    let bytes = number * bytes_of_unit;
    if bytes >= 1.0 { Ok(bytes as u64) } else { Err("expected an amount of memory such as 8GB, 8GiB or 500MB".to_owned()) }
}

/// Parses a color: a name, or three numbers.
fn background(text: &str) -> Result<[f64; 3], String> {
    match text {
        "white" => return Ok([1.0; 3]),
        "black" => return Ok([0.0; 3]),
        _ => {}
    }
    let color = numbers(text).ok().filter(|color: &[f64; 3]| color.iter().all(|c| (0.0..=1.0).contains(c)));
    color.ok_or_else(|| "expected white, black, or three numbers in [0, 1] such as 0.2,0.5,1".to_owned())
}

/// Formats a color for [`background`].
fn background_name(color: [f32; 3]) -> String {
    match color {
        [1.0, 1.0, 1.0] => "white".to_owned(),
        [0.0, 0.0, 0.0] => "black".to_owned(),
        [r, g, b] => format!("{r},{g},{b}"),
    }
}

/// Parses a number of at least `least`.
fn number(least: f64) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| match text.parse::<f64>() {
        Ok(number) if number.is_finite() && number >= least => Ok(number),
        _ if least == f64::NEG_INFINITY => Err("expected a number".to_owned()),
        _ if least == f64::MIN_POSITIVE => Err("expected a number above 0".to_owned()),
        _ => Err(format!("expected a number of at least {least}")),
    }
}

/// Parses N numbers separated by commas.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok().filter(|n: &f64| n.is_finite())).collect();
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| format!("expected {N} numbers separated by commas"))
}

/// Maximum factor of image reduction.
const MOST_REDUCTION: u64 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units_of_1000_or_of_1024() {
        let sizes = [("17", 17), ("500MB", 500_000_000), ("1.5g", 1_500_000_000), ("8 GiB", 8 << 30), ("2mib", 2 << 20)];
        sizes.into_iter().for_each(|(text, bytes)| assert_eq!(memory_size(text), Ok(bytes), "{text}"));
        ["", "GB", "-1GB", "8 apples", "0", "1.2.3MB", "nan"].into_iter().for_each(|text| assert!(memory_size(text).is_err(), "{text}"));
    }
}
