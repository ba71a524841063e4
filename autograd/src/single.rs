//! Instances in `f32` that a library has compiled, for the crates that use it.
//!
//! Generic code is compiled anew in every crate that names its types, and an optimised renderer takes a minute. So a library may name the instance for
//! `f32` itself, in a function that is not generic, and have its generic function call that one:
//!
//! ```
//! use autograd::single::{cast, cast_ref, is_single};
//! use autograd::{Real, Tensor};
//!
//! pub fn total<T: Real>(x: &Tensor<T>) -> Tensor<T> {
//!     if const { is_single::<T>() } { cast(total_single(cast_ref(x))) } else { total_of(x) }
//! }
//!
//! #[inline(never)]
//! fn total_single(x: &Tensor<f32>) -> Tensor<f32> {
//!     total_of(x)
//! }
//!
//! fn total_of<T: Real>(x: &Tensor<T>) -> Tensor<T> {
//!     x.square().sum()
//! }
//! # assert_eq!(total(&Tensor::scalar(3.0f32)).item(), 9.0);
//! # assert_eq!(total(&Tensor::scalar(3.0f64)).item(), 9.0);
//! ```
//!
//! The condition is a constant, so the other branch is not compiled for `f32`. The same code runs either way, and gives the same bits.

use std::any::Any;

/// True for `f32` among the scalar types.
pub const fn is_single<T>() -> bool {
    size_of::<T>() == size_of::<f32>()
}

/// A value as the type that it has.
///
/// Panics if it has another.
pub fn cast<A: 'static, B: 'static>(value: A) -> B {
    let mut value = Some(value);
    let same = (&mut value as &mut dyn Any).downcast_mut::<Option<B>>();
    same.and_then(Option::take).expect("cast: the value has another type")
}

/// A reference as one to the type that the value has.
///
/// Panics if it has another.
pub fn cast_ref<A: 'static, B: 'static>(value: &A) -> &B {
    (value as &dyn Any).downcast_ref().expect("cast_ref: the value has another type")
}

/// A mutable reference as one to the type that the value has.
///
/// Panics if it has another.
pub fn cast_mut<A: 'static, B: 'static>(value: &mut A) -> &mut B {
    (value as &mut dyn Any).downcast_mut().expect("cast_mut: the value has another type")
}
