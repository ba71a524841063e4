//! Settings of TensoRF.

use crate::camera::mean_pixel_width;
use crate::dataset::View;
use crate::error::{Error, Result};
use crate::field::encoding::Directions;
use crate::field::factored::{Shape, fused};
use crate::model::stage::Stage;
use crate::render::Engine;
use crate::space::{Region, Space};
use serde::{Deserialize, Serialize};

/// Settings of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Components of each of the three plane-line pairs of the density. If this or `appearance_components` is not a multiple of 16, the fused kernel does not
    /// compute the field, and a step takes about ten times as long.
    pub density_components: usize,
    /// Components of each of the three plane-line pairs of the appearance.
    pub appearance_components: usize,
    /// Length of the appearance feature.
    pub features: usize,
    /// Width of the two hidden layers of the color network.
    pub hidden: usize,
    /// Octaves of the positional encoding of the appearance feature.
    pub feature_octaves: usize,
    /// Encoding of directions.
    pub directions: Directions,
    /// Distance between samples, in cells; in normalized device coordinates, in lengths of a cell along the depth.
    pub step: f64,
    /// Distance between samples in pictures, in the same unit. Training shifts the samples of each ray at random, so the field is trained between them too.
    pub step_in_pictures: f64,
    /// Length of a cell along the depth of normalized device coordinates, in lengths of its other sides, 1 to 8. In other spaces cells are cubes.
    pub cell_depth: f64,
    /// Least side of a cell in [`Space::Box`], in pixels of a training view at the middle of the box, on average over the views; 0 for no bound. Stages whose
    /// resolution has smaller cells get cells of this side.
    pub pixels_per_cell: f64,
    /// Weight that completes a group of samples, for which the color network is evaluated once ([`Grouping`](crate::field::grouping::Grouping)), in training; 0
    /// for each sample.
    pub group: f64,
    /// Weight that completes a group in pictures.
    pub group_in_pictures: f64,
    /// True: the samples of a group have the color of their mean position, and a group also ends at gaps and with eight samples, in training and in pictures.
    /// False: the network is evaluated at one sample of each group, which is drawn by weight, and colors between such samples are interpolated
    /// ([`Grouping::compact`](crate::field::grouping::Grouping)).
    pub compact_groups: bool,
    /// Groups of samples whose weight is not above this have no color.
    pub color_above: f64,
    /// Transmittance below which a training ray ends.
    pub stop_below: f64,
    /// Transmittance below which a ray of a picture ends.
    pub stop_below_in_pictures: f64,
    /// Gradients of density and color below this share of their mean are pruned at random by the fused kernel
    /// ([`Factored::gradient_above`](crate::field::factored::Factored::gradient_above)); 0 for exact gradients.
    pub gradient_above: f64,
    /// Distance from a camera, in units of the box, below which gradients are scaled by the square of the distance
    /// ([`Factored::gradient_scaling`](crate::field::factored::Factored::gradient_scaling)); 0 for exact gradients. Not used in normalized device coordinates.
    pub gradient_scaling: f64,
    /// Least opacity 1 − exp(−σ · step) of a cell that is sampled, once a stage has been trained.
    pub occupied_above: f64,
    /// Density before the first step, in units of the box, if there is no visual hull; 0 for the authors' random density, which is about 0.0011. A ray of length
    /// l through this fog has opacity 1 − exp(−σ l). With a visual hull and [`frozen_steps`](Config::frozen_steps), the hull is opaque instead.
    pub initial_density: f64,
    /// Number of steps, from the beginning of the run, for which the density is constant, and only colors are learned.
    #[serde(alias = "opaque_steps")]
    pub frozen_steps: u64,
    /// Learning rate of planes and lines.
    pub factor_rate: f64,
    /// Learning rate of the matrix B and the network.
    pub network_rate: f64,
    /// Share of the learning rates that is left at the end of the run; they fall exponentially.
    pub last_rate: f64,
    /// Share of the steps of the run, at its end, during which the learning rates also fall linearly to 0.
    pub cool_down: f64,
    /// Earlier lengths of a run with a time budget, as pairs `[steps, taken]`: the run was planned for `steps` steps, and this changed after `taken` steps. The learning
    /// rates continue from their value at that step. They fall linearly to 0 in the last share [`cool_down`](Config::cool_down) of the next length, of which
    /// only the steps after `taken` count. Empty if the length never changed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub former_lengths: Vec<[u64; 2]>,
    /// Weight of the L1 norm of the density factors, Σ over planes and lines of the mean absolute value, in the first stage.
    pub density_l1: f64,
    /// Weight of the L1 norm of the density factors in the other stages.
    pub density_l1_later: f64,
    /// Weight of the total variation of the density planes, 0.02 Σ over planes of the mean squared differences of neighbours along both axes; the authors'
    /// `TV_weight_density`. A step reads a twentieth of each plane. 0 for none.
    pub density_tv: f64,
    /// Treatment of rows of planes without a gradient by Adam: true visits only rows with a gradient.
    pub lazy: bool,
    /// True: products of the color network are computed in [`Precision::Mixed`](autograd::Precision::Mixed), in training and in pictures;
    /// with the fused kernel, those of the matrix B too.
    pub mixed_precision: bool,
    /// Changes for a run that is planned for a short time; `None` for none. The settings of a planned run have `None`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub short: Option<Short>,
    /// Stages, with increasing resolution.
    pub stages: Vec<Stage>,
}

