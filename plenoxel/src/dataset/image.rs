//! Images: decoding of PNG, JPEG and WebP, encoding of PNG, reduction with a box filter, compositing over a background.
//!
//! An image is 8-bit RGBA with *straight* alpha, as stored in files. This takes a quarter of the memory of floats, and the background can
//! be chosen when a color is read. Values are sRGB as stored. They are not linearised, because published results compare and composite the
//! stored values.

mod decode;
mod jpeg;
mod rows;
mod webp;

use crate::error::{Error, Result};
use crate::files;
use ::image::{ExtendedColorType, ImageEncoder};
use ndarray::{Array2, Array3, ArrayView3};
use std::path::Path;

pub use ::image::RgbaImage;
pub use decode::{Orientation, decode, read, read_as, size, size_as};
pub use rows::MAX_SIDE;

/// Extensions of the images that are read, in lower case.
const EXTENSIONS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];

/// Returns true if the name of a file is that of an image that can be read.
pub fn is_photograph(name: &str) -> bool {
    name.rsplit_once('.').is_some_and(|(_, extension)| EXTENSIONS.iter().any(|known| known.eq_ignore_ascii_case(extension)))
}

/// Checks that images of `width` x `height` can be reduced by k. k must divide both sides, because blocks of different sizes do not belong
/// to one camera.
///
/// Errors with a configuration error that lists the accepted divisors.
pub fn check_downscale(k: usize, (width, height): (usize, usize)) -> Result<()> {
    let divides = |k: usize| width.is_multiple_of(k) && height.is_multiple_of(k);
    if k > 0 && divides(k) {
        return Ok(());
    }
    let divisors: Vec<String> = (1..=width.min(height).min(MAX_SIDE as usize)).filter(|&k| divides(k)).map(|k| k.to_string()).collect();
    let found = if k == 0 { "invalid value 0".to_owned() } else { format!("{k} does not divide the image size {width} x {height}") };
    Err(Error::usage("downscale", found, format!("expected {}", divisors.join(", "))))
}

/// Crops an image at the right and bottom so that k divides its width and height.
pub(super) fn cropped(image: RgbaImage, k: usize) -> RgbaImage {
    let whole = |side: u32| side - side % k as u32;
    let (width, height) = (whole(image.width()), whole(image.height()));
    if (width, height) == image.dimensions() { image } else { ::image::imageops::crop_imm(&image, 0, 0, width, height).to_image() }
}

/// Reduces an image by k: each pixel is the mean of a block of k x k pixels.
///
/// The means are of alpha and of color *times* alpha. The result has straight alpha, rounded to nearest. Compositing it over any background
/// therefore equals averaging the composited block, up to rounding to 8 bits. Alpha is 0 only if the whole block has alpha 0, so that
/// silhouettes do not shrink; the color is then 0. Panics unless k divides width and height ([`check_downscale`]).
pub fn downscale(image: &RgbaImage, k: usize) -> RgbaImage {
    if k == 1 {
        return image.clone();
    }
    let (width, height) = (image.width() as usize, image.height() as usize);
    assert!(k > 0 && width.is_multiple_of(k) && height.is_multiple_of(k), "downscale {k} does not divide {width} x {height}");
    let pixels = image.as_raw();
    RgbaImage::from_fn((width / k) as u32, (height / k) as u32, |i, j| {
        let mut sum = [0_u64; 4];
        for y in j as usize * k..(j as usize + 1) * k {
            let start = 4 * (y * width + i as usize * k);
            for pixel in pixels[start..start + 4 * k].chunks_exact(4) {
                let alpha = u64::from(pixel[3]);
                for channel in 0..3 {
                    sum[channel] += alpha * u64::from(pixel[channel]);
                }
                sum[3] += alpha;
            }
        }
        let rounded = |numerator: u64, denominator: u64| (numerator + denominator / 2).checked_div(denominator).unwrap_or(0) as u8;
        let alpha = sum[3];
        let mean = rounded(alpha, (k * k) as u64).max(u8::from(alpha > 0));
        ::image::Rgba([rounded(sum[0], alpha), rounded(sum[1], alpha), rounded(sum[2], alpha), mean])
    })
}

