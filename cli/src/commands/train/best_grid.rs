//! `best.safetensors`: of the grids that a run saved, the one that showed validation views best, as long as the last is not better.

use crate::progress::Console;
use plenoxel::checkpoint::Header;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::metrics::History;

/// The best grid that was saved so far. Nothing that goes wrong with it stops a run.
pub struct BestGrid<'a, 'c> {
    folder: &'a RunFolder,
    console: &'a Console<'c>,
    /// Mean PSNR of validation views that it shows, if there is one.
    psnr: Option<f64>,
}

impl<'a, 'c> BestGrid<'a, 'c> {
    /// That of a run, with what its lines tell of it.
    pub fn of(folder: &'a RunFolder, past: &History, console: &'a Console<'c>) -> Self {
        let step = folder.best_step().and_then(|taken| taken.checked_sub(1));
        BestGrid { folder, console, psnr: step.and_then(|step| past.validation.get(&step)).copied() }
    }

    /// A grid is saved. If it shows validation views better than the best, or as well, it is written.
    pub fn saved(&mut self, psnr: Option<f64>, grid: &VoxelGrid<f32>, header: &Header) {
        if psnr.is_some() && psnr >= self.psnr {
            match self.folder.save_best(grid, header) {
                Ok(()) => self.psnr = psnr,
                Err(e) => self.console.note(&format!("the best grid is not saved: {e}")),
            }
        }
    }

    /// The last grid is written, and shows validation views so well. If it is the best, no other is kept.
    pub fn conclude(&self, last: Option<f64>) {
        let shown = "best.safetensors, which evaluate, render and export take with --best";
        match (self.psnr, last) {
            (Some(best), Some(last)) if best > last => {
                let found = format!("an earlier grid shows validation views better, {best:.2} dB instead of {last:.2} dB");
                self.console.note(&format!("{found}: {shown}"));
            }
            (Some(best), None) => {
                self.console.note(&format!("validation views were not looked at in the end; {best:.2} dB has {shown}"));
            }
            _ => {
                if let Err(e) = self.folder.remove_best() {
                    self.console.note(&e.to_string());
                }
            }
        }
    }
}