/// Changes for a short run: with a smaller network and fewer colors on a ray, it trains more rays.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Short {
    /// Share of the configured duration below which a run is short.
    pub below: f64,
    /// Replaces [`Config::hidden`].
    pub hidden: usize,
    /// Replaces [`Config::group`].
    pub group: f64,
    /// Duration of a step with these changes, relative to one without.
    pub cost: f64,
}

/// The recipe for two cores.
impl Default for Config {
    fn default() -> Self {
        let stages = [(64, 600, 512), (90, 600, 1024), (128, 800, 2048), (180, 1000, 3072), (256, 2000, 4096)];
        Config {
            density_components: 16,
            appearance_components: 48,
            features: 32,
            hidden: 128,
            feature_octaves: 0,
            directions: Directions::Harmonics(3),
            step: 1.0,
            step_in_pictures: 0.5,
            cell_depth: 1.0,
            pixels_per_cell: 0.0,
            group: 0.04,
            group_in_pictures: 0.02,
            compact_groups: false,
            color_above: 1e-3,
            stop_below: 3e-3,
            stop_below_in_pictures: 3e-4,
            gradient_above: 0.0,
            gradient_scaling: 0.0,
            occupied_above: 0.01,
            initial_density: 0.0,
            frozen_steps: 50,
            factor_rate: 0.02,
            network_rate: 5e-3,
            last_rate: 1.0,
            cool_down: 0.4,
            former_lengths: Vec::new(),
            density_l1: 8e-5,
            density_l1_later: 4e-5,
            density_tv: 0.0,
            lazy: true,
            mixed_precision: false,
            short: None,
            stages: stages.map(|(resolution, steps, rays)| Stage { resolution, steps, rays }).to_vec(),
        }
    }
}

