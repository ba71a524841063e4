//! How many training views see each node of a grid.

use crate::camera::projection::Projection;
use crate::dataset::View;
use crate::geometry::Aabb;
use autograd::parallel;

/// Returns for each node, in row-major order, the number of views in whose image it projects.
///
/// The authors count the views whose samples have trilinear weights on the node of a sum above 1. The two counts agree inside of the images, if a pixel is not
/// larger than a voxel.
pub fn seeing(views: &[View], aabb: Aabb, nodes: [usize; 3]) -> Vec<u32> {
    let cells = nodes.map(|n| n - 1);
    let projections: Vec<Projection> = views.iter().map(|view| Projection::of(&view.camera, view.size(), aabb, cells)).collect();
    let mut counts = vec![0; nodes.iter().product()];
    parallel::for_each_chunk(&mut counts, nodes[2], |start, line| {
        let (i, j) = (start / nodes[2] / nodes[1], start / nodes[2] % nodes[1]);
        for projection in &projections {
            let [width, height] = projection.size.map(|n| n as f64);
            for (k, count) in line.iter_mut().enumerate() {
                let p = projection.corner([i, j, k]);
                let inside = p.z > 0.0 && (0.0..=width * p.z).contains(&p.x) && (0.0..=height * p.z).contains(&p.y);
                *count += u32::from(inside);
            }
        }
    });
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use glam::DVec3;

    #[test]
    fn a_node_is_counted_by_the_views_that_show_it() {
        let options = ProceduralOptions { width: 20, height: 30, train: 7, val: 0, test: 0, supersample: 1 };
        let views = Dataset::procedural(options).and_then(|scene| scene.load(Split::Train, &|_, _| {})).expect("the built-in scene");
        // The middle is in all images, and a node at a camera's back is not in the image of that camera.
        let back = 2.0 * views[0].camera.position();
        let aabb = Aabb { min: back.min(-back), max: back.max(-back) };
        let nodes = [3; 3];
        let counts = seeing(&views, aabb, nodes);
        let node = |a: usize, at: f64| if at > 0.0 { 2 } else { usize::from(a > 3) };
        let [i, j, k] = [0, 1, 2].map(|a| node(a, back[a]));
        assert_eq!(counts[13], 7);
        assert!(counts[(i * 3 + j) * 3 + k] < 7 && back != DVec3::ZERO);
    }
}
