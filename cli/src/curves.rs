//! The curves of loss and PSNR of a run, like figure 4 of the source paper, with stages side by side and a logarithmic scale.
//!
//! The pale band shows the minimum and the maximum loss of the steps in a column. The line is a moving average over about 2 % of the run, separate for
//! each stage, so that the jump at the start of a stage remains visible.

use crate::chart::{Chart, Curve, DECIBELS};
use plenoxel::train::PlannedStage;

/// Number of points of the curve.
const COLUMNS: usize = 400;
/// Number of points on either side for smoothing: 1 % of the run.
const REACH: usize = COLUMNS / 100;

/// Draws `losses`, one for each step from 0 on, as SVG. `stages` may have more steps, if the run ended early.
pub fn loss_svg(losses: &[f64], stages: &[PlannedStage], title: &str) -> String {
    let curve = curve("loss", losses, stages);
    chart(title, "loss", losses.len(), stages, vec![curve]).svg()
}

/// Draws the PSNR of the training rays, one value for each step from 0 on, and of validation views, by step, as SVG. Values that are not finite are left
/// out.
pub fn psnr_svg(training: &[f64], validation: Vec<(f64, f64)>, stages: &[PlannedStage]) -> String {
    let mut curves = vec![curve("training rays", training, stages)];
    if !validation.is_empty() {
        curves.push(Curve { name: "validation views".to_owned(), lines: vec![validation], band: Vec::new() });
    }
    chart("PSNR", DECIBELS, training.len(), stages, curves).svg()
}

fn chart(title: &str, up: &str, taken: usize, stages: &[PlannedStage], curves: Vec<Curve>) -> Chart {
    let steps = stages.last().map_or(0, |stage| stage.first + stage.steps).max(taken as u64).max(1);
    Chart {
        title: title.to_owned(),
        across: ("training step".to_owned(), steps as f64),
        up: up.to_owned(),
        parts: stages.iter().map(|stage| (stage.first as f64, stage.resolution.map_or(String::new(), |n| format!("{n}³")))).collect(),
        curves,
    }
}

fn curve(name: &str, values: &[f64], stages: &[PlannedStage]) -> Curve {
    let columns = columns(values, stages);
    let lines = columns.chunk_by(|a, b| a.stage == b.stage).map(|stage| stage.iter().map(|c| (c.step, c.smooth)).collect());
    Curve { name: name.to_owned(), lines: lines.collect(), band: columns.iter().map(|c| (c.step, c.low, c.high)).collect() }
}

/// The steps of a point of the curve.
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

/// Smooths the means with a centered window, which becomes smaller towards the ends.
fn smooth(columns: &mut [Column]) {
    let means: Vec<f64> = columns.iter().map(|c| c.smooth).collect();
    for (i, column) in columns.iter_mut().enumerate() {
        let reach = REACH.min(i).min(means.len() - 1 - i);
        let around = &means[i - reach..=i + reach];
        column.smooth = around.iter().sum::<f64>() / around.len() as f64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stages() -> Vec<PlannedStage> {
        let planned = |(i, resolution)| PlannedStage {
            index: i,
            resolution: Some(resolution),
            first: 50 * i as u64,
            steps: 50,
            first_ray: 0,
            rays_per_step: 1,
            ray_cost: 1.0,
        };
        [16, 32].into_iter().enumerate().map(planned).collect()
    }

    #[test]
    fn the_curve_is_not_smoothed_across_the_end_of_a_stage() {
        let losses: Vec<f64> = (0..100).map(|i| if i < 50 { 1.0 } else { 0.25 }).collect();
        let columns = columns(&losses, &stages());
        assert!(columns.iter().all(|c| c.smooth == if c.stage == 0 { 1.0 } else { 0.25 }));
    }

    #[test]
    fn pictures_of_unusual_losses_hold_no_number_that_is_not_one() {
        for losses in [vec![], vec![0.5], vec![0.0, 1.0], vec![-1.0, 2.0], vec![3.0; 100], vec![0.0; 7], vec![2e6; 3], vec![f64::NAN, 1.0]]
        {
            let svg = loss_svg(&losses, &stages(), "a < b & c");
            assert!(svg.contains("a &lt; b &amp; c") && svg.contains("32³"));
            let svg =
                svg + &psnr_svg(&losses, losses.iter().map(|loss| (3.0, *loss)).filter(|(_, loss)| loss.is_finite()).collect(), &stages());
            let numbers = svg.split('"').filter(|part| part.starts_with(|c: char| c.is_ascii_digit() || c == '-' || c == 'N'));
            assert!(numbers.into_iter().all(|part| !part.contains("NaN") && !part.contains("inf")), "{losses:?}: {svg}");
        }
    }
}
