//! Panels of test views in a run folder: target, render, error and depth of some of them.

use crate::images::{self, DepthRange, Rgb};
use plenoxel::dataset::View;
use plenoxel::error::Result;
use plenoxel::render::picture::Picture;
use plenoxel::run::evenly_spaced;
use plenoxel::run::folder::RunFolder;

/// Largest number of panels.
const MOST: usize = 25;

/// Writes the panels of a run.
pub struct Panels {
    folder: RunFolder,
    /// Indices of the test views with a panel.
    chosen: Vec<usize>,
    views: usize,
}

impl Panels {
    /// Chooses the test views with a panel among `views`; none unless they are wanted.
    pub fn new(folder: &RunFolder, views: usize, wanted: bool) -> Self {
        let chosen = if wanted { evenly_spaced(views, MOST) } else { Vec::new() };
        Panels { folder: folder.clone(), chosen, views }
    }

    /// Writes the panel of a test view, if it has one. `half_width` is that of the box of the model.
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
            .then(|| format!("wrote panels of {shown} of the {} test views, evenly spaced; the results are of all test views", self.views))
    }
}
