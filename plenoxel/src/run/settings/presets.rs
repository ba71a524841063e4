//! The presets: named settings with their purpose and training time.

use super::Layers;
use crate::error::{Error, Result};
use crate::model::plenoxels::config::Config;

/// A named layer of settings over the defaults.
#[derive(Debug)]
pub struct Preset {
    /// Name, as `--preset` and [`Config::preset`] take it.
    pub name: &'static str,
    /// Purpose, in a few words.
    pub purpose: &'static str,
    /// Training time on two cores, and the image size it is for.
    pub time: &'static str,
    /// The layer as TOML, with the reasons for each value in comments.
    pub text: &'static str,
}

/// The presets for training.
pub const PRESETS: [Preset; 5] = [
    Preset {
        name: "fast",
        purpose: "a good grid soon: what `train` does by itself",
        time: "1 to 3 min at 800 x 800",
        text: include_str!("../../../presets/fast.toml"),
    },
    Preset {
        name: "quality",
        purpose: "the best there is",
        time: "about 15 min at 800 x 800",
        text: include_str!("../../../presets/quality.toml"),
    },
    Preset {
        name: "plenoxels",
        purpose: "Plenoxels as published, for comparison",
        time: "2 hours or more at 800 x 800",
        text: include_str!("../../../presets/plenoxels.toml"),
    },
    Preset {
        name: "paper",
        purpose: "\"Plenoxels and extension to point clouds\", bugs repaired",
        time: "23 s at 100 x 100",
        text: include_str!("../../../presets/paper.toml"),
    },
    Preset {
        name: "demo",
        purpose: "coarse to fine as plainly as can be, for the built-in scene",
        time: "40 s at 200 x 200",
        text: include_str!("../../../presets/demo.toml"),
    },
];

/// The preset for carving.
pub const CARVE: Preset = Preset {
    name: "carve",
    purpose: "an opaque grid, without training: for `plenoxel carve`",
    time: "20 s at 800 x 800",
    text: include_str!("../../../presets/carve.toml"),
};

/// Looks up a preset by name, [`CARVE`] included.
///
/// Errors: no preset has this name; the message lists the names.
pub fn preset(name: &str) -> Result<&'static Preset> {
    let preset = PRESETS.iter().chain([&CARVE]).find(|preset| preset.name == name);
    preset.ok_or_else(|| Error::config("preset", name, PRESETS.map(|preset| preset.name).join(", ")))
}

impl Config {
    /// The settings of a preset over the defaults, as `plenoxel train --preset NAME` resolves them without other flags.
    ///
    /// Errors: no preset has this name; the message lists the names.
    ///
    /// ```
    /// let config = plenoxel::model::plenoxels::config::Config::preset("fast")?;
    /// # Ok::<(), plenoxel::error::Error>(())
    /// ```
    pub fn preset(name: &str) -> Result<Self> {
        Layers::defaults()?.with_preset(name)?.resolve()
    }
}
