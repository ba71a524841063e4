//! Values, a scalar made of them, and how it changes with each.
//!
//! How does the light that comes through fog depend on the density at each of four places?

use autograd::Tensor;
use ndarray::arr1;

pub fn main() {
    let density = Tensor::variable(arr1(&[0.1, 0.8, 0.3, 0.0]));
    let spacing = 0.5;

    // Transmittance T = e^(−Σ σδ). Ops are methods and operators; what depends on a variable remembers how it was made.
    let transmittance = (-(&density * spacing).sum()).exp();
    let slopes = transmittance.backward().array(&density);

    println!("T = {:.4}, ∂T/∂σ = {slopes:.4}", transmittance.item());
    // ∂T/∂σᵢ = −δ T, the same at each place: in fog it does not matter where the density is.
    let expected = -spacing * transmittance.item();
    assert!(slopes.iter().all(|slope| (slope - expected).abs() < 1e-15));
}
