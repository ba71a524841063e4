//! The pictures of a run: one view at the end of each stage, and panels of test views.

use crate::images::{self, DepthRange, Rgb};
use plenoxel::camera::Camera;
use plenoxel::dataset::{Dataset, Split, View, image};
use plenoxel::error::Result;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::render::picture::Picture;
use plenoxel::run::evaluation::Viewer;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::metrics::History;
use plenoxel::train::PlannedStage;
use plenoxel::model::plenoxels::config::Config;
use std::path::PathBuf;

/// Panels of more views than this fill folders and nobody's eye.
const MOST_PANELS: usize = 25;

/// The pictures of a run.
pub struct Pictures<'a> {
    folder: &'a RunFolder,
    config: &'a Config,
    /// Of the first test view, or of the first training view where there is none. Its photograph is not looked at in training.
    camera: Option<Camera>,
    /// Test views that get a panel.
    panels: Vec<usize>,
    views: usize,
    stages: Vec<Rgb>,
}

impl<'a> Pictures<'a> {
    /// Pictures for a run, or none at all.
    pub fn new(folder: &'a RunFolder, config: &'a Config, dataset: &Dataset, wanted: bool) -> Result<Self> {
        let views = dataset.count(Split::Test);
        let first = |split| dataset.cameras(split).into_iter().next();
        if wanted {
            folder.create_images()?;
        }
        Ok(Pictures {
            folder,
            config,
            camera: first(Split::Test).or(first(Split::Train)).filter(|_| wanted),
            panels: match wanted {
                true => images::evenly_spaced(views, MOST_PANELS),
                false => Vec::new(),
            },
            views,
            stages: Vec::new(),
        })
    }

    /// From where pictures of the stages are taken, if there are any.
    pub fn camera(&self) -> Option<Camera> {
        self.camera
    }

    /// A stage has ended with this grid.
    pub fn stage(&mut self, stage: usize, grid: &VoxelGrid<f32>) -> Result<()> {
        let Some(camera) = &self.camera else {
            return Ok(());
        };
        let viewer = Viewer::new(grid, self.config.evaluation, self.config);
        let picture = viewer.see(camera).rgb;
        images::write(&self.stage_path(stage, grid.shape().resolution), &picture)?;
        self.stages.push(picture);
        Ok(())
    }

    /// Stages had ended when the run was interrupted: their pictures are there, if they were wanted then too; one that cannot be read is left out.
    pub fn earlier_stages(&mut self, past: &History, plan: &[PlannedStage]) {
        for (index, planned) in past.stages.iter().filter_map(|&(index, _)| Some((index, plan.get(index)?))) {
            if self.camera.is_some()
                && let Ok(picture) = image::read(&self.stage_path(index, planned.stage.resolution))
            {
                self.stages.push(image::composite(&picture, self.config.background));
            }
        }
    }

    fn stage_path(&self, stage: usize, resolution: usize) -> PathBuf {
        self.folder.image(&format!("stage_{}_{resolution}.png", stage + 1))
    }

    /// A test view was rendered with the final grid, which fills a cube of a half width.
    pub fn panel(&self, number: usize, view: &View, target: &Rgb, picture: &Picture, half_width: f64) -> Result<()> {
        if !self.panels.contains(&number) {
            return Ok(());
        }
        let range = DepthRange::of(&view.camera, half_width);
        images::write(&self.folder.image(&RunFolder::panel_name(number, &view.name)), &images::panel(target, picture, range))
    }

    /// The stages side by side, and the photograph they are to become.
    pub fn strip(&self, first_test: Option<&View>, background: [f32; 3]) -> Result<()> {
        if self.stages.is_empty() {
            return Ok(());
        }
        let target = first_test.map(|view| view.composite(background));
        let all: Vec<&Rgb> = self.stages.iter().chain(&target).collect();
        images::write(&self.folder.image("stages.png"), &images::strip(&all))
    }

    /// What is to be said about views without a picture.
    pub fn note(&self) -> Option<String> {
        let shown = self.panels.len();
        (shown > 0 && shown < self.views)
            .then(|| format!("images: panels of {shown} of the {} test views, evenly spaced; all of them are in the figures", self.views))
    }
}