impl Config {
    /// Returns the authors' VM-192 for synthetic scenes.
    pub fn authors() -> Self {
        // From 128 to 300 in five steps of equal ratio.
        let stages = [(128, 2000), (152, 1000), (180, 1000), (213, 1500), (253, 1500), (300, 23_000)];
        Config {
            features: 27,
            feature_octaves: 2,
            directions: Directions::Frequency(2),
            step: 0.5,
            step_in_pictures: 0.5,
            group: 0.0,
            group_in_pictures: 0.0,
            color_above: 1e-4,
            stop_below: 0.0,
            stop_below_in_pictures: 0.0,
            frozen_steps: 0,
            network_rate: 1e-3,
            last_rate: 0.1,
            cool_down: 0.0,
            lazy: false,
            stages: stages.map(|(resolution, steps)| Stage { resolution, steps, rays: 4096 }).to_vec(),
            ..Config::default()
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
        for (key, width) in [
            ("density_components", self.density_components),
            ("appearance_components", self.appearance_components),
            ("features", self.features),
            ("hidden", self.hidden),
        ] {
            check((1..=1024).contains(&width), key, width as f64, "1 to 1024")?;
        }
        check(self.feature_octaves <= 16, "feature_octaves", self.feature_octaves as f64, "0 to 16")?;
        self.directions.validate("directions")?;
        for (key, step) in [("step", self.step), ("step_in_pictures", self.step_in_pictures)] {
            check(step > 0.0 && step.is_finite(), key, step, "a number of cells above 0")?;
        }
        check((1.0..=8.0).contains(&self.cell_depth), "cell_depth", self.cell_depth, "1 to 8")?;
        check((0.0..=1e6).contains(&self.pixels_per_cell), "pixels_per_cell", self.pixels_per_cell, "0 to 1e6")?;
        for (key, share) in [
            ("group", self.group),
            ("group_in_pictures", self.group_in_pictures),
            ("color_above", self.color_above),
            ("stop_below", self.stop_below),
            ("stop_below_in_pictures", self.stop_below_in_pictures),
            ("occupied_above", self.occupied_above),
            ("cool_down", self.cool_down),
        ] {
            check((0.0..1.0).contains(&share), key, share, "a number in [0, 1)")?;
        }
        for (key, rate) in [("factor_rate", self.factor_rate), ("network_rate", self.network_rate), ("last_rate", self.last_rate)] {
            check(rate > 0.0 && rate <= 1.0, key, rate, "a number in (0, 1]")?;
        }
        let taken_before_the_end = |[steps, taken]: &[u64; 2]| taken < steps && *taken < self.total_steps();
        if !self.former_lengths.iter().all(taken_before_the_end) || !self.former_lengths.is_sorted_by(|a, b| a[1] < b[1]) {
            let expected = "pairs [steps, taken] in the order of taken, which is less than steps and less than the steps of all stages; remove this key if you change the stages";
            return Err(Error::config("former_lengths", format!("{:?}", self.former_lengths), expected));
        }
        for (key, weight) in [("density_l1", self.density_l1), ("density_l1_later", self.density_l1_later)] {
            check((0.0..=1.0).contains(&weight), key, weight, "a number in [0, 1]")?;
        }
        check((0.0..=100.0).contains(&self.initial_density), "initial_density", self.initial_density, "0 to 100")?;
        check((0.0..=100.0).contains(&self.gradient_above), "gradient_above", self.gradient_above, "0 to 100")?;
        check((0.0..=1e3).contains(&self.gradient_scaling), "gradient_scaling", self.gradient_scaling, "0 to 1000")?;
        check((0.0..=1e3).contains(&self.density_tv), "density_tv", self.density_tv, "0 to 1000")?;
        if let Some(Short { below, hidden, group, cost }) = self.short {
            check((1..=1024).contains(&hidden), "short.hidden", hidden as f64, "1 to 1024")?;
            check((0.0..1.0).contains(&group), "short.group", group, "a number in [0, 1)")?;
            for (key, share) in [("short.below", below), ("short.cost", cost)] {
                check(share > 0.0 && share <= 1.0, key, share, "a number in (0, 1]")?;
            }
        }
        if self.stages.is_empty() {
            return Err(Error::usage("stages", "there is no stage", "set at least one"));
        }
        for (i, stage) in self.stages.iter().enumerate() {
            stage.validate(&format!("stages[{i}]"))?;
        }
        Ok(())
    }

    /// Returns the engine that renders the field if `engine` is asked for.
    pub(super) fn engine(&self, engine: Engine) -> Engine {
        if fused::supports(&self.shape()) { engine } else { Engine::Graph }
    }

    pub(super) fn shape(&self) -> Shape {
        Shape {
            density_components: self.density_components,
            appearance_components: self.appearance_components,
            features: self.features,
            hidden: self.hidden,
            feature_octaves: self.feature_octaves,
            directions: self.directions,
        }
    }

    /// Returns the number of nodes along each axis of a region, about `resolution`³ in total.
    pub(super) fn nodes(&self, region: Region, resolution: usize) -> [usize; 3] {
        let Region { space, mut aabb } = region;
        if matches!(space, Space::Ndc { .. }) {
            aabb.min.z /= self.cell_depth;
            aabb.max.z /= self.cell_depth;
        }
        aabb.nodes(resolution)
    }

    /// Returns the resolution of a stage in a region, bounded by [`pixels_per_cell`](Config::pixels_per_cell).
    pub(super) fn bounded(&self, resolution: usize, Region { space, aabb }: Region, views: &[View]) -> usize {
        let (middle, side) = (0.5 * (aabb.min + aabb.max), aabb.volume().cbrt());
        let pixel = mean_pixel_width(views.iter().map(|view| &view.camera), middle, 0.5 * side);
        let finest = side / (self.pixels_per_cell * pixel);
        // Without views or without a bound it is NaN or infinite.
        if space == Space::Box && finest.is_finite() { resolution.min(finest as usize + 1).max(2) } else { resolution }
    }

    pub(super) fn total_steps(&self) -> u64 {
        self.stages.iter().map(|stage| stage.steps).sum()
    }

    /// Returns how the learning rates fall linearly at the end of the run.
    pub(super) fn cooling(&self) -> CoolDown {
        let present = [self.total_steps(), u64::MAX];
        CoolDown { share: self.cool_down, lengths: self.former_lengths.iter().copied().chain([present]).collect() }
    }
}

/// Factor of the learning rates that falls linearly to 0 at the end of a run.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CoolDown {
    /// Share of the run during which it falls.
    share: f64,
    /// The [`former_lengths`](Config::former_lengths) and the length of the run.
    lengths: Vec<[u64; 2]>,
}

