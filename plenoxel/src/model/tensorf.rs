//! TensoRF (Chen et al. 2022), the vector-matrix decomposition VM with a small color network: density and appearance are sums of products of planes and lines.
//!
//! With p in [−1, 1]³ the position in the box, and for each axis a the plane of the other two axes (b, c):
//!
//! * density feature s = Σₐ Σᵣ Pₐᵣ(p_b, p_c) Lₐᵣ(pₐ), density σ = 25 softplus(s − 10);
//! * appearance feature f = B · concatₐᵣ(P'ₐᵣ(p_b, p_c) L'ₐᵣ(pₐ));
//! * color = sigmoid(MLP(f, d, sin and cos of 2ᵏ f, sin and cos of 2ᵏ d)), d the unit direction of the ray, k < [`octaves`](Config::octaves).
//!
//! Planes are bilinear and lines linear, with corners aligned: the outermost nodes lie on the faces of the box. Colors are computed only for samples whose weight
//! on their pixel is above [`color_above`](Config::color_above). Everything is a graph of small ops, so that every loss has a gradient with respect to every
//! parameter; there is no fused kernel yet.
//!
//! The numbers of the default are those of the authors' `configs/lego.txt`, `opt.py` and `models/tensoRF.py`, but for the cells that are sampled: here they are found anew at
//! the beginning of every stage but the first, above an opacity of 0.01 of one step; the authors find them at steps 2000 and 4000, above 0.08 without the factor 25, and
//! shrink the box.

use crate::camera::Ray;
use crate::error::{Error, Result};
use crate::geometry::Aabb;
use crate::loss::Step;
use crate::rays::RaySource;
use crate::render::{Field, Radiance, Rendered, composite};
use crate::sampling::{Occupancy, Samples, Spacing, sample};
use crate::tensor_file::{TensorFile, TensorWriter};
use crate::train::{Model, Pass, PlannedStage, StageLength, TrainOptions};
use autograd::nn::{Activation, Init, Linear, Mlp};
use autograd::optim::{Adam, AdamMode, Exponential, Optimizer, Rates};
use autograd::{Indices, Module, Param, Real, Tensor, impl_module, no_grad, random::Stream};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Kind of this model in checkpoints.
pub const KIND: &str = "tensorf";

/// Nodes along each axis, and training steps, of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Stage {
    /// Nodes of a plane along each axis, and of a line.
    pub resolution: usize,
    /// Steps.
    pub steps: u64,
}

/// Settings of the model. The default is the authors' VM-192 for synthetic scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Config {
    /// Half the side of the box around the origin, world length.
    pub half_width: f64,
    /// Components of each of the three plane-line pairs of the density.
    pub density_components: usize,
    /// Components of each of the three plane-line pairs of the appearance.
    pub appearance_components: usize,
    /// Length of the appearance feature.
    pub features: usize,
    /// Width of the two hidden layers of the color network.
    pub hidden: usize,
    /// Octaves of the positional encodings of feature and direction.
    pub octaves: usize,
    /// Distance between samples, in cells.
    pub step: f64,
    /// Least weight of a sample whose color is computed.
    pub color_above: f64,
    /// Least opacity 1 − exp(−σ · step) of a cell that is sampled, once a stage has been trained.
    pub occupied_above: f64,
    /// Learning rate of planes and lines at the beginning of each stage; it falls to a tenth over the run.
    pub factor_rate: f64,
    /// Learning rate of the matrix B and the network; it falls likewise.
    pub network_rate: f64,
    /// Stages, with increasing resolution.
    pub stages: Vec<Stage>,
    /// Seed of the initial parameters.
    pub seed: u64,
}

impl Default for Config {
    fn default() -> Self {
        // From 128 to 300 in five steps of equal ratio.
        let stages = [(128, 2000), (152, 1000), (180, 1000), (213, 1500), (253, 1500), (300, 23_000)];
        Config {
            half_width: 1.5,
            density_components: 16,
            appearance_components: 48,
            features: 27,
            hidden: 128,
            octaves: 2,
            step: 0.5,
            color_above: 1e-4,
            occupied_above: 0.01,
            factor_rate: 0.02,
            network_rate: 1e-3,
            stages: stages.map(|(resolution, steps)| Stage { resolution, steps }).to_vec(),
            seed: 42,
        }
    }
}

