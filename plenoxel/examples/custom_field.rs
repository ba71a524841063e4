//! A custom field: an encoded MLP that is trained, saved, resumed and evaluated. `cargo run --release -p plenoxel --example custom_field`
use autograd::nn::{Activation, Mlp};
use autograd::optim::{Adam, AdamMode, Exponential, Optimizer};
use autograd::{Real, Tensor, impl_module, random::Stream};
use plenoxel::dataset::{Dataset, Split, procedural::ProceduralOptions};
use plenoxel::evaluate::evaluate;
use plenoxel::loss::{Objective, mse};
use plenoxel::render::{Radiance, Rendered, composite};
use plenoxel::sampling::{Spacing, sample};
use plenoxel::train::{Model, Pass, PlannedStage, TrainOptions, Trainer, ViewOptions};
use plenoxel::{camera::Ray, error::Result, geometry::Aabb};

struct Field<T: Real> {
    net: Mlp<T>,
}
impl_module!(Field { net });

impl Model<f32> for Field<f32> {
    fn kind(&self) -> &'static str {
        "encoded mlp"
    }
    fn aabb(&self) -> Aabb {
        Aabb::cube(1.4)
    }
    fn render(&self, rays: &[Ray], pass: &Pass) -> Rendered<f32> {
        let samples = sample::<f32>(rays, &self.aabb(), Spacing::Step(0.08), pass.jitter, None);
        let octaves = (0..5).map(|k| &samples.positions * f64::from(1 << k)).flat_map(|x| [x.sin(), x.cos()]);
        let encoded: Vec<Tensor<f32>> = octaves.collect();
        let out = self.net.forward(&Tensor::concat(&encoded.iter().collect::<Vec<_>>(), 1));
        let radiance = Radiance { sigma: out.index_axis(1, 0).softplus(), rgb: out.narrow(1, 1, 3).sigmoid() };
        composite(samples, radiance, &Tensor::from_vec(pass.background.to_vec(), &[3]))
    }
    fn optimizer(&self, stage: &PlannedStage) -> Box<dyn Optimizer<f32>> {
        Box::new(Adam::new(Exponential::new(5e-3, 5e-4, stage.steps), AdamMode::Dense))
    }
}

/// Trains for `steps` steps, and again from a file saved halfway. Returns the mean PSNR of the test views in dB.
pub fn run(steps: u64) -> Result<f64> {
    let scene = Dataset::procedural(ProceduralOptions { width: 50, height: 50, train: 40, val: 0, test: 8, supersample: 2 })?;
    let views = scene.load(Split::Train, &|_, _| {})?;
    let options = TrainOptions { rays_per_step: 512, steps, ..TrainOptions::default() };
    let start = || {
        let net = Mlp::new("net", &[30, 64, 64, 64, 4], Activation::Relu, &Stream::new(7));
        Trainer::with_model(Field { net }, &views[..], Objective::new().with("mse", 1.0, mse), options.clone())
    };
    let mut whole = start()?;
    (0..steps / 2).try_for_each(|_| whole.step().map(drop))?;
    let file = std::env::temp_dir().join(format!("custom-field-{}.safetensors", std::process::id()));
    whole.save(&file, scene.name())?;
    let mut resumed = start()?.resumed(&file)?;
    while let Some(report) = whole.step()? {
        assert_eq!(resumed.step()?.as_ref(), Some(&report), "a resumed run has the same bits");
    }
    Ok(evaluate(resumed.model(), &scene.load(Split::Test, &|_, _| {})?, &ViewOptions::over([1.0; 3])).psnr().unwrap_or(0.0))
}

fn main() -> Result<()> {
    run(1000).map(|psnr| println!("{psnr:.2} dB on test views"))
}
