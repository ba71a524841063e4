//! Neural network layers: [`Linear`] and [`Mlp`], and the initialization of their parameters ([`Init`]).
//!
//! A layer is a [`Module`](crate::Module): an optimizer updates its parameters, and [`save_safetensors`](crate::save_safetensors) writes them.
//!
//! ```
//! use autograd::nn::{Activation, Mlp};
//! use autograd::optim::{Adam, AdamMode, Exponential, Optimizer};
//! use autograd::{Tensor, random::Stream, value_and_grad};
//!
//! let random = Stream::new(7);
//! let x: Tensor<f32> = random.named("points").uniform_tensor(&[256, 2], -1.0, 1.0);
//! let distance = x.norm(1).unsqueeze(1);
//!
//! let mut net = Mlp::new("distance", &[2, 32, 32, 1], Activation::Relu, &random);
//! let mut adam = Adam::new(Exponential::new(0.01, 0.001, 200), AdamMode::Dense);
//! let mut loss = 0.0;
//! for step in 0..200 {
//!     let (value, gradients) = value_and_grad(|| (net.forward(&x) - &distance).square().mean());
//!     adam.step(&mut net, &gradients, step);
//!     loss = value;
//! }
//! assert!(loss < 0.002);
//! ```

mod init;
mod linear;
mod mlp;

pub use init::Init;
pub use linear::Linear;
pub use mlp::{Activation, Mlp};
