//! `report.html`: the results of a run on a single page that needs no other file, no server and no network.
//!
//! It is built from the run folder and the model, so it can be regenerated at any time.

mod cameras;
pub mod curves;
pub mod pictures;
mod scene;

use crate::html::{self, escaped};
use crate::progress::{Console, thousands};
use plenoxel::dataset::Dataset;
use plenoxel::error::Result;
use plenoxel::model::Model;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::folder::{RunFolder, RunRecord};
use plenoxel::run::memory::bytes;
use plenoxel::run::metrics;
use plenoxel::text::clock;
use serde_json::Value;
use std::fmt::Write;

/// Style sheet of reports and of other pages with curves and pictures.
pub const STYLE: &str = include_str!("report/style.css");
/// Script that enlarges and sorts pictures.
pub const SCRIPT: &str = include_str!("report/page.js");

/// The contents of a report.
pub struct Report<'a> {
    pub folder: &'a RunFolder,
    pub config: &'a Config,
    pub record: &'a RunRecord,
    pub dataset: &'a Dataset,
    /// The trained model; `None` for a custom model.
    pub model: Option<&'a dyn Model<f32>>,
}

impl Report<'_> {
    /// Writes the page. Returns a message with its path.
    pub fn write(&self, console: &Console<'_>) -> Result<String> {
        let result = self.folder.figures()?.unwrap_or(Value::Null);
        let metrics = metrics::read(&self.folder.metrics())?;
        let lines = curves::lines(self.folder, &metrics, console);
        let scene = scene::Scene::of(self, console)?;
        let title = format!("{} – {}", self.folder.path().file_name().unwrap_or_default().to_string_lossy(), self.record.scene);
        let parts = [
            facts(self, &result),
            scene.as_ref().map_or_else(String::new, scene::Scene::figure),
            curves::section(&lines, self.config),
            pictures::stages(self.folder, &result)?,
            stages(&result),
            cameras::section(self.dataset, &result),
            pictures::panels(self.folder, &result)?,
            costs(self, &result),
            self.settings()?,
        ];
        let scripts = format!("<script>\n{}</script>\n{}", SCRIPT, scene.as_ref().map_or_else(String::new, scene::Scene::scripts));
        let page = html::page(&title, STYLE, &(parts.join("\n") + &scripts));
        self.folder.write_report(&page)?;
        let note = scene.map_or_else(|| "it has no interactive viewer".to_owned(), |scene| scene.note());
        console.note(&format!("report.html has {}; {note}", bytes(page.len() as u64)));
        Ok(format!("report: {}", console.address(&self.folder.report())))
    }

    /// The section with all settings.
    fn settings(&self) -> Result<String> {
        let text = self.folder.settings()?;
        let again = escaped(&self.record.command_line("config.toml"));
        Ok(format!(
            "<section><h2>Settings</h2>\n<p>This command repeats the run: <code>{again}</code></p>\n\
             <details><summary>config.toml</summary><pre>{}</pre></details></section>",
            escaped(&text)
        ))
    }
}

