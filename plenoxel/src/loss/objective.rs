//! The weighted sum of losses, and the data that losses read.

use super::{AdaptiveRobust, beta, cauchy_sparsity, charbonnier, distortion, entropy, huber, mse, opacity_supervision, random_background};
use crate::error::{Error, Result};
use crate::rays::RayBatch;
use crate::render::{PerSample, Rendered};
use autograd::optim::{Adam, AdamMode, Optimizer, Rates, Schedule};
use autograd::single::{cast, is_single};
use autograd::{Module, Param, Real, Tensor};

/// Data of a training step that losses read. `M` is the type of the model; losses that read the model depend on it.
pub struct Step<'a, T: Real, M> {
    /// Number of the step, from 0 over the whole run.
    pub number: u64,
    /// Seed of the run, for losses that draw random numbers.
    pub seed: u64,
    /// Rays, with the colors of the photographs along them.
    pub batch: &'a RayBatch<T>,
    /// Rendered pixels of the rays.
    pub rendered: &'a Rendered<T>,
    /// The model.
    pub model: &'a M,
    /// Longest side of the model's box, world length.
    pub extent: f64,
    /// Background color, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Predicted colors, `[n, 3]`: the rendered colors, or the result of [`Objective::predicting`].
    pub prediction: Tensor<T>,
    params: &'a [Param<T>],
}

impl<'a, T: Real, M> Step<'a, T, M> {
    /// Creates a step whose prediction is the rendered color. [`Objective::evaluate`] adds the parameters of the losses and the prediction.
    pub fn new(
        (number, seed): (u64, u64),
        batch: &'a RayBatch<T>,
        rendered: &'a Rendered<T>,
        model: &'a M,
        (extent, background): (f64, [f32; 3]),
    ) -> Self {
        Step { number, seed, batch, rendered, model, extent, background, prediction: rendered.rgb.clone(), params: &[] }
    }

    /// Returns the step without its model, for losses of any model.
    pub fn without_model(&self) -> Step<'_, T, ()> {
        let Step { number, seed, batch, rendered, extent, background, ref prediction, params, .. } = *self;
        Step { number, seed, batch, rendered, model: &(), extent, background, prediction: prediction.clone(), params }
    }

    /// Returns the step with another prediction.
    fn predicted(&self, prediction: Tensor<T>) -> Self {
        Step { prediction, ..*self }
    }

    /// Returns the parameter of this name, as added by [`Objective::with_param`].
    ///
    /// Panics if there is none.
    #[track_caller]
    pub fn param(&self, name: &str) -> &'a Tensor<T> {
        let found = self.params.iter().find(|param| param.name() == name);
        let Some(param) = found else {
            let known: Vec<&str> = self.params.iter().map(Param::name).collect();
            panic!("step.param: the objective has no parameter `{name}`; it has {known:?}");
        };
        param.tensor()
    }
}

type LossFn<T, M> = Box<dyn Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync>;

struct Term<T: Real, M> {
    name: String,
    weight: Box<dyn Schedule>,
    loss: LossFn<T, M>,
    needs_samples: bool,
}

/// Weighted sum of named losses for a model of type `M`, with the parameters of the losses. Weights may change over the run.
///
/// The losses of an objective for the type `()` do not read the model. [`Objective::joined`] adds them to the objective of any model.
///
/// As a [`Module`] it consists of the parameters of its losses.
pub struct Objective<T: Real, M> {
    terms: Vec<Term<T, M>>,
    predict: Option<LossFn<T, M>>,
    params: Vec<Param<T>>,
    rates: Rates,
}

impl<T: Real, M> Default for Objective<T, M> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Real, M> Module<T> for Objective<T, M> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.params.iter().for_each(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.params.iter_mut().for_each(f);
    }
}

/// Value of an objective at a step.
pub struct Evaluation<T: Real> {
    /// Σ weight · loss, a scalar.
    pub total: Tensor<T>,
    /// Unweighted value of each loss whose weight is not 0.
    pub losses: Vec<(String, f64)>,
    /// Predicted colors `[n, 3]`, which the training PSNR is computed from.
    pub prediction: Tensor<T>,
}

