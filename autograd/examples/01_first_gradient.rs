//! The gradient of a scalar with respect to an array.
//!
//! The example computes how the light that passes through fog depends on the density of each of four samples.

use autograd::Tensor;
use ndarray::arr1;

pub fn main() {
    let density = Tensor::variable(arr1(&[0.1, 0.8, 0.3, 0.0]));
    let spacing = 0.5;

    // Transmittance T = e^(−Σ σδ). Ops are methods and operators. A tensor that depends on a variable records how it was computed.
    let transmittance = (-(&density * spacing).sum()).exp();
    let slopes = transmittance.backward().array(&density);

    println!("T = {:.4}, ∂T/∂σ = {slopes:.4}", transmittance.item());
    // ∂T/∂σᵢ = −δ T is the same for each sample: the position of the density along the ray does not matter.
    let expected = -spacing * transmittance.item();
    assert!(slopes.iter().all(|slope| (slope - expected).abs() < 1e-15));
}
