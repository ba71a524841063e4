//! Photographs in memory: those of a program that has arrays and no folder.

use super::blender::rigid;
use super::capture::{FARTHEST, splits};
use super::image::{self, RgbaImage};
use super::mask::Mask;
use super::normalize::Normalization;
use super::{Dataset, Frame, OpenOptions, Source, Split, View, largest};
use crate::camera::Camera;
use crate::error::{Error, Result};
use glam::DMat4;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A photograph with its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Photograph {
    /// Name, which no other photograph has.
    pub name: String,
    /// Image, 8-bit sRGB with straight alpha.
    pub image: RgbaImage,
    /// Pixels to use; `None` for all.
    pub mask: Option<Mask>,
    /// Camera. Its intrinsics have the size of the image.
    pub camera: Camera,
    /// Split; `None` if `test_every` of [`CaptureOptions`](super::normalize::CaptureOptions) chooses it. If one photograph has a split, those without belong to
    /// the training.
    pub split: Option<Split>,
}

/// Photographs of a scene, in the order of their views.
#[derive(Debug, Clone, PartialEq)]
pub struct Photographs {
    /// Name of the scene.
    pub scene: String,
    /// The photographs.
    pub views: Vec<Photograph>,
    /// True if the cameras are to be turned, moved and scaled like those of a capture ([`normalize`](super::normalize)). False if their coordinates are the
    /// world's, like those of a NeRF-synthetic folder.
    pub normalize: bool,
}

impl Photographs {
    /// Makes a dataset of the photographs, which stay shared with it.
    ///
    /// Errors if there is no training view, if two photographs have one name, if a camera or a mask is invalid or has another size than its image, or if `options`
    /// do not fit.
    pub fn open(self: &Arc<Self>, options: &OpenOptions) -> Result<Dataset> {
        let mut names = BTreeSet::new();
        for view in &self.views {
            view.check()?;
            if !names.insert(&view.name) {
                return Err(Error::usage("names", format!("two views have the name {}", view.name), "name each view differently"));
            }
        }
        let downscale = options.downscale;
        if let Some(view) = self.views.iter().find(|view| downscale > view.image.width().min(view.image.height()) as usize) {
            let found = format!("{downscale} is more than the {} x {} pixels of {}", view.image.width(), view.image.height(), view.name);
            return Err(Error::usage("downscale", found, "use a smaller factor"));
        }
        let cameras: Vec<Camera> = self.views.iter().map(|view| view.camera).collect();
        let normalization = match self.normalize {
            true => Normalization::of(Path::new(&self.scene), &cameras, &[], None, options)?,
            false => Normalization::none(options, "these are arrays")?,
        };
        let mut frames: [Vec<Frame>; 3] = Default::default();
        let stated: Vec<_> = self.views.iter().map(|view| view.split).collect();
        for (view, split) in self.views.iter().zip(splits(&stated, options)) {
            let Camera { intrinsics, camera_to_world } = view.camera;
            let full = (intrinsics.width, intrinsics.height);
            let camera =
                Camera { intrinsics: intrinsics.downscaled(downscale), camera_to_world: normalization.to_world.camera(camera_to_world) };
            let (path, orientation) = (PathBuf::new(), image::Orientation::Stored);
            frames[split as usize].push(Frame { name: view.name.clone(), camera, path, mask: None, orientation, full });
        }
        if frames[0].is_empty() {
            return Err(Error::usage("images", "there is no training view", "give at least one view for training"));
        }
        Ok(Dataset {
            name: self.scene.clone(),
            format: "arrays",
            size: largest(&frames),
            frames,
            source: Source::Memory { photographs: self.clone(), downscale },
            normalization,
            points: Arc::default(),
            notes: Vec::new(),
        })
    }

    /// Returns the view of a name with the camera of its frame, its image reduced by `downscale`.
    pub(super) fn view(&self, name: &str, camera: Camera, downscale: usize) -> Option<View> {
        let photograph = self.views.iter().find(|view| view.name == name)?;
        let image = match downscale {
            1 => photograph.image.clone(),
            k => image::downscale(&image::cropped(photograph.image.clone(), k), k),
        };
        let mask = photograph.mask.as_ref().map(|mask| if downscale == 1 { mask.clone() } else { mask.reduced(downscale) });
        Some(View { name: name.to_owned(), camera, image, depth: None, mask })
    }
}