impl CoolDown {
    /// Returns the number of steps of the run.
    pub fn steps(&self) -> u64 {
        self.lengths.last().map_or(0, |[steps, _]| *steps)
    }

    /// Returns the factor of a step.
    pub fn at(&self, step: u64) -> f64 {
        let (mut before, mut from) = (1.0, 0.0);
        if self.share == 0.0 {
            return before;
        }
        for &[total, until] in &self.lengths {
            let total = total as f64;
            let begin = ((1.0 - self.share) * total).max(from);
            let factor = |step: u64| before * ((total - step as f64) / (total - begin)).clamp(0.0, 1.0);
            if step < until {
                return factor(step);
            }
            (before, from) = (factor(until), until as f64);
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Aabb;
    use glam::dvec3;

    #[test]
    fn learning_rates_fall_to_0_from_where_they_were_when_the_length_changed() {
        let stages = vec![Stage { resolution: 8, steps: 90, rays: 16 }];
        let config = Config { cool_down: 0.4, former_lengths: vec![[80, 20], [100, 70]], stages, ..Config::default() };
        let cooling = config.cooling();
        let found = [0, 20, 48, 60, 65, 70, 80, 89].map(|step| cooling.at(step));
        let want = [1.0, 1.0, 1.0, 1.0, 0.875, 0.75, 0.375, 0.0375];
        assert!(found.iter().zip(want).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-12), "{found:?}");
        // A run that becomes so short that its rates should have fallen already.
        let sudden = Config { former_lengths: vec![[1000, 80]], ..config.clone() }.cooling();
        assert_eq!([79, 80, 85, 90].map(|step| sudden.at(step)), [1.0, 1.0, 0.5, 0.0]);
        assert_eq!(Config { cool_down: 0.0, ..config.clone() }.cooling().at(89), 1.0);
        for lengths in [vec![[80, 20], [90, 20]], vec![[80, 80]], vec![[200, 90]]] {
            assert!(Config { former_lengths: lengths, ..config.clone() }.validate().unwrap_err().to_string().contains("former_lengths"));
        }
    }

    #[test]
    fn cells_are_longer_along_the_depth_of_normalized_device_coordinates_only() {
        let half = dvec3(1.2, 1.5, 1.0);
        let aabb = Aabb { min: -half, max: half };
        let config = Config { cell_depth: 4.0, ..Config::default() };
        let sides = |space| {
            let nodes = config.nodes(Region { space, aabb }, 101);
            let total: f64 = nodes.iter().map(|n| (n - 1) as f64).product();
            assert!((0.95e6..1.05e6).contains(&total), "{nodes:?}");
            [0, 1, 2].map(|axis| 2.0 * half[axis] / (nodes[axis] - 1) as f64)
        };
        let ratio = |space| sides(space)[2] / sides(space)[0];
        assert!((ratio(Space::Ndc { a: 1.6, b: 2.1 }) / 4.0 - 1.0).abs() < 0.02);
        assert!((ratio(Space::Box) - 1.0).abs() < 0.02 && (ratio(Space::Contracted) - 1.0).abs() < 0.02);
        assert!(Config { cell_depth: 0.0, ..config.clone() }.validate().is_err());
    }
}
