//! What training may know before its first step: silhouettes, and a grid that was there before.

use super::config::{Config, Hull, Initial};
use crate::carve::visual_hull;
use crate::dataset::{View, has_alpha};
use crate::error::Error;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::sampling::walk::Walk;
use crate::train::Progress;
use autograd::lattice::has;
use autograd::{Real, Tensor};
use std::ops::ControlFlow;
use std::sync::Arc;

/// Voxels along each axis of the hull that the cube is fitted to.
const COARSE: usize = 64;

/// Silhouettes of the training views, where the config lets them decide and the images have alpha.
#[derive(Debug)]
pub struct Silhouettes {
    views: Arc<[View]>,
    margin: f64,
    /// Counts views while a visual hull is computed.
    pub progress: Arc<Progress>,
}

impl Silhouettes {
    /// `None` if the config does not let them decide, or there are none.
    pub fn new(config: &Config, views: &Arc<[View]>, progress: Arc<Progress>) -> Option<Self> {
        let margin = config.carve.margin;
        (config.hull == Hull::Auto && has_alpha(views)).then(|| Silhouettes { views: views.clone(), margin, progress })
    }

    /// The half width of the smallest cube around the origin that holds all that the silhouettes leave of the cube of `half_width`; `None` if they
    /// leave nothing.
    pub fn half_width(&self, half_width: f64) -> Option<f64> {
        let cube = Aabb::cube(half_width);
        let hull = |done: &dyn Fn(usize)| visual_hull::by_footprint(&self.views, cube, [COARSE; 3], self.margin, done);
        self.progress.of(self.views.len(), hull).half_width()
    }

    /// The error if no voxel lies within the silhouettes of all views.
    pub fn nothing_inside() -> Error {
        let found = "no voxel of the box lies within the silhouettes of all views";
        Error::usage("hull", found, "set it to \"off\", set a half_width whose box contains the object, or start from another run")
    }

    /// The voxels of a grid that a sample inside of the silhouettes can read.
    pub fn voxels<T: Real>(&self, grid: &VoxelGrid<T>) -> Occupancy {
        let shape = grid.shape();
        let near = shape.reached_from(&grid.voxels_where(|_| true));
        let hull = |done: &dyn Fn(usize)| visual_hull::by_footprint_of(&self.views, &near, self.margin, done);
        shape.reached_from(&self.progress.of(self.views.len(), hull))
    }
}

/// What a scout leaves to the stage after it: a grid at another resolution, as training starts, in the cube around what is worth keeping, with
/// those voxels that read one of its visual hull. What of the hull lies outside of the cube is lost. `margin` is that of
/// [`visual_hull::by_footprint`], in pixels of these views.
pub fn scouted<T: Real>(
    grid: &VoxelGrid<T>,
    kept: &Occupancy,
    views: &[View],
    margin: f64,
    resolution: usize,
    initial: &Initial,
) -> VoxelGrid<T> {
    let half_width = kept.half_width().unwrap_or(grid.shape().half_width);
    let hull = hull_of(kept, &grid.voxels_where(|_| true), views, margin);
    let near = grid.pruned(&hull).resample_in(resolution, half_width);
    let whole = VoxelGrid::uniform(*near.shape(), initial.density, initial.color);
    whole.pruned(&near.voxels_where(|_| true))
}

