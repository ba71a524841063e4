//! The presets, and what is to be known of one before it is used.

use plenoxel::error::{Error, Result};

/// Settings with a name.
#[derive(Debug)]
pub struct Preset {
    /// As `--preset` takes it.
    pub name: &'static str,
    /// What it is for.
    pub purpose: &'static str,
    /// How long it takes on two cores, and with what.
    pub time: &'static str,
    /// A layer over the defaults, with its reasons.
    pub text: &'static str,
}

/// What `train` may start from.
pub const PRESETS: [Preset; 5] = [
    Preset {
        name: "fast",
        purpose: "a good grid soon: what `train` does by itself",
        time: "1 to 3 min at 800 x 800",
        text: include_str!("../../presets/fast.toml"),
    },
    Preset {
        name: "quality",
        purpose: "the best there is",
        time: "about 15 min at 800 x 800",
        text: include_str!("../../presets/quality.toml"),
    },
    Preset {
        name: "plenoxels",
        purpose: "Plenoxels as published, for comparison",
        time: "2 hours or more at 800 x 800",
        text: include_str!("../../presets/plenoxels.toml"),
    },
    Preset {
        name: "paper",
        purpose: "\"Plenoxels and extension to point clouds\", bugs repaired",
        time: "23 s at 100 x 100",
        text: include_str!("../../presets/paper.toml"),
    },
    Preset {
        name: "demo",
        purpose: "coarse to fine as plainly as can be, for the built-in scene",
        time: "40 s at 200 x 200",
        text: include_str!("../../presets/demo.toml"),
    },
];

/// What `carve` starts from.
pub const CARVE: Preset = Preset {
    name: "carve",
    purpose: "an opaque grid, without training: for `plenoxel carve`",
    time: "20 s at 800 x 800",
    text: include_str!("../../presets/carve.toml"),
};

/// The preset of a name.
///
/// Errors: there is none, with the names that there are.
pub fn find(name: &str) -> Result<&'static Preset> {
    let preset = PRESETS.iter().chain([&CARVE]).find(|preset| preset.name == name);
    preset.ok_or_else(|| Error::config("preset", name, PRESETS.map(|preset| preset.name).join(", ")))
}
