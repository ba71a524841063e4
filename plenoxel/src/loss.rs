//! Losses and their weighted sum.
//!
//! A loss is a function of a training step to a scalar tensor; those of this crate and a user's own closure are the same thing:
//!
//! ```
//! use plenoxel::loss::{Objective, mse};
//! let objective = Objective::<f32>::new()
//!     .with("mse", 1.0, mse)
//!     .with("bright", 0.01, |step| (1.0 - &step.rendered.rgb).square().mean());
//! assert_eq!(objective.names().collect::<Vec<_>>(), ["mse", "bright"]);
//! ```

mod opacity;
mod photometric;
mod sparsity;
mod total_variation;

pub use opacity::{beta, entropy, opacity_supervision};
pub use photometric::{charbonnier, huber, mse};
pub use sparsity::{cauchy_sparsity, distortion};
pub use total_variation::{Cells, sampled_total_variation, total_variation, total_variation_of_bricks, tv_color, tv_density};

use crate::error::{Error, Result};
use crate::field::voxel_grid::VoxelGrid;
use crate::rays::RayBatch;
use crate::render::Rendered;
use crate::render::composite::PerSample;
use autograd::optim::Schedule;
use autograd::{Real, Tensor};

/// What a loss sees.
pub struct Step<'a, T: Real> {
    /// The number of the step, from 0 over the whole run.
    pub number: u64,
    /// Seed of the run, for losses that draw.
    pub seed: u64,
    /// Rays and what the photographs show along them.
    pub batch: &'a RayBatch<T>,
    /// What the model shows.
    pub rendered: &'a Rendered<T>,
    /// The model.
    pub grid: &'a VoxelGrid<T>,
}

type LossFn<T> = Box<dyn Fn(&Step<'_, T>) -> Tensor<T> + Send + Sync>;

struct Term<T: Real> {
    name: String,
    weight: Box<dyn Schedule>,
    loss: LossFn<T>,
    needs_samples: bool,
}

/// A sum of named losses with weights that may change over the run.
pub struct Objective<T: Real> {
    terms: Vec<Term<T>>,
}

impl<T: Real> Default for Objective<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Real> Objective<T> {
    /// No losses yet.
    pub fn new() -> Self {
        Objective { terms: Vec::new() }
    }

    /// Adds a loss. `weight` is a number or a schedule over the steps of the run; where it is 0 the loss is not computed.
    pub fn with(
        mut self,
        name: impl Into<String>,
        weight: impl Schedule + 'static,
        loss: impl Fn(&Step<'_, T>) -> Tensor<T> + Send + Sync + 'static,
    ) -> Self {
        self.terms.push(Term { name: name.into(), weight: Box::new(weight), loss: Box::new(loss), needs_samples: false });
        self
    }

    /// Adds a loss that reads [`Rendered::samples`], the numbers of every sample: training then renders with the graph, which has them.
    pub fn with_samples(
        mut self,
        name: impl Into<String>,
        weight: impl Schedule + 'static,
        loss: impl Fn(&Step<'_, T>, &PerSample<T>) -> Tensor<T> + Send + Sync + 'static,
    ) -> Self {
        let loss = move |step: &Step<'_, T>| {
            let samples = step.rendered.samples().expect("a loss of samples is rendered with the graph engine");
            loss(step, samples)
        };
        self.terms.push(Term { name: name.into(), weight: Box::new(weight), loss: Box::new(loss), needs_samples: true });
        self
    }

    /// True if a loss reads the numbers of every sample.
    pub fn needs_samples(&self) -> bool {
        self.terms.iter().any(|term| term.needs_samples)
    }

    /// Adds one of this crate's losses by its name.
    pub fn with_named(self, name: &str, weight: impl Schedule + 'static) -> Result<Self> {
        Ok(match name {
            "mse" => self.with(name, weight, mse),
            "charbonnier" => self.with(name, weight, charbonnier),
            "huber" => self.with(name, weight, huber),
            "tv_density" => self.with(name, weight, tv_density(Cells::Whole)),
            "tv_color" => self.with(name, weight, tv_color(Cells::Whole)),
            "tv_density_sampled" => self.with(name, weight, tv_density(Cells::SAMPLED)),
            "tv_color_sampled" => self.with(name, weight, tv_color(Cells::SAMPLED)),
            "sparsity" => self.with(name, weight, cauchy_sparsity),
            "entropy" => self.with(name, weight, entropy),
            "beta" => self.with(name, weight, beta),
            "distortion" => self.with(name, weight, distortion),
            "opacity" => self.with(name, weight, opacity_supervision),
            _ => return Err(Error::config(format!("losses.{name}"), "an unknown loss", format!("one of {}", NAMES.join(", ")))),
        })
    }

    /// The names, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.terms.iter().map(|t| t.name.as_str())
    }

    /// Σ weight · loss, and the unweighted value of each loss that was computed.
    ///
    /// Panics if a loss is not a scalar, or if there are no losses.
    pub fn evaluate(&self, step: &Step<'_, T>) -> (Tensor<T>, Vec<(&str, f64)>) {
        let mut values = Vec::with_capacity(self.terms.len());
        let mut total: Option<Tensor<T>> = None;
        for term in &self.terms {
            let weight = term.weight.at(step.number);
            if weight == 0.0 {
                continue;
            }
            let loss = (term.loss)(step);
            assert_eq!(loss.len(), 1, "the loss `{}` must be a scalar, got shape {:?}", term.name, loss.shape());
            values.push((term.name.as_str(), loss.item().as_f64()));
            let share = loss.reshape(&[]) * weight;
            total = Some(match total {
                None => share,
                Some(sum) => sum + share,
            });
        }
        (total.unwrap_or_else(|| Tensor::scalar(T::zero())), values)
    }
}

/// Every loss that [`Objective::with_named`] knows.
pub const NAMES: [&str; 12] = [
    "mse",
    "charbonnier",
    "huber",
    "tv_density",
    "tv_color",
    "tv_density_sampled",
    "tv_color_sampled",
    "sparsity",
    "entropy",
    "beta",
    "distortion",
    "opacity",
];
