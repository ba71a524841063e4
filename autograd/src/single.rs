//! Precompiled `f32` instances of generic functions.
//!
//! Generic code is compiled again in every crate that instantiates it, which takes a minute for an optimised renderer. A library can avoid this for
//! `f32`: it instantiates the code in a function that is not generic, and its generic function calls that one:
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
//! The condition is a constant, so the second branch is not compiled for `f32`. Both branches run the same code and give the same bits.

use std::any::Any;

/// Returns true if the scalar type `T` is `f32`. `T` must be `f32` or `f64`: only the size is compared.
pub const fn is_single<T>() -> bool {
    size_of::<T>() == size_of::<f32>()
}

/// Returns `value` as type `B`, which must be its own type `A`. Generic code uses this where the compiler cannot see that the types are equal.
///
/// Panics if `A` and `B` are different types.
pub fn cast<A: 'static, B: 'static>(value: A) -> B {
    let mut value = Some(value);
    let same = (&mut value as &mut dyn Any).downcast_mut::<Option<B>>();
    same.and_then(Option::take).expect("cast: the types are different")
}

/// Returns `value` as a reference to type `B`, which must be its own type `A`.
///
/// Panics if `A` and `B` are different types.
pub fn cast_ref<A: 'static, B: 'static>(value: &A) -> &B {
    (value as &dyn Any).downcast_ref().expect("cast_ref: the value has another type")
}

/// Returns `value` as a mutable reference to type `B`, which must be its own type `A`.
///
/// Panics if `A` and `B` are different types.
pub fn cast_mut<A: 'static, B: 'static>(value: &mut A) -> &mut B {
    (value as &mut dyn Any).downcast_mut().expect("cast_mut: the value has another type")
}
