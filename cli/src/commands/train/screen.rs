//! Output of a training run: progress, the loss curve, pictures, and the report at the end.

use super::pictures::Pictures;
use super::say;
use crate::commands::new_run::{announce, loading};
use crate::curves::loss_svg;
use crate::images;
use crate::progress::{Console, Count, Training};
use crate::report::Report;
use plenoxel::error::Result;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::training::{Event, Finished};
use plenoxel::train::PlannedStage;

/// A listener that prints the events of a run and writes its pictures.
pub struct Screen<'c, 'a> {
    console: &'c Console<'a>,
    draws: bool,
    reports: bool,
    count: Option<Count<'c, 'a>>,
    progress: Option<Training<'c, 'a>>,
    pictures: Option<Pictures>,
    folder: Option<RunFolder>,
    plan: Vec<PlannedStage>,
    /// The first error of printing or of writing the report.
    failure: Result<()>,
}

impl<'c, 'a> Screen<'c, 'a> {
    /// Creates the listener. It writes pictures if `draws` is true, and the report if `reports` is true.
    pub fn new(console: &'c Console<'a>, draws: bool, reports: bool) -> Self {
        Screen { console, draws, reports, count: None, progress: None, pictures: None, folder: None, plan: Vec::new(), failure: Ok(()) }
    }

    /// Handles an event. If a picture cannot be written, the run continues with a note.
    pub fn show(&mut self, event: Event<'_>) {
        let console = self.console;
        match event {
            Event::Note(text) => console.note(&text),
            Event::Opened { dataset, config } => announce(console, dataset, config),
            Event::Loading { split, source, done, total } => {
                self.count.get_or_insert_with(|| console.count(&loading(split, source), total)).at(done, total);
                if done == total {
                    self.count = None;
                }
            }
            Event::Carving { done, total } => {
                const WHAT: &str = "computing the visual hull, view";
                match &self.progress {
                    Some(training) => training.count(WHAT, done, total),
                    None => self.count.get_or_insert_with(|| console.count(WHAT, total)).at(done, total),
                }
            }
            Event::Started { run, plan, test_views, history } => {
                self.count = None;
                self.plan = plan.to_vec();
                let pictures = console.drawn(Pictures::new(run, test_views, self.draws));
                self.pictures = pictures.map(|pictures| pictures.after(history, plan));
                let (width, height) = run.dataset.size();
                self.progress = Some(console.training(plan, (test_views * width * height) as f64, history.seconds));
                self.folder = Some(run.folder.clone());
            }
            Event::Planned { plan } => {
                self.plan = plan.to_vec();
                if let Some(progress) = &mut self.progress {
                    progress.replace_plan(plan);
                }
            }
            Event::Initial { stage, see } => {
                if let Some(pictures) = &mut self.pictures {
                    console.drawn(pictures.initial(&stage, see));
                }
            }
            Event::Step { report, observation, .. } => {
                if let Some(progress) = &mut self.progress {
                    progress.step(report, observation);
                }
            }
            Event::StageEnded { stage, losses, see } => {
                console.drawn(self.draw_loss(losses));
                if let Some(pictures) = &mut self.pictures {
                    console.drawn(pictures.stage(&stage, see));
                }
            }
            Event::Preview { step, ends_stage, picture, target, metrics } => {
                let Some(folder) = &self.folder else { return };
                let path = folder.image("preview.png");
                let picture = target.map_or_else(|| picture.clone(), |target| images::strip(&[target, picture]));
                let written = console.drawn(images::write(&path, &picture));
                if ends_stage && written.is_some() {
                    let (height, width, _) = picture.dim();
                    console.drawn(metrics.picture(step, (width, height), &path));
                }
            }
            Event::Saved { .. } => {}
            Event::Failed { losses } => drop(console.drawn(self.draw_loss(losses))),
            Event::Trained => self.progress = None,
            Event::Evaluating { done, total } => {
                self.count.get_or_insert_with(|| console.count("evaluating", total)).at(done, total);
            }
            Event::Compared { number, view, target, picture, half_width } => {
                if let Some(pictures) = &self.pictures {
                    console.drawn(pictures.panels.draw(number, view, target, picture, half_width));
                }
            }
            Event::Evaluated { summary, run } => {
                self.count = None;
                let pictures = self.pictures.as_ref();
                pictures.map(|pictures| console.drawn(pictures.strip(run.test.first(), run.config.background)));
                let note = pictures.and_then(|pictures| pictures.panels.note());
                let said = say(console, summary, note.as_deref());
                let reported = said.and_then(|()| if self.reports { self.report(run) } else { Ok(()) });
                self.failure = std::mem::replace(&mut self.failure, Ok(())).and(reported);
            }
        }
    }

    /// Ends the output.
    ///
    /// Errors: the result could not be printed, or the report could not be written.
    pub fn finish(self) -> Result<()> {
        self.failure
    }

    fn report(&self, run: Finished<'_>) -> Result<()> {
        let Finished { folder, config, record, dataset, model, .. } = run;
        self.console.note(&Report { folder, config, record, dataset, model: Some(model) }.write(self.console)?);
        Ok(())
    }

    fn draw_loss(&self, losses: &[f64]) -> Result<()> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let title = format!("Training loss of {}", folder.path().file_name().unwrap_or_default().display());
        folder.write_loss(&loss_svg(losses, &self.plan, &title))
    }
}