/// Returns the color of pixel (x, y) over `background`: rgb a + background (1 - a) on the stored sRGB values, in [0, 1].
#[inline]
pub fn color(image: &RgbaImage, x: usize, y: usize, background: [f32; 3]) -> [f32; 3] {
    let [r, g, b, a] = image.get_pixel(x as u32, y as u32).0;
    let alpha = f32::from(a) / 255.0;
    let over = |value: u8, back: f32| f32::from(value) / 255.0 * alpha + back * (1.0 - alpha);
    [over(r, background[0]), over(g, background[1]), over(b, background[2])]
}

/// Returns the whole image over `background`: [height, width, 3] in [0, 1].
pub fn composite(image: &RgbaImage, background: [f32; 3]) -> Array3<f32> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let mut out = Array3::zeros((height, width, 3));
    for ((y, x), mut pixel) in ndarray::indices((height, width)).into_iter().zip(out.lanes_mut(ndarray::Axis(2))) {
        for (to, value) in pixel.iter_mut().zip(color(image, x, y, background)) {
            *to = value;
        }
    }
    out
}

/// Writes `rgb` [height, width, 3] as an 8-bit PNG. Values are clamped to [0, 1] and rounded to nearest; NaN becomes 0. The file is written
/// atomically.
///
/// Panics unless there are three channels. Errors if the image is empty or cannot be written.
#[track_caller]
pub fn write_rgb(path: &Path, rgb: ArrayView3<'_, f32>) -> Result<()> {
    files::write_atomically(path, &rgb_as_png(path, rgb)?)
}

/// The bytes of the PNG file that [`write_rgb`] writes; `path` is for error messages.
///
/// Panics unless there are three channels. Errors: an empty picture, or one that is too large.
#[track_caller]
pub fn rgb_as_png(path: &Path, rgb: ArrayView3<'_, f32>) -> Result<Vec<u8>> {
    let (height, width, channels) = rgb.dim();
    assert_eq!(channels, 3, "a picture must be [height, width, 3], got {:?}", rgb.shape());
    let bytes: Vec<u8> = rgb.iter().map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    encoded(path, &bytes, (width, height), ExtendedColorType::Rgb8)
}

/// Writes an RGBA image with straight alpha as a PNG, atomically.
pub fn write_rgba(path: &Path, image: &RgbaImage) -> Result<()> {
    encode(path, image.as_raw(), (image.width() as usize, image.height() as usize), ExtendedColorType::Rgba8)
}

/// Writes 16-bit gray values [height, width] as a PNG, atomically.
pub fn write_gray16(path: &Path, values: &Array2<u16>) -> Result<()> {
    // The encoder expects samples in native byte order.
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_ne_bytes()).collect();
    encode(path, &bytes, (values.ncols(), values.nrows()), ExtendedColorType::L16)
}

fn encode(path: &Path, bytes: &[u8], size: (usize, usize), color: ExtendedColorType) -> Result<()> {
    files::write_atomically(path, &encoded(path, bytes, size, color)?)
}

