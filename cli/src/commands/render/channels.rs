//! Channels of rendered pictures and their file formats.

use super::float_files;
use crate::images::{self, Channel, DepthRange};
use clap::ValueEnum;
use ndarray::{Array2, Array3, Axis};
use plenoxel::camera::Camera;
use plenoxel::error::Result;
use plenoxel::evaluate::Viewer;
use plenoxel::files::write_atomically;
use plenoxel::model::Model;
use plenoxel::model::plenoxels::Plenoxels;
use plenoxel::render::picture::Picture;
use plenoxel::space::Space;
use plenoxel::train::ViewOptions;
use std::path::{Path, PathBuf};

/// File format of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FileFormat {
    /// 8-bit, for display.
    Png,
    /// 32-bit floats, for compositing programs.
    Exr,
    /// 32-bit floats, for NumPy.
    Npy,
}

/// A writer for the pictures of a run.
pub struct Pictures<'a> {
    color: Viewer<'a, f32>,
    normals: Option<Viewer<'a, f32>>,
    half_width: f64,
    space: Space,
    /// Units of the dataset in a world length.
    unit: f64,
    channels: &'a [Channel],
    formats: &'a [FileFormat],
}

impl<'a> Pictures<'a> {
    /// Creates a writer for a model. `normals` is required if it is among the channels. `unit` is the number of units of the dataset in a world length.
    pub fn new(
        model: &'a dyn Model<f32>,
        normals: Option<&'a Plenoxels<f32>>,
        view: &ViewOptions,
        unit: f64,
        channels: &'a [Channel],
        formats: &'a [FileFormat],
    ) -> Self {
        let of_normals = ViewOptions { background: [0.0; 3], ..view.clone() };
        let aabb = model.aabb();
        Pictures {
            color: Viewer::of(model, view),
            normals: normals.map(|normals| Viewer::of(normals, &of_normals)),
            half_width: 0.5 * (aabb.max - aabb.min).max_element(),
            space: model.space(),
            unit,
            channels,
            formats,
        }
    }

    /// Renders a camera to files whose names begin with `stem`.
    pub fn write(&self, camera: &Camera, stem: &Path) -> Result<()> {
        let normals = self.normals.as_ref().map(|viewer| viewer.see(camera));
        // Depth and opacity are the same in both.
        let color = (self.channels != [Channel::Normal]).then(|| self.color.see(camera));
        let range = DepthRange::of(camera, self.half_width);
        for &channel in self.channels {
            let picture = if channel == Channel::Normal { &normals } else { &color };
            let Some(picture) = picture else { continue };
            for &format in self.formats {
                let file = |ending: &str| file(stem, channel, ending);
                match format {
                    FileFormat::Png => images::write(&file("png"), &images::shown(channel, picture, range))?,
                    FileFormat::Exr => {
                        let values =
                            if channel == Channel::Color { picture.rgb.mapv(linear) } else { self.values(channel, picture, camera) };
                        float_files::write_exr(&file("exr"), values.view())?;
                    }
                    FileFormat::Npy => write_atomically(&file("npy"), &float_files::npy(self.values(channel, picture, camera).view()))?,
                }
            }
        }
        Ok(())
    }

    /// The values of a channel, `[h, w, 1 or 3]`.
    fn values(&self, channel: Channel, picture: &Picture, camera: &Camera) -> Array3<f32> {
        let one = |values: Array2<f32>| values.insert_axis(Axis(2));
        match channel {
            Channel::Color => picture.rgb.clone(),
            Channel::Depth => one(picture.distances(camera, self.space) * self.unit as f32),
            Channel::Normal => images::unit_normals(picture),
            Channel::Opacity => one(picture.opacity.clone()),
        }
    }
}

/// `<stem><suffix>.<ending>`; a stem may have dots of its own.
fn file(stem: &Path, channel: Channel, ending: &str) -> PathBuf {
    let mut path = stem.as_os_str().to_owned();
    path.push(format!("{}.{ending}", channel.suffix()));
    path.into()
}

/// Linear light of an sRGB value (IEC 61966-2-1), odd around 0.
fn linear(value: f32) -> f32 {
    let size = value.abs();
    let linear = if size <= 0.040_45 { size / 12.92 } else { ((size + 0.055) / 1.055).powf(2.4) };
    linear.copysign(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_becomes_linear_light() {
        assert_eq!((linear(0.0), linear(1.0), linear(-1.0)), (0.0, 1.0, -1.0));
        // The middle gray of a screen, 0.735, has half of its light.
        assert!((linear(0.735_357) - 0.5).abs() < 1e-5 && (linear(0.04) - 0.04 / 12.92).abs() < 1e-9);
    }

    #[test]
    fn names_keep_the_dots_of_views() {
        assert_eq!(file(Path::new("a/test_000_img.1"), Channel::Depth, "exr"), PathBuf::from("a/test_000_img.1_depth.exr"));
    }
}