impl<T: Real, M> Objective<T, M> {
    /// Creates an objective without losses.
    pub fn new() -> Self {
        Objective { terms: Vec::new(), predict: None, params: Vec::new(), rates: Rates::new(0.0) }
    }

    /// Adds a loss. `weight` is a number or a schedule over the steps of the run. Steps with weight 0 do not compute the loss.
    pub fn with(
        self,
        name: impl Into<String>,
        weight: impl Schedule + 'static,
        loss: impl Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync + 'static,
    ) -> Self {
        self.with_term(name.into(), weight, Box::new(loss), false)
    }

    /// Adds a loss that reads [`Rendered::samples`], the values of every sample. Training then renders with the graph engine, which keeps
    /// them.
    pub fn with_samples(
        self,
        name: impl Into<String>,
        weight: impl Schedule + 'static,
        loss: impl Fn(&Step<'_, T, M>, &PerSample<T>) -> Tensor<T> + Send + Sync + 'static,
    ) -> Self {
        let loss = move |step: &Step<'_, T, M>| {
            let samples = step.rendered.samples().expect("a loss of samples is rendered with the graph engine");
            loss(step, samples)
        };
        self.with_term(name.into(), weight, Box::new(loss), true)
    }

    fn with_term(mut self, name: String, weight: impl Schedule + 'static, loss: LossFn<T, M>, needs_samples: bool) -> Self {
        self.terms.push(Term { name, weight: Box::new(weight), loss, needs_samples });
        self
    }

    /// Adds a parameter that losses read with [`Step::param`]. It is trained by Adam (β₁ = 0.9, β₂ = 0.99) with the learning rate `rate`, a
    /// number or a schedule over the steps of the run. It is saved and resumed with the run.
    ///
    /// Panics if a parameter of this name exists.
    #[track_caller]
    pub fn with_param(mut self, param: Param<T>, rate: impl Schedule + 'static) -> Self {
        assert!(self.params.iter().all(|known| known.name() != param.name()), "with_param: parameter `{}` exists already", param.name());
        self.rates = self.rates.with(param.name(), rate);
        self.params.push(param);
        self
    }

    /// Replaces the learning rate of a parameter.
    ///
    /// Panics if there is no parameter of this name.
    #[track_caller]
    pub fn with_rate(mut self, name: &str, rate: impl Schedule + 'static) -> Self {
        assert!(self.params.iter().any(|param| param.name() == name), "with_rate: no parameter `{name}`");
        self.rates = self.rates.with(name, rate);
        self
    }

