//! A run that is watched while it is trained: its figures and curves, pictures between its steps, and requests to save or stop.

use super::order::{Order, Studio};
use super::server::{Door, Server};
use super::site::{Scene, Site};
use super::studio;
use crate::curves::{loss_svg, psnr_svg};
use crate::interrupt;
use crate::progress::Console;
use plenoxel::error::Result;
use plenoxel::evaluate::Viewer;
use plenoxel::run::metrics::Observation;
use plenoxel::run::training::{Event, Underway};
use plenoxel::train::{Model, PlannedStage, Report, ViewOptions};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Seconds of a picture that is rendered without waiting for a turn: one in motion.
const QUICK: f64 = 0.15;

/// Figures of a run for visitors, and their requests.
#[derive(Default)]
pub struct Training {
    figures: Mutex<Figures>,
    wants_checkpoint: AtomicBool,
}

/// Figures of a run.
#[derive(Default)]
struct Figures {
    plan: Vec<PlannedStage>,
    /// Loss and PSNR in dB of each step. Those of the steps before the run was resumed may be NaN.
    losses: Vec<f64>,
    psnr: Vec<f64>,
    /// PSNR of validation views, with the number of the step.
    validation: Vec<(f64, f64)>,
    facts: Vec<(&'static str, f64)>,
    seconds: f64,
    /// Number of steps in the last checkpoint.
    saved: Option<u64>,
    /// The run folder.
    folder: String,
    state: State,
}

#[derive(Clone, Copy, Default, PartialEq, Eq)]
enum State {
    #[default]
    Training,
    Stopping,
    /// Stopped before its last step.
    Stopped,
    Done,
}

impl Training {
    fn figures(&self) -> MutexGuard<'_, Figures> {
        self.figures.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Figures for the page.
    pub fn status(&self) -> Value {
        let figures = self.figures();
        let finite = |x: Option<&f64>| x.copied().filter(|x| x.is_finite());
        let message = match figures.state {
            State::Training => String::new(),
            State::Stopping => format!("saving and stopping; resume with: plenoxel train --resume {}", figures.folder),
            State::Stopped => format!("the training has stopped; resume with: plenoxel train --resume {}", figures.folder),
            State::Done => format!("the training has ended; look at the scene with: plenoxel view {}", figures.folder),
        };
        json!({
            "step": figures.losses.len(),
            "steps": figures.plan.iter().map(|stage| stage.steps).sum::<u64>(),
            "loss": finite(figures.losses.last()),
            "psnr": finite(figures.psnr.last()),
            "validation_psnr": finite(figures.validation.last().map(|(_, psnr)| psnr)),
            "facts": figures.facts,
            "seconds": figures.seconds,
            "saved": figures.saved,
            "goes_on": figures.state == State::Training,
            "message": message,
        })
    }

    /// Draws the loss over the steps.
    pub fn loss(&self) -> String {
        let (losses, plan) = {
            let figures = self.figures();
            (figures.losses.clone(), figures.plan.clone())
        };
        loss_svg(&losses, &plan, "Loss")
    }

    /// Draws the PSNR over the steps.
    pub fn psnr(&self) -> String {
        let (psnr, validation, plan) = {
            let figures = self.figures();
            (figures.psnr.clone(), figures.validation.clone(), figures.plan.clone())
        };
        psnr_svg(&psnr, validation, &plan)
    }

    /// Stops the run, as Ctrl-C does.
    pub fn stop(&self) {
        let mut figures = self.figures();
        if figures.state == State::Training {
            figures.state = State::Stopping;
            interrupt::request();
        }
    }

    /// Asks for a checkpoint after the next step.
    pub fn ask_for_checkpoint(&self) {
        self.wants_checkpoint.store(true, SeqCst);
    }

