//! Settings of the frame of a capture.

use crate::error::{Error, Result};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// Choices about a capture: its format, its frame, which follows from the cameras by default, and its test views. The table `capture` of a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureOptions {
    /// Format of the files.
    pub format: FormatChoice,
    /// Space.
    pub space: SpaceChoice,
    /// Orientation, unless the space is NDC.
    pub orient: Orient,
    /// Origin, unless the space is NDC.
    pub center: Center,
    /// Scale, unless the space is NDC.
    pub scale: Scale,
    /// Interval of the test views, if the files have no splits: views whose number by sorted name is a multiple of it. 0 for none. 8 as in
    /// LLFF and mip-NeRF 360.
    pub test_every: usize,
}

impl Default for CaptureOptions {
    fn default() -> Self {
        CaptureOptions {
            format: FormatChoice::default(),
            space: SpaceChoice::default(),
            orient: Orient::default(),
            center: Center::default(),
            scale: Scale::default(),
            test_every: 8,
        }
    }
}

impl CaptureOptions {
    /// Checks every value. An error names the key.
    pub fn validate(&self) -> Result<()> {
        if self.test_every == 1 {
            return Err(Error::config("test_every", 1, "2 or more, or 0 for none"));
        }
        match self.scale {
            Scale::Factor(factor) if !(1e-12..=1e12).contains(&factor) => {
                Err(Error::config("scale", factor, "auto, none or a number from 1e-12 to 1e12"))
            }
            _ => Ok(()),
        }
    }

    /// Checks that nothing is asked for that NDC does not leave open.
    pub(super) fn check_ndc(&self) -> Result<()> {
        let defaults = CaptureOptions::default();
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

/// Format in which the folder of a capture is read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FormatChoice {
    /// The first that the folder has, in the order of [`open`](crate::dataset::open).
    #[default]
    Auto,
    /// `transforms.json` of instant-ngp or nerfstudio.
    Transforms,
    /// A reconstruction of COLMAP.
    Colmap,
    /// `poses_bounds.npy` of LLFF.
    Llff,
    /// `intrinsics.txt` and poses of NSVF.
    Nsvf,
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

/// Scale of the world: `"auto"`, `"none"` or a number.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Scale {
    /// The farthest camera comes to 1 along an axis; in the contracted space to 2, if the cameras look inwards.
    #[default]
    Auto,
    /// World lengths are those of the files.
    None,
    /// World lengths per length of the files, positive.
    Factor(f64),
}

impl std::str::FromStr for Scale {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "auto" => Ok(Scale::Auto),
            "none" => Ok(Scale::None),
            number => match number.parse() {
                Ok(factor) => Ok(Scale::Factor(factor)),
                Err(_) => Err(Error::config("scale", format!("\"{text}\""), "auto, none or a number")),
            },
        }
    }
}

impl Serialize for Scale {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        match self {
            Scale::Factor(factor) => serializer.serialize_f64(*factor),
            named => serializer.collect_str(named),
        }
    }
}

impl<'de> Deserialize<'de> for Scale {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Name(String),
        }
        let refused = || serde::de::Error::custom("not a scale, expected auto, none or a number");
        match Written::deserialize(deserializer).map_err(|_: D::Error| refused())? {
            Written::Number(factor) => Ok(Scale::Factor(factor)),
            Written::Name(name) if name == "auto" => Ok(Scale::Auto),
            Written::Name(name) if name == "none" => Ok(Scale::None),
            Written::Name(_) => Err(refused()),
        }
    }
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

names!(FormatChoice, Auto "auto", Transforms "transforms", Colmap "colmap", Llff "llff", Nsvf "nsvf");
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
