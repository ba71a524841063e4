//! The loss over the steps of a run as an SVG, after figure 4 of the source paper: stages side by side, the loss on a logarithmic
//! scale where all of it is positive.
//!
//! The pale band reaches from the lowest to the highest loss among the steps that share a column; the line is a mean over about 2 % of
//! the run, never across the end of a stage, so that the jump after a subdivision stays visible.

use plenoxel::train::PlannedStage;
use std::fmt::Write;

const WIDTH: f64 = 900.0;
const HEIGHT: f64 = 480.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 64.0;
const BOTTOM: f64 = 56.0;
/// Points of the curve: one for each pixel across would be more than an eye can tell apart.
const COLUMNS: usize = 400;
/// Points to either side that smooth one: 1 % of the run.
const REACH: usize = COLUMNS / 100;

const INK: &str = "#222";
const FAINT: &str = "#e4e4e4";
const MARK: &str = "#888";
const CURVE: &str = "#1f5fa8";

/// The picture of `losses`, one for each step from 0 on. `stages` may reach beyond them, if a run ended early.
pub fn loss_svg(losses: &[f64], stages: &[PlannedStage], title: &str) -> String {
    let steps = stages.last().map_or(0, |stage| stage.first + stage.steps).max(losses.len() as u64).max(1);
    let x = |step: f64| LEFT + step / steps as f64 * (WIDTH - LEFT - RIGHT);
    let scale = Scale::of(losses);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"Helvetica, Arial, sans-serif\" \
         font-size=\"13\" fill=\"{INK}\">\n<title>{0}</title>\n<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/>\n\
         <text x=\"{LEFT}\" y=\"24\" font-size=\"16\">{0}</text>\n",
        escaped(title),
    );
    let (bottom, right) = (HEIGHT - BOTTOM, WIDTH - RIGHT);

    for (value, label) in scale.ticks() {
        let y = scale.y(value);
        line(&mut svg, [LEFT, y, right, y], FAINT, "");
        text(&mut svg, LEFT - 8.0, y + 4.5, "end", &label);
    }
    for step in linear_ticks(0.0, steps as f64, 8) {
        let x = x(step);
        line(&mut svg, [x, bottom, x, bottom + 5.0], INK, "");
        text(&mut svg, x, bottom + 20.0, "middle", &format!("{step}"));
    }

    for stage in stages {
        let from = x(stage.first as f64);
        if stage.first > 0 {
            line(&mut svg, [from, TOP, from, bottom], MARK, " stroke-dasharray=\"4 3\"");
        }
        let middle = 0.5 * (from + x((stage.first + stage.steps) as f64));
        let label = format!("{}³", stage.stage.resolution);
        text(&mut svg, middle, TOP - 10.0, "middle", &label);
    }

    let columns = columns(losses, stages);
    if !columns.is_empty() {
        let place = |step: f64, value: f64| format!("{:.1},{:.1} ", x(step), scale.y(value));
        let above = columns.iter().map(|c| place(c.step, c.high));
        let below = columns.iter().rev().map(|c| place(c.step, c.low));
        let band: String = above.chain(below).collect();
        let _ = writeln!(svg, "<polygon points=\"{band}\" fill=\"{CURVE}\" fill-opacity=\"0.22\"/>");
        for stage in columns.chunk_by(|a, b| a.stage == b.stage) {
            let points: String = stage.iter().map(|c| place(c.step, c.smooth)).collect();
            let _ = writeln!(
                svg,
                "<polyline points=\"{points}\" fill=\"none\" stroke=\"{CURVE}\" stroke-width=\"1.8\" stroke-linejoin=\"round\"/>"
            );
        }
    }

    line(&mut svg, [LEFT, bottom, right, bottom], INK, "");
    line(&mut svg, [LEFT, TOP, LEFT, bottom], INK, "");
    text(&mut svg, 0.5 * (LEFT + right), HEIGHT - 12.0, "middle", "training step");
    let y = 0.5 * (TOP + bottom);
    let axis = if scale.logarithmic { "loss (log scale)" } else { "loss" };
    let _ = writeln!(svg, "<text transform=\"translate(20 {y}) rotate(-90)\" text-anchor=\"middle\">{axis}</text>\n</svg>");
    svg
}

/// The steps that share a point of the curve.
struct Column {
    step: f64,
    stage: usize,
    low: f64,
    high: f64,
    smooth: f64,
}

fn columns(losses: &[f64], stages: &[PlannedStage]) -> Vec<Column> {
    let width = losses.len().div_ceil(COLUMNS).max(1);
    let mut columns: Vec<Column> = Vec::new();
    for (stage, planned) in stages.iter().enumerate() {
        let first = (planned.first as usize).min(losses.len());
        let end = ((planned.first + planned.steps) as usize).min(losses.len());
        let begin = columns.len();
        for (i, part) in losses[first..end].chunks(width).enumerate() {
            let finite: Vec<f64> = part.iter().copied().filter(|loss| loss.is_finite()).collect();
            if !finite.is_empty() {
                columns.push(Column {
                    step: (first + i * width) as f64 + 0.5 * part.len() as f64,
                    stage,
                    low: finite.iter().copied().fold(f64::INFINITY, f64::min),
                    high: finite.iter().copied().fold(f64::NEG_INFINITY, f64::max),
                    smooth: finite.iter().sum::<f64>() / finite.len() as f64,
                });
            }
        }
        smooth(&mut columns[begin..]);
    }
    columns
}