impl Photograph {
    /// Errors if the camera or the mask is invalid, or has another size than the image.
    fn check(&self) -> Result<()> {
        let (name, k) = (&self.name, &self.camera.intrinsics);
        let size = [self.image.width() as usize, self.image.height() as usize];
        if [k.width, k.height] != size {
            let found = format!("the image of {name} has {} x {} pixels, but its camera {} x {}", size[0], size[1], k.width, k.height);
            return Err(Error::usage("images", found, "give intrinsics of the size of the images"));
        }
        if size.iter().any(|side| !(1..=image::MAX_SIDE as usize).contains(side)) {
            let found = format!("the image of {name} has {} x {} pixels", size[0], size[1]);
            return Err(Error::usage("images", found, format!("give images of 1 to {} pixels per side", image::MAX_SIDE)));
        }
        let numbers = [k.fx, k.fy, k.cx, k.cy];
        if !(numbers.iter().all(|number| number.abs() <= FARTHEST) && k.fx > 0.0 && k.fy > 0.0) {
            let found = format!("{name} has the focal lengths {}, {} and the principal point {}, {}", k.fx, k.fy, k.cx, k.cy);
            return Err(Error::usage("intrinsics", found, "give finite numbers, focal lengths above 0, in pixels"));
        }
        k.check_lens().map_err(|unusable| Error::usage("intrinsics", format!("{name}: {}", unusable.found), unusable.remedy))?;
        let pose = self.camera.camera_to_world;
        if !(pose.is_finite() && pose.translation.abs().max_element() <= FARTHEST) {
            let found = format!("{name} has a number that is not finite, or is at a distance of more than {FARTHEST:e}");
            return Err(Error::usage("camera_to_world", found, "give finite numbers"));
        }
        let rows = DMat4::from(pose).transpose().to_cols_array_2d();
        rigid(rows).map_err(|(found, remedy)| Error::usage("camera_to_world", format!("the matrix of {name} {found}"), remedy))?;
        if let Some(mask) = &self.mask {
            let found = match mask.size() {
                found if found != size => {
                    format!("that of {name} has {} x {} pixels, but its image {} x {}", found[0], found[1], size[0], size[1])
                }
                _ if mask.kept() == 0 => format!("that of {name} ignores every pixel"),
                _ => return Ok(()),
            };
            return Err(Error::usage("masks", found, "give masks of the size of the images, true where a pixel is used"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use crate::dataset::procedural::ProceduralOptions;
    use glam::{DMat3, DVec3};

    fn photographs() -> Photographs {
        let scene = ProceduralOptions { width: 12, height: 8, train: 9, val: 0, test: 0, supersample: 1 };
        let views = Dataset::procedural(scene).unwrap().load(Split::Train, &|_, _| ()).unwrap();
        let views = views.into_iter().map(|View { name, camera, image, .. }| Photograph { name, image, mask: None, camera, split: None });
        Photographs { scene: "arrays".to_owned(), views: views.collect(), normalize: false }
    }

    #[test]
    fn views_keep_their_order_their_pixels_and_their_coordinates() {
        let photographs = Arc::new(photographs());
        let dataset = photographs.open(&OpenOptions::default()).unwrap();
        // Every eighth view is for testing.
        assert_eq!((dataset.view_names(Split::Test), dataset.count(Split::Train)), (vec!["r_0", "r_8"], 7));
        let views = dataset.load(Split::Train, &|_, _| ()).unwrap();
        for (view, given) in views.iter().zip(&photographs.views[1..8]) {
            assert!(view.image == given.image && view.camera == given.camera && view.name == given.name);
        }
        let small = photographs.open(&OpenOptions { downscale: 4, validation_every: Some(2), ..OpenOptions::default() }).unwrap();
        assert_eq!((small.size(), small.count(Split::Val)), ((3, 2), 3));
        assert_eq!(small.load_view(Split::Train, 0).unwrap().image.dimensions(), (3, 2));
        let moved = Arc::new(Photographs { normalize: true, ..(*photographs).clone() }).open(&OpenOptions::default()).unwrap();
        let reach = moved.cameras(Split::Train).iter().map(|camera| camera.position().abs().max_element()).fold(0.0, f64::max);
        assert!(reach > 1.0 && reach < 2.0 + 1e-9, "{reach}");
    }

    #[test]
    fn invalid_photographs_are_named() {
        type Change = fn(&mut Photograph);
        let changes: [(Change, &str); 8] = [
            (|view| view.name = "r_1".to_owned(), "names: two views have the name r_1"),
            (|view| view.image = RgbaImage::new(8, 8), "images: the image of r_2 has 8 x 8 pixels, but its camera 12 x 8"),
            (|view| view.camera.intrinsics.fx = f64::NAN, "intrinsics: r_2 has the focal lengths NaN"),
            (|view| view.camera.intrinsics.fy = -1.0, "focal lengths above 0"),
            (|view| view.camera.camera_to_world.translation = DVec3::splat(f64::INFINITY), "not finite"),
            (|view| view.camera.camera_to_world.matrix3 *= DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0)), "determinant is -1"),
            (|view| view.mask = Some(Mask::new([8, 8], |_, _| true)), "masks: that of r_2 has 8 x 8 pixels"),
            (|view| view.mask = Some(Mask::new([12, 8], |_, _| false)), "ignores every pixel"),
        ];
        for (change, message) in changes {
            let mut photographs = photographs();
            change(&mut photographs.views[2]);
            let error = Arc::new(photographs).open(&OpenOptions::default()).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains(message), "{error}");
        }
        let none = Photographs { views: Vec::new(), ..photographs() };
        assert!(Arc::new(none).open(&OpenOptions::default()).unwrap_err().to_string().contains("no training view"));
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(4, 4, 0.7));
        let image = RgbaImage::new(4, 4);
        let one = Photograph { name: "a".to_owned(), image, mask: None, camera, split: Some(Split::Train) };
        let one = Photographs { views: vec![one], ..photographs() };
        let error = Arc::new(one).open(&OpenOptions { downscale: 5, ..OpenOptions::default() }).unwrap_err();
        assert!(error.to_string().contains("downscale: 5 is more than the 4 x 4 pixels of a"), "{error}");
    }
}
