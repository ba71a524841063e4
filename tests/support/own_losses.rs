//! Losses of one's own, exposure of the views and a parameter of a loss, for any model.

use autograd::{Module, Param};
use ndarray::arr1;
use plenoxel::dataset::View;
use plenoxel::loss::{Objective, distortion};
use plenoxel::train::{Model, TrainOptions, Trainer};

/// Trains a model with its losses and with others, and returns the names of all. Every parameter of the losses must be trained.
pub fn train<M: Model<f32> + 'static>(model: M, losses: Objective<f32, M>, views: &[View]) -> Vec<String> {
    let objective = losses
        .with_exposure(1e-3, views.len())
        .with("distortion", 1e-3, distortion)
        .with_samples("thin", 1e-6, |_, samples| samples.radiance.sigma.mean())
        .with_param(Param::new("gain", arr1(&[1.0f32])), 1e-2)
        .predicting(|step| &step.prediction * step.param("gain"));
    let mut trainer = Trainer::with_model(model, views, objective, TrainOptions::default()).expect("a trainer");
    let mut names = Vec::new();
    while let Some(report) = trainer.step().expect("a step") {
        names = report.losses.iter().map(|(name, _)| name.to_string()).collect();
    }
    trainer.objective().visit(&mut |param| {
        let values = param.tensor().data();
        assert!(values.iter().any(|&x| x != 0.0 && x != 1.0), "{} was not trained", param.name());
    });
    names
}
