//! Renderings of the same test views by several runs.

use super::Run;
use crate::html::{enlarged, escaped, picture};
use crate::images;
use crate::report::pictures::LARGEST;
use plenoxel::dataset::image as files;
use plenoxel::error::{Error, Result};
use plenoxel::run::evenly_spaced;
use plenoxel::run::folder::RunFolder;
use std::path::Path;

/// Largest number of views.
const MOST: usize = 8;

/// Indices of the pictures in a panel.
const TARGET: usize = 0;
const RENDER: usize = 1;
const ERROR: usize = 2;

/// The section with the test views for which every run has a panel: the photograph, and the rendering and error of each run. Empty without such views.
pub fn section(runs: &[Run]) -> Result<String> {
    let views: Vec<Vec<(String, f64)>> = runs.iter().map(panels).collect::<Result<_>>()?;
    let has = |run: &Run, panel: &str| run.record.scene == runs[0].record.scene && run.folder.image(panel).exists();
    let shared = views[0].iter().map(|(panel, _)| panel).filter(|panel| runs.iter().all(|run| has(run, panel)));
    let shared: Vec<&String> = shared.collect();
    let mut page = String::new();
    for &i in &evenly_spaced(shared.len(), MOST) {
        let panel = shared[i];
        page +=
            &format!("<div class=\"views\"><figure>{}<figcaption>photograph</figcaption></figure>\n", part(&runs[0], panel, &[TARGET])?);
        for (run, views) in runs.iter().zip(&views) {
            let psnr = views.iter().find(|(known, _)| known == panel).map_or(String::new(), |(_, psnr)| format!(": {psnr:.2} dB"));
            let name = escaped(&run.name);
            page += &format!("<figure>{}<figcaption>{name}{psnr}</figcaption></figure>\n", part(run, panel, &[RENDER, ERROR])?);
        }
        page += "</div>\n";
    }
    if page.is_empty() {
        return Ok(page);
    }
    Ok(format!(
        "<section><h2>Test views</h2>\n<p>The rendering of each run, with its error below: black is 0, pale yellow is 0.25 or more.</p>\n{page}</section>"
    ))
}

/// File names and PSNR of the test views of a run.
fn panels(run: &Run) -> Result<Vec<(String, f64)>> {
    let result = run.folder.figures()?.unwrap_or_default();
    let views = result["per_view"].as_array().into_iter().flatten().enumerate();
    let named = views.filter_map(|(number, view)| Some((RunFolder::panel_name(number, view["name"].as_str()?), view["psnr"].as_f64()?)));
    Ok(named.collect())
}

/// Some pictures of a panel, one below the other.
fn part(run: &Run, panel: &str, parts: &[usize]) -> Result<String> {
    let path = run.folder.image(panel);
    let whole = files::read(&path)?;
    let (Some(width), Some(height)) = (run.figures.width, run.figures.height) else {
        let found = "result.json of this run is missing or damaged, so the size of its pictures is unknown";
        return Err(Error::input(run.folder.path(), found, "write it again with `plenoxel train --resume`"));
    };
    let mut all = String::new();
    for &number in parts {
        let Some(cut) = images::part(&whole, number, (width, height)) else { return Err(unlike(&path)) };
        all += &picture(&enlarged(&cut, LARGEST[1]), LARGEST, &format!("{} of {}", ["photograph", "render", "error"][number], run.name));
    }
    Ok(all)
}

fn unlike(path: &Path) -> Error {
    Error::input(path, "the size of this picture differs from that in result.json", "remove the picture, or train again")
}
