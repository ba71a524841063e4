//! Frame of a capture: the similarity from the frame of its files to the world in which a field is trained, and the [`Space`].
//!
//! Structure from motion finds cameras up to a similarity, and every program that writes them turns, moves and scales them in its own way.
//! Training needs a known up, centre and size. All choices follow from the cameras alone, in an order that a similarity of the input does
//! not change: two files of the same reconstruction give the same world.
//!
//! - **NDC** for cameras that look in one direction: the frame of the mean camera (LLFF), with the near plane at depth 1/0.75.
//! - **Contracted** for all others: +z is up, and the middle of the scene is the origin. All cameras are in [-2, 2]³ if they look inwards, so that what
//!   they look at fills the part of space that is not contracted; else in [-1, 1]³.

mod choice;
mod frame;

pub use choice::{CaptureOptions, Center, FormatChoice, Orient, Scale, SpaceChoice};

use super::OpenOptions;
use super::capture::Point;
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::geometry::Similarity;
use crate::space::Space;
use frame::Frame;
use glam::DVec3;
use std::path::Path;

/// Depth of the nearest surface in the world of a capture in NDC, whose near plane is at depth 1.
pub const NEAREST_DEPTH: f64 = 1.0 / NEAR;

/// Returns the point that cameras look at from around it; `None` if they do not look inwards.
pub fn looked_at(cameras: &[Camera]) -> Option<DVec3> {
    let frame = Frame::new(cameras);
    if frame.spread > 0.0 { frame.looked_at(cameras) } else { None }
}

/// Share of the nearest depth that LLFF leaves in front of the scene.
const NEAR: f64 = 0.75;
/// Largest angle between an optical axis and the mean one in a forward-facing capture, degrees.
const FORWARD_FACING: f64 = 35.0;
/// Coordinate of the farthest camera in the contracted space, if cameras look inwards. bonsai, training rays after 2.5 M rays: 22.83 dB for 1, 22.98 dB
/// for 2, 22.70 dB for 4.
const INWARD_REACH: f64 = 2.0;
/// Quantile of the depths of points that is taken as the nearest depth.
const NEAREST: f64 = 0.01;

/// Similarity and space of a dataset, with the reasons.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Normalization {
    /// Space that fits the cameras.
    pub space: Space,
    /// From the frame of the files to the world.
    pub to_world: Similarity,
    reasons: Vec<(&'static str, String)>,
}

impl Normalization {
    /// Returns the identity, for datasets whose coordinates are the world's.
    ///
    /// Errors if `options` ask for anything else; `reason` says why nothing else is possible.
    pub(super) fn none(options: &OpenOptions, reason: &str) -> Result<Self> {
        let CaptureOptions { space, orient, center, scale, .. } = options.capture;
        let refused = |key: &str, value: &str| {
            let found = format!("{value} is for captures, and {reason}, whose coordinates are used as they are");
            Err(Error::usage(key, found, "leave it out"))
        };
        if !matches!(space, SpaceChoice::Auto | SpaceChoice::Box) {
            return refused("space", &space.to_string());
        }
        let defaults = CaptureOptions::default();
        if orient != defaults.orient && orient != Orient::None {
            return refused("orient", &orient.to_string());
        }
        if center != defaults.center && center != Center::None {
            return refused("center", &center.to_string());
        }
        if scale != defaults.scale && scale != Scale::None {
            return refused("scale", &scale.to_string());
        }
        Ok(Normalization::default())
    }

