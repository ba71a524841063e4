//! What a user may choose about the frame of a capture.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Choices about the frame of a capture; by default all follow from the cameras.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct NormalizeOptions {
    /// Space.
    pub space: SpaceChoice,
    /// Orientation, unless the space is NDC.
    pub orient: Orient,
    /// Origin, unless the space is NDC.
    pub center: Center,
    /// Scale, unless the space is NDC.
    pub scale: Scale,
}

impl NormalizeOptions {
    /// Checks that nothing is asked for that NDC does not leave open.
    pub(super) fn check_ndc(&self) -> Result<()> {
        let defaults = NormalizeOptions::default();
        let refused = |key: &str, value: String| {
            let remedy = "leave it out, or use --space contracted";
            Err(Error::usage(key, format!("{value} has no effect in NDC, whose frame is that of the mean camera"), remedy))
        };
        if self.orient != defaults.orient {
            return refused("orient", self.orient.to_string());
        }
        if self.center != defaults.center {
            return refused("center", self.center.to_string());
        }
        if self.scale != defaults.scale {
            return refused("scale", self.scale.to_string());
        }
        Ok(())
    }
}

/// Choice of the [`Space`](crate::space::Space) of a capture.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpaceChoice {
    /// NDC if the cameras face forward, else contracted.
    #[default]
    Auto,
    /// A box of the world.
    Box,
    /// Normalized device coordinates of the mean camera.
    Ndc,
    /// The whole world, contracted.
    Contracted,
}

/// Direction in which the scene is turned.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Orient {
    /// The mean of the cameras' up axes becomes +z, as in nerfstudio.
    #[default]
    Up,
    /// The plane of the camera positions becomes horizontal, as in mip-NeRF 360.
    Pca,
    /// Axes are those of the files.
    None,
}

/// Point that becomes the origin.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Center {
    /// The focus if the cameras look inwards, else the mean position.
    #[default]
    Auto,
    /// The mean position of the cameras.
    Poses,
    /// The point with the smallest sum of distances to all optical axes.
    Focus,
    /// The origin of the files.
    None,
}

/// Scale of the world.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// The farthest camera comes to 1 along an axis.
    #[default]
    Auto,
    /// That of the files.
    None,
    /// World lengths per length of the files, positive.
    #[serde(untagged)]
    Factor(f64),
}

macro_rules! names {
    ($type:ident, $($variant:ident $name:literal),+) => {
        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $($type::$variant => $name),+ })
            }
        }

        impl $type {
            /// All choices, in the usual order.
            pub const ALL: &[$type] = &[$($type::$variant),+];
        }
    };
}

names!(SpaceChoice, Auto "auto", Box "box", Ndc "ndc", Contracted "contracted");
names!(Orient, Up "up", Pca "pca", None "none");
names!(Center, Auto "auto", Poses "poses", Focus "focus", None "none");

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Scale::Auto => f.write_str("auto"),
            Scale::None => f.write_str("none"),
            Scale::Factor(factor) => write!(f, "{factor}"),
        }
    }
}