    /// True if a checkpoint was asked for since the last call.
    pub fn wants_checkpoint(&self) -> bool {
        self.wants_checkpoint.swap(false, SeqCst)
    }
}

/// A listener that shows a run in training on a page. Pictures are rendered on the thread of the training, between its steps.
pub struct LiveTraining<'c, 'a> {
    console: &'c Console<'a>,
    shared: Arc<Training>,
    door: Option<Door>,
    /// Renders until the training ends.
    studio: Option<Studio>,
    server: Option<Server>,
    background: [f32; 3],
    /// The training has its turn until then.
    rests: Instant,
    /// An order that waits for its turn.
    waiting: Option<Order>,
    /// Seconds per pixel of the last picture.
    pace: f64,
    /// The first error.
    failure: Result<()>,
}

impl<'c, 'a> LiveTraining<'c, 'a> {
    pub fn new(door: Door, console: &'c Console<'a>) -> Self {
        LiveTraining {
            console,
            shared: Arc::default(),
            door: Some(door),
            studio: None,
            server: None,
            background: [0.0; 3],
            rests: Instant::now(),
            waiting: None,
            pace: 0.0,
            failure: Ok(()),
        }
    }

    /// Figures and requests that the server shares.
    pub fn shared(&self) -> Arc<Training> {
        self.shared.clone()
    }

    /// Handles an event.
    pub fn hear(&mut self, event: &Event<'_>) {
        match *event {
            Event::Started { run, plan, history, .. } => {
                let mut figures = self.shared.figures();
                figures.plan = plan.to_vec();
                figures.losses.clone_from(&history.losses);
                figures.psnr = vec![f64::NAN; history.losses.len()];
                figures.validation = history.validation.iter().map(|(step, psnr)| (*step as f64, *psnr)).collect();
                figures.seconds = history.seconds;
                figures.folder = run.folder.path().display().to_string();
                drop(figures);
                self.failure = self.start(&run);
            }
            Event::Planned { plan } => self.shared.figures().plan = plan.to_vec(),
            Event::Step { report, observation, model } => self.step(report, observation, model),
            Event::Saved { steps } => self.shared.figures().saved = Some(steps),
            Event::Trained => {
                // Waiting visitors are told.
                (self.studio, self.waiting) = (None, None);
                let mut figures = self.shared.figures();
                figures.state = if interrupt::requested() { State::Stopped } else { State::Done };
            }
            _ => {}
        }
    }

    /// Opens the page.
    fn start(&mut self, run: &Underway<'_>) -> Result<()> {
        let Some(door) = self.door.take() else { return Ok(()) };
        self.background = run.config.background;
        let title = format!("{} – training", run.folder.path().file_name().unwrap_or_default().to_string_lossy());
        let (desk, studio) = studio();
        self.studio = Some(studio);
        let address = door.address();
        self.server = Some(door.serve(Site::new(&Scene::of(title, run.dataset), desk, Some(self.shared.clone())))?);
        self.console.result(&format!("view: {address}"))
    }

    fn step(&mut self, report: &Report, observation: &Observation, model: &dyn Model<f32>) {
        let mut figures = self.shared.figures();
        figures.losses.push(report.loss);
        figures.psnr.push(report.psnr);
        figures.validation.extend(observation.validation_psnr.map(|psnr| (report.step as f64, psnr)));
        if figures.facts != observation.facts {
            figures.facts.clone_from(&observation.facts);
        }
        figures.seconds = observation.seconds;
        drop(figures);
        self.draw(model);
    }

    /// Fills an order, if there is one: at once if that is quick, otherwise if the training has had its turn, as much time as the last picture took.
    fn draw(&mut self, model: &dyn Model<f32>) {
        let Some(studio) = &self.studio else { return };
        let waiting = self.waiting.take().filter(|order| !order.is_cancelled());
        let Some(order) = waiting.or_else(|| studio.next(Duration::ZERO)) else { return };
        let (start, pixels) = (Instant::now(), order.pixels() as f64);
        if start < self.rests && pixels * self.pace > QUICK {
            self.waiting = Some(order);
            return;
        }
        let aabb = model.aabb();
        let viewer = Viewer::of(model, &ViewOptions::over(self.background));
        if order.fill_with(0.5 * (aabb.max - aabb.min).max_element(), &viewer).is_some() {
            self.pace = start.elapsed().as_secs_f64() / pixels;
        }
        self.rests = Instant::now() + start.elapsed();
    }

    /// Closes the page.
    ///
    /// Errors: it could not be opened, or its address could not be printed.
    pub fn finish(self) -> Result<()> {
        self.failure
    }
}