    /// Chooses similarity and space for the cameras of a capture in the folder `root`, sorted by name.
    ///
    /// Errors if all cameras are at one point; if `options` ask for NDC and no near plane is known, or together with another frame.
    pub(super) fn of(root: &Path, cameras: &[Camera], points: &[Point], bounds: Option<[f64; 2]>, options: &OpenOptions) -> Result<Self> {
        let frame = Frame::new(cameras);
        if frame.spread <= 1e-9 * frame.mean.abs().max_element() || frame.spread == 0.0 {
            let found = format!("all {} cameras are at one point: no depth can be learned", cameras.len());
            return Err(Error::input(root, found, "take pictures from several places"));
        }
        let choice = options.capture;
        let near = || frame.near(cameras, points, bounds);
        match choice.space {
            SpaceChoice::Ndc => {
                let remedy = "use --space contracted, or give poses_bounds.npy or the points of COLMAP";
                let (near, source) = near().ok_or_else(|| Error::usage("space", "ndc needs the depth of the nearest surface", remedy))?;
                frame.behind(near).map_or(Ok(()), |found| Err(Error::usage("space", found, "use --space contracted")))?;
                Self::ndc(&frame, cameras, near, source, "asked for".into(), &choice)
            }
            SpaceChoice::Auto => match (frame.widest_angle <= FORWARD_FACING).then(near) {
                Some(Some((near, source))) if frame.behind(near).is_none() => {
                    let why = format!("all cameras look within {:.0}° of one direction, before the scene", frame.widest_angle);
                    Self::ndc(&frame, cameras, near, source, why, &choice)
                }
                Some(None) => {
                    Ok(Self::centred(Space::Contracted, "cameras face forward, but no depth is known".into(), &frame, cameras, &choice))
                }
                Some(_) => Ok(Self::centred(Space::Contracted, "cameras are among what they see".into(), &frame, cameras, &choice)),
                None => {
                    let why = format!("cameras look up to {:.0}° away from their mean direction", frame.widest_angle);
                    Ok(Self::centred(Space::Contracted, why, &frame, cameras, &choice))
                }
            },
            SpaceChoice::Box => Ok(Self::centred(Space::Box, "asked for".into(), &frame, cameras, &choice)),
            SpaceChoice::Contracted => Ok(Self::centred(Space::Contracted, "asked for".into(), &frame, cameras, &choice)),
        }
    }

    fn ndc(frame: &Frame, cameras: &[Camera], near: f64, source: &str, why: String, choice: &CaptureOptions) -> Result<Self> {
        choice.check_ndc()?;
        let rotation = frame.mean_axes().transpose();
        let scale = 1.0 / (NEAR * near);
        let n = cameras.len() as f64;
        let a = cameras.iter().map(|c| 2.0 * c.intrinsics.fx / c.intrinsics.width as f64).sum::<f64>() / n;
        let b = cameras.iter().map(|c| 2.0 * c.intrinsics.fy / c.intrinsics.height as f64).sum::<f64>() / n;
        Ok(Normalization {
            space: Space::Ndc { a, b },
            to_world: Similarity::about(frame.mean, rotation, scale),
            reasons: vec![
                ("space", format!("ndc: {why}; a {a:.3}, b {b:.3}")),
                ("orientation", "that of the mean camera, which looks along -z".into()),
                ("center", "the mean position of the cameras".into()),
                ("scale", format!("{scale:.6}: the nearest depth of {near:.4} ({source}) becomes {:.3}", 1.0 / NEAR)),
            ],
        })
    }

    fn centred(space: Space, why: String, frame: &Frame, cameras: &[Camera], choice: &CaptureOptions) -> Self {
        let (rotation, orientation) = frame.orientation(cameras, choice.orient);
        let looked_at = frame.looked_at(cameras);
        let (center, centered) = frame.center(cameras, choice.center, looked_at);
        let farthest = cameras.iter().map(|c| (rotation * (c.position() - center)).abs().max_element()).fold(0.0, f64::max);
        let (scale, scaled) = match choice.scale {
            Scale::Auto if space == Space::Contracted && looked_at.is_some() => {
                let scaled = format!("the farthest camera comes to {INWARD_REACH} along an axis, for the cameras look inwards");
                (INWARD_REACH / farthest, scaled)
            }
            Scale::Auto => (1.0 / farthest, "the farthest camera comes to 1 along an axis".to_owned()),
            Scale::None => (1.0, "that of the files".to_owned()),
            Scale::Factor(factor) => (factor, "asked for".to_owned()),
        };
        let name = if space == Space::Box { "box" } else { "contracted" };
        Normalization {
            space,
            to_world: Similarity::about(center, rotation, scale),
            reasons: vec![
                ("space", format!("{name}: {why}")),
                ("orientation", orientation),
                ("center", format!("{centered}, in the files at {}", place(center))),
                ("scale", format!("{scale:.6}: {scaled}")),
            ],
        }
    }

    /// Returns what was chosen and why, as names and sentences; empty if nothing was.
    pub fn describe(&self) -> &[(&'static str, String)] {
        &self.reasons
    }
}

fn place(p: DVec3) -> String {
    format!("({:.4}, {:.4}, {:.4})", p.x, p.y, p.z)
}
