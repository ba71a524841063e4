//! Pictures of results: panels of target, render, error and depth; strips; and their color maps.

use clap::ValueEnum;
use image::RgbImage;
use image::imageops::crop_imm;
use ndarray::{Array2, Array3, Axis, Slice, concatenate};
use plenoxel::camera::Camera;
use plenoxel::dataset::image::RgbaImage;
use plenoxel::error::Result;
use plenoxel::render::picture::Picture;
use serde::Deserialize;
use std::path::Path;

/// Error with the brightest color: the absolute difference, averaged over channels.
pub const ERROR_SCALE: f32 = 0.25;

/// A channel of a rendered picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Channel {
    Color,
    Depth,
    Normal,
    Opacity,
}

impl Channel {
    pub const ALL: [Channel; 4] = [Channel::Color, Channel::Depth, Channel::Normal, Channel::Opacity];

    /// Suffix of its file names.
    pub fn suffix(self) -> &'static str {
        match self {
            Channel::Color => "",
            Channel::Depth => "_depth",
            Channel::Normal => "_normal",
            Channel::Opacity => "_opacity",
        }
    }
}

/// A picture with values in [0, 1], `[h, w, 3]`.
pub type Rgb = Array3<f32>;

/// Range of distances for the color map of depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRange {
    /// Distance shown in red.
    pub near: f64,
    /// Distance shown in blue.
    pub far: f64,
}

impl DepthRange {
    /// The range for a camera: the largest ball inside the box. Cameras at the same distance have the same range.
    pub fn of(camera: &Camera, half_width: f64) -> Self {
        let distance = camera.position().length();
        DepthRange { near: (distance - half_width).max(0.0), far: distance + half_width }
    }
}

/// Draws target, render, error and depth side by side.
pub fn panel(target: &Rgb, picture: &Picture, range: DepthRange) -> Rgb {
    let error = error_map(target, picture);
    strip(&[target, &picture.rgb, &error, &depth_map(picture, range)])
}

/// Draws pictures of the same height side by side, with thin gaps.
pub fn strip(pictures: &[&Rgb]) -> Rgb {
    let Some(first) = pictures.first() else {
        return Rgb::zeros((0, 0, 3));
    };
    let height = first.dim().0;
    let gap = Rgb::from_elem((height, gap(height), 3), 0.55);
    let mut parts = vec![first.view()];
    for picture in &pictures[1..] {
        parts.extend([gap.view(), picture.slice_axis(Axis(0), Slice::from(..height))]);
    }
    concatenate(Axis(1), &parts).unwrap_or_else(|_| (*first).clone())
}

/// Gap between the pictures of a strip of this height, in pixels.
fn gap(height: usize) -> usize {
    (height / 50).max(2)
}

/// Cuts a picture out of a strip of pictures of one size. In a panel, 0 is the target, 1 the render and 2 the error. `None` if the strip has no such
/// picture.
pub fn part(strip: &RgbaImage, number: usize, (width, height): (usize, usize)) -> Option<RgbaImage> {
    // The size is read from a file, and may be any number.
    if height != strip.height() as usize || width > strip.width() as usize {
        return None;
    }
    let x = number * (width + gap(height));
    (x + width <= strip.width() as usize).then(|| crop_imm(strip, x as u32, 0, width as u32, height as u32).to_image())
}

/// Mean absolute error over channels: black is 0, pale yellow is [`ERROR_SCALE`] or more.
pub fn error_map(target: &Rgb, picture: &Picture) -> Rgb {
    let (h, w, _) = target.dim();
    colored(h, w, |y, x| {
        let error: f32 = (0..3).map(|c| (picture.rgb[[y, x, c]].clamp(0.0, 1.0) - target[[y, x, c]]).abs()).sum();
        color(&INFERNO, error / 3.0 / ERROR_SCALE)
    })
}

