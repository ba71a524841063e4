//! Spaces: how positions in the world become positions in the box of a field.
//!
//! A field is a function on a box. The world may be larger than any box: a room seen from inside has walls, windows and sky. A [`Space`]
//! maps the world, or the part of it that cameras see, to a box.

use serde::{Deserialize, Serialize};

/// Map from the world to the box of a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Space {
    /// The identity: the box is a box of the world, and nothing outside of it is seen.
    #[default]
    Box,
    /// Normalized device coordinates of a reference camera at the origin that looks along −z, for forward-facing captures (Mildenhall et
    /// al. 2020, appendix C): (x, y, z) becomes (−a x / z, −b y / z, 1 + 2 / z) for z ≤ −1, with −1 the near plane.
    Ndc {
        /// a = 2 fx / width of the reference camera.
        a: f64,
        /// b = 2 fy / height of the reference camera.
        b: f64,
    },
    /// The contraction of mip-NeRF 360 (Barron et al. 2022) in its infinity-norm form: with m = max |xᵢ|, x for m ≤ 1 and
    /// (2 − 1 / m) x / m beyond. The whole world becomes the box [−2, 2]³.
    Contracted,
}
