//! Settings of DirectVoxGO.

use crate::error::{Error, Result};
use crate::field::encoding::Directions;
pub use crate::model::stage::Stage;
use serde::{Deserialize, Serialize};

/// Settings of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Length of the color feature in the fine stages.
    pub features: usize,
    /// Width of the hidden layers of the color network.
    pub hidden: usize,
    /// Number of linear layers of the color network.
    pub depth: usize,
    /// Encoding of directions.
    pub directions: Directions,
    /// Distance between samples, in voxels of the stage.
    pub step: f64,
    /// Weight that completes a group of samples, for which the color network is evaluated once ([`Grouping`](crate::field::grouping::Grouping)), in training of
    /// the fine stages; 0 for each sample.
    pub group: f64,
    /// Weight that completes a group in pictures.
    pub group_in_pictures: f64,
    /// Transmittance below which a ray ends.
    pub stop_below: f64,
    /// The coarse stage.
    pub coarse: Stage,
    /// The fine stages, with increasing resolution.
    pub fine: Vec<Stage>,
    /// Initial opacity of a voxel of the coarse stage.
    pub coarse_opacity: f64,
    /// Initial opacity of a voxel of the last fine stage.
    pub fine_opacity: f64,
    /// Least opacity of a sample, and least weight of a color, in the coarse stage.
    pub coarse_above: f64,
    /// Least opacity of a sample, and least weight of a color, in the fine stages; also the least opacity of a voxel in whose neighbourhood is sampled.
    pub fine_above: f64,
    /// Least opacity of a coarse voxel that belongs to the box of the fine stages, and in whose neighbourhood they sample.
    pub occupied_above: f64,
    /// Size of the box of the fine stages, in sizes of the box around the occupied coarse voxels.
    pub box_scale: f64,
    /// Amount by which the shift of the density falls when the resolution increases.
    pub shift_fall: f64,
    /// Number of steps between the searches for occupied cells in the fine stages; 0 for none but those at the beginning of stages.
    pub prune_every: u64,
    /// Least number of training views that see a coarse voxel which is sampled.
    pub least_views: u32,
    /// Learning rate of densities and features.
    pub grid_rate: f64,
    /// Learning rate of the network.
    pub network_rate: f64,
    /// Number of steps in which learning rates fall to a tenth. They rise to the full rates at the beginning of each stage.
    pub tenth_every: u64,
    /// Weight of the entropy of the opacity, in the coarse stage and in the fine stages.
    pub entropy: [f64; 2],
    /// Weight of the error of the colors of single samples, in the coarse stage and in the fine stages.
    pub sample_color: [f64; 2],
    /// True: products of the color network are computed in [`Precision::Mixed`](autograd::Precision::Mixed), in training and in pictures.
    pub mixed_precision: bool,
}

fn stages<const N: usize>(stages: [(usize, u64, usize); N]) -> Vec<Stage> {
    stages.map(|(resolution, steps, rays)| Stage { resolution, steps, rays }).to_vec()
}

/// The recipe for two cores: the authors' method with fewer steps of fewer rays.
impl Default for Config {
    fn default() -> Self {
        Config {
            coarse: Stage { resolution: 64, steps: 800, rays: 1024 },
            fine: stages([(64, 300, 1024), (80, 300, 1024), (101, 300, 1536), (127, 300, 2048), (160, 2800, 4096)]),
            tenth_every: 3000,
            // With the authors' 1e-6, 800 steps find nothing.
            coarse_opacity: 1e-4,
            ..Config::authors()
        }
    }
}

impl Config {
    /// Returns the settings of the authors' `configs/default.py` for synthetic scenes (160³ voxels).
    pub fn authors() -> Self {
        Config {
            features: 12,
            hidden: 128,
            depth: 3,
            directions: Directions::Frequency(4),
            step: 0.5,
            group: 0.0,
            group_in_pictures: 0.0,
            stop_below: 1e-3,
            coarse: Stage { resolution: 100, steps: 5000, rays: 8192 },
            // The number of voxels doubles at steps 1000, 2000, 3000 and 4000.
            fine: stages([(63, 1000, 8192), (80, 1000, 8192), (101, 1000, 8192), (127, 1000, 8192), (160, 16_000, 8192)]),
            coarse_opacity: 1e-6,
            fine_opacity: 1e-2,
            coarse_above: 1e-7,
            fine_above: 1e-4,
            occupied_above: 1e-3,
            box_scale: 1.05,
            shift_fall: 1.0,
            prune_every: 1000,
            least_views: 3,
            grid_rate: 0.1,
            network_rate: 1e-3,
            tenth_every: 20_000,
            entropy: [0.01, 0.001],
            sample_color: [0.1, 0.01],
            mixed_precision: false,
        }
    }

    /// Checks the settings.
    ///
    /// Errors name the setting that is invalid.
    pub fn validate(&self) -> Result<()> {
        let check = |valid: bool, key: &str, value: f64, expected: &str| match valid {
            true => Ok(()),
            false => Err(Error::config(key, value, expected)),
        };
        for (key, width) in [("features", self.features), ("hidden", self.hidden)] {
            check((1..=1024).contains(&width), key, width as f64, "1 to 1024")?;
        }
        check((1..=16).contains(&self.depth), "depth", self.depth as f64, "1 to 16")?;
        self.directions.validate("directions")?;
        check(self.step > 0.0 && self.step.is_finite(), "step", self.step, "a number of voxels above 0")?;
        for (key, share) in [
            ("group", self.group),
            ("group_in_pictures", self.group_in_pictures),
            ("stop_below", self.stop_below),
            ("coarse_above", self.coarse_above),
            ("fine_above", self.fine_above),
            ("occupied_above", self.occupied_above),
        ] {
            check((0.0..1.0).contains(&share), key, share, "a number in [0, 1)")?;
        }
        for (key, opacity) in [("coarse_opacity", self.coarse_opacity), ("fine_opacity", self.fine_opacity)] {
            check(opacity > 0.0 && opacity < 1.0, key, opacity, "a number in (0, 1)")?;
        }
        check((1.0..=10.0).contains(&self.box_scale), "box_scale", self.box_scale, "a number in [1, 10]")?;
        check((0.0..=100.0).contains(&self.shift_fall), "shift_fall", self.shift_fall, "a number in [0, 100]")?;
        for (key, rate) in [("grid_rate", self.grid_rate), ("network_rate", self.network_rate)] {
            check(rate > 0.0 && rate <= 1.0, key, rate, "a number in (0, 1]")?;
        }
        check(self.tenth_every > 0, "tenth_every", 0.0, "at least 1")?;
        for (key, weights) in [("entropy", self.entropy), ("sample_color", self.sample_color)] {
            for weight in weights {
                check((0.0..=1.0).contains(&weight), key, weight, "numbers in [0, 1]")?;
            }
        }
        self.coarse.validate("coarse")?;
        if self.fine.is_empty() {
            return Err(Error::usage("fine", "there is no stage", "set at least one"));
        }
        self.fine.iter().enumerate().try_for_each(|(i, stage)| stage.validate(&format!("fine[{i}]")))
    }
}
