//! `plenoxel presets`: lists and prints presets.

use crate::progress::Console;
use clap::Args;
use clap::builder::PossibleValuesParser;
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::{Config, Hull};
use plenoxel::run::settings::{self, CARVE, PRESETS};

const EXAMPLES: &str = "\
Examples:
  plenoxel presets                               list all presets
  plenoxel presets fast                          print the settings of a preset, with comments
  plenoxel presets fast --resolved > mine.toml   write all settings to a file, for editing
  plenoxel train data/lego --config mine.toml    train with the edited settings

Times are training times on two cores, for the given image size.";

/// List the presets, or print one
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct PresetsArgs {
    /// Preset to print: its differences from the defaults, with comments
    #[arg(value_parser = PossibleValuesParser::new(PRESETS.iter().chain([&CARVE]).map(|preset| preset.name)))]
    name: Option<String>,

    /// Print the complete configuration of the preset, as a file for --config
    #[arg(long, requires = "name")]
    resolved: bool,
}

/// Lists the presets, or prints one.
pub fn run(args: &PresetsArgs, console: &Console<'_>) -> Result<()> {
    match &args.name {
        None => list(console),
        Some(name) if args.resolved => {
            let (config, command) = (Config::preset(name)?, if *name == CARVE.name { "carve" } else { "train" });
            let remark = format!("Preset {name} of {}. Use it with:\nplenoxel {command} DATA --config THIS_FILE", crate::PROGRAM);
            console.text(settings::to_toml(&config, &remark)?.trim_end())
        }
        Some(name) => console.text(settings::preset(name)?.text.trim_end()),
    }
}

fn list(console: &Console<'_>) -> Result<()> {
    console.result(&row(["preset", "time on two cores", "alpha gives", "purpose"]))?;
    PRESETS.iter().chain([&CARVE]).try_for_each(|preset| {
        let alpha = alpha_decides(&Config::preset(preset.name)?);
        console.result(&row([preset.name, preset.time, alpha, preset.purpose]))
    })
}

fn row([name, time, alpha, purpose]: [&str; 4]) -> String {
    format!("{name:11}{time:29}{alpha:17}{purpose}")
}

/// Use of the alpha channel of images, besides compositing.
fn alpha_decides(config: &Config) -> &'static str {
    match (config.trains(), config.hull) {
        (false, _) => "the shape",
        (true, Hull::Auto) => "box and voxels",
        (true, Hull::Off) => "nothing",
    }
}