/// Some voxels, and those among others that the visual hull of their silhouettes has: what they hide, and what no view rules out.
///
/// What few rays get to, such as the ground under a machine, is fog or nothing to a scout; where no voxels are, nothing can be learned.
fn hull_of(matter: &Occupancy, among: &Occupancy, views: &[View], margin: f64) -> Occupancy {
    let Some(extent) = matter.extent() else { return matter.clone() };
    let walk = Walk::new(matter.aabb(), matter.cells()).within(extent);
    let shows_matter = |view: &View, x: usize, y: usize| {
        let mut found = false;
        let ray = view.camera.ray(x as f64 + 0.5, y as f64 + 0.5);
        walk.along(
            &ray,
            |brick| matter.free(brick),
            |crossing| {
                found = has(matter.masks()[crossing.brick], crossing.bit);
                if found { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            },
        );
        found
    };
    // A ray may pass by the thinnest.
    visual_hull::by_silhouettes(views, shows_matter, among, margin, &|_| ()).union(matter)
}

/// A carved grid whose voxels that no pixel shows have a color, the same for each channel, instead of zeros. As black as that their colors would be
/// clamped, and have no gradient, if training finds that they are seen after all.
pub fn with_unseen_colors<T: Real>(grid: &VoxelGrid<T>, color: f64) -> VoxelGrid<T> {
    if grid.shape().color != Color::Rgb {
        // Coefficients of 0 are the color of the offset.
        return grid.with_density(grid.density.tensor().detach());
    }
    let mut colors = grid.color.tensor().data().to_vec();
    let unseen = colors.chunks_exact_mut(3).filter(|color| color.iter().all(|c| *c == T::zero()));
    unseen.for_each(|unseen| unseen.fill(T::lit(color)));
    let tables = vec![grid.density.tensor().detach(), Tensor::from_vec(colors, grid.color.shape())];
    VoxelGrid::with_tables(*grid.shape(), grid.lattice().clone(), tables)
}

/// A grid as training with a shape can start from it: resampled if the resolution is another, and with a layer of empty voxels around where
/// trilinear look-up will read them. The box stays that of the grid.
pub fn adapted<T: Real>(grid: &VoxelGrid<T>, shape: &GridShape) -> VoxelGrid<T> {
    let same = grid.shape().resolution == shape.resolution;
    let resampled = (!same).then(|| grid.resample(shape.resolution));
    let grid = resampled.as_ref().unwrap_or(grid);
    // Before colors change: zeros are then those of voxels that nobody saw.
    let grown = (shape.interpolation == Interpolation::Trilinear).then(|| grid.grown());
    let grid = grown.as_ref().unwrap_or(grid);
    // Harmonics last, so that they are averaged over what training will see.
    grid.with_color(shape.color).with_interpolation(shape.interpolation).with_reduction(shape.sh_reduction)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use autograd::lattice::BRICK;
    use glam::DVec3;

    #[test]
    fn the_hull_of_matter_is_matter_and_what_it_hides_and_nothing_beside_it() {
        let options = ProceduralOptions { width: 64, height: 64, train: 12, val: 0, test: 0, supersample: 1 };
        let views = Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap();
        let cells = 6 * BRICK;
        let of = |present: &[bool]| Occupancy::new(Aabb::cube(1.0), [cells; 3], present);
        let all = of(&vec![true; cells.pow(3)]);
        let radius = |place: [usize; 3]| DVec3::from(place.map(|k| (k as f64 + 0.5) / (cells as f64 / 2.0) - 1.0)).length();
        let places = || (0..cells.pow(3)).map(|c| [c / cells.pow(2), c / cells % cells, c % cells]);
        let shell: Vec<bool> = places().map(|place| (0.45..0.65).contains(&radius(place))).collect();
        let hull = hull_of(&of(&shell), &all, &views, 0.5);
        for place in places() {
            let r = radius(place);
            assert!(r >= 0.65 || hull.contains(place), "{place:?} is in the ball of radius 0.65, at {r}");
            assert!(r <= 0.95 || !hull.contains(place), "{place:?} is beside it, at {r}");
        }
        // Matter so thin that rays of all pixels pass it by is matter all the same, and nothing hides nothing.
        let coarse: Vec<View> = views.iter().map(|view| view.reduced(32)).collect();
        let mut one = vec![false; cells.pow(3)];
        assert_eq!(hull_of(&of(&one), &all, &views, 0.5).fraction(), 0.0);
        one[cells.pow(3) / 2 + 5 * cells + 7] = true;
        assert!(hull_of(&of(&one), &all, &coarse, 0.0).intersection(&of(&one)).fraction() > 0.0);
    }
}