impl Config {
    /// Checks the settings.
    ///
    /// Errors name the setting that is invalid.
    pub fn validate(&self) -> Result<()> {
        let check = |valid: bool, key: &str, value: f64, expected: &str| match valid {
            true => Ok(()),
            false => Err(Error::config(key, value, expected)),
        };
        check(self.half_width > 0.0 && self.half_width.is_finite(), "half_width", self.half_width, "a length above 0")?;
        for (key, width) in [
            ("density_components", self.density_components),
            ("appearance_components", self.appearance_components),
            ("features", self.features),
            ("hidden", self.hidden),
        ] {
            check((1..=1024).contains(&width), key, width as f64, "1 to 1024")?;
        }
        check(self.octaves <= 16, "octaves", self.octaves as f64, "0 to 16")?;
        check(self.step > 0.0 && self.step.is_finite(), "step", self.step, "a number of cells above 0")?;
        for (key, share) in [("color_above", self.color_above), ("occupied_above", self.occupied_above)] {
            check((0.0..1.0).contains(&share), key, share, "a number in [0, 1)")?;
        }
        for (key, rate) in [("factor_rate", self.factor_rate), ("network_rate", self.network_rate)] {
            check((0.0..=1.0).contains(&rate), key, rate, "a number in [0, 1]")?;
        }
        if self.stages.is_empty() {
            return Err(Error::usage("stages", "there is no stage", "set at least one"));
        }
        for (i, stage) in self.stages.iter().enumerate() {
            let key = format!("stages[{i}].resolution");
            check((2..=4096).contains(&stage.resolution), &key, stage.resolution as f64, "2 to 4096")?;
            check(stage.steps > 0, &format!("stages[{i}].steps"), 0.0, "at least 1")?;
        }
        Ok(())
    }
}

/// One of the two decompositions: for each axis a plane of the other two axes, `[n², R]` with the later axis fastest, and a line `[n, R]`.
#[derive(Debug)]
struct Factors<T: Real> {
    planes: Vec<Param<T>>,
    lines: Vec<Param<T>>,
}

impl_module!(Factors { planes, lines });

const AXES: [&str; 3] = ["x", "y", "z"];

impl<T: Real> Factors<T> {
    /// Creates factors of 0.1 · N(0, 1).
    fn new(name: &str, resolution: usize, components: usize, random: &Stream) -> Self {
        let param = |kind: &str, axis: &str, rows: usize| {
            let name = format!("{name}.{kind}.{axis}");
            let values = random.named(&name).normal_tensor(&[rows, components], 0.0, 0.1);
            Param::from_tensor(name, values)
        };
        Factors {
            planes: AXES.map(|axis| param("plane", axis, resolution * resolution)).into(),
            lines: AXES.map(|axis| param("line", axis, resolution)).into(),
        }
    }

    /// Returns the number of nodes along each axis.
    fn resolution(&self) -> usize {
        self.lines[0].shape()[0]
    }

    /// Returns the products plane · line of each axis at positions `[m, 3]` in units of cells: three tensors `[m, R]`.
    fn products(&self, cells: &Tensor<T>) -> [Tensor<T>; 3] {
        let n = self.resolution();
        let column = |axis: usize| cells.narrow(1, axis, 1);
        let zero = Tensor::zeros(&[cells.shape()[0], 1]);
        [0, 1, 2].map(|axis| {
            let [b, c] = [[1, 2], [0, 2], [0, 1]][axis];
            let plane = self.planes[axis].tensor().trilinear(&Tensor::concat(&[&column(b), &column(c), &zero], 1), [n, n, 1]);
            let line = self.lines[axis].tensor().trilinear(&Tensor::concat(&[&column(axis), &zero, &zero], 1), [n, 1, 1]);
            plane * line
        })
    }

    /// Resamples planes and lines, with corners aligned.
    fn resample(&mut self, resolution: usize) {
        let n = self.resolution();
        let at = |k: usize| T::lit(k as f64 * (n - 1) as f64 / (resolution - 1) as f64);
        let of_line: Vec<T> = (0..resolution).flat_map(|i| [at(i), T::zero(), T::zero()]).collect();
        let of_plane = (0..resolution * resolution).flat_map(|i| [at(i / resolution), at(i % resolution), T::zero()]).collect();
        let (of_line, of_plane) = (Tensor::from_vec(of_line, &[resolution, 3]), Tensor::from_vec(of_plane, &[resolution * resolution, 3]));
        let resampled = |param: &Param<T>, at: &Tensor<T>, nodes: [usize; 3]| {
            Param::from_tensor(param.name(), no_grad(|| param.tensor().trilinear(at, nodes)))
        };
        self.planes = self.planes.iter().map(|plane| resampled(plane, &of_plane, [n, n, 1])).collect();
        self.lines = self.lines.iter().map(|line| resampled(line, &of_line, [n, 1, 1])).collect();
    }
}

