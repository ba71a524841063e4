//! Every op, by file. Each is a function on [`crate::Tensor`], a rule beside it, and a row of the table in `tests/gradcheck/rows.rs`.
//!
//! | file | ops | gradient of the inputs |
//! | --- | --- | --- |
//! | [`arithmetic`] | `+ - * /` with tensors and numbers, `affine`, `maximum`, `minimum` | the textbook's; broadcasting is undone by the engine |
//! | [`elementwise`] | `exp` `expm1` `one_minus_exp_neg` `ln` `sqrt` `square` `abs` `sigmoid` `softplus` `relu` `leaky_relu` `tanh` `clamp` `sin` `cos` `powi` | elementwise |
//! | [`power`] | `pow` `powf` | elementwise; `pow`'s also in the exponent |
//! | [`reduce`] | `sum` `mean` `max` `min`, over all or along an axis; `sum_to` | repeated; extrema share it among equals |
//! | [`normalization`] | `log_sum_exp` `softmax` `norm` `normalize`, along an axis | compositions of the other ops |
//! | [`shape`] | `reshape` `unsqueeze` `broadcast_to` `permute` `transpose` `narrow` `index_axis` `pad` `concat` `stack` | moved back |
//! | [`linalg`] | `matmul`, batched | products with the transposes |
//! | [`scan`] | `cumsum` `exclusive_cumsum` | the running sum from the other end |
//! | [`segment`] | `segment_sum` `segment_repeat` `segment_exclusive_sum` over packed rays | each other, and the sum from the other end |
//! | [`lookup`] | `gather_rows` `scatter_rows` | each other; a gather's is row-sparse |
//! | [`trilinear`] | `trilinear` (a kernel), `nearest` | row-sparse in the table; slopes in the positions |
//! | [`select`] | `greater` `greater_equal` `equal` `masked` `where_` | masked |

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
