//! HTML pages: escaping, embedded pictures, and the page template with its style sheet.
//!
//! A page is a single file without external resources, so it can be moved and sent.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::DynamicImage;
use image::codecs::jpeg::JpegEncoder;
use plenoxel::camera::Camera;
use plenoxel::dataset::image::RgbaImage;
use serde_json::{Value, json};

/// Style sheet of all pages, with the light or dark color scheme of the reader.
const STYLE: &str = "\
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; }
table { border-collapse: collapse; }
th, td { padding: .6rem .8rem; border-bottom: 1px solid #8886; text-align: left; vertical-align: top; }
img { display: block; max-width: 100%; border-radius: 4px; }
.small { font-size: .85rem; opacity: .75; }
.scroll { overflow-x: auto; }
";

/// Script of the camera of a page: rotation, zoom, and controls by mouse, fingers and keys.
pub const CAMERA: &str = include_str!("html/camera.js");

/// Escapes text for an element or a quoted attribute.
pub fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            c => safe.push(c),
        }
    }
    safe
}

/// Formats a camera for [`CAMERA`]: right, up and backward axes, position, and intrinsics in pixels, without the distortion of its lens.
pub fn camera(name: &str, camera: &Camera) -> Value {
    let k = &camera.intrinsics;
    json!({
        "name": name,
        "pose": camera.camera_to_world.to_cols_array(),
        "width": k.width,
        "height": k.height,
        "fx": k.fx,
        "fy": k.fy,
        "cx": k.cx,
        "cy": k.cy,
    })
}

/// JPEG quality of embedded pictures.
const QUALITY: u8 = 88;

/// Embeds an opaque picture, downscaled to at most this width and height in pixels.
pub fn picture(picture: &RgbaImage, [width, height]: [u32; 2], description: &str) -> String {
    let large = picture.width() > width || picture.height() > height;
    let whole = DynamicImage::from(picture.clone());
    let rgb = if large { whole.thumbnail(width, height) } else { whole }.into_rgb8();
    let (width, height, description) = (rgb.width(), rgb.height(), escaped(description));
    let mut jpeg = Vec::new();
    // JPEG fails only for pictures of more than 65535 pixels per side.
    match JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode_image(&rgb) {
        Ok(()) => format!(
            "<img width=\"{width}\" height=\"{height}\" alt=\"{description}\" src=\"data:image/jpeg;base64,{}\">",
            STANDARD.encode(jpeg)
        ),
        Err(e) => format!("<p>{description}: {}</p>", escaped(&e.to_string())),
    }
}

/// Enlarges a picture by the largest whole factor for which it has at most `side` pixels per side. Pixels become squares.
pub fn enlarged(picture: &RgbaImage, side: u32) -> RgbaImage {
    let (width, height) = picture.dimensions();
    let factor = side / width.max(height).max(1);
    if factor < 2 {
        return picture.clone();
    }
    image::imageops::resize(picture, width * factor, height * factor, image::imageops::FilterType::Nearest)
}

/// Formats a page from its title as text, its style sheet, and the HTML below its heading.
pub fn page(title: &str, style: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <link rel=\"icon\" href=\"data:,\">\n<title>{title}</title>\n<style>\n{STYLE}{style}</style>\n<h1>{title}</h1>\n{body}</html>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_becomes_markup() {
        assert_eq!(escaped("a<b> & \"c\" 'd'"), "a&lt;b&gt; &amp; &quot;c&quot; &#39;d&#39;");
        let page = page("<script>", "", "<p>text</p>\n");
        assert!(!page.contains("<script>") && page.contains("<p>text</p>"), "{page}");
        let mut spots = RgbaImage::new(4, 2);
        spots.get_pixel_mut(1, 1).0 = [9, 8, 7, 255];
        let large = enlarged(&spots, 13);
        assert_eq!(
            (large.dimensions(), large.get_pixel(3, 3), large.get_pixel(5, 5)),
            ((12, 6), spots.get_pixel(1, 1), spots.get_pixel(1, 1))
        );
        assert_eq!((large.get_pixel(6, 3), enlarged(&spots, 7).dimensions()), (spots.get_pixel(0, 0), (4, 2)));
        let picture = picture(&RgbaImage::new(40, 20), [10, 10], "\"x");
        assert!(picture.starts_with("<img width=\"10\" height=\"5\" alt=\"&quot;x\" src=\"data:image/jpeg;base64,/9j/"), "{picture}");
    }
}
