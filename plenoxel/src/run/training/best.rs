//! `best.safetensors`: the saved model with the best validation PSNR, as long as the last one is not better.

use super::{Event, Listener};
use crate::run::folder::RunFolder;
use crate::run::metrics::History;
use crate::train::{About, Model};

/// The best model that was saved so far. Nothing that goes wrong with it stops a run.
pub struct BestModel<'a> {
    folder: &'a RunFolder,
    /// Its mean PSNR of validation views, if there is one.
    psnr: Option<f64>,
}

impl<'a> BestModel<'a> {
    /// The best model in a folder, with what the lines of the run tell of it.
    pub fn of(folder: &'a RunFolder, past: &History) -> Self {
        let step = folder.best_step().and_then(|taken| taken.checked_sub(1));
        BestModel { folder, psnr: step.and_then(|step| past.validation.get(&step)).copied() }
    }

    /// Writes a model whose state was saved, if its validation PSNR is at least the best.
    pub fn saved(&mut self, psnr: Option<f64>, model: &impl Model<f32>, about: &About, on: &mut Listener<'_>) {
        if psnr.is_some() && psnr >= self.psnr {
            match self.folder.save_best(model, about) {
                Ok(()) => self.psnr = psnr,
                Err(e) => on(Event::note(format!("the best checkpoint is not saved: {e}"))),
            }
        }
    }

    /// Removes the best model if the last one, with this validation PSNR, is at least as good.
    pub fn conclude(&self, last: Option<f64>, on: &mut Listener<'_>) {
        let shown = "best.safetensors, which evaluate, render and export take with --best";
        match (self.psnr, last) {
            (Some(best), Some(last)) if best > last => {
                let found = format!("an earlier checkpoint shows validation views better, {best:.2} dB instead of {last:.2} dB");
                on(Event::note(format!("{found}: {shown}")));
            }
            (Some(best), None) => {
                on(Event::note(format!("validation views were not looked at in the end; {best:.2} dB has {shown}")));
            }
            _ => {
                if let Err(e) = self.folder.remove_best() {
                    on(Event::note(e.to_string()));
                }
            }
        }
    }
}
