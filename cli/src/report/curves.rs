//! Curves of loss, PSNR, resolution and learning rates of one or several runs, over steps and over seconds.

use crate::chart::{Chart, Curve, DECIBELS};
use crate::progress::Console;
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::folder::RunFolder;
use plenoxel::run::metrics::{self, Line};
use std::collections::BTreeSet;

/// Maximum number of points per curve.
const POINTS: usize = 500;

/// A horizontal axis: its name, its label, and the position of a line of the metrics.
type Axis = (&'static str, &'static str, fn(&Line<'_>) -> f64);
const AXES: [Axis; 2] =
    [("steps", "training step", |line| line.step as f64 + 1.0), ("seconds", "seconds of training", |line| line.seconds)];

/// Parses the metrics of a run. Warns of unreadable lines.
pub fn lines<'t>(folder: &RunFolder, metrics: &'t str, console: &Console<'_>) -> Vec<Line<'t>> {
    let (lines, unreadable) = metrics::of_steps(metrics);
    if unreadable > 0 {
        let (path, s) = (folder.metrics(), if unreadable == 1 { "" } else { "s" });
        console.note(&format!("warning: {}: {unreadable} unreadable line{s} left out of the curves", path.display()));
    }
    lines
}

/// The curves of a run; empty without training.
pub fn section(lines: &[Line<'_>], config: &Config) -> String {
    let Some(last) = lines.last().filter(|_| config.trains()) else { return String::new() };
    over_both(|_, (_, across, at)| {
        let charts = charts(lines, config).into_iter().map(|(title, up, values)| {
            let curves = values.into_iter().map(|(name, value)| curve(&name, lines, at, &*value)).filter(|curve| !curve.lines.is_empty());
            Chart {
                title: title.to_owned(),
                across: (across.to_owned(), at(last)),
                up: up.to_owned(),
                parts: parts(lines, at),
                curves: curves.collect(),
            }
        });
        charts.collect()
    })
}

/// Charts with one curve per run: title, unit, and value of a line of the metrics.
type OfEach = (&'static str, &'static str, fn(&Line<'_>) -> Option<f64>);
const OF_EACH: [OfEach; 4] = [
    ("Loss", "loss", |line| Some(line.loss)),
    ("PSNR of training rays", DECIBELS, |line| Some(line.psnr)),
    ("PSNR of validation views", DECIBELS, |line| line.validation_psnr),
    ("Voxels", "number", |line| line.figure("voxels").filter(|n| *n > 0.0)),
];

/// The curves of one run among several, without the lines of the metrics.
#[derive(Debug)]
pub struct RunCurves {
    /// For each axis: the end of the run, and its curves.
    over: [(f64, [Curve; OF_EACH.len()]); AXES.len()],
    is_empty: bool,
}

impl RunCurves {
    /// Computes the curves of a run with this name.
    pub fn of(name: &str, lines: &[Line<'_>]) -> Self {
        let over = AXES.map(|(_, _, at)| (lines.last().map_or(0.0, at), OF_EACH.map(|(_, _, value)| curve(name, lines, at, &value))));
        RunCurves { over, is_empty: lines.is_empty() }
    }
}

/// The curves of several runs in the same charts; empty if none of them was trained.
pub fn side_by_side<'r>(runs: impl Iterator<Item = &'r RunCurves> + Clone) -> String {
    if runs.clone().all(|run| run.is_empty) {
        return String::new();
    }
    over_both(|axis, (_, across, _)| {
        let end = runs.clone().map(|run| run.over[axis].0).fold(0.0, f64::max);
        let charts = OF_EACH.into_iter().enumerate().filter_map(|(number, (title, up, _))| {
            // A run without these values keeps its color in the other charts.
            let curves: Vec<Curve> = runs.clone().map(|run| run.over[axis].1[number].clone()).collect();
            let known = curves.iter().any(|curve| !curve.lines.is_empty());
            let chart =
                || Chart { title: title.to_owned(), across: (across.to_owned(), end), up: up.to_owned(), parts: Vec::new(), curves };
            known.then(chart)
        });
        charts.collect()
    })
}

/// A section with charts over steps and over seconds; the reader selects one.
fn over_both(charts: impl Fn(usize, Axis) -> Vec<Chart>) -> String {
    let mut page = String::from("<section><h2>Curves</h2>\n");
    for (i, (name, ..)) in AXES.iter().enumerate() {
        let checked = if i == 0 { " checked" } else { "" };
        page +=
            &format!("<input type=\"radio\" name=\"axis\" id=\"over-{name}\"{checked}><label for=\"over-{name}\">over {name}</label>\n");
    }
    for (i, axis) in AXES.into_iter().enumerate() {
        let charts: String = charts(i, axis).iter().map(Chart::svg).collect();
        page += &format!("<div class=\"charts\" data-over=\"{}\">{charts}</div>\n", axis.0);
    }
    page + "</section>"
}

/// A function from a line to a value, if the line has it.
type Value<'a> = Box<dyn Fn(&Line<'_>) -> Option<f64> + 'a>;

/// Title, vertical axis and curves of a chart.
type Shown<'a> = (&'static str, &'static str, Vec<(String, Value<'a>)>);

fn charts<'a>(lines: &[Line<'_>], config: &'a Config) -> Vec<Shown<'a>> {
    let whole: Vec<(String, Value<'a>)> = vec![("loss".to_owned(), Box::new(|line| Some(line.loss)))];
    let names: BTreeSet<String> = lines.iter().flat_map(|line| line.losses.keys().map(|name| name.to_string())).collect();
    // Weighted, as in the sum. A loss that is not in the settings was added by a program, with an unknown weight.
    let each = names.into_iter().map(|name| {
        let (key, weight) = (name.clone(), config.losses.get(&name));
        let shown = if weight.is_some() { name } else { format!("{name} (unweighted)") };
        let counted = move |line: &Line<'_>| Some(line.losses.get(key.as_str())? * weight.map_or(1.0, |weight| weight.at(line.step)));
        (shown, Box::new(counted) as Value<'a>)
    });
    // A single loss is equal to the sum.
    let each: Vec<_> = each.collect();
    let losses = if each.len() > 1 { whole.into_iter().chain(each).collect() } else { whole };
    vec![
        ("Loss and its weighted parts", "loss", losses),
        (
            "PSNR",
            DECIBELS,
            vec![
                ("training rays".to_owned(), Box::new(|line| Some(line.psnr))),
                ("validation views".to_owned(), Box::new(|line| line.validation_psnr)),
            ],
        ),
        (
            "Size of the grid",
            "number",
            vec![
                ("voxels per side".to_owned(), Box::new(|line| line.resolution.map(|n| n as f64))),
                ("voxels".to_owned(), Box::new(|line| line.figure("voxels").filter(|n| *n > 0.0))),
            ],
        ),
        ("Learning rates", "rate", rates(lines)),
    ]
}

/// The learning rate of each parameter.
fn rates(lines: &[Line<'_>]) -> Vec<(String, Value<'static>)> {
    let parameter = |figure: &String| figure.strip_suffix("_rate").map(str::to_owned);
    let parameters: BTreeSet<String> = lines.iter().flat_map(|line| line.figures.keys().filter_map(parameter)).collect();
    let curve = |parameter: String| {
        let figure = format!("{parameter}_rate");
        (parameter, Box::new(move |line: &Line<'_>| line.figure(&figure)) as Value<'static>)
    };
    parameters.into_iter().map(curve).collect()
}

/// A curve with breaks between stages.
fn curve(name: &str, lines: &[Line<'_>], at: fn(&Line<'_>) -> f64, value: &dyn Fn(&Line<'_>) -> Option<f64>) -> Curve {
    let each = lines.len().div_ceil(POINTS).max(1);
    let mean = |values: &mut dyn Iterator<Item = f64>| {
        let (n, sum) = values.fold((0.0, 0.0), |(n, sum), value| (n + 1.0, sum + value));
        sum / n
    };
    let stages = lines.chunk_by(|a, b| a.stage == b.stage).map(|stage| {
        let known: Vec<(f64, f64)> = stage.iter().filter_map(|line| Some((at(line), value(line).filter(|v| v.is_finite())?))).collect();
        let points = known.chunks(each).map(|part| (mean(&mut part.iter().map(|p| p.0)), mean(&mut part.iter().map(|p| p.1))));
        points.collect::<Vec<_>>()
    });
    Curve { name: name.to_owned(), lines: stages.filter(|points| !points.is_empty()).collect(), band: Vec::new() }
}

/// The start of each stage, with its label.
fn parts(lines: &[Line<'_>], at: fn(&Line<'_>) -> f64) -> Vec<(f64, String)> {
    let mut begin = 0.0;
    let parts = lines.chunk_by(|a, b| a.stage == b.stage).map(|stage| {
        let part = (begin, stage[0].resolution.map_or(String::new(), |n| format!("{n}³")));
        begin = at(&stage[stage.len() - 1]);
        part
    });
    parts.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use plenoxel::model::plenoxels::config::Weight;

    #[test]
    fn parts_of_the_loss_are_shown_as_they_count_in_it() {
        let losses = [("mse", Weight::Constant(1.0)), ("sparsity", Weight::Until { weight: 0.01, until: 5 })];
        let losses = losses.map(|(name, weight)| (name.to_owned(), weight)).into();
        let config = Config { losses, ..Config::default() };
        let line = |step: u64| {
            format!(
                r#"{{"step":{step},"stage":0,"ends_stage":false,"loss":0.6,"losses":{{"mse":0.5,"sparsity":10.0,"mine":2.0}},"psnr":3.0,"rays":1,"samples":1,"seconds":1.0}}"#
            )
        };
        let text = [4, 5].map(line).join("\n");
        let (lines, _) = metrics::of_steps(&text);
        let (_, _, values) = charts(&lines, &config).swap_remove(0);
        let shown: Vec<(&str, Vec<Option<f64>>)> =
            values.iter().map(|(name, value)| (name.as_str(), lines.iter().map(&**value).collect())).collect();
        let both = |a, b| vec![Some(a), Some(b)];
        assert_eq!(
            shown,
            [("loss", both(0.6, 0.6)), ("mine (unweighted)", both(2.0, 2.0)), ("mse", both(0.5, 0.5)), ("sparsity", both(0.1, 0.0)),]
        );
    }
}