    /// Sets the prediction: a function from the step to predicted colors, `[n, 3]`. The step's `prediction` is the current prediction,
    /// initially the rendered colors. Photometric losses and the reported PSNR use the prediction. Several functions are applied in the
    /// order in which they were added.
    pub fn predicting(mut self, predict: impl Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync + 'static) -> Self
    where
        M: 'static,
    {
        self.predict = Some(match self.predict.take() {
            None => Box::new(predict),
            Some(before) => Box::new(move |step| predict(&step.predicted(before(step)))),
        });
        self
    }

    /// Adds the losses, parameters and predictions of an objective that does not read the model. Its predictions are applied last.
    ///
    /// Panics if both have a parameter of the same name.
    #[track_caller]
    pub fn joined(mut self, other: Objective<T, ()>) -> Self
    where
        M: 'static,
    {
        let Objective { terms, predict, params, rates } = other;
        for Term { name, weight, loss, needs_samples } in terms {
            let loss: LossFn<T, M> = Box::new(move |step| loss(&step.without_model()));
            self.terms.push(Term { name, weight, loss, needs_samples });
        }
        for param in params {
            assert!(self.param(param.name()).is_none(), "joined: parameter `{}` exists already", param.name());
            self.params.push(param);
        }
        self.rates = self.rates.joined(rates);
        match predict {
            Some(predict) => self.predicting(move |step| predict(&step.without_model())),
            None => self,
        }
    }

    /// Returns true if a loss reads the values of every sample.
    pub fn needs_samples(&self) -> bool {
        self.terms.iter().any(|term| term.needs_samples)
    }

    /// Adds a loss of [`NAMES`] by its name. `views` is the number of training views, for losses with a parameter per view.
    ///
    /// Errors if the name is unknown.
    pub fn with_named(self, name: &str, weight: impl Schedule + 'static, views: usize) -> Result<Self>
    where
        M: 'static,
    {
        Ok(match name {
            "mse" => self.with(name, weight, mse),
            "charbonnier" => self.with(name, weight, charbonnier),
            "huber" => self.with(name, weight, huber),
            "robust" => self.with_adaptive_robust(name, weight, AdaptiveRobust::default()),
            "exposure" => self.with_exposure(weight, views),
            "poses" => self.with_poses(weight, views),
            "outlier_views" => self.with_outlier_views(weight, views),
            "sparsity" => self.with(name, weight, cauchy_sparsity),
            "entropy" => self.with(name, weight, entropy),
            "beta" => self.with(name, weight, beta),
            "distortion" => self.with(name, weight, distortion),
            "opacity" => self.with(name, weight, opacity_supervision),
            "random_background" => self.with(name, weight, random_background),
            _ => return Err(Error::usage(format!("losses.{name}"), "unknown loss", format!("expected one of {}", NAMES.join(", ")))),
        })
    }

    /// Returns the names of the losses, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.terms.iter().map(|t| t.name.as_str())
    }

    /// Returns the parameters of the losses.
    pub fn params(&self) -> &[Param<T>] {
        &self.params
    }

    /// Returns the value of the parameter of this name; `None` if there is none.
    pub fn param(&self, name: &str) -> Option<&Tensor<T>> {
        self.params.iter().find(|param| param.name() == name).map(Param::tensor)
    }

    /// Returns the optimizer of the parameters of the losses. It takes over their learning rates.
    pub(crate) fn take_optimizer(&mut self) -> Box<dyn Optimizer<T>> {
        let rates = std::mem::replace(&mut self.rates, Rates::new(0.0));
        if const { is_single::<T>() } { cast(adam_single(rates)) } else { Box::new(Adam::new(rates, AdamMode::Dense)) }
    }

    /// Evaluates Σ weight · loss at a step, with the value of each loss.
    ///
    /// Panics if a loss is not a scalar, or if the prediction has another shape than the rendered colors.
    pub fn evaluate(&self, step: Step<'_, T, M>) -> Evaluation<T> {
        let mut step = Step { params: &self.params, ..step };
        if let Some(predict) = &self.predict {
            step.prediction = predict(&step);
            assert_eq!(step.prediction.shape(), step.rendered.rgb.shape(), "predicting: the prediction must have one color per ray");
        }
        let mut losses = Vec::with_capacity(self.terms.len());
        let mut total: Option<Tensor<T>> = None;
        for term in &self.terms {
            let weight = term.weight.at(step.number);
            if weight == 0.0 {
                continue;
            }
            let loss = (term.loss)(&step);
            assert_eq!(loss.len(), 1, "the loss `{}` must be a scalar, got shape {:?}", term.name, loss.shape());
            losses.push((term.name.clone(), loss.item().as_f64()));
            let share = loss.reshape(&[]) * weight;
            total = Some(match total {
                None => share,
                Some(sum) => sum + share,
            });
        }
        Evaluation { total: total.unwrap_or_else(|| Tensor::scalar(T::zero())), losses, prediction: step.prediction }
    }
}

#[inline(never)]
fn adam_single(rates: Rates) -> Box<dyn Optimizer<f32>> {
    Box::new(Adam::new(rates, AdamMode::Dense))
}

/// Names of the losses that [`Objective::with_named`] adds. They do not depend on the type of the model.
pub const NAMES: [&str; 13] = [
    "mse",
    "charbonnier",
    "huber",
    "robust",
    "exposure",
    "poses",
    "outlier_views",
    "sparsity",
    "entropy",
    "beta",
    "distortion",
    "opacity",
    "random_background",
];
