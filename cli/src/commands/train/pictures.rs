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
    /// Of the first test view, or of the first training view where there is none. Its photograph is not looked at in training.
    camera: Option<Camera>,
    /// Those of test views.
    pub panels: Panels,
    /// The view before the first step and after each stage.
    stages: Vec<Rgb>,
}

impl Pictures {
    /// Pictures for a run that is compared with so many test views, or none at all.
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

    /// Adds the pictures that were drawn before the run was interrupted, if they were wanted then too; one that cannot be read is left out.
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

    /// The model that `see` renders has not taken a step yet.
    pub fn initial(&mut self, stage: &PlannedStage, see: &dyn Fn(&Camera) -> Picture) -> Result<()> {
        self.draw(0, stage, see)
    }

    /// A stage has ended with a model that `see` renders.
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

    /// The start and the stages side by side, and the photograph they are to become.
    pub fn strip(&self, first_test: Option<&View>, background: [f32; 3]) -> Result<()> {
        if self.stages.is_empty() {
            return Ok(());
        }
        let target = first_test.map(|view| view.composite(background));
        let all: Vec<&Rgb> = self.stages.iter().chain(&target).collect();
        images::write(&self.folder.image("stages.png"), &images::strip(&all))
    }
}
