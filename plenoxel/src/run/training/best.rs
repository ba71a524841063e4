//! `best.safetensors`: the saved grid with the best validation PSNR, as long as the last grid is not better.

use super::{Event, Listener};
use crate::checkpoint::Header;
use crate::field::voxel_grid::VoxelGrid;
use crate::run::folder::RunFolder;
use crate::run::metrics::History;

/// The best grid that was saved so far. Nothing that goes wrong with it stops a run.
pub struct BestGrid<'a> {
    folder: &'a RunFolder,
    /// Its mean PSNR of validation views, if there is one.
    psnr: Option<f64>,
}

impl<'a> BestGrid<'a> {
    /// The best grid in a folder, with what the lines of the run tell of it.
    pub fn of(folder: &'a RunFolder, past: &History) -> Self {
        let step = folder.best_step().and_then(|taken| taken.checked_sub(1));
        BestGrid { folder, psnr: step.and_then(|step| past.validation.get(&step)).copied() }
    }

    /// Writes a grid whose state was saved, if its validation PSNR is at least the best.
    pub fn saved(&mut self, psnr: Option<f64>, grid: &VoxelGrid<f32>, header: &Header, on: &mut Listener<'_>) {
        if psnr.is_some() && psnr >= self.psnr {
            match self.folder.save_best(grid, header) {
                Ok(()) => self.psnr = psnr,
                Err(e) => on(Event::note(format!("the best grid is not saved: {e}"))),
            }
        }
    }

    /// Removes the best grid if the last grid, with this validation PSNR, is at least as good.
    pub fn conclude(&self, last: Option<f64>, on: &mut Listener<'_>) {
        let shown = "best.safetensors, which evaluate, render and export take with --best";
        match (self.psnr, last) {
            (Some(best), Some(last)) if best > last => {
                let found = format!("an earlier grid shows validation views better, {best:.2} dB instead of {last:.2} dB");
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
