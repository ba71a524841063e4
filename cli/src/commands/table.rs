//! The table of the results of a sweep, scenes x methods, as Markdown, CSV and an HTML page.

mod csv;
pub mod figures;
mod html;
pub mod markdown;
mod thumbnail;

pub use figures::{Failure, Figures, Measured, Scores};
use plenoxel::error::Result;
use plenoxel::files;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Name of the row of means.
const MEAN: &str = "mean";

/// Results of runs, by scene and method.
#[derive(Debug)]
pub struct RunTable {
    /// Heading of the table.
    pub title: String,
    /// Names of the columns.
    pub methods: Vec<String>,
    /// One row per scene, with one cell per method.
    pub rows: Vec<Row>,
    /// Columns with published results.
    pub published: Vec<Published>,
    /// Published results for other scenes, which are only listed in the notes.
    pub elsewhere: Vec<Published>,
}

/// Results of all methods for a scene.
#[derive(Debug)]
pub struct Row {
    pub scene: String,
    pub cells: Vec<Cell>,
}

/// Result of a method for a scene.
#[derive(Debug)]
pub enum Cell {
    Measured(Box<Measured>),
    Failed(Failure),
    /// The run is not part of the sweep, or has not ended.
    Missing,
}

/// Published results, by scene.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Published {
    /// Name of the method.
    pub name: String,
    /// Publication, and what was measured.
    pub source: String,
    /// PSNR in dB.
    #[serde(default)]
    pub psnr: BTreeMap<String, f64>,
    #[serde(default)]
    pub ssim: BTreeMap<String, f64>,
    /// Seconds of training.
    #[serde(default)]
    pub seconds: BTreeMap<String, f64>,
}

impl Published {
    /// The scenes with results.
    pub fn scenes(&self) -> BTreeSet<&String> {
        [&self.psnr, &self.ssim, &self.seconds].into_iter().flat_map(BTreeMap::keys).collect()
    }

    /// The results for a scene.
    fn scores(&self, scene: &str) -> Scores {
        let of = |figures: &BTreeMap<String, f64>| figures.get(scene).copied();
        Scores { psnr: of(&self.psnr), ssim: of(&self.ssim), seconds: of(&self.seconds) }
    }
}

impl RunTable {
    /// Writes `table.md`, `table.csv` and `table.html` into a folder, and returns the Markdown.
    pub fn write(&self, folder: &Path) -> Result<String> {
        let markdown = markdown::text(self);
        for (name, text) in [("table.md", &markdown), ("table.csv", &csv::text(self)), ("table.html", &html::text(self))] {
            files::write_atomically(&folder.join(name), text.as_bytes())?;
        }
        Ok(markdown)
    }

    /// The rows below several scenes: a name, a statistic of each method, and one of each column with published results.
    fn summaries(&self) -> Vec<(&'static str, Vec<Scores>, Vec<Scores>)> {
        if self.rows.len() < 2 {
            return Vec::new();
        }
        let row = |name, of: fn(&[f64]) -> f64| {
            let measured = (0..self.methods.len()).map(|method| Scores::over(self.rows.iter().map(|row| row.scores(method)), of));
            let published = self.published.iter().map(|p| Scores::over(self.rows.iter().map(|row| p.scores(&row.scene)), of));
            (name, measured.collect(), published.collect())
        };
        vec![row(MEAN, figures::mean), row("standard deviation", figures::deviation)]
    }

    /// Notes below the table.
    fn notes(&self) -> Vec<String> {
        let mut notes = vec![
            "PSNR in dB on test views, SSIM, and seconds of training or carving; means and standard deviations are over all scenes, and are left out if \
             a scene is missing."
                .to_owned(),
        ];
        for row in &self.rows {
            notes.extend(self.views_of(row));
        }
        for (row, (method, cell)) in self.rows.iter().flat_map(|row| self.methods.iter().zip(&row.cells).map(move |cell| (row, cell))) {
            if let Cell::Failed(failure) = cell {
                notes.push(format!("{}, {method}: failed with exit code {}: {}", row.scene, failure.code, failure.error));
            }
        }
        notes.extend(self.published.iter().map(|p| format!("{}: published, not measured here: {}", p.name, p.source)));
        notes.extend(self.elsewhere.iter().map(|p| {
            let scenes: Vec<&str> = p.scenes().into_iter().map(String::as_str).collect();
            format!("{}: published for other scenes ({}), not shown: {}", p.name, scenes.join(", "), p.source)
        }));
        notes
    }

    /// The test views of a scene; for each method, if they differ.
    fn views_of(&self, row: &Row) -> Option<String> {
        let first = row.cells.iter().find_map(Cell::measured)?;
        if row.is_comparable() {
            return Some(format!("{}: {}.", row.scene, first.views()));
        }
        let measured = self.methods.iter().zip(&row.cells).filter_map(|(method, cell)| Some((method, cell.measured()?)));
        let each: Vec<String> = measured.map(|(method, measured)| format!("{method}, {}", measured.views())).collect();
        Some(format!("{}: {}; these results are not comparable.", row.scene, each.join("; ")))
    }
}

impl Row {
    /// The scores of a method.
    fn scores(&self, method: usize) -> Scores {
        self.cells.get(method).map(Cell::scores).unwrap_or_default()
    }

    /// True if all methods were evaluated on the same number of views, of the same size and with the same background.
    fn is_comparable(&self) -> bool {
        let mut views = self.cells.iter().filter_map(Cell::measured).map(Measured::views);
        let first = views.next();
        views.all(|views| Some(views) == first)
    }
}

impl Cell {
    fn measured(&self) -> Option<&Measured> {
        match self {
            Cell::Measured(measured) => Some(measured),
            _ => None,
        }
    }

    fn scores(&self) -> Scores {
        self.measured().map(|measured| measured.figures.scores()).unwrap_or_default()
    }
}

/// Formats a figure; a dash if it is missing.
fn said(value: Option<f64>, say: impl Fn(f64) -> String) -> String {
    value.map_or("–".to_owned(), say)
}

fn decibels(psnr: Option<f64>) -> String {
    said(psnr, |psnr| format!("{psnr:.2}"))
}

/// Formats SSIM and time, which follow the PSNR.
fn beside(scores: &Scores) -> String {
    let seconds = |s: f64| if s < 9.95 { format!("{s:.1} s") } else { format!("{s:.0} s") };
    format!("{} · {}", said(scores.ssim, |ssim| format!("{ssim:.3}")), said(scores.seconds, seconds))
}

#[cfg(test)]
mod tests;
