//! The pictures of a run in its report: stages, and test views with their figures.

use crate::html::{escaped, picture};
use plenoxel::dataset::image as files;
use plenoxel::error::Result;
use plenoxel::run::folder::RunFolder;
use serde_json::Value;
use std::fmt::Write;
use std::path::Path;

/// Pictures are at most so wide and so high, in pixels: the files beside the report are whole.
pub const LARGEST: [u32; 2] = [4000, 400];

/// What the pictures of a panel show, from left to right.
const PANEL: [&str; 4] = ["target", "render", "error", "depth"];

/// The stages of the run side by side, or what was carved.
pub fn stages(folder: &RunFolder, result: &Value) -> Result<String> {
    let what = [
        ("stages.png", "Stages", "One view before the first step and at the end of each stage, and its photograph."),
        ("carved.png", "Carved", "What some cameras see."),
    ];
    let Some((name, title, caption)) = what.into_iter().find(|(name, ..)| folder.image(name).exists()) else { return Ok(String::new()) };
    let resolutions = result["stages"].as_array().into_iter().flatten().map(|stage| stage["resolution"].as_u64().map(|n| n as usize));
    let numbered = resolutions.clone().take(1).chain(resolutions).enumerate();
    // A view that was not drawn is not in the strip: a run of an earlier version has none of the start.
    let drawn = numbered.filter(|&(number, resolution)| folder.image(&RunFolder::stage_name(number, resolution)).exists());
    let stages = drawn.map(|(number, resolution)| match (number, resolution) {
        (0, _) => "start".to_owned(),
        (_, Some(resolution)) => format!("{resolution}³"),
        (_, None) => "stage".to_owned(),
    });
    // The photograph is of the first test view.
    let photograph = result["views"].as_u64().filter(|views| *views > 0).map(|_| "photograph".to_owned());
    let labels: Vec<String> = if name == "stages.png" { stages.chain(photograph).collect() } else { Vec::new() };
    let picture = embedded(&folder.image(name), title)?;
    Ok(format!("<section><h2>{title}</h2>\n{}</section>", strip(&picture, &labels, caption, "")))
}

/// Pictures side by side with a label below each, and a caption; `more` are attributes.
fn strip(picture: &str, labels: &[impl AsRef<str>], caption: &str, more: &str) -> String {
    let labels: String = labels.iter().map(|label| format!("<span>{}</span>", label.as_ref())).collect();
    let labels = if labels.is_empty() { labels } else { format!("<div class=\"parts\">{labels}</div>") };
    format!("<figure{more}><div class=\"strip\">{picture}{labels}</div><figcaption>{caption}</figcaption></figure>\n")
}

/// Test views as target | render | error | depth, each with its figures, and the figures of those without a picture.
pub fn panels(folder: &RunFolder, result: &Value) -> Result<String> {
    let Some(views) = result["per_view"].as_array().filter(|views| !views.is_empty()) else { return Ok(String::new()) };
    let (mut figures, mut rows) = (String::new(), String::new());
    for (number, view) in views.iter().enumerate() {
        let name = view["name"].as_str().unwrap_or_default();
        // JSON has no number for that of equal pictures.
        let psnr = view["psnr"].as_f64();
        let (order, psnr) = (psnr.map_or("Infinity".to_owned(), |x| x.to_string()), psnr.map_or("∞".to_owned(), |x| format!("{x:.2}")));
        let ssim = view["ssim"].as_f64().map_or("–".to_owned(), |ssim| format!("{ssim:.4}"));
        let name_shown = escaped(name);
        let _ = write!(rows, "<tr><td>{number}</td><td>{name_shown}</td><td>{psnr}</td><td>{ssim}</td></tr>");
        let path = folder.image(&RunFolder::panel_name(number, name));
        if path.exists() {
            let caption = format!("{name_shown}: {psnr} dB, SSIM {ssim}");
            let picture = embedded(&path, &caption)?;
            figures += &strip(&picture, &PANEL, &caption, &format!(" data-psnr=\"{order}\""));
        }
    }
    let order = "<label>order <select id=\"order\"><option value=\"\">as they are</option><option value=\"1\">worst first</option>\
                 <option value=\"-1\">best first</option></select></label>";
    let pictures = match figures.is_empty() {
        true => String::new(),
        false => format!(
            "<p>Error is the absolute difference averaged over channels, black at 0, pale yellow at 0.25 and above. \
             Depth is red where near and blue where far. {order}</p>\n<div id=\"panels\">\n{figures}</div>\n"
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
    Ok(picture(&files::read(path)?, LARGEST, what))
}