/// The model.
#[derive(Debug)]
pub struct Tensorf<T: Real> {
    config: Config,
    density: Factors<T>,
    appearance: Factors<T>,
    basis: Linear<T>,
    color: Mlp<T>,
    /// Cells that are sampled; all of them until a stage has been trained.
    occupied: Option<Occupancy>,
}

impl<T: Real> Module<T> for Tensorf<T> {
    fn visit(&self, f: &mut dyn FnMut(&Param<T>)) {
        self.density.visit(f);
        self.appearance.visit(f);
        f(&self.basis.weight);
        self.color.visit(f);
    }

    fn visit_mut(&mut self, f: &mut dyn FnMut(&mut Param<T>)) {
        self.density.visit_mut(f);
        self.appearance.visit_mut(f);
        f(&mut self.basis.weight);
        self.color.visit_mut(f);
    }
}

impl<T: Real> Tensorf<T> {
    /// Creates the model at the resolution of the first stage.
    ///
    /// Errors name the setting that is invalid.
    pub fn new(config: Config) -> Result<Self> {
        config.validate()?;
        let (random, n) = (Stream::new(config.seed), config.stages[0].resolution);
        let encoded = (config.features + 3) * (1 + 2 * config.octaves);
        let mut color = Mlp::new("color", &[encoded, config.hidden, config.hidden, 3], Activation::Relu, &random);
        if let Some(last) = color.layers.last_mut() {
            last.initialize(Init::default(), Init::Zeros, &random);
        }
        Ok(Tensorf {
            density: Factors::new("density", n, config.density_components, &random),
            appearance: Factors::new("appearance", n, config.appearance_components, &random),
            // A matrix without bias.
            basis: Linear::new("basis", 3 * config.appearance_components, config.features, &random),
            color,
            occupied: None,
            config,
        })
    }

    /// Returns the settings of the model.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the side of a cell, world length.
    fn cell(&self) -> f64 {
        2.0 * self.config.half_width / (self.density.resolution() - 1) as f64
    }

    /// Returns positions `[m, 3]` in units of cells.
    fn cells(&self, positions: &Tensor<T>) -> Tensor<T> {
        (positions + self.config.half_width) * (1.0 / self.cell())
    }

    /// Returns the colors at positions `[m, 3]`, seen along unit directions `[m, 3]`: `[m, 3]`.
    fn colors(&self, positions: &Tensor<T>, directions: &Tensor<T>) -> Tensor<T> {
        let products = self.appearance.products(&self.cells(positions));
        let features = Tensor::concat(&products.each_ref(), 1).matmul(self.basis.weight.tensor());
        let input = Tensor::concat(&[&features, directions], 1);
        let waves = (0..self.config.octaves).map(|k| &input * f64::from(1 << k)).flat_map(|x| [x.sin(), x.cos()]);
        let encoded: Vec<Tensor<T>> = [input.clone()].into_iter().chain(waves).collect();
        self.color.forward(&Tensor::concat(&encoded.iter().collect::<Vec<_>>(), 1)).sigmoid()
    }

    /// Resamples all factors, if their resolution is another.
    fn resample(&mut self, resolution: usize) {
        if resolution != self.density.resolution() {
            self.density.resample(resolution);
            self.appearance.resample(resolution);
        }
    }

    /// Returns the cells whose opacity, or that of a neighbour, is above [`occupied_above`](Config::occupied_above).
    fn occupied(&self) -> Occupancy {
        // An opacity 1 − exp(−σ · step) above a threshold is a density above another.
        let threshold = -(-self.config.occupied_above).ln_1p() / (self.config.step * self.cell());
        let cells = [(self.density.resolution() - 1).min(MOST_CELLS); 3];
        Occupancy::where_dense(self.aabb(), cells, threshold, |positions| self.density(positions)).dilated(1)
    }
}

/// Most cells of an occupancy along each axis.
const MOST_CELLS: usize = 128;
/// The authors' `density_shift` and `distance_scale`.
const SHIFT: f64 = -10.0;
const SCALE: f64 = 25.0;

impl<T: Real> Field<T> for Tensorf<T> {
    fn density(&self, positions: &Tensor<T>) -> Tensor<T> {
        let [x, y, z] = self.density.products(&self.cells(positions)).map(|product| product.sum_axis(1));
        (x + y + z + SHIFT).softplus() * SCALE
    }

    fn radiance(&self, samples: &Samples<T>) -> Radiance<T> {
        let sigma = self.density(&samples.positions);
        let weights = no_grad(|| {
            let tau = &sigma.detach() * &samples.delta;
            (-tau.segment_exclusive_sum(&samples.offsets)).exp() * tau.one_minus_exp_neg()
        });
        let seen = weights.data().iter().enumerate().filter(|(_, weight)| weight.as_f64() > self.config.color_above);
        let seen = Indices::from(seen.map(|(i, _)| i as u32).collect::<Vec<_>>());
        let directions = samples.directions.segment_repeat(&samples.offsets);
        let rgb = self.colors(&samples.positions.gather_rows(&seen), &directions.gather_rows(&seen));
        Radiance { sigma, rgb: rgb.scatter_rows(&seen, samples.len()) }
    }

