//! The presets: named settings with their purpose and training time.

use super::Layers;
use crate::error::{Error, Result};
use crate::model::plenoxels::config::Config;

/// A named layer of settings over the defaults.
#[derive(Debug)]
pub struct Preset {
    /// Name, as in `--preset` and [`Config::preset`].
    pub name: &'static str,
    /// Purpose, in a few words.
    pub purpose: &'static str,
    /// Training time on two cores, and the image size.
    pub time: &'static str,
    /// The layer as TOML; comments give the reason for each value.
    pub text: &'static str,
}

/// The presets for training.
pub const PRESETS: [Preset; 11] = [
    Preset {
        name: "fast",
        purpose: "good quality in short time; the default of `train`",
        time: "1 to 3 min at 800 x 800",
        text: include_str!("../../../presets/fast.toml"),
    },
    Preset {
        name: "quality",
        purpose: "the best quality: a factored field; `bake` makes voxels of it",
        time: "about 11 min at 800 x 800",
        text: include_str!("../../../presets/quality.toml"),
    },
    Preset {
        name: "photos",
        purpose: "captures of the real world; the default of `train` for them",
        time: "9 min at 1008 x 756 (NDC)",
        text: include_str!("../../../presets/photos.toml"),
    },
    Preset {
        name: "voxels",
        purpose: "the best quality of a voxel grid",
        time: "about 15 min at 800 x 800",
        text: include_str!("../../../presets/voxels.toml"),
    },
    Preset {
        name: "tensorf",
        purpose: "TensoRF, scaled for two cores; the same as quality",
        time: "about 11 min at 800 x 800",
        text: include_str!("../../../presets/quality.toml"),
    },
    Preset {
        name: "dvgo",
        purpose: "DirectVoxGO: dense grids with a color network",
        time: "minutes at 800 x 800",
        text: include_str!("../../../presets/dvgo.toml"),
    },
    Preset {
        name: "ngp",
        purpose: "Instant-NGP: a hash grid with two small networks",
        time: "minutes at 800 x 800",
        text: include_str!("../../../presets/ngp.toml"),
    },
    Preset {
        name: "nerf",
        purpose: "NeRF: two networks without a grid, shortened",
        time: "an hour at 800 x 800",
        text: include_str!("../../../presets/nerf.toml"),
    },
    Preset {
        name: "plenoxels",
        purpose: "Plenoxels as published, for comparison",
        time: "from 1.6 hours at 800 x 800",
        text: include_str!("../../../presets/plenoxels.toml"),
    },
    Preset {
        name: "paper",
        purpose: "\"Plenoxels and extension to point clouds\", with bugs fixed",
        time: "23 s at 100 x 100",
        text: include_str!("../../../presets/paper.toml"),
    },
    Preset {
        name: "demo",
        purpose: "the simplest coarse-to-fine training, for the built-in scene",
        time: "40 s at 200 x 200",
        text: include_str!("../../../presets/demo.toml"),
    },
];

/// The preset for carving.
pub const CARVE: Preset = Preset {
    name: "carve",
    purpose: "an opaque grid without training, for `plenoxel carve`",
    time: "20 s at 800 x 800",
    text: include_str!("../../../presets/carve.toml"),
};

/// Returns the preset of a name, which may also be [`CARVE`].
///
/// Errors: no preset has this name; the message lists the names.
pub fn preset(name: &str) -> Result<&'static Preset> {
    let preset = PRESETS.iter().chain([&CARVE]).find(|preset| preset.name == name);
    preset.ok_or_else(|| Error::config("preset", name, PRESETS.map(|preset| preset.name).join(", ")))
}

impl Config {
    /// Returns the settings of a preset over the defaults, as `plenoxel train --preset NAME` resolves them without other flags.
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
