use super::*;
use ::image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage, Rgba};

fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).expect("an image of this kind");
    bytes.into_inner()
}

/// Four rectangles of gray, 16 x 8 pixels each: 0 and 80 above, 160 and 240 below.
fn quarters() -> Vec<u8> {
    encoded(GrayImage::from_fn(32, 16, |x, y| Luma([(80 * (x / 16) + 160 * (y / 8)) as u8])), ImageFormat::Jpeg)
}

/// Puts a segment of EXIF behind the start of a JPEG.
fn with_exif(jpeg: &[u8], tiff: &[u8]) -> Vec<u8> {
    let length = (8 + tiff.len() as u16).to_be_bytes();
    [&jpeg[..2], &[0xff, 0xe1], &length, b"Exif\0\0", tiff, &jpeg[2..]].concat()
}

/// Little-endian TIFF with one entry, the orientation.
fn stating(orientation: u8) -> Vec<u8> {
    [&b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"[..], &[orientation, 0, 0, 0], &[0; 4]].concat()
}

/// Sizes by [`size_as`] of a file with these bytes.
fn sizes(name: &str, bytes: &[u8]) -> [Result<(usize, usize)>; 2] {
    let path = std::env::temp_dir().join(format!("plenoxel-decode-{}-{name}", std::process::id()));
    std::fs::write(&path, bytes).expect("the temporary folder");
    let sizes = [Orientation::Stated, Orientation::Stored].map(|orientation| size_as(&path, orientation));
    std::fs::remove_file(path).expect("it was written");
    sizes
}

/// Asserts that bytes are refused as bad input, by the decoder and without decoding, with a message that has these parts.
fn refused(name: &str, bytes: &[u8], parts: &[&str]) {
    let [size, _] = sizes(name, bytes);
    for error in [size.map(drop).expect_err(name), decode(Path::new(name), bytes).map(drop).expect_err(name)] {
        assert!(error.exit_code() == 3 && parts.iter().all(|part| error.to_string().contains(part)), "{name}: {error}");
    }
}

#[test]
fn a_jpeg_is_turned_as_its_exif_states() {
    let jpeg = quarters();
    // Gray of the corners at the top left, top right and bottom left.
    let turned = [[0, 80, 160], [80, 0, 240], [240, 160, 80], [160, 240, 0], [0, 160, 80], [160, 0, 240], [240, 80, 160], [80, 240, 0]];
    for (orientation, corners) in (1..).zip(turned) {
        let bytes = with_exif(&jpeg, &stating(orientation));
        let size = if orientation < 5 { (32, 16) } else { (16, 32) };
        let [stated, stored] = sizes(&format!("turned-{orientation}.png"), &bytes).map(|size| size.expect("a JPEG"));
        assert_eq!((stated, stored), (size, (32, 16)));
        let image = decode(Path::new("turned"), &bytes).expect("a JPEG");
        assert_eq!((image.width() as usize, image.height() as usize), size);
        let found = [(2, 2), (size.0 as u32 - 3, 2), (2, size.1 as u32 - 3)].map(|(x, y)| image.get_pixel(x, y).0);
        for ([r, g, b, a], corner) in found.into_iter().zip(corners) {
            assert!(r.abs_diff(corner) <= 3 && r == g && g == b && a == 255, "orientation {orientation}: {found:?}");
        }
        let stored = picture(Path::new("stored"), Cursor::new(&bytes), Orientation::Stored).expect("a JPEG");
        assert!(stored.width() == 32 && stored.get_pixel(2, 2).0[0] <= 3);
    }
}

#[test]
fn exif_that_makes_no_sense_turns_nothing() {
    let far = b"II*\0\xff\xff\xff\x7f";
    let many = b"II*\0\x08\0\0\0\xff\xff\x12\x01\x03";
    for tiff in [&stating(9)[..], &stating(0), &stating(255), &stating(6)[..13], b"", b"II", b"neither II nor MM", far, many] {
        let bytes = with_exif(&quarters(), tiff);
        assert_eq!(sizes("senseless.jpg", &bytes)[0].as_ref().ok(), Some(&(32, 16)), "{tiff:?}");
        assert_eq!(decode(Path::new("senseless.jpg"), &bytes).expect("a JPEG").dimensions(), (32, 16), "{tiff:?}");
    }
}

#[test]
fn a_jpeg_or_webp_cut_anywhere_is_noticed() {
    let rgb = RgbImage::from_fn(24, 18, |x, y| Rgb([(10 * x) as u8, (14 * y) as u8, (x * y) as u8]));
    for (name, bytes) in [("cut.jpg", encoded(rgb.clone(), ImageFormat::Jpeg)), ("cut.webp", encoded(rgb, ImageFormat::WebP))] {
        assert_eq!(sizes(name, &bytes)[0].as_ref().ok(), Some(&(24, 18)));
        for length in 0..bytes.len() {
            let part = if length == 0 { "the file is empty" } else { "truncated" };
            refused(name, &bytes[..length], &[name, part]);
        }
        let behind = [&bytes[..], &[7; 100]].concat();
        assert!(sizes(name, &behind)[0].is_ok() && decode(Path::new(name), &behind).is_ok(), "bytes behind the end are no damage");
    }
}

#[test]
fn colors_survive_every_format_under_any_name() {
    let gradient = RgbImage::from_fn(40, 30, |x, y| Rgb([(6 * x) as u8, (8 * y) as u8, 90]));
    let jpeg = decode(Path::new("a.png"), &encoded(gradient.clone(), ImageFormat::Jpeg)).expect("a JPEG");
    let far = gradient.pixels().zip(jpeg.pixels()).flat_map(|(a, b)| [0, 1, 2].map(|c| a.0[c].abs_diff(b.0[c]))).max();
    assert!(far.is_some_and(|far| far < 40) && jpeg.pixels().all(|pixel| pixel.0[3] == 255), "{far:?}");
    let rgba = RgbaImage::from_fn(5, 4, |x, y| Rgba([50 * x as u8, 60 * y as u8, 7, 250 - 50 * x as u8]));
    assert_eq!(decode(Path::new("a.jpg"), &encoded(rgba.clone(), ImageFormat::WebP)).expect("a WebP"), rgba);
    assert_eq!(decode(Path::new("a.webp"), &encoded(rgba.clone(), ImageFormat::Png)).expect("a PNG"), rgba);
    let one = encoded(GrayImage::from_pixel(1, 1, Luma([77])), ImageFormat::Jpeg);
    assert_eq!(decode(Path::new("one.jpg"), &one).expect("a JPEG").get_pixel(0, 0).0, [77, 77, 77, 255]);
}

#[test]
fn what_is_no_image_is_named() {
    let jpeg = quarters();
    let frame = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).expect("a baseline JPEG");
    let sized = |height: [u8; 2], width: [u8; 2]| [&jpeg[..frame + 5], &height, &width, &jpeg[frame + 9..]].concat();
    refused("zero.jpg", &sized([0, 0], [0, 9]), &["the header says 9 x 0 pixels", "1 to 16384 pixels"]);
    refused("large.jpg", &sized([0xff, 0xff], [0, 9]), &["the header says 9 x 65535 pixels", "1 to 16384 pixels"]);
    refused("absurd.jpg", &sized([0x40, 0], [0x40, 0]), &["16384 x 16384 pixels", "cannot hold as many"]);
    refused("ends.jpg", &[&jpeg[..2], &[0xff, 0xd9]].concat(), &["damaged", "does not state its size"]);
    refused("lost.jpg", &[&jpeg[..2], &[0xff, 0xe0, 0, 4, 1, 2, 3], &jpeg[2..]].concat(), &["damaged", "begin with a marker"]);
    refused("photo.heic", b"\0\0\0\x18ftypheic\0\0\0\0", &["this is a HEIC image", "convert it to PNG or JPEG"]);
    refused("raw.dng", b"II*\0\x08\0\0\0", &["TIFF or raw"]);
    refused("film.gif", b"GIF89a", &["this is a GIF image"]);
    refused("sound.wav", b"RIFF\x24\0\0\0WAVEfmt ", &["not a PNG, JPEG or WebP image"]);
    refused("page.jpg", b"<html>Not found</html>", &["page.jpg", "not a PNG, JPEG or WebP image"]);
    refused("empty.jpg", b"", &["the file is empty"]);
}