    fn reach(&self) -> Option<&Occupancy> {
        self.occupied.as_ref()
    }
}

impl<T: Real> Model<T> for Tensorf<T> {
    fn kind(&self) -> &'static str {
        KIND
    }

    fn aabb(&self) -> Aabb {
        Aabb::cube(self.config.half_width)
    }

    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<T> {
        let spacing = Spacing::Step(self.config.step * self.cell());
        let samples = sample(rays, &self.aabb(), spacing, pass.jitter, self.reach());
        let background = Tensor::from_vec(pass.background.map(|c| T::lit(f64::from(c))).to_vec(), &[3]);
        let radiance = self.radiance(&samples);
        composite(samples, radiance, &background)
    }

    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<T>> {
        let config = &self.config;
        let total: u64 = config.stages.iter().map(|stage| stage.steps).sum();
        // The authors restart the rates at each upsampling, and let them fall to a tenth over as many steps as the whole run has.
        let falling = |rate: f64| Exponential::new(rate, 0.1 * rate, total.max(stage.steps));
        let network = self.color.param_names().into_iter().chain([self.basis.weight.name().to_owned()]);
        let rates = network.fold(Rates::new(falling(config.factor_rate)), |rates, name| rates.with(name, falling(config.network_rate)));
        Box::new(Adam::new(rates, AdamMode::Dense).betas(0.9, 0.99))
    }

    fn stages(&self, _: &TrainOptions, _: u64) -> Vec<StageLength> {
        self.config.stages.iter().map(|stage| StageLength { resolution: Some(stage.resolution), steps: stage.steps }).collect()
    }

    fn begin_stage(&mut self, stage: &PlannedStage, _: &mut RaySource) -> Result<()> {
        if stage.index > 0 {
            let occupied = self.occupied();
            if occupied.fraction() == 0.0 {
                return Err(Error::usage("occupied_above", "no cell is this opaque", "use a smaller opacity"));
            }
            self.occupied = Some(occupied);
        }
        self.resample(self.config.stages[stage.index].resolution);
        Ok(())
    }

    fn settings(&self) -> Value {
        json!(self.config)
    }

    fn write<'a>(&'a self, file: &mut TensorWriter<'a>) {
        file.fact("resolution", self.density.resolution());
        file.fact("cells", self.occupied.as_ref().map(Occupancy::cells));
        if let Some(occupied) = &self.occupied {
            file.words("occupied", occupied.masks());
        }
        self.visit(&mut |param| file.owned(param.name(), param.tensor().detach()));
    }

    fn read(&mut self, file: &mut TensorFile<'_>, _: usize) -> Result<()> {
        let resolution: usize = file.fact("resolution")?;
        if !self.config.stages.iter().any(|stage| stage.resolution == resolution) {
            return Err(file.damaged("the resolution is not one of the stages"));
        }
        let cells: Option<[usize; 3]> = file.fact("cells")?;
        if cells.is_some_and(|cells| cells.iter().any(|n| !(1..=MOST_CELLS).contains(n))) {
            return Err(file.damaged("the number of cells is not one of this model"));
        }
        self.occupied = match cells {
            None => None,
            Some(cells) => {
                let masks = file.brick_masks("occupied", cells)?;
                let masks = masks.ok_or_else(|| file.damaged("the mask `occupied` has cells outside of the box"))?;
                Some(Occupancy::from_masks(self.aabb(), cells, masks))
            }
        };
        self.resample(resolution);
        let mut done = Ok(());
        self.visit_mut(&mut |param| {
            if done.is_ok() {
                done = file.tensor(param.name(), param.shape()).map(|read| param.replace(read));
            }
        });
        done
    }
}

/// Returns the L1 norm of the density factors: Σ over planes and lines of the mean absolute value. The authors' weight is 8e-5 in the first stage and 4e-5 after it.
pub fn density_l1<T: Real>(step: &Step<'_, T, Tensorf<T>>) -> Tensor<T> {
    let mut sum: Option<Tensor<T>> = None;
    step.model.density.visit(&mut |param| {
        let mean = param.tensor().abs().mean();
        sum = Some(sum.take().map_or_else(|| mean.clone(), |sum| sum + &mean));
    });
    sum.unwrap_or_else(|| Tensor::zeros(&[]))
}