/// Replaces each mean by that of its neighbourhood, which shrinks towards the ends so that it stays centred.
fn smooth(columns: &mut [Column]) {
    let means: Vec<f64> = columns.iter().map(|c| c.smooth).collect();
    for (i, column) in columns.iter_mut().enumerate() {
        let reach = REACH.min(i).min(means.len() - 1 - i);
        let around = &means[i - reach..=i + reach];
        column.smooth = around.iter().sum::<f64>() / around.len() as f64;
    }
}

/// From losses to heights.
struct Scale {
    logarithmic: bool,
    low: f64,
    high: f64,
}

impl Scale {
    fn of(losses: &[f64]) -> Self {
        let finite = || losses.iter().copied().filter(|loss| loss.is_finite());
        let low = finite().fold(f64::INFINITY, f64::min);
        let high = finite().fold(f64::NEG_INFINITY, f64::max);
        if low > high {
            return Scale { logarithmic: false, low: 0.0, high: 1.0 };
        }
        // A loss that touches 0, or a prior that is negative, has no logarithm.
        if low > 0.0 {
            let (low, high) = (low / 1.15, high * 1.15);
            return Scale { logarithmic: true, low, high };
        }
        let margin = 0.05 * (high - low).max(1e-12);
        Scale { logarithmic: false, low: low - margin, high: high + margin }
    }

    fn y(&self, value: f64) -> f64 {
        let place = match self.logarithmic {
            true => (value / self.low).ln() / (self.high / self.low).ln(),
            false => (value - self.low) / (self.high - self.low),
        };
        let bottom = HEIGHT - BOTTOM;
        bottom - place.clamp(0.0, 1.0) * (bottom - TOP)
    }

    /// Values worth a line, with their labels: 1, 2, 5 in every decade, powers of ten alone where there are many.
    fn ticks(&self) -> Vec<(f64, String)> {
        if !self.logarithmic {
            let ticks = linear_ticks(self.low, self.high, 6).into_iter();
            return ticks.map(|v| (v, label(v))).collect();
        }
        let decades = (self.high / self.low).log10();
        let steps: &[f64] = if decades > 3.0 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let powers = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        powers
            .flat_map(|power| steps.iter().map(move |step| step * 10f64.powi(power)))
            .filter(|v| (self.low..=self.high).contains(v))
            .map(|v| (v, label(v)))
            .collect()
    }
}

fn label(value: f64) -> String {
    // Rounded to two digits, so that 5 · 10⁻³ is not 0.0050000000000000001.
    match value.abs() {
        0.0 => "0".to_owned(),
        v if !(1e-4..1e5).contains(&v) => format!("{value:.0e}"),
        v => {
            let digits = (1.0 - v.log10().floor()).max(0.0) as usize;
            let text = format!("{value:.digits$}");
            match text.contains('.') {
                true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
                false => text,
            }
        }
    }
}

/// At most `most` + 1 round numbers between two bounds.
fn linear_ticks(low: f64, high: f64, most: usize) -> Vec<f64> {
    let rough = (high - low) / most as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|k| k * power);
    let step = step.into_iter().find(|s| *s >= rough).unwrap_or(10.0 * power);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|k| k as f64 * step).collect()
}

fn line(svg: &mut String, [x1, y1, x2, y2]: [f64; 4], color: &str, more: &str) {
    let _ = writeln!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{color}\"{more}/>");
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, text: &str) {
    let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>", escaped(text));
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use plenoxel::train::config::Stage;

    fn stages() -> Vec<PlannedStage> {
        let planned = |(i, resolution)| PlannedStage { stage: Stage::new(resolution, 50), first: 50 * i as u64, steps: 50 };
        [16, 32].into_iter().enumerate().map(planned).collect()
    }

    #[test]
    fn ticks_are_round_numbers_with_short_labels() {
        let scale = Scale::of(&[0.004, 0.11]);
        let labels: Vec<String> = scale.ticks().into_iter().map(|(_, label)| label).collect();
        assert_eq!(labels, ["0.005", "0.01", "0.02", "0.05", "0.1"]);
        assert_eq!(linear_ticks(0.0, 4400.0, 8), [0.0, 1000.0, 2000.0, 3000.0, 4000.0]);
        assert_eq!([label(0.0), label(2.5), label(1e-7), label(100.0)], ["0", "2.5", "1e-7", "100"]);
    }

    #[test]
    fn the_curve_is_not_smoothed_across_the_end_of_a_stage() {
        let losses: Vec<f64> = (0..100).map(|i| if i < 50 { 1.0 } else { 0.25 }).collect();
        let columns = columns(&losses, &stages());
        assert!(columns.iter().all(|c| c.smooth == if c.stage == 0 { 1.0 } else { 0.25 }));
    }

    #[test]
    fn pictures_of_unusual_losses_hold_no_number_that_is_not_one() {
        for losses in [vec![], vec![0.5], vec![0.0, 1.0], vec![-1.0, 2.0], vec![3.0; 100], vec![0.0; 7], vec![f64::NAN, 1.0]] {
            let svg = loss_svg(&losses, &stages(), "a < b & c");
            assert!(svg.contains("a &lt; b &amp; c") && svg.contains("32³"));
            let numbers = svg.split('"').filter(|part| part.starts_with(|c: char| c.is_ascii_digit() || c == '-' || c == 'N'));
            assert!(numbers.into_iter().all(|part| !part.contains("NaN") && !part.contains("inf")), "{losses:?}: {svg}");
        }
    }
}
