//! `plenoxel compare`: compares runs in a table and in a page with curves and pictures.

mod pictures;

use super::table::Figures;
use super::table::markdown::as_text;
use crate::html::{self, escaped};
use crate::progress::{Console, is_stdout, thousands};
use crate::report::curves::{self, RunCurves};
use crate::report::{SCRIPT, STYLE};
use clap::{Args, ValueHint};
use plenoxel::error::Result;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::memory::bytes;
use plenoxel::run::metrics;
use plenoxel::run::settings;
use plenoxel::text::clock;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "\
Examples:
  plenoxel compare runs/lego-1 runs/lego-2         print a table and write compare.html
  plenoxel compare runs/lego-* --out lego.html

The page has the table, curves over steps and over seconds, the test views that all runs have rendered (rendering and error of each run), and \
the settings that differ. Runs of different scenes are compared without pictures.";

/// Compare runs in a table, and in a page with curves and pictures side by side
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub struct CompareArgs {
    /// Run folders to compare
    #[arg(required = true, value_name = "RUN", value_hint = ValueHint::DirPath)]
    runs: Vec<PathBuf>,

    /// HTML page to write, replacing an existing file
    #[arg(long, short, value_name = "FILE", help_heading = "Output", default_value = "compare.html", value_hint = ValueHint::FilePath)]
    out: PathBuf,
}

/// A run to compare.
struct Run {
    /// Path as given on the command line, which distinguishes runs of the same name.
    name: String,
    folder: RunFolder,
    config: Config,
    record: RunRecord,
    figures: Figures,
    curves: RunCurves,
}

impl Run {
    fn read(path: &Path, console: &Console<'_>) -> Result<Self> {
        let (folder, config, record) = RunFolder::open(path)?;
        let figures = Figures::of(&folder, &config)?.unwrap_or_default();
        let name = path.display().to_string();
        // The metrics of one run at a time: the curves take much less memory.
        let metrics = metrics::read(&folder.metrics())?;
        let curves = RunCurves::of(&name, &curves::lines(&folder, &metrics, console));
        Ok(Run { name, folder, config, record, figures, curves })
    }

    /// The cells of the table.
    fn facts(&self) -> [(&'static str, String); 11] {
        let Figures { psnr, ssim, views, seconds, voxels, resolution, rays, peak_memory_bytes, .. } = self.figures;
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
        [
            ("run", self.name.clone()),
            ("scene", self.record.scene.clone()),
            ("preset", or_dash(self.record.preset.clone())),
            ("PSNR", or_dash(psnr.map(|x| format!("{x:.2}")))),
            ("SSIM", or_dash(ssim.map(|x| format!("{x:.4}")))),
            ("views", or_dash(views.map(|n| n.to_string()))),
            ("time", or_dash(seconds.map(clock))),
            ("grid", or_dash(resolution.map(|n| format!("{n}³")))),
            ("voxels", or_dash(voxels.map(|n| thousands(n as u64)))),
            ("rays", or_dash(rays.map(thousands))),
            ("memory", or_dash(peak_memory_bytes.map(bytes))),
        ]
    }
}

/// Compares runs.
pub fn run(args: &CompareArgs, console: &Console<'_>) -> Result<()> {
    let runs: Vec<Run> = args.runs.iter().map(|path| Run::read(path, console)).collect::<Result<_>>()?;
    super::check_replaceable(&args.out, &runs.iter().map(|run| &run.folder).collect::<Vec<_>>(), None)?;
    let facts: Vec<_> = runs.iter().map(Run::facts).collect();
    let heads: Vec<&str> = facts.iter().take(1).flatten().map(|(name, _)| *name).collect();
    let cells: Vec<Vec<&str>> = facts.iter().map(|facts| facts.iter().map(|(_, value)| value.as_str()).collect()).collect();
    let parts = [
        format!("<section>{}</section>", table(&heads, &cells)),
        curves::side_by_side(runs.iter().map(|run| &run.curves)),
        pictures::section(&runs)?,
        settings(&runs),
        format!("<script>\n{SCRIPT}</script>\n"),
    ];
    let page = html::page(&format!("{} runs", runs.len()), STYLE, &parts.join("\n"));
    console.write_file(&args.out, page.as_bytes())?;
    if !is_stdout(&args.out) {
        console.text(&aligned(&heads, &cells))?;
    }
    console.wrote(&args.out, &format!("wrote {}", args.out.display()))
}

/// The section with the settings that differ.
fn settings(runs: &[Run]) -> String {
    let values: Vec<BTreeMap<String, String>> = runs.iter().map(|run| settings::values(&run.config)).collect();
    let keys: BTreeSet<&String> = values.iter().flat_map(BTreeMap::keys).collect();
    let differs = keys.into_iter().filter(|key| values.iter().any(|of| of.get(*key) != values[0].get(*key)));
    let rows: Vec<Vec<&str>> = differs
        .map(|key| [key.as_str()].into_iter().chain(values.iter().map(|of| of.get(key).map_or("–", String::as_str))).collect())
        .collect();
    if rows.is_empty() {
        return "<section><h2>Settings</h2><p>All settings are equal.</p></section>".to_owned();
    }
    let heads: Vec<&str> = ["setting"].into_iter().chain(runs.iter().map(|run| run.name.as_str())).collect();
    let table = table(&heads, &rows);
    let what = if rows.len() == 1 { "setting differs" } else { "settings differ" };
    format!("<section><h2>Settings</h2>\n<details open><summary>{} {what}</summary>{table}</details></section>", rows.len())
}

/// Formats a table as HTML.
fn table(heads: &[&str], rows: &[Vec<&str>]) -> String {
    let line = |tag: &str, cells: &[&str]| {
        let cells: String = cells.iter().map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell))).collect();
        format!("<tr>{cells}</tr>\n")
    };
    let rows: String = rows.iter().map(|row| line("td", row)).collect();
    format!("<div class=\"scroll\"><table>\n{}{rows}</table></div>", line("th", heads))
}

/// Formats a table as aligned Markdown, for a terminal.
fn aligned(heads: &[&str], rows: &[Vec<&str>]) -> String {
    let rows: Vec<Vec<String>> = rows.iter().map(|row| row.iter().map(|cell| as_text(cell)).collect()).collect();
    let rows: Vec<Vec<&str>> = rows.iter().map(|row| row.iter().map(String::as_str).collect()).collect();
    let width =
        |column: usize| rows.iter().map(|row| row[column]).chain([heads[column]]).map(|cell| cell.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..heads.len()).map(width).collect();
    let line = |cells: &[&str]| {
        let padded = cells.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}"));
        format!("| {} |", padded.collect::<Vec<_>>().join(" | "))
    };
    let rule: Vec<String> = widths.iter().map(|width| "-".repeat(*width)).collect();
    let rule: Vec<&str> = rule.iter().map(String::as_str).collect();
    [heads, &rule].into_iter().chain(rows.iter().map(Vec::as_slice)).map(line).collect::<Vec<_>>().join("\n")
}