/// Mean distance along the ray, Σ wᵢ tᵢ / opacity: red is near, blue is far, white is empty.
pub fn depth_map(picture: &Picture, range: DepthRange) -> Rgb {
    let (h, w) = picture.depth.dim();
    colored(h, w, |y, x| {
        let opacity = picture.opacity[[y, x]].clamp(0.0, 1.0);
        if opacity <= 0.0 {
            return [1.0; 3];
        }
        let depth = f64::from(picture.depth[[y, x]] / opacity);
        let place = (range.far - depth) / (range.far - range.near);
        color(&TURBO, place as f32).map(|c| c * opacity + 1.0 - opacity)
    })
}

/// Opacity from black to white.
pub fn opacity_map(picture: &Picture) -> Rgb {
    let opacity: &Array2<f32> = &picture.opacity;
    let (h, w) = opacity.dim();
    colored(h, w, |y, x| [opacity[[y, x]]; 3])
}

/// Unit normals `[h, w, 3]` from a picture of normals over black; zero where empty.
pub fn unit_normals(picture: &Picture) -> Rgb {
    let mut normals = picture.rgb.clone();
    for mut normal in normals.lanes_mut(Axis(2)) {
        let length = normal.iter().map(|x| x * x).sum::<f32>().sqrt();
        normal.mapv_inplace(|x| if length > 0.0 { x / length } else { 0.0 });
    }
    normals
}

/// Normals as colors: x, y, z from -1 to 1 are red, green, blue from 0 to 1; white is empty.
pub fn normal_map(picture: &Picture) -> Rgb {
    let normals = unit_normals(picture);
    let (h, w, _) = normals.dim();
    colored(h, w, |y, x| {
        let opacity = picture.opacity[[y, x]].clamp(0.0, 1.0);
        [0, 1, 2].map(|c| (0.5 + 0.5 * normals[[y, x, c]]) * opacity + 1.0 - opacity)
    })
}

/// Draws a channel for display.
pub fn shown(channel: Channel, picture: &Picture, range: DepthRange) -> Rgb {
    match channel {
        Channel::Color => picture.rgb.clone(),
        Channel::Depth => depth_map(picture, range),
        Channel::Normal => normal_map(picture),
        Channel::Opacity => opacity_map(picture),
    }
}

/// Rounds a picture to 8 bits per channel, clamped to [0, 1].
pub fn to_rgb8(picture: &Rgb) -> RgbImage {
    let (height, width, _) = picture.dim();
    let channel = |x: u32, y: u32, c: usize| (picture[[y as usize, x as usize, c]].clamp(0.0, 1.0) * 255.0).round() as u8;
    RgbImage::from_fn(width as u32, height as u32, |x, y| [0, 1, 2].map(|c| channel(x, y, c)).into())
}

/// Writes a picture as PNG.
pub fn write(path: &Path, picture: &Rgb) -> Result<()> {
    plenoxel::dataset::image::write_rgb(path, picture.view())
}

fn colored(h: usize, w: usize, color: impl Fn(usize, usize) -> [f32; 3]) -> Rgb {
    let mut picture = Rgb::zeros((h, w, 3));
    for y in 0..h {
        for x in 0..w {
            let color = color(y, x);
            (0..3).for_each(|c| picture[[y, x, c]] = color[c]);
        }
    }
    picture
}

/// Coefficients of a polynomial of degree 6 for red, green and blue, the constant first.
type Map = [[f32; 3]; 7];

/// Evaluates a color map at `x`, clamped to [0, 1].
fn color(map: &Map, x: f32) -> [f32; 3] {
    let x = if x.is_finite() { x.clamp(0.0, 1.0) } else { 1.0 };
    let value = |c: usize| map.iter().rev().fold(0.0, |sum, k| sum * x + k[c]);
    [0, 1, 2].map(|c| value(c).clamp(0.0, 1.0))
}

/// Google's turbo in Mikhailov's polynomial fit, from dark blue to dark red. Its many hues make small differences of distance visible.
const TURBO: Map = [
    [0.135_721_38, 0.091_402_61, 0.106_673_3],
    [4.615_392_6, 2.194_188_4, 12.641_946],
    [-42.660_324, 4.842_966_6, -60.582_05],
    [132.131_09, -14.185_033, 110.362_76],
    [-152.942_4, 4.277_298_6, -89.903_11],
    [59.286_38, 2.829_566, 27.348_25],
    [0.0; 3],
];

