//! The cameras of a report: plans from above and from the side. Test views have the color of their PSNR and lead to their pictures.

use crate::camera_plan::{Plan, SIDES};
use crate::html::escaped;
use glam::{DVec2, DVec3};
use plenoxel::dataset::{Dataset, Split};
use serde_json::Value;
use std::fmt::Write;

/// Width and height of a plan, in units of the drawing.
const SIDE: f64 = 480.0;
/// Largest number of drawn points.
const POINTS: usize = 3000;

/// The section with the cameras; empty without test views. `result` has the scores of the test views of `dataset`.
pub fn section(dataset: &Dataset, result: &Value) -> String {
    let scores: Vec<&Value> = result["per_view"].as_array().into_iter().flatten().collect();
    if scores.is_empty() || scores.len() != dataset.count(Split::Test) {
        return String::new();
    }
    let plan = Plan::of(dataset);
    let psnr = || scores.iter().filter_map(|view| view["psnr"].as_f64());
    let (worst, best) = (psnr().fold(f64::INFINITY, f64::min), psnr().fold(f64::NEG_INFINITY, f64::max));
    let colors = Colors { worst, best };
    let drawings: String = SIDES.iter().map(|flat| drawing(&plan, *flat, &scores, &colors)).collect();
    format!(
        "<section><h2>Cameras</h2>\n<p>From above (x right, y up) and from the side (x right, z up). Training views are gray. Test views are red at {worst:.2} dB \
         and green at {best:.2} dB; click on one to see it.</p>\n<div class=\"plans\">{drawings}</div></section>"
    )
}

/// Colors of test views: hues from red for the worst PSNR to green for the best.
struct Colors {
    worst: f64,
    best: f64,
}

impl Colors {
    /// A PSNR that is `None` is infinite.
    fn of(&self, psnr: Option<f64>) -> String {
        let share = psnr.map_or(1.0, |psnr| (psnr - self.worst) / (self.best - self.worst).max(1e-9));
        format!("hsl({:.0} 85% 40%)", 120.0 * share)
    }
}

/// One plan as SVG.
fn drawing(plan: &Plan, flat: fn(DVec3) -> DVec2, scores: &[&Value], colors: &Colors) -> String {
    let place = |p: DVec3| {
        let p = flat(p) / plan.half;
        DVec2::new(0.5 * SIDE * (1.0 + p.x), 0.5 * SIDE * (1.0 - p.y))
    };
    let mut svg = format!("<svg viewBox=\"0 0 {SIDE} {SIDE}\">");
    let mut dots = String::new();
    for point in plan.points.iter().step_by(plan.points.len().div_ceil(POINTS).max(1)) {
        let p = place(*point);
        let _ = write!(dots, "M{:.0} {:.0}h1", p.x, p.y);
    }
    let _ = write!(svg, "<path class=\"points\" d=\"{dots}\"/>");
    let mut number = 0;
    for (split, camera) in &plan.cameras {
        let mut lines = String::new();
        for [from, to] in plan.frustum(camera).into_iter().map(|line| line.map(place)) {
            let _ = write!(lines, "M{:.1} {:.1}L{:.1} {:.1}", from.x, from.y, to.x, to.y);
        }
        if *split != Split::Test {
            let _ = write!(svg, "<path d=\"{lines}\"/>");
            continue;
        }
        let psnr = scores[number]["psnr"].as_f64();
        let name = escaped(scores[number]["name"].as_str().unwrap_or_default());
        let said = psnr.map_or("∞".to_owned(), |psnr| format!("{psnr:.2}"));
        let _ = write!(
            svg,
            "<a href=\"#view-{number}\"><path d=\"{lines}\" style=\"stroke: {}\"><title>{name}: {said} dB</title></path></a>",
            colors.of(psnr)
        );
        number += 1;
    }
    svg + "</svg>"
}

#[cfg(test)]
mod tests {
    use super::*;
    use plenoxel::dataset::procedural::ProceduralOptions;
    use serde_json::json;

    #[test]
    fn each_test_view_is_drawn_twice_in_the_color_of_its_score_and_others_in_gray() {
        let options = ProceduralOptions { width: 8, height: 8, train: 5, val: 2, test: 3, supersample: 1 };
        let dataset = Dataset::procedural(options).expect("the built-in scene");
        let view = |name: &str, psnr: Value| json!({ "name": name, "psnr": psnr });
        let result = json!({ "per_view": [view("a", json!(20.0)), view("<b>", json!(30.0)), view("c", Value::Null)] });
        let page = section(&dataset, &result);
        let count = |what: &str| page.matches(what).count();
        assert_eq!((count("<svg"), count("<path d="), count("<a href")), (2, 2 * (5 + 2 + 3), 2 * 3));
        assert_eq!((count("stroke: hsl(0 "), count("stroke: hsl(120 "), count("&lt;b&gt;: 30.00 dB")), (2, 4, 2));
        // Scores of other views are not shown.
        assert!(section(&dataset, &json!({ "per_view": [view("a", json!(20.0))] })).is_empty());
    }
}
