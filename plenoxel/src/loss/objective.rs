//! The weighted sum of losses, and what a loss sees.

use super::{AdaptiveRobust, beta, cauchy_sparsity, charbonnier, distortion, entropy, huber, mse, opacity_supervision};
use crate::error::{Error, Result};
use crate::rays::RayBatch;
use crate::render::{PerSample, Rendered};
use autograd::optim::{Adam, AdamMode, Optimizer, Rates, Schedule};
use autograd::single::{cast, is_single};
use autograd::{Module, Param, Real, Tensor};

/// The data of a training step that a loss may read. `M` is the type of the model; a loss that reads the model says so by this type.
pub struct Step<'a, T: Real, M> {
    /// Number of the step, from 0 over the whole run.
    pub number: u64,
    /// Seed of the run, for losses that draw random numbers.
    pub seed: u64,
    /// Rays, with the photographs' colors along them.
    pub batch: &'a RayBatch<T>,
    /// Pixels that the model shows along the rays.
    pub rendered: &'a Rendered<T>,
    /// The model.
    pub model: &'a M,
    /// Longest side of the model's box, world length.
    pub extent: f64,
    /// Color behind the scene, sRGB in [0, 1].
    pub background: [f32; 3],
    /// Predicted colors of the photographs' pixels, `[n, 3]`: the rendered colors, or what [`Objective::predicting`] makes of them.
    pub prediction: Tensor<T>,
    params: &'a [Param<T>],
}

impl<'a, T: Real, M> Step<'a, T, M> {
    /// A step before any prediction. [`Objective::evaluate`] adds the parameters of the losses and the prediction.
    pub fn new(
        (number, seed): (u64, u64),
        batch: &'a RayBatch<T>,
        rendered: &'a Rendered<T>,
        model: &'a M,
        (extent, background): (f64, [f32; 3]),
    ) -> Self {
        Step { number, seed, batch, rendered, model, extent, background, prediction: rendered.rgb.clone(), params: &[] }
    }

    /// The same step with another prediction.
    fn predicted(&self, prediction: Tensor<T>) -> Self {
        Step { prediction, ..*self }
    }

    /// The parameter of this name that was given to [`Objective::with_param`].
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

/// A sum of named losses for a model of type `M`, with weights that may change over the run, and the parameters of the losses.
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
    /// Value of each loss that was computed, without its weight.
    pub losses: Vec<(String, f64)>,
    /// Predicted colors `[n, 3]`, of which the training PSNR is computed.
    pub prediction: Tensor<T>,
}

impl<T: Real, M> Objective<T, M> {
    /// An objective without losses.
    pub fn new() -> Self {
        Objective { terms: Vec::new(), predict: None, params: Vec::new(), rates: Rates::new(0.0) }
    }

    /// Adds a loss. `weight` is a number or a schedule over the steps of the run; where it is 0 the loss is not computed.
    pub fn with(
        self,
        name: impl Into<String>,
        weight: impl Schedule + 'static,
        loss: impl Fn(&Step<'_, T, M>) -> Tensor<T> + Send + Sync + 'static,
    ) -> Self {
        self.with_term(name.into(), weight, Box::new(loss), false)
    }

    /// Adds a loss that reads [`Rendered::samples`], the values of every sample. Training then renders with the graph, which keeps them.
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

    /// Adds a parameter that the losses read with [`Step::param`]. It is updated by Adam (β₁ = 0.9, β₂ = 0.99) with this learning rate, a number or a
    /// schedule over the steps of the run, and is saved and resumed with the run.
    ///
    /// Panics if a parameter of this name exists.
    #[track_caller]
    pub fn with_param(mut self, param: Param<T>, rate: impl Schedule + 'static) -> Self {
        assert!(self.params.iter().all(|known| known.name() != param.name()), "with_param: two parameters `{}`", param.name());
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

    /// Says how the colors of the photographs' pixels are predicted, `[n, 3]`, from a step whose `prediction` is what was predicted so far, at
    /// first the rendered colors. Photometric losses and the reported PSNR compare the prediction. Several predictions are applied in the order
    /// in which they were given.
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

    /// True if a loss reads the values of every sample.
    pub fn needs_samples(&self) -> bool {
        self.terms.iter().any(|term| term.needs_samples)
    }

    /// Adds one of the losses in [`NAMES`] by its name. `views` is the number of training views, for losses with a parameter for each view.
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
            "sparsity" => self.with(name, weight, cauchy_sparsity),
            "entropy" => self.with(name, weight, entropy),
            "beta" => self.with(name, weight, beta),
            "distortion" => self.with(name, weight, distortion),
            "opacity" => self.with(name, weight, opacity_supervision),
            _ => return Err(Error::usage(format!("losses.{name}"), "unknown loss", format!("expected one of {}", NAMES.join(", ")))),
        })
    }

    /// Names of the losses, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.terms.iter().map(|t| t.name.as_str())
    }

    /// Parameters of the losses.
    pub fn params(&self) -> &[Param<T>] {
        &self.params
    }

    /// The optimizer of the parameters of the losses, with their learning rates, which it takes over.
    pub(crate) fn take_optimizer(&mut self) -> Box<dyn Optimizer<T>> {
        let rates = std::mem::replace(&mut self.rates, Rates::new(0.0));
        if const { is_single::<T>() } { cast(adam_single(rates)) } else { Box::new(Adam::new(rates, AdamMode::Dense)) }
    }

    /// Σ weight · loss at a step, with the value of each loss.
    ///
    /// Panics if a loss is not a scalar, or a prediction not of the rendered colors' shape.
    pub fn evaluate(&self, step: Step<'_, T, M>) -> Evaluation<T> {
        let mut step = Step { params: &self.params, ..step };
        if let Some(predict) = &self.predict {
            step.prediction = predict(&step);
            assert_eq!(step.prediction.shape(), step.rendered.rgb.shape(), "predicting: one color for each ray");
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

/// Every loss that [`Objective::with_named`] knows: those that no particular model is needed for.
pub const NAMES: [&str; 10] = ["mse", "charbonnier", "huber", "robust", "exposure", "sparsity", "entropy", "beta", "distortion", "opacity"];
