//! `best.safetensors`: the checkpoint with the best validation PSNR, unless the last model is at least as good.

use super::{Event, Listener};
use crate::run::folder::RunFolder;
use crate::run::metrics::History;
use crate::train::{About, Model};

/// The checkpoint with the best validation PSNR so far. Its errors do not stop a run.
pub struct BestModel<'a> {
    folder: &'a RunFolder,
    /// Its mean validation PSNR, if there is one.
    psnr: Option<f64>,
}

impl<'a> BestModel<'a> {
    /// The best checkpoint in a folder; its PSNR is read from the metrics.
    pub fn of(folder: &'a RunFolder, past: &History) -> Self {
        let step = folder.best_step().and_then(|taken| taken.checked_sub(1));
        BestModel { folder, psnr: step.and_then(|step| past.validation.get(&step)).copied() }
    }

    /// Returns true if there is a best checkpoint whose PSNR is known.
    pub fn is_kept(&self) -> bool {
        self.psnr.is_some()
    }

    /// Writes the model as the best checkpoint if its validation PSNR is at least the best so far.
    pub fn saved(&mut self, psnr: Option<f64>, model: &impl Model<f32>, about: &About, on: &mut Listener<'_>) {
        if psnr.is_some() && psnr >= self.psnr {
            match self.folder.save_best(model, about) {
                Ok(()) => self.psnr = psnr,
                Err(e) => on(Event::note(format!("the best checkpoint was not saved: {e}"))),
            }
        }
    }

    /// Removes the best checkpoint if the last model, with this validation PSNR, is at least as good.
    pub fn conclude(&self, last: Option<f64>, on: &mut Listener<'_>) {
        let shown = "it is best.safetensors; evaluate, render and export use it with --best";
        match (self.psnr, last) {
            (Some(best), Some(last)) if best > last => {
                let found = format!("an earlier checkpoint has a better validation PSNR, {best:.2} dB instead of {last:.2} dB");
                on(Event::note(format!("{found}: {shown}")));
            }
            (Some(best), None) => {
                on(Event::note(format!(
                    "the validation PSNR of the last model was not measured; the best checkpoint has {best:.2} dB: {shown}"
                )));
            }
            _ => {
                if let Err(e) = self.folder.remove_best() {
                    on(Event::note(e.to_string()));
                }
            }
        }
    }
}
