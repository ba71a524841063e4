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
            let _ = writeln!(figures, "<figure data-psnr=\"{order}\">{picture}<figcaption>{caption}</figcaption></figure>");
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
    Ok(picture(&files::read(path)?, LARGEST, what))
}
