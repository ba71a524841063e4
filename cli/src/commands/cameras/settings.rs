//! The settings of COLMAP, as flags and in the record of a folder.

use super::Step;
use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};
use serde::{Deserialize, Serialize};

/// Camera models that COLMAP estimates and training reads, from few to many parameters.
const MODELS: [&str; 9] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
];
/// Most photographs of which all pairs are matched. The time grows with the square of their number.
const MOST_EXHAUSTIVE: usize = 200;

/// Pairs of photographs whose features are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Matcher {
    /// All pairs, for photographs in any order.
    Exhaustive,
    /// Neighbors by name, for frames of a film.
    Sequential,
}

/// Flags of COLMAP.
#[derive(Debug, Args)]
pub struct SettingsFlags {
    /// Camera model with its lens distortion, named as in COLMAP [default: OPENCV; with --camera-per-photo SIMPLE_RADIAL]
    #[arg(long, value_name = "MODEL", help_heading = "COLMAP", value_parser = PossibleValuesParser::new(MODELS))]
    camera_model: Option<String>,

    /// Estimate a camera for each photograph: for several cameras, zooms or crops [default: one camera for all photographs of a size]
    #[arg(long, help_heading = "COLMAP")]
    camera_per_photo: bool,

    /// Match all pairs of photographs, or neighbors by name, as in a film [default: exhaustive for up to 200 photographs, else sequential]
    #[arg(long, value_name = "PAIRS", help_heading = "COLMAP", value_enum)]
    matcher: Option<Matcher>,
}

/// Settings on which the result depends.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    pub camera_model: String,
    pub camera_per_photo: bool,
    pub matcher: Matcher,
}

impl SettingsFlags {
    /// Resolves the flags for a number of photographs.
    ///
    /// All photographs together determine the eight parameters of OPENCV, which fits most lenses. One photograph determines few parameters.
    pub fn resolve(&self, photos: usize) -> Settings {
        let default = if self.camera_per_photo { "SIMPLE_RADIAL" } else { "OPENCV" };
        let matcher = if photos <= MOST_EXHAUSTIVE { Matcher::Exhaustive } else { Matcher::Sequential };
        Settings {
            camera_model: self.camera_model.clone().unwrap_or_else(|| default.to_owned()),
            camera_per_photo: self.camera_per_photo,
            matcher: self.matcher.unwrap_or(matcher),
        }
    }
}

impl Settings {
    /// Returns how earlier settings differ, and the first step that is concerned.
    pub fn difference(&self, earlier: &Settings) -> Option<(String, Step)> {
        if self.camera_model != earlier.camera_model {
            return Some((format!("camera-model was {}, not {}", earlier.camera_model, self.camera_model), Step::Features));
        }
        if self.camera_per_photo != earlier.camera_per_photo {
            let (was, is) = if earlier.camera_per_photo { ("with", "without") } else { ("without", "with") };
            return Some((format!("it was {was} --camera-per-photo, not {is}"), Step::Features));
        }
        let name = |matcher: Matcher| format!("{matcher:?}").to_lowercase();
        let difference = format!("matcher was {}, not {}", name(earlier.matcher), name(self.matcher));
        (self.matcher != earlier.matcher).then_some((difference, Step::Matching))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use plenoxel::camera::lens::colmap::MODELS as ALL;

    #[test]
    fn every_offered_camera_model_is_one_of_colmap() {
        MODELS.iter().for_each(|name| assert!(ALL.iter().any(|model| model.name == *name), "{name}"));
    }

    #[test]
    fn defaults_follow_from_the_number_of_photographs_and_cameras() {
        let flags = |camera_per_photo| SettingsFlags { camera_model: None, camera_per_photo, matcher: None };
        let (few, many) = (flags(false).resolve(200), flags(true).resolve(201));
        assert_eq!((few.camera_model.as_str(), few.matcher), ("OPENCV", Matcher::Exhaustive));
        assert_eq!((many.camera_model.as_str(), many.matcher), ("SIMPLE_RADIAL", Matcher::Sequential));
        let (how, step) = many.difference(&Settings { matcher: Matcher::Exhaustive, ..many.clone() }).expect("another matcher");
        assert_eq!((how.as_str(), step), ("matcher was exhaustive, not sequential", Step::Matching));
        assert_eq!(few.difference(&many).map(|(_, step)| step), Some(Step::Features));
        assert_eq!(few.difference(&few), None);
    }
}
