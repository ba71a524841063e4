//! Panels of test views in a run folder: target, render, error and depth of some of them.

use crate::images::{self, DepthRange, Rgb};
use plenoxel::dataset::View;
use plenoxel::error::Result;
use plenoxel::render::picture::Picture;
use plenoxel::run::evenly_spaced;
use plenoxel::run::folder::RunFolder;

/// Panels of more views than this fill folders and nobody's eye.
const MOST: usize = 25;

/// The test views of a run that get a panel.
pub struct Panels {
    folder: RunFolder,
    chosen: Vec<usize>,
    views: usize,
}

impl Panels {
    /// Panels of some of so many test views, or none at all.
    pub fn new(folder: &RunFolder, views: usize, wanted: bool) -> Self {
        let chosen = if wanted { evenly_spaced(views, MOST) } else { Vec::new() };
        Panels { folder: folder.clone(), chosen, views }
    }

    /// A test view was rendered with a model whose box has a half width.
    pub fn draw(&self, number: usize, view: &View, target: &Rgb, picture: &Picture, half_width: f64) -> Result<()> {
        if !self.chosen.contains(&number) {
            return Ok(());
        }
        let range = DepthRange::of(&view.camera, half_width);
        images::write(&self.folder.image(&RunFolder::panel_name(number, &view.name)), &images::panel(target, picture, range))
    }

    /// A note about views without a picture.
    pub fn note(&self) -> Option<String> {
        let shown = self.chosen.len();
        (shown > 0 && shown < self.views)
            .then(|| format!("images: panels of {shown} of the {} test views, evenly spaced; all of them are in the figures", self.views))
    }
}
