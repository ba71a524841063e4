//! A picture of the cameras of a dataset, from above and from the side.

use crate::camera_plan::{Plan, SIDES};
use crate::images::strip;
use glam::DVec2;
use ndarray::Array3;
use plenoxel::dataset::Dataset;

/// Width and height of a plan, pixels.
const SIDE: usize = 640;
/// Pixels around what is drawn.
const MARGIN: f64 = 24.0;
/// Colors of the cameras of each split.
const COLORS: [[f32; 3]; 3] = [[0.0, 0.27, 0.68], [0.1, 0.55, 0.1], [0.85, 0.2, 0.0]];
const GRAY: [f32; 3] = [0.75; 3];
const AXES: [f32; 3] = [0.88; 3];

/// Draws the cameras, with training views in blue, validation views in green and test views in red, the axes and the points of structure
/// from motion: from above, and from the side.
pub fn picture(dataset: &Dataset) -> Array3<f32> {
    let plan = Plan::of(dataset);
    let half = plan.half;
    let plans = SIDES.map(|flat| {
        let mut canvas = Canvas { pixels: Array3::from_elem((SIDE, SIDE, 3), 1.0), half };
        canvas.line([DVec2::new(-half, 0.0), DVec2::new(half, 0.0)], AXES);
        canvas.line([DVec2::new(0.0, -half), DVec2::new(0.0, half)], AXES);
        plan.points.iter().for_each(|point| canvas.dot(flat(*point), GRAY));
        for (split, camera) in &plan.cameras {
            plan.frustum(camera).into_iter().for_each(|line| canvas.line(line.map(flat), COLORS[*split as usize]));
        }
        canvas.pixels
    });
    strip(&[&plans[0], &plans[1]])
}

/// A white square that shows [-half, half]², the second coordinate upwards.
struct Canvas {
    pixels: Array3<f32>,
    half: f64,
}

impl Canvas {
    fn pixel(&self, p: DVec2) -> DVec2 {
        let scale = (0.5 * SIDE as f64 - MARGIN) / self.half;
        DVec2::new(0.5 * SIDE as f64 + scale * p.x, 0.5 * SIDE as f64 - scale * p.y)
    }

    fn paint(&mut self, at: DVec2, color: [f32; 3]) {
        let inside = at.cmpge(DVec2::ZERO).all() && at.cmplt(DVec2::splat(SIDE as f64)).all();
        if inside {
            (0..3).for_each(|c| self.pixels[[at.y as usize, at.x as usize, c]] = color[c]);
        }
    }

    fn dot(&mut self, p: DVec2, color: [f32; 3]) {
        self.paint(self.pixel(p), color);
    }

    fn line(&mut self, ends: [DVec2; 2], color: [f32; 3]) {
        let [a, b] = ends.map(|p| self.pixel(p));
        let steps = (b - a).abs().max_element().ceil().clamp(1.0, 4.0 * SIDE as f64);
        (0..=steps as usize).for_each(|i| self.paint(a.lerp(b, i as f64 / steps), color));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use plenoxel::dataset::procedural::ProceduralOptions;

    #[test]
    fn cameras_of_each_split_are_drawn_in_their_color_and_those_above_the_ground_in_the_upper_half() {
        let options = ProceduralOptions { width: 8, height: 8, train: 9, val: 2, test: 3, supersample: 1 };
        let picture = picture(&Dataset::procedural(options).expect("the built-in scene"));
        let (height, width, _) = picture.dim();
        assert!(height == SIDE && width >= 2 * SIDE);
        let places = |color: [f32; 3]| {
            let all = (0..height).flat_map(|y| (0..width).map(move |x| (y, x)));
            all.filter(|(y, x)| (0..3).all(|c| picture[[*y, *x, c]] == color[c])).collect::<Vec<_>>()
        };
        for color in COLORS {
            let found = places(color);
            // The cameras are on the upper hemisphere, and their frusta look down by less than their height.
            let side: Vec<_> = found.iter().filter(|(_, x)| *x >= width - SIDE).collect();
            assert!(found.len() > side.len() && !side.is_empty());
            let upper = side.iter().filter(|(y, _)| *y <= SIDE / 2).count();
            assert!(10 * upper >= 9 * side.len(), "{upper} of {}", side.len());
        }
    }
}
