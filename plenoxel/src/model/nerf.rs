//! NeRF (Mildenhall et al. 2020): a coarse network finds where matter is on a ray, and a fine network is evaluated there.
//!
//! The numbers of [`Config::authors`] are those of the paper and of the authors' program. What differs: a batch has rays of all images and not of one; the
//! lengths of the intervals add up to the sampled section ([`importance`](crate::sampling::importance)); random numbers of the second pass are stratified;
//! rays pass through the centres of the pixels; the crop of the first steps is around the projected centre of the box and not in the middle of the image.

mod config;
mod recipe;

pub use config::Config;

use super::cells;
use crate::camera::Ray;
use crate::error::Result;
use crate::field::nerf::NerfField;
use crate::geometry::Aabb;
use crate::loss::{Objective, Step, mse};
use crate::random::{Purpose, Stream};
use crate::rays::RaySource;
use crate::render::{Rendered, ShadedField, composite};
use crate::sampling::importance::{Section, importance, stratified};
use crate::sampling::{Jitter, Occupancy, Samples};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{About, Model, Pass, PlannedStage, RenderFn, StageLength, TrainOptions, ViewOptions, read_params, same_settings};
use autograd::optim::{Adam, AdamMode, Exponential, Optimizer};
use autograd::{Module, Precision, Real, Tensor, impl_module};
use serde_json::{Value, json};
use std::path::Path;

/// Kind of this model in checkpoints.
pub const KIND: &str = "nerf";

/// The model.
#[derive(Debug)]
pub struct Nerf<T: Real> {
    config: Config,
    aabb: Aabb,
    /// Network of the first pass.
    pub coarse: NerfField<T>,
    /// Network of the second pass, whose pixels are the result.
    pub fine: NerfField<T>,
}

impl_module!(Nerf { coarse, fine });

/// Most samples that a picture evaluates at a time: 130 MB for 256 numbers of each.
const SAMPLES_IN_PICTURES: usize = 1 << 17;

impl<T: Real> Nerf<T> {
    /// Creates the model in a box. `seed` determines the initial parameters.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config, aabb: Aabb, seed: u64) -> Result<Self> {
        config.validate()?;
        let random = Stream::new(seed);
        let field = |name: &str| {
            let mut field = NerfField::new(name, config.shape(), &random);
            field.set_precision(Precision::mixed_if(config.mixed_precision));
            field
        };
        Ok(Nerf { coarse: field("coarse"), fine: field("fine"), config, aabb })
    }

    /// Opens a trained model.
    ///
    /// Errors if the file is damaged or holds another kind of model; the error names the file and the problem.
    pub fn open(path: &Path) -> Result<(Self, About)> {
        let config = TensorFile::open(path)?.fact("settings")?;
        // The box and the parameters are in the file.
        let mut model = Nerf::new(config, Aabb::cube(1.0), 0)?;
        let about = model.load(path)?;
        Ok((model, about))
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    fn section(&self) -> Section {
        match self.config.near_far {
            None => Section::Inside(self.aabb),
            Some([near, far]) => Section::Between { near, far },
        }
    }

    /// Renders the samples of a pass. In training, the raw density has noise if the settings say so.
    fn pixels(&self, field: &NerfField<T>, samples: Samples<T>, background: &Tensor<T>, jitter: Jitter) -> Rendered<T> {
        let noise = match jitter {
            Jitter::PerRay { seed, step } if self.config.noise > 0.0 => {
                // Both passes draw other numbers, for they have other numbers of samples.
                let stream = Stream::new(crate::random::bits(seed, Purpose::Noise, step, samples.len() as u64));
                Some(stream.normal_tensor(&[samples.len()], 0.0, self.config.noise))
            }
            _ => None,
        };
        let radiance = field.radiance_with(&samples, noise.as_ref());
        composite(samples, radiance, background)
    }

    fn render_with(&self, rays: &[Ray], background: [f32; 3], jitter: Jitter) -> Rendered<T> {
        let (section, background) = (self.section(), background.map(|c| T::lit(f64::from(c))));
        let background = Tensor::from_vec(background.to_vec(), &[3]);
        let samples = stratified(rays, section, self.config.coarse_samples, jitter);
        let coarse = self.pixels(&self.coarse, samples, &background, jitter);
        let first = coarse.samples().expect("pixels of single samples");
        let samples = importance(rays, section, &first.samples, &first.weights, self.config.fine_samples, jitter);
        self.pixels(&self.fine, samples, &background, jitter).with_coarse(coarse.rgb)
    }

    /// Aims the rays of a stage. Rays that miss the box have no samples.
    fn aim(&self, stage: &PlannedStage, rays: &mut RaySource) {
        let whole = |aabb: Aabb| Occupancy::new(aabb, [1; 3], &[true]);
        let (center, half) = (0.5 * (self.aabb.min + self.aabb.max), 0.25 * (self.aabb.max - self.aabb.min));
        if self.config.crop_steps > 0 && stage.index == 0 {
            rays.aim_at(&whole(Aabb { min: center - half, max: center + half }));
        } else if self.config.near_far.is_none() {
            rays.aim_at(&whole(self.aabb));
        } else {
            rays.set_reduction(rays.reduction());
        }
    }
}

impl<T: Real> Model<T> for Nerf<T> {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn aabb(&self) -> Aabb {
        self.aabb
    }

    fn shaded(&self) -> Option<&dyn ShadedField<T>> {
        Some(&self.fine)
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T> {
        self.render_with(rays, pass.background, pass.jitter)
    }

    fn viewer<'a>(&'a self, view: &ViewOptions) -> RenderFn<'a, T> {
        let background = view.background;
        let size = (SAMPLES_IN_PICTURES / (self.config.coarse_samples + self.config.fine_samples)).max(1);
        let render = move |rays: &[Ray]| self.render_with(rays, background, Jitter::None);
        Box::new(move |rays| match rays.len() {
            n if n > size => Rendered::joined(rays.chunks(size).map(render).collect()),
            _ => render(rays),
        })
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let Config { rate, last_rate, decay_steps, .. } = self.config;
        let from = rate * last_rate.powf(stage.first as f64 / decay_steps as f64);
        let rates = Exponential::new(from, from * last_rate, decay_steps);
        Box::new(Adam::new(rates, AdamMode::Dense).betas(0.9, 0.999).epsilon(1e-7))
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        self.config.lengths()
    }

    fn begin_stage(&mut self, stage: &PlannedStage, rays: &mut RaySource) -> Result<()> {
        self.aim(stage, rays);
        Ok(())
    }

    fn resume(&mut self, stage: &PlannedStage, rays: &mut RaySource) {
        self.aim(stage, rays);
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    fn continues(&self, saved: &Value, _: u64) -> bool {
        same_settings(&self.config, saved)
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        cells::write_box(self.aabb, file);
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        self.aabb = cells::read_box(file)?;
        read_params(self, file)
    }
}

/// Returns the mean over rays and channels of (C − C*)², where C is the color of the first pass: the loss from which the coarse network learns.
pub fn coarse_mse<T: Real>(step: &Step<'_, T, Nerf<T>>) -> Tensor<T> {
    let coarse = step.rendered.coarse.as_ref().expect("a color of the first pass");
    step.batch.mean(&(coarse - &step.batch.target).square())
}

/// Returns the objective of the paper: the mean squared errors of both passes.
pub fn objective<T: Real>() -> Objective<T, Nerf<T>> {
    Objective::new().with("mse", 1.0, mse).with("coarse", 1.0, coarse_mse)
}