/// matplotlib's inferno in Zucker's polynomial fit, with uniformly increasing brightness from black.
const INFERNO: Map = [
    [0.000_218_940_37, 0.001_651_004_6, -0.019_480_899],
    [0.106_513_42, 0.563_956_44, 3.932_712_3],
    [11.602_493, -3.972_854, -15.942_394],
    [-41.703_995, 17.436_398, 44.354_145],
    [77.162_94, -33.402_36, -81.807_31],
    [-71.319_43, 32.626_064, 73.209_52],
    [25.131_126, -12.242_669, -23.070_325],
];

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: [f32; 3], b: [f32; 3]) -> bool {
        // The error of the fit is about 1 %.
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 0.02)
    }

    #[test]
    fn errors_go_from_black_through_red_to_pale_yellow() {
        // matplotlib's table: #000004, #bc3754, #fcffa4.
        assert!(near(color(&INFERNO, 0.0), [0.001, 0.000, 0.014]));
        assert!(near(color(&INFERNO, 0.5), [0.736, 0.216, 0.330]));
        assert!(near(color(&INFERNO, 1.0), [0.988, 0.998, 0.645]));
        assert_eq!(color(&INFERNO, f32::NAN), color(&INFERNO, 1.0));
    }

    #[test]
    fn depths_go_from_blue_through_green_to_red() {
        let strongest = |x: f32| {
            let c = color(&TURBO, x);
            (0..3).max_by(|&a, &b| c[a].total_cmp(&c[b]))
        };
        assert_eq!([0.15, 0.45, 0.85].map(strongest), [Some(2), Some(1), Some(0)]);
    }

    #[test]
    fn empty_pixels_are_white_and_full_ones_colored_by_distance() {
        let picture =
            Picture { rgb: Rgb::zeros((1, 3, 3)), depth: ndarray::array![[0.0, 2.5, 2.75]], opacity: ndarray::array![[0.0, 1.0, 0.5]] };
        let map = depth_map(&picture, DepthRange { near: 2.5, far: 5.5 });
        let pixel = |x: usize| [0, 1, 2].map(|c| map[[0, x, c]]);
        assert_eq!(pixel(0), [1.0; 3]);
        assert!(near(pixel(1), color(&TURBO, 1.0)));
        // Opacity 0.5 at the distance 2.75 / 0.5 = 5.5: half the color of the far end, half white.
        assert!(near(pixel(2), color(&TURBO, 0.0).map(|c| 0.5 * c + 0.5)));
    }

    #[test]
    fn normals_are_made_unit_and_shown_as_colors_over_white() {
        let rgb = ndarray::array![[[0.0, 0.0, 0.0], [0.0, 0.0, 0.8], [-0.3, 0.0, 0.4]]];
        let picture = Picture { rgb, depth: Array2::zeros((1, 3)), opacity: ndarray::array![[0.0, 1.0, 0.5]] };
        let units = unit_normals(&picture);
        assert_eq!(units, ndarray::array![[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [-0.6, 0.0, 0.8]]]);
        let map = normal_map(&picture);
        let pixel = |x: usize| [0, 1, 2].map(|c| map[[0, x, c]]);
        assert_eq!((pixel(0), pixel(1)), ([1.0; 3], [0.5, 0.5, 1.0]));
        assert!(near(pixel(2), [0.6, 0.75, 0.95]));
    }

    #[test]
    fn a_strip_is_as_wide_as_its_pictures_and_gaps() {
        let picture = Rgb::zeros((100, 40, 3));
        assert_eq!(strip(&[&picture, &picture, &picture]).dim(), (100, 124, 3));
        let shades = RgbaImage::from_fn(124, 100, |x, _| [x as u8, 0, 0, 255].into());
        let third = part(&shades, 2, (40, 100)).unwrap();
        assert_eq!((third.dimensions(), third.get_pixel(0, 0)[0]), ((40, 100), 84));
        assert!(
            [(3, (40, 100)), (0, (40, 99)), (2, (usize::MAX, 100))].into_iter().all(|(number, size)| part(&shades, number, size).is_none())
        );
        assert_eq!(strip(&[]).dim(), (0, 0, 3));
    }
}
