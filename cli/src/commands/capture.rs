//! Flags about a capture: which of its files are read, where its scene is, and which views are for testing.

use super::number;
use clap::Args;
use clap::builder::PossibleValuesParser;
use plenoxel::dataset::normalize::{CaptureOptions, Center, FormatChoice, Orient, Scale, SpaceChoice};
use plenoxel::error::Result;
use plenoxel::run::settings::Layers;
use std::fmt::Display;
use toml::Value;

/// Choices about a capture. By default, they follow from its files and its cameras; `plenoxel info` explains them.
#[derive(Debug, Args)]
pub struct CaptureFlags {
    /// Format of a capture whose folder has several: transforms (transforms.json), colmap, llff, nsvf, or auto: the first that the folder has [default: auto]
    #[arg(long, help_heading = "Scene", value_parser = names(FormatChoice::ALL))]
    format: Option<String>,

    /// Space of a capture: box, ndc (cameras that face forward), contracted (everything else), or auto, by the cameras [default: auto]
    #[arg(long, help_heading = "Scene", value_parser = names(SpaceChoice::ALL))]
    space: Option<String>,

    /// Orientation of a capture: up (the cameras' mean up is +z), pca (the plane of the cameras is horizontal), or none [default: up]
    #[arg(long, help_heading = "Scene", value_parser = names(Orient::ALL))]
    orient: Option<String>,

    /// Origin of a capture: poses (the mean of the cameras), focus (the point that they look at), none, or auto, which is focus if they look
    /// inwards [default: auto]
    #[arg(long, help_heading = "Scene", value_parser = names(Center::ALL))]
    center: Option<String>,

    /// Scale of a capture: auto (the farthest camera comes to 1, or to 2 if cameras look inwards), none, or a number that multiplies its lengths [default: auto]
    #[arg(long, value_name = "FACTOR", help_heading = "Scene", value_parser = scale, allow_negative_numbers = true)]
    scale: Option<Scale>,

    /// Interval of the test views of a capture without splits: every n-th by sorted name; 0 for none [default: 8]
    #[arg(long, value_name = "N", help_heading = "Scene", value_parser = super::whole::<i64>(0, i64::MAX as u64), allow_negative_numbers = true)]
    test_every: Option<i64>,
}

impl CaptureFlags {
    /// Adds the flags to settings.
    pub fn set(&self, layers: &mut Layers) -> Result<()> {
        let text = |value: &Option<String>| value.clone().map(Value::String);
        let scale = self.scale.map(|scale| match scale {
            Scale::Factor(factor) => Value::Float(factor),
            named => Value::String(named.to_string()),
        });
        for (flag, path, value) in [
            ("--format", "capture.format", text(&self.format)),
            ("--space", "capture.space", text(&self.space)),
            ("--orient", "capture.orient", text(&self.orient)),
            ("--center", "capture.center", text(&self.center)),
            ("--scale", "capture.scale", scale),
            ("--test-every", "capture.test_every", self.test_every.map(Value::Integer)),
        ] {
            if let Some(value) = value {
                layers.set(path, Some(value), flag)?;
            }
        }
        Ok(())
    }

    /// Returns true if a format of captures is chosen.
    pub fn names_format(&self) -> bool {
        self.format.as_deref().is_some_and(|format| format != FormatChoice::Auto.to_string())
    }

    /// Returns the choices, for a command without other settings.
    pub fn options(&self) -> Result<CaptureOptions> {
        let mut layers = Layers::defaults()?;
        self.set(&mut layers)?;
        Ok(layers.resolve()?.capture)
    }
}

fn names<T: Display>(all: &[T]) -> PossibleValuesParser {
    PossibleValuesParser::new(all.iter().map(|choice| choice.to_string().leak() as &str).collect::<Vec<_>>())
}

fn scale(text: &str) -> std::result::Result<Scale, String> {
    match text.parse() {
        Ok(Scale::Factor(_)) | Err(_) => {
            number(f64::MIN_POSITIVE)(text).map(Scale::Factor).map_err(|_| "expected auto, none or a number above 0".to_owned())
        }
        Ok(named) => Ok(named),
    }
}
