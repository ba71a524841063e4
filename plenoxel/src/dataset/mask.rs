//! Masks: pixels of a photograph to ignore, such as people who walked by.
//!
//! No ray is trained on an ignored pixel, and it counts in no PSNR. For carving it shows neither object nor background. White keeps a pixel
//! and black ignores it, as in nerfstudio (`mask_path`).

use super::image;
use crate::error::{Error, Result};
use std::path::Path;

/// Pixels of an image that are kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    width: usize,
    /// Row after row.
    keeps: Vec<bool>,
}

impl Mask {
    /// Creates a mask of `width` x `height` pixels from a function of column and row.
    pub fn new([width, height]: [usize; 2], keeps: impl Fn(usize, usize) -> bool) -> Self {
        Mask { width, keeps: (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| keeps(x, y)).collect() }
    }

    /// Reads the mask of an image of width and height `size`, as stored. A pixel is kept if its brightest channel is 128 or more and it is
    /// not transparent (alpha 128 or more): the edges of a JPEG are not exact.
    ///
    /// Errors if the file is no image, has another size, or ignores every pixel.
    pub fn read(path: &Path, size: (usize, usize)) -> Result<Self> {
        let mask = image::read_as(path, image::Orientation::Stored)?;
        check(path, (mask.width() as usize, mask.height() as usize), size)?;
        let mask = Mask::new([size.0, size.1], |x, y| {
            let [r, g, b, alpha] = mask.get_pixel(x as u32, y as u32).0;
            r.max(g).max(b).min(alpha) >= 128
        });
        match mask.kept() {
            0 => Err(Error::input(path, "the mask ignores every pixel", "make it white where the image is used, or leave the image out")),
            _ => Ok(mask),
        }
    }

    /// Checks that the file of a mask has the size of its image, as stored, without decoding it.
    pub(super) fn check_file(path: &Path, size: (usize, usize)) -> Result<()> {
        check(path, image::size_as(path, image::Orientation::Stored)?, size)
    }

    /// Returns width and height in pixels.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.keeps.len().checked_div(self.width).unwrap_or(0)]
    }

    /// Returns true if pixel (x, y) is kept.
    #[inline]
    pub fn keeps(&self, x: usize, y: usize) -> bool {
        self.keeps[y * self.width + x]
    }

    /// Returns the number of pixels that are kept.
    pub fn kept(&self) -> usize {
        self.keeps.iter().filter(|keeps| **keeps).count()
    }

    /// Returns the fraction of the pixels that are kept.
    pub fn share(&self) -> f64 {
        self.kept() as f64 / self.keeps.len() as f64
    }

    /// Returns the pixels of all rows as bytes of 0 and 1.
    pub(crate) fn bytes(&self) -> impl Iterator<Item = u8> + '_ {
        self.keeps.iter().map(|keeps| u8::from(*keeps))
    }

    /// Returns the runs of kept pixels among columns `from..to` of a row: first column and length.
    pub(crate) fn runs(&self, y: usize, from: usize, to: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let row = &self.keeps[y * self.width..][from..to];
        let mut at = from;
        row.chunk_by(|a, b| a == b).filter_map(move |run| {
            at += run.len();
            run[0].then_some((at - run.len(), run.len()))
        })
    }

    /// Returns the mask of the image reduced by k. A pixel is kept if its whole block is, so that no ignored color is in it; if no block is
    /// whole, those kept in part are.
    pub fn reduced(&self, k: usize) -> Self {
        let size = [self.width / k, self.keeps.len() / self.width / k];
        let block = |x: usize, y: usize| (0..k * k).map(move |i| self.keeps(k * x + i % k, k * y + i / k));
        let whole = Mask::new(size, |x, y| block(x, y).all(|keeps| keeps));
        if whole.kept() > 0 { whole } else { Mask::new(size, |x, y| block(x, y).any(|keeps| keeps)) }
    }
}

/// Checks the size of a mask.
fn check(path: &Path, mask: (usize, usize), image: (usize, usize)) -> Result<()> {
    if mask == image {
        return Ok(());
    }
    let found = format!("the mask has {} x {} pixels, but its image has {} x {}", mask.0, mask.1, image.0, image.1);
    Err(Error::input(path, found, "write a mask of the size of its image"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{GrayImage, ImageFormat, Luma, LumaA};

    fn with_file<T>(name: &str, image: impl Into<::image::DynamicImage>, format: ImageFormat, f: impl Fn(&Path) -> T) -> T {
        let path = std::env::temp_dir().join(format!("plenoxel-mask-{}-{name}", std::process::id()));
        image.into().save_with_format(&path, format).expect("the temporary folder");
        let result = f(&path);
        std::fs::remove_file(path).expect("it was written");
        result
    }

    #[test]
    fn white_keeps_in_every_format() {
        let left = GrayImage::from_fn(32, 16, |x, _| Luma([if x < 16 { 255 } else { 0 }]));
        let expected = Mask::new([32, 16], |x, _| x < 16);
        for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
            let mask =
                with_file("left", ::image::DynamicImage::ImageLuma8(left.clone()).to_rgb8(), format, |path| Mask::read(path, (32, 16)));
            assert_eq!(mask.expect("a mask"), expected, "{format:?}");
        }
        assert_eq!((expected.kept(), expected.share()), (256, 0.5));
        let deep = ::image::ImageBuffer::from_fn(2, 1, |x, _| LumaA([40_000_u16, if x == 0 { 65535 } else { 0 }]));
        let deep = with_file("deep", deep, ImageFormat::Png, |path| Mask::read(path, (2, 1)));
        assert_eq!(deep.expect("a mask"), Mask::new([2, 1], |x, _| x == 0));
    }

    #[test]
    fn a_mask_that_does_not_fit_its_image_is_refused() {
        let mask =
            |gray, size| with_file("unfit", GrayImage::from_pixel(6, 4, Luma([gray])), ImageFormat::Png, |path| Mask::read(path, size));
        let error = mask(255, (4, 6)).expect_err("another size");
        assert_eq!(error.exit_code(), 3);
        assert!(error.to_string().contains("the mask has 6 x 4 pixels, but its image has 4 x 6; write a mask"), "{error}");
        let error = mask(127, (6, 4)).expect_err("nothing is kept");
        assert!(error.exit_code() == 3 && error.to_string().contains("ignores every pixel; make it white"), "{error}");
    }

    #[test]
    fn runs_are_the_kept_pixels_and_reduced_pixels_show_nothing_ignored() {
        let mask = Mask::new([9, 4], |x, y| x * y % 3 != 1);
        for (y, from, to) in [(0, 0, 9), (1, 0, 9), (1, 4, 9), (2, 1, 3), (3, 5, 5)] {
            let of_runs: Vec<usize> = mask.runs(y, from, to).flat_map(|(x, n)| x..x + n).collect();
            assert_eq!(of_runs, (from..to).filter(|&x| mask.keeps(x, y)).collect::<Vec<_>>());
        }
        let small = mask.reduced(2);
        for (x, y) in (0..2).flat_map(|y| (0..4).map(move |x| (x, y))) {
            assert_eq!(small.keeps(x, y), [(0, 0), (1, 0), (0, 1), (1, 1)].iter().all(|(i, j)| mask.keeps(2 * x + i, 2 * y + j)));
        }
        assert!(small.kept() > 0 && small.kept() < 8);
        assert_eq!(Mask::new([4, 2], |x, y| (x + y) % 2 == 0).reduced(2).kept(), 2);
    }
}
