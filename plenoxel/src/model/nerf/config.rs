//! Settings of NeRF.

use crate::error::{Error, Result};
use crate::field::nerf::{Density, Shape};
use crate::train::StageLength;
use serde::{Deserialize, Serialize};

/// Settings of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Hidden layers of the network of the position.
    pub depth: usize,
    /// Their width.
    pub width: usize,
    /// Layer, from 0, that reads the encoded position again; 0 for none.
    pub skip: usize,
    /// Width of the hidden layer of the network of the color.
    pub color_width: usize,
    /// Octaves of the encoding of the position.
    pub position_octaves: usize,
    /// Octaves of the encoding of the direction.
    pub direction_octaves: usize,
    /// Function from the raw density to the density.
    pub density: Density,
    /// Standard deviation of the noise of the raw density in training.
    pub noise: f64,
    /// Section of the rays that is sampled, in multiples of the direction whose camera z is −1; `None` for the part inside the box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near_far: Option<[f64; 2]>,
    /// Samples per ray of the first pass.
    pub coarse_samples: usize,
    /// Samples per ray that the second pass adds.
    pub fine_samples: usize,
    /// Steps.
    pub steps: u64,
    /// Steps at the beginning that only have rays around the middle of the box. A network that first learns the background everywhere may not recover.
    pub crop_steps: u64,
    /// Rays per step.
    pub rays: usize,
    /// Learning rate at the beginning.
    pub rate: f64,
    /// Factor by which the learning rate has fallen, exponentially, after `decay_steps`.
    pub last_rate: f64,
    /// Steps in which the learning rate falls.
    pub decay_steps: u64,
    /// True: products of the networks are computed in [`Precision::Mixed`](autograd::Precision::Mixed), in training and in pictures.
    /// The preset `nerf` has true.
    pub mixed_precision: bool,
}

/// The recipe for two cores: the authors' needs days on them. A step has a fiftieth of the operations.
impl Default for Config {
    fn default() -> Self {
        Config {
            // A quarter of the operations of 256.
            width: 128,
            color_width: 64,
            // Learns from the first step on, so the crop is not needed.
            density: Density::Softplus,
            crop_steps: 0,
            // Inside the box, all samples are where matter can be.
            near_far: None,
            coarse_samples: 32,
            fine_samples: 48,
            rays: 512,
            // A short run takes larger steps, and its rate falls to its end.
            rate: 1e-3,
            steps: 10_000,
            decay_steps: 10_000,
            ..Config::authors()
        }
    }
}

impl Config {
    /// Returns the authors' settings for synthetic scenes, with the crop of the first steps that their program offers.
    pub fn authors() -> Self {
        Config {
            depth: 8,
            width: 256,
            skip: 5,
            color_width: 128,
            position_octaves: 10,
            direction_octaves: 4,
            density: Density::Relu,
            noise: 0.0,
            near_far: Some([2.0, 6.0]),
            coarse_samples: 64,
            fine_samples: 128,
            steps: 500_000,
            crop_steps: 500,
            rays: 1024,
            rate: 5e-4,
            last_rate: 0.1,
            decay_steps: 500_000,
            mixed_precision: false,
        }
    }

    /// Returns the stages: the steps around the middle of the box, and the others.
    pub(super) fn lengths(&self) -> Vec<StageLength> {
        let length = |steps: u64| StageLength { resolution: None, steps, rays_per_step: Some(self.rays), ray_cost: 1.0 };
        [self.crop_steps, self.steps - self.crop_steps].into_iter().filter(|steps| *steps > 0).map(length).collect()
    }

    /// Checks the settings.
    ///
    /// Errors name the setting that is invalid.
    pub fn validate(&self) -> Result<()> {
        let check = |valid: bool, key: &str, value: f64, expected: &str| match valid {
            true => Ok(()),
            false => Err(Error::config(key, value, expected)),
        };
        for (key, count, most) in [
            ("depth", self.depth, 64),
            ("width", self.width, 4096),
            ("color_width", self.color_width, 4096),
            ("coarse_samples", self.coarse_samples, 1 << 12),
            ("fine_samples", self.fine_samples, 1 << 12),
            ("rays", self.rays, 1 << 20),
        ] {
            check((1..=most).contains(&count), key, count as f64, &format!("1 to {most}"))?;
        }
        if self.skip >= self.depth {
            let found = format!("{} is not a layer after the first of {}", self.skip, self.depth);
            return Err(Error::usage("skip", found, "use 1 to nerf.depth - 1, or 0 for none"));
        }
        for (key, octaves) in [("position_octaves", self.position_octaves), ("direction_octaves", self.direction_octaves)] {
            check(octaves <= 16, key, octaves as f64, "0 to 16")?;
        }
        check((0.0..=100.0).contains(&self.noise), "noise", self.noise, "a number from 0 to 100")?;
        if let Some([near, far]) = self.near_far {
            check(near >= 0.0 && near.is_finite(), "near_far[0]", near, "a distance of at least 0")?;
            check(far > near && far.is_finite(), "near_far[1]", far, "a distance above the first")?;
        }
        check(self.steps > 0, "steps", self.steps as f64, "at least 1")?;
        check(self.crop_steps < self.steps, "crop_steps", self.crop_steps as f64, "less than steps")?;
        for (key, rate) in [("rate", self.rate), ("last_rate", self.last_rate)] {
            check(rate > 0.0 && rate <= 1.0, key, rate, "a number in (0, 1]")?;
        }
        check(self.decay_steps > 0, "decay_steps", self.decay_steps as f64, "at least 1")
    }

    pub(super) fn shape(&self) -> Shape {
        Shape {
            depth: self.depth,
            width: self.width,
            skip: self.skip,
            color_width: self.color_width,
            position_octaves: self.position_octaves,
            direction_octaves: self.direction_octaves,
            density: self.density,
        }
    }
}
