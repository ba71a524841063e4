//! The ops, by file. Each op has a method of [`crate::Tensor`], a gradient rule next to it, and a row of the table in `tests/gradcheck/rows.rs`.
//!
//! | file | ops | gradient |
//! | --- | --- | --- |
//! | [`arithmetic`] | `+ - * /` with tensors and numbers, `affine`, `maximum`, `minimum` | elementwise; the engine sums over broadcast dimensions |
//! | [`elementwise`] | `exp` `expm1` `one_minus_exp_neg` `ln` `sqrt` `square` `abs` `sigmoid` `softplus` `relu` `leaky_relu` `tanh` `clamp` `sin` `cos` `powi` | elementwise |
//! | [`power`] | `pow` `powf` | elementwise; `pow` also has a gradient with respect to the exponent |
//! | [`reduce`] | `sum` `mean` `max` `min`, over all elements or along an axis; `sum_to` | repeated; extrema divide it equally among ties |
//! | [`normalization`] | `log_sum_exp` `softmax` `norm` `normalize`, along an axis | from the other ops that they are composed of |
//! | [`shape`] | `reshape` `unsqueeze` `broadcast_to` `permute` `transpose` `narrow` `index_axis` `pad` `concat` `stack` | the inverse change of shape |
//! | [`linalg`] | `matmul`, batched | products with the transposes |
//! | [`scan`] | `cumsum` `exclusive_cumsum` | the running sum in the opposite direction |
//! | [`segment`] | `segment_sum` `segment_repeat` `segment_exclusive_sum`, over packed rays | sum and repeat are adjoint; the opposite running sum |
//! | [`lookup`] | `gather_rows` `scatter_rows` | each is the adjoint of the other; the gradient of a gather is row-sparse |
//! | [`trilinear`] | `trilinear` (a kernel), `nearest` | row-sparse in the table; `trilinear` also has a gradient with respect to the positions |
//! | [`select`] | `greater` `greater_equal` `equal` `masked` `where_` | masked; comparisons are constants |

pub mod arithmetic;
pub mod elementwise;
pub mod linalg;
pub mod lookup;
pub mod normalization;
pub mod power;
pub mod reduce;
pub mod scan;
pub mod segment;
pub mod select;
pub mod shape;
pub mod trilinear;
