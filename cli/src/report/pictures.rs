//! The pictures of a report: stages, and test views with their scores.

use crate::html::{escaped, picture};
use plenoxel::dataset::image as files;
use plenoxel::error::Result;
use plenoxel::run::folder::RunFolder;
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;

/// Maximum width and height of pictures in a report, in pixels. The files in the run folder have the full size.
pub const LARGEST: [u32; 2] = [4000, 400];

/// The parts of a panel, from left to right.
const PANEL: [&str; 4] = ["target", "render", "error", "depth"];

/// The section with the stages side by side, or with the carved or baked grid.
pub fn stages(folder: &RunFolder, result: &Value) -> Result<String> {
    let what = [
        ("stages.png", "Stages", "One view before the first step and at the end of each stage, and the photograph."),
        ("carved.png", "Carved grid", "The carved grid from some cameras."),
        ("baked.png", "Baked grid", "A test view."),
    ];
    let Some((name, title, caption)) = what.into_iter().find(|(name, ..)| folder.image(name).exists()) else { return Ok(String::new()) };
    let resolutions = result["stages"].as_array().into_iter().flatten().map(|stage| stage["resolution"].as_u64().map(|n| n as usize));
    let numbered = resolutions.clone().take(1).chain(resolutions).enumerate();
    // Only pictures that exist are in the strip: runs of earlier versions have none of the start.
    let drawn = numbered.filter(|&(number, resolution)| folder.image(&RunFolder::stage_name(number, resolution)).exists());
    let stages = drawn.map(|(number, resolution)| match (number, resolution) {
        (0, _) => "start".to_owned(),
        (_, Some(resolution)) => format!("{resolution}³"),
        (_, None) => "stage".to_owned(),
    });
    // The photograph is of the first test view.
    let photograph = result["views"].as_u64().filter(|views| *views > 0).map(|_| "photograph".to_owned());
    let labels: Vec<String> = match name {
        "stages.png" => stages.chain(photograph).collect(),
        "baked.png" => ["photograph", "field", "baked grid"].map(str::to_owned).to_vec(),
        _ => Vec::new(),
    };
    let picture = embedded(&folder.image(name), title)?;
    Ok(format!("<section><h2>{title}</h2>\n{}</section>", strip(&picture, &labels, caption, "")))
}

/// Pictures side by side with a label below each, and a caption; `more` are attributes.
fn strip(picture: &str, labels: &[impl AsRef<str>], caption: &str, more: &str) -> String {
    let labels: String = labels.iter().map(|label| format!("<span>{}</span>", label.as_ref())).collect();
    let labels = if labels.is_empty() { labels } else { format!("<div class=\"parts\">{labels}</div>") };
    format!("<figure{more}><div class=\"strip\">{picture}{labels}</div><figcaption>{caption}</figcaption></figure>\n")
}

/// The section with the test views as target | render | error | depth, and a table with the scores of all test views.
pub fn panels(folder: &RunFolder, result: &Value) -> Result<String> {
    let Some(views) = result["per_view"].as_array().filter(|views| !views.is_empty()) else { return Ok(String::new()) };
    let (mut figures, mut rows) = (String::new(), String::new());
    for (number, view) in views.iter().enumerate() {
        let name = view["name"].as_str().unwrap_or_default();
        // JSON has no infinity, the PSNR of equal pictures.
        let psnr = view["psnr"].as_f64();
        let (order, psnr) = (psnr.map_or("Infinity".to_owned(), |x| x.to_string()), psnr.map_or("∞".to_owned(), |x| format!("{x:.2}")));
        let ssim = view["ssim"].as_f64().map_or("–".to_owned(), |ssim| format!("{ssim:.4}"));
        let name_shown = escaped(name);
        let _ = write!(rows, "<tr><td>{number}</td><td>{name_shown}</td><td>{psnr}</td><td>{ssim}</td></tr>");
        let path = folder.image(&RunFolder::panel_name(number, name));
        if path.exists() {
            let caption = format!("{name_shown}: {psnr} dB, SSIM {ssim}");
            let picture = embedded(&path, &caption)?;
            figures += &strip(&picture, &PANEL, &caption, &format!(" id=\"view-{number}\" data-psnr=\"{order}\""));
        }
    }
    let order = "<label>order <select id=\"order\"><option value=\"\">as listed</option><option value=\"1\">worst first</option>\
                 <option value=\"-1\">best first</option></select></label>";
    let pictures = match figures.is_empty() {
        true => String::new(),
        false => format!(
            "<p>Error is the absolute difference averaged over channels: black is 0, pale yellow is 0.25 or more. \
             In depth, red is near and blue is far. {order}</p>\n<div id=\"panels\">\n{figures}</div>\n"
        ),
    };
    Ok(format!(
        "<section><h2>Test views</h2>\n{pictures}<details><summary>scores of all {} test views</summary><table><thead><tr><th></th><th>view</th>\
         <th>PSNR, dB</th><th>SSIM</th></tr></thead><tbody>{rows}</tbody></table></details></section>",
        views.len()
    ))
}

/// Embeds a picture file in the page.
fn embedded(path: &Path, what: &str) -> Result<String> {
    Ok(picture(&files::read(path)?, LARGEST, what))
}