/// The main results.
fn facts(report: &Report<'_>, result: &Value) -> String {
    let number = |key: &str, digits: usize, unit: &str| result[key].as_f64().map(|x| format!("{x:.digits$}{unit}"));
    let views = result["views"].as_u64().unwrap_or(0);
    let of_model = report.model.map_or_else(Vec::new, |model| model.facts());
    let of_model = of_model.into_iter().map(|(name, value)| (name, Some(thousands(value as u64))));
    let facts = [
        ("PSNR", number("psnr", 2, " dB")),
        ("SSIM", number("ssim", 4, "")),
        (report.record.kind.process(), result["seconds"].as_f64().map(clock)),
        ("grid", result["resolution"].as_u64().map(|resolution| format!("{resolution}³"))),
    ];
    let baselines = [
        ("PSNR of the background", number("baseline_background_psnr", 2, " dB")),
        ("PSNR of the mean training image", number("baseline_mean_image_psnr", 2, " dB")),
        ("PSNR of the field", number("psnr_of_field", 2, " dB")),
    ];
    let facts = facts
        .into_iter()
        .chain(of_model)
        .chain(baselines)
        .filter_map(|(name, value)| Some(format!("<div><b>{}</b><span>{name}</span></div>", value?)));
    let what = match (views, result["width"].as_u64(), result["height"].as_u64()) {
        (1.., Some(width), Some(height)) => format!(
            "PSNR and SSIM are means over {views} test views of {width} x {height} pixels, on the background {:?}, with predictions clamped to [0, 1].",
            report.config.background
        ),
        _ if result.is_null() => "There are no valid results: `plenoxel train --resume` computes them again.".to_owned(),
        _ => "The run was not evaluated on test views. Run `plenoxel evaluate`, then `plenoxel report` to regenerate this page.".to_owned(),
    };
    format!(
        "<div class=\"facts\">{}</div>\n<p>{}, {}. {what}</p>",
        facts.collect::<String>(),
        escaped(&report.record.scene),
        escaped(&report.record.format)
    ) + &warnings(result)
}

/// Warnings about the results.
fn warnings(result: &Value) -> String {
    let warnings = result["warnings"].as_array().into_iter().flatten().filter_map(Value::as_str);
    warnings.map(|warning| format!("\n<p class=\"warning\"><b>Warning:</b> {}</p>", escaped(warning))).collect()
}

/// The table of stages.
fn stages(result: &Value) -> String {
    let Some(stages) = result["stages"].as_array().filter(|stages| !stages.is_empty()) else { return String::new() };
    let mut rows = String::new();
    for stage in stages {
        let psnr = stage["psnr"].as_f64().map_or("–".to_owned(), |psnr| format!("{psnr:.2} dB"));
        let seconds = stage["seconds"].as_f64().map_or_else(String::new, clock);
        let resolution = stage["resolution"].as_u64().map_or_else(|| "–".to_owned(), |resolution| format!("{resolution}³"));
        let _ = write!(rows, "<tr><td>{resolution}</td><td>{}</td><td>{seconds}</td><td>{psnr}</td></tr>", stage["steps"]);
    }
    format!(
        "<section><table><thead><tr><th>stage</th><th>steps</th><th>training time at its end</th><th>test PSNR</th></tr></thead>\
         <tbody>{rows}</tbody></table></section>"
    )
}

/// The table of time, memory and machine.
fn costs(report: &Report<'_>, result: &Value) -> String {
    let time = |key: &str| result[key].as_f64().map(clock);
    let count = |key: &str| result[key].as_u64().map(thousands);
    let per_ray = result["samples"].as_f64().zip(result["rays"].as_f64()).map(|(samples, rays)| format!("{:.1}", samples / rays.max(1.0)));
    let rows = [
        ("reading images", time("seconds_load")),
        (report.record.kind.process(), time("seconds").filter(|_| !report.record.is_carved())),
        ("carving the hull", time("seconds_hull")),
        ("fitting colors", time("seconds_color")),
        ("evaluating test views", time("seconds_evaluate")),
        ("peak memory", result["peak_memory_bytes"].as_u64().map(bytes)),
        ("steps", count("steps")),
        ("rays", count("rays")),
        ("samples per ray", per_ray),
        ("threads", Some(report.record.threads.to_string())),
        ("vector instructions", Some(report.record.instruction_set.clone())),
        ("program", Some(report.record.program.clone())),
        ("preset", report.record.preset.clone()),
        ("seed", Some(report.config.seed.to_string())),
    ];
    let rows = rows.into_iter().filter_map(|(name, value)| Some(format!("<tr><td>{name}</td><td>{}</td></tr>", escaped(&value?))));
    format!("<section><h2>Time and memory</h2>\n<table><tbody>{}</tbody></table></section>", rows.collect::<String>())
}
