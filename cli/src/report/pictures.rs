//! The pictures of a run in its report: stages, and test views with their figures.

use crate::html::escaped;
use crate::run_folder::RunFolder;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{FilterType, resize};
use image::{ExtendedColorType, ImageEncoder};
use plenoxel::dataset::image::{self as files, RgbaImage};
use plenoxel::error::{Error, Result};
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;

/// Pictures are made at most this high, and as JPEG of this quality: the files beside the report are whole.
const MOST_HEIGHT: u32 = 400;
const QUALITY: u8 = 88;

/// The stages of the run side by side, or what was carved.
pub fn stages(folder: &RunFolder) -> Result<String> {
    let what = [
        ("stages.png", "Stages", "One view at the end of each stage, and its photograph."),
        ("carved.png", "Carved", "What some cameras see."),
    ];
    let Some((name, title, caption)) = what.into_iter().find(|(name, ..)| folder.image(name).exists()) else { return Ok(String::new()) };
    Ok(format!(
        "<section><h2>{title}</h2>\n<figure>{}<figcaption>{caption}</figcaption></figure></section>",
        embedded(&folder.image(name), title)?
    ))
}

/// Test views as target | render | error | depth, each with its figures, and the figures of those without a picture.
pub fn panels(folder: &RunFolder, result: &Value) -> Result<String> {
    let Some(views) = result["per_view"].as_array().filter(|views| !views.is_empty()) else { return Ok(String::new()) };
    let (mut figures, mut rows) = (String::new(), String::new());
    for (number, view) in views.iter().enumerate() {
        let name = view["name"].as_str().unwrap_or_default();
        let psnr = view["psnr"].as_f64().unwrap_or(f64::NAN);
        let ssim = view["ssim"].as_f64().map_or("–".to_owned(), |ssim| format!("{ssim:.4}"));
        let name_shown = escaped(name);
        let _ = write!(rows, "<tr><td>{number}</td><td>{name_shown}</td><td>{psnr:.2}</td><td>{ssim}</td></tr>");
        let picture = folder.image(&RunFolder::panel_name(number, name));
        if picture.exists() {
            let caption = format!("{name_shown}: {psnr:.2} dB, SSIM {ssim}");
            let picture = embedded(&picture, &caption)?;
            let _ = writeln!(figures, "<figure data-psnr=\"{psnr}\">{picture}<figcaption>{caption}</figcaption></figure>");
        }
    }
    let order = "<label>order <select id=\"order\"><option value=\"\">as they are</option><option value=\"1\">worst first</option>\
                 <option value=\"-1\">best first</option></select></label>";
    let pictures = match figures.is_empty() {
        true => String::new(),
        false => format!(
            "<p>Target, render, error and depth. Error is the absolute difference averaged over channels, black at 0, pale yellow at 0.25 and \
             above. Depth is red where near and blue where far. {order}</p>\n<div id=\"panels\">\n{figures}</div>\n"
        ),
    };
    Ok(format!(
        "<section><h2>Test views</h2>\n{pictures}<details><summary>figures of all {} test views</summary><table><thead><tr><th></th><th>view</th>\
         <th>PSNR, dB</th><th>SSIM</th></tr></thead><tbody>{rows}</tbody></table></details></section>",
        views.len()
    ))
}

/// A picture of a file as part of the page.
fn embedded(path: &Path, what: &str) -> Result<String> {
    embed(files::read(path)?, path, what)
}

/// A picture as part of the page; `path` is where it came from, for messages.
pub fn embed(mut picture: RgbaImage, path: &Path, what: &str) -> Result<String> {
    let (width, height) = picture.dimensions();
    if height > MOST_HEIGHT {
        picture = resize(&picture, (width * MOST_HEIGHT / height).max(1), MOST_HEIGHT, FilterType::Triangle);
    }
    let (width, height) = picture.dimensions();
    let rgb: Vec<u8> = picture.pixels().flat_map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2]]).collect();
    let mut jpeg = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
    let written = encoder.write_image(&rgb, width, height, ExtendedColorType::Rgb8);
    written.map_err(|e| Error::input(path, format!("it cannot become part of the report: {e}"), "a smaller picture"))?;
    let data = STANDARD.encode(jpeg);
    Ok(format!("<img width=\"{width}\" height=\"{height}\" alt=\"{}\" src=\"data:image/jpeg;base64,{data}\">", escaped(what)))
}
