//! Factored fields that the fused kernel computes, and the comparison of their engines.

use autograd::{Module, Param, Tensor, random::Stream};
use glam::{DVec3, dvec3};
use ndarray::ArrayD;
use plenoxel::camera::Ray;
use plenoxel::geometry::Aabb;
use plenoxel::model::tensorf::{Config, Tensorf};
use plenoxel::render::{Engine, Rendered};
use plenoxel::space::{Region, Space};

/// Boxes with the spaces of captures.
pub const NDC: Region =
    Region { space: Space::Ndc { a: 1.7, b: 1.9 }, aabb: Aabb { min: dvec3(-1.5, -1.6, -1.0), max: dvec3(1.5, 1.6, 1.0) } };
pub const CONTRACTED: Region =
    Region { space: Space::Contracted, aabb: Aabb { min: DVec3::splat(-Space::CONTRACTED), max: DVec3::splat(Space::CONTRACTED) } };

/// Rays from around the origin that look along −z and to the sides.
pub fn rays_of_a_capture(count: usize) -> Vec<Ray> {
    let numbers = Stream::new(6).uniform_tensor::<f64>(&[count, 6], -1.0, 1.0);
    let ray =
        |x: &[f64]| Ray { origin: 0.3 * DVec3::from_slice(x), direction: dvec3(0.8 * x[3], 0.8 * x[4], -1.0).normalize(), stretch: 1.0 };
    numbers.data().chunks(6).map(ray).collect()
}

/// A model that the kernel computes, whose density is neither fog nor nothing.
pub fn wide(config: Config, region: Region) -> Tensorf<f64> {
    let config = Config { density_components: 16, appearance_components: 32, ..config };
    let mut model = Tensorf::<f64>::in_region(config, region, 42).expect("valid settings");
    let random = Stream::new(11);
    model.visit_mut(&mut |param: &mut Param<f64>| {
        if param.name().starts_with("density") {
            let values = random.named(param.name()).uniform_tensor(param.shape(), 0.2, 0.75);
            *param = Param::from_tensor(param.name(), values);
        }
    });
    model
}

/// A number that depends on every column.
pub fn all_columns(rendered: &Rendered<f64>) -> Tensor<f64> {
    let random = Stream::new(8);
    let weights = |name: &str, shape: &[usize]| random.named(name).uniform_tensor::<f64>(shape, -1.0, 1.0);
    let mut sum = (&rendered.rgb * weights("rgb", rendered.rgb.shape())).sum();
    let columns = [
        ("depth", rendered.depth()),
        ("opacity", rendered.opacity.clone()),
        ("transmittance", rendered.log_transmittance.clone()),
        ("distortion", rendered.distortion()),
        ("sparsity", rendered.sparsity() * 1e-2),
    ];
    for (name, column) in columns {
        sum = sum + (&column * weights(name, column.shape())).sum();
    }
    sum
}

/// Checks that both engines compute the same pixels, and the same gradients of all parameters and of `inputs`.
pub fn agree(model: &mut Tensorf<f64>, inputs: &[(&str, &Tensor<f64>)], render: impl Fn(&Tensorf<f64>) -> Rendered<f64>) {
    let mut results = Vec::new();
    for engine in [Engine::Graph, Engine::Fused] {
        model.engine = engine;
        let (value, gradients) = autograd::value_and_grad(|| all_columns(&render(model)));
        let of_inputs = inputs.iter().map(|(name, input)| ((*name).to_owned(), gradients.array(input)));
        let mut all: Vec<(String, ArrayD<f64>)> = of_inputs.collect();
        model.visit(&mut |param| all.push((param.name().to_owned(), gradients.array(param.tensor()))));
        results.push((value, all));
    }
    let ((want, graph), (got, fused)) = (&results[0], &results[1]);
    assert!((want - got).abs() < 1e-9 * want.abs(), "{want} {got}");
    for ((name, want), (_, got)) in graph.iter().zip(fused) {
        let scale = want.iter().fold(1e-12f64, |most, x| most.max(x.abs()));
        let off = want.iter().zip(got).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
        assert!(off < 1e-9 * scale, "{name}: {off:e} of {scale:e}");
    }
}
