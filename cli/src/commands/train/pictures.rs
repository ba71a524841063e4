//! The pictures of a run: one view before the first step and at the end of each stage, and panels of test views.

use crate::commands::panels::Panels;
use crate::images::{self, Rgb};
use plenoxel::camera::Camera;
use plenoxel::dataset::{Split, View, image};
use plenoxel::error::Result;
use plenoxel::render::picture::Picture;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::metrics::History;
use plenoxel::run::training::Underway;
use plenoxel::train::PlannedStage;
use std::path::PathBuf;

/// The pictures of a run.
pub struct Pictures {
    folder: RunFolder,
    background: [f32; 3],
    /// Camera of the pictures of stages: that of the first test view, or of the first training view if there are no test views. Training does not read the
    /// photograph of a test view.
    camera: Option<Camera>,
    /// Panels of test views.
    pub panels: Panels,
    /// Pictures of the view before the first step and after each stage.
    stages: Vec<Rgb>,
}

impl Pictures {
    /// Prepares the pictures of a run that is evaluated on `views` test views; draws none unless they are wanted.
    pub fn new(run: Underway<'_>, views: usize, wanted: bool) -> Result<Self> {
        let first = |split| run.dataset.cameras(split).into_iter().next();
        if wanted {
            run.folder.create_images()?;
        }
        Ok(Pictures {
            folder: run.folder.clone(),
            background: run.config.background,
            camera: first(Split::Test).or(first(Split::Train)).filter(|_| wanted),
            panels: Panels::new(run.folder, views, wanted),
            stages: Vec::new(),
        })
    }

    /// Adds the pictures of the stages before the run was interrupted. Missing and unreadable pictures are left out.
    pub fn after(mut self, past: &History, plan: &[PlannedStage]) -> Self {
        if past.losses.is_empty() || self.camera.is_none() {
            return self;
        }
        let first = plan.first().map(|stage| (0, stage));
        let ended = past.stages.iter().filter_map(|&(index, _)| Some((index + 1, plan.get(index)?)));
        for (number, stage) in first.into_iter().chain(ended) {
            if let Ok(picture) = image::read(&self.stage_path(number, stage)) {
                self.stages.push(image::composite(&picture, self.background));
            }
        }
        self
    }

    /// Draws the model before its first step; `see` renders it.
    pub fn initial(&mut self, stage: &PlannedStage, see: &dyn Fn(&Camera) -> Picture) -> Result<()> {
        self.draw(0, stage, see)
    }

    /// Draws the model at the end of a stage; `see` renders it.
    pub fn stage(&mut self, stage: &PlannedStage, see: &dyn Fn(&Camera) -> Picture) -> Result<()> {
        self.draw(stage.index + 1, stage, see)
    }

    fn draw(&mut self, number: usize, stage: &PlannedStage, see: &dyn Fn(&Camera) -> Picture) -> Result<()> {
        let Some(camera) = &self.camera else {
            return Ok(());
        };
        let picture = see(camera).rgb;
        images::write(&self.stage_path(number, stage), &picture)?;
        self.stages.push(picture);
        Ok(())
    }

    fn stage_path(&self, number: usize, stage: &PlannedStage) -> PathBuf {
        self.folder.image(&RunFolder::stage_name(number, stage.resolution))
    }

    /// Writes the strip of the pictures before the first step and of all stages, followed by the photograph.
    pub fn strip(&self, first_test: Option<&View>, background: [f32; 3]) -> Result<()> {
        if self.stages.is_empty() {
            return Ok(());
        }
        let target = first_test.map(|view| view.composite(background));
        let all: Vec<&Rgb> = self.stages.iter().chain(&target).collect();
        images::write(&self.folder.image("stages.png"), &images::strip(&all))
    }
}