fn encoded(path: &Path, bytes: &[u8], (width, height): (usize, usize), color: ExtendedColorType) -> Result<Vec<u8>> {
    // Images that could not be read back are not written.
    if width.max(height) > MAX_SIDE as usize {
        let found = format!("an image of {width} x {height} pixels is too large to write");
        return Err(Error::input(path, found, format!("expected at most {MAX_SIDE} pixels per side")));
    }
    let mut png = Vec::new();
    ::image::codecs::png::PngEncoder::new(&mut png).write_image(bytes, width as u32, height as u32, color).map_err(|error| {
        Error::input(path, format!("a {width} x {height} image cannot be encoded ({error})"), "choose a usual image size")
    })?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{DynamicImage, ImageBuffer, ImageFormat, ImageReader, Luma, LumaA, Rgb, Rgba};
    use std::fs::File;
    use std::io::BufReader;

    fn temporary(name: &str) -> std::path::PathBuf {
        std::env::temp_dir().join(format!("plenoxel-image-{}-{name}", std::process::id()))
    }

    /// Encodes with the `image` crate, writes, reads back with `read`, removes the file.
    fn round_trip(name: &str, image: impl Into<DynamicImage>) -> RgbaImage {
        let path = temporary(name);
        image.into().save_with_format(&path, ImageFormat::Png).unwrap();
        let read = read(&path).unwrap();
        assert_eq!(size(&path).unwrap(), (read.width() as usize, read.height() as usize));
        std::fs::remove_file(path).unwrap();
        read
    }

    #[test]
    fn every_color_type_and_bit_depth_becomes_rgba8() {
        let gray = round_trip("gray", ImageBuffer::from_pixel(2, 1, Luma([90_u8])));
        assert_eq!(gray.get_pixel(1, 0).0, [90, 90, 90, 255]);
        let gray_alpha = round_trip("la", ImageBuffer::from_pixel(1, 1, LumaA([90_u8, 7])));
        assert_eq!(gray_alpha.get_pixel(0, 0).0, [90, 90, 90, 7]);
        let rgb = round_trip("rgb", ImageBuffer::from_pixel(1, 1, Rgb([1_u8, 2, 3])));
        assert_eq!(rgb.get_pixel(0, 0).0, [1, 2, 3, 255]);
        // 16 bit to 8 bit is value / 257, rounded: 257 * 100 + 128 is just below half way between 100 and 101.
        let deep = round_trip("deep", ImageBuffer::from_pixel(1, 1, Rgba([257_u16 * 100 + 128, 257 * 100 + 129, 0, 65535])));
        assert_eq!(deep.get_pixel(0, 0).0, [100, 101, 0, 255]);
    }

    #[test]
    fn compositing_a_reduced_picture_equals_averaging_the_composited_picture() {
        // A fixed scramble of the pixel number gives every combination of strong and weak alpha.
        let mut state = 1_u32;
        let image = RgbaImage::from_fn(12, 8, |_, _| {
            state = state.wrapping_mul(1664525).wrapping_add(1013904223);
            Rgba(state.to_be_bytes())
        });
        let (k, background) = (4, [1.0, 0.25, 0.0]);
        let small = composite(&downscale(&image, k), background);
        let large = composite(&image, background);
        assert_eq!(small.dim(), (2, 3, 3));
        for ((y, x, c), value) in small.indexed_iter() {
            let block = large.slice(ndarray::s![y * k..(y + 1) * k, x * k..(x + 1) * k, c]);
            // Color and alpha are each rounded by at most half a level, and each moves the composite by at most that.
            assert!((value - block.mean().unwrap()).abs() < 1.0 / 255.0 + 1e-6, "pixel ({x}, {y}) channel {c}");
        }
    }

    #[test]
    fn transparent_neighbours_do_not_stain_the_edge() {
        let mut image = RgbaImage::from_pixel(2, 2, Rgba([0, 0, 0, 0]));
        image.put_pixel(0, 0, Rgba([200, 100, 50, 255]));
        assert_eq!(downscale(&image, 2).get_pixel(0, 0).0, [200, 100, 50, 64]); // 255 / 4 = 63.75
        assert_eq!(downscale(&RgbaImage::from_pixel(2, 2, Rgba([9, 9, 9, 0])), 2).get_pixel(0, 0).0, [0; 4]);
        // A trace of object keeps its pixel: 1 / 4 of a level would round to none.
        image.put_pixel(0, 0, Rgba([200, 100, 50, 1]));
        assert_eq!(downscale(&image, 2).get_pixel(0, 0).0, [200, 100, 50, 1]);
    }

    #[test]
    fn a_reduction_that_does_not_divide_lists_those_that_do() {
        let error = check_downscale(3, (8, 12)).unwrap_err();
        assert_eq!(error.exit_code(), 2);
        assert!(error.to_string().contains("does not divide the image size 8 x 12"), "{error}");
        assert!(error.to_string().ends_with("expected 1, 2, 4"), "{error}");
        assert!(check_downscale(0, (8, 12)).is_err() && check_downscale(4, (8, 12)).is_ok());
        // Trying one divisor after another would never end for such sizes of a damaged file.
        assert!(check_downscale(7, (usize::MAX, usize::MAX - 1)).is_err());
    }

    #[test]
    fn written_colors_are_rounded_and_clamped() {
        let path = temporary("write");
        let rgb = ndarray::arr3(&[[[-1.0, 0.5, 2.0_f32], [f32::NAN, 0.0019, 0.0021]]]);
        write_rgb(&path, rgb.view()).unwrap();
        let image = read(&path).unwrap();
        // 0.5 * 255 = 127.5 rounds to 128; 0.0019 * 255 = 0.48 and 0.0021 * 255 = 0.54 fall on either side of a half.
        assert_eq!((image.get_pixel(0, 0).0, image.get_pixel(1, 0).0), ([0, 128, 255, 255], [0, 0, 1, 255]));
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn sixteen_bit_gray_is_written_in_the_right_byte_order() {
        let path = temporary("gray16");
        write_gray16(&path, &ndarray::arr2(&[[0, 256, 65535], [1, 2, 3]])).unwrap();
        let image = ImageReader::with_format(BufReader::new(File::open(&path).unwrap()), ImageFormat::Png).decode().unwrap().into_luma16();
        assert_eq!((image.dimensions(), image.as_raw().as_slice()), ((3, 2), &[0, 256, 65535, 1, 2, 3][..]));
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn an_absurd_header_is_rejected_before_memory_is_taken() {
        let path = temporary("absurd");
        write_rgba(&path, &RgbaImage::new(1, 1)).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[16..20].copy_from_slice(&60000_u32.to_be_bytes());
        bytes[20..24].copy_from_slice(&60000_u32.to_be_bytes());
        std::fs::write(&path, bytes).unwrap();
        let error = size(&path).unwrap_err();
        assert!(error.to_string().contains("60000 x 60000"), "{error}");
        assert_eq!((error.exit_code(), read(&path).unwrap_err().exit_code()), (3, 3));
        // The size is acceptable, but the file is too short for it.
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        std::fs::write(&path, bytes).unwrap();
        for error in [size(&path).unwrap_err(), read(&path).unwrap_err()] {
            assert!(error.exit_code() == 3 && error.to_string().contains("16384 x 16384 pixels; a file of"), "{error}");
        }
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn interlaced_rows_go_to_their_places() {
        // The encoder knows no interlacing: 9 x 9 pixels of 16-bit gray, not compressed, pass by pass.
        let passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)];
        let mut rows = Vec::new();
        for (x0, y0, dx, dy) in passes {
            for y in (y0..9).step_by(dy).filter(|_| x0 < 9) {
                rows.push(0);
                rows.extend((x0..9).step_by(dx).flat_map(|x| (257 * (9 * y + x) as u16).to_be_bytes()));
            }
        }
        let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::none());
        std::io::Write::write_all(&mut zlib, &rows).unwrap();
        let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
        for (name, data) in [(b"IHDR", &b"\0\0\0\x09\0\0\0\x09\x10\0\0\0\x01"[..]), (b"IDAT", &zlib.finish().unwrap()), (b"IEND", b"")] {
            let named = [name, data].concat();
            let mut crc = flate2::Crc::new();
            crc.update(&named);
            png.extend([&(data.len() as u32).to_be_bytes()[..], &named, &crc.sum().to_be_bytes()].concat());
        }
        let image = decode(Path::new("interlaced.png"), &png).unwrap();
        for (x, y, pixel) in image.enumerate_pixels() {
            let gray = (9 * y + x) as u8;
            assert_eq!(pixel.0, [gray, gray, gray, 255], "({x}, {y})");
        }
    }

    #[test]
    fn bytes_behind_the_end_are_no_damage() {
        let path = temporary("behind");
        write_rgba(&path, &RgbaImage::from_pixel(3, 2, Rgba([1, 2, 3, 4]))).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes.extend([7; 100]);
        std::fs::write(&path, bytes).unwrap();
        assert_eq!((size(&path).unwrap(), read(&path).unwrap().get_pixel(2, 1).0), ((3, 2), [1, 2, 3, 4]));
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_palette_that_ends_within_a_color_is_refused() {
        // One pixel, and four bytes of palette: the decoder once panicked at it.
        let png = [
            &b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\x03\0\0\0(\xcb4\xbb\0\0\0\x04PLTE\x01\x02\x03\x04#\xdb\x8a\xab"[..],
            b"\0\0\0\nIDATx\x9cc`\0\0\0\x02\0\x01H\xaf\xa4q\0\0\0\0IEND\xaeB`\x82",
        ];
        let error = decode(Path::new("palette.png"), &png.concat()).unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains("palette.png: the palette ends within a color"), "{error}");
    }

    #[test]
    fn a_png_cut_anywhere_is_noticed_without_being_asked_to_decode() {
        let path = temporary("cut");
        write_rgba(&path, &RgbaImage::from_fn(16, 16, |x, y| Rgba([x as u8, y as u8, 5, 255]))).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        for length in [1, 8, 20, 30, 45, bytes.len() - 20, bytes.len() - 13] {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let error = size(&path).unwrap_err();
            assert_eq!(error.exit_code(), 3, "{length} bytes: {error}");
        }
        std::fs::remove_file(path).unwrap();
    }
}
