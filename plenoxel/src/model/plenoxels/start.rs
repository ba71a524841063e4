//! Initial knowledge of training: silhouettes, and an existing grid.

use super::config::{Config, Hull, Initial};
use crate::carve::visual_hull;
use crate::dataset::{View, has_alpha};
use crate::error::Error;
use crate::field::voxel_grid::{Color, GridShape, Interpolation, VoxelGrid};
use crate::geometry::Aabb;
use crate::sampling::Occupancy;
use crate::sampling::walk::Walk;
use crate::train::StageProgress;
use autograd::lattice::has;
use autograd::{Real, Tensor};
use std::ops::ControlFlow;
use std::sync::Arc;

/// Resolution of the visual hull that the cube is fitted to.
const COARSE: usize = 64;

/// Silhouettes of the training views, for configs that use them and images with an alpha channel.
#[derive(Debug)]
pub struct Silhouettes {
    views: Arc<[View]>,
    margin: f64,
    /// Counts views while a visual hull is computed.
    pub progress: Arc<StageProgress>,
}

impl Silhouettes {
    /// Returns `None` if the config does not use silhouettes, or if the images have no alpha channel.
    pub fn new(config: &Config, views: &Arc<[View]>, progress: Arc<StageProgress>) -> Option<Self> {
        let margin = config.carve.margin;
        (config.hull == Hull::Auto && has_alpha(views)).then(|| Silhouettes { views: views.clone(), margin, progress })
    }

    /// Returns the half width of the smallest cube around the origin that contains the visual hull inside the cube of `half_width`. Returns
    /// `None` if the hull is empty.
    pub fn half_width(&self, half_width: f64) -> Option<f64> {
        let cube = Aabb::cube(half_width);
        let hull = |done: &dyn Fn(usize)| visual_hull::by_footprint(&self.views, cube, [COARSE; 3], self.margin, done);
        self.progress.of(self.views.len(), hull).half_width()
    }

    /// Returns the error for an empty visual hull.
    pub fn nothing_inside() -> Error {
        let found = "no voxel of the box lies within the silhouettes of all views";
        Error::usage("hull", found, "set it to \"off\", set a half_width whose box contains the object, or start from another run")
    }

    /// Returns the voxels of a grid that a sample inside the silhouettes can read.
    pub fn voxels<T: Real>(&self, grid: &VoxelGrid<T>) -> Occupancy {
        let shape = grid.shape();
        let near = shape.reached_from(&grid.voxels_where(|_| true));
        let hull = |done: &dyn Fn(usize)| visual_hull::by_footprint_of(&self.views, &near, self.margin, done);
        shape.reached_from(&self.progress.of(self.views.len(), hull))
    }
}

/// Returns the initial grid of the stage after a scout. It has the given resolution and the values of `initial`, fills the smallest cube
/// around the kept voxels, and contains the voxels that a sample in their visual hull reads. Parts of the hull outside of the cube are
/// lost. `margin` is the margin of [`visual_hull::by_footprint`], in pixels of these views.
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

/// Returns `matter` and the voxels of `among` in the visual hull of its silhouettes: voxels that it hides, and voxels that no view rules
/// out.
///
/// A scout leaves fog, or nothing, where few rays pass, for example the ground under a machine. Without voxels nothing could be learned
/// there.
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
    // Rays may miss the thinnest voxels, so `matter` is added.
    visual_hull::by_silhouettes(views, shows_matter, among, margin, &|_| ()).union(matter)
}

/// Replaces the zero colors of a carved grid, of voxels that no pixel shows, by `color` in each channel. Zero colors would be clamped and
/// have no gradient if training finds that the voxels are visible.
pub fn with_unseen_colors<T: Real>(grid: &VoxelGrid<T>, color: f64) -> VoxelGrid<T> {
    if grid.shape().color != Color::Rgb {
        // Zero coefficients mean the color of the offset.
        return grid.with_density(grid.density.tensor().detach());
    }
    let mut colors = grid.color.tensor().data().to_vec();
    let unseen = colors.chunks_exact_mut(3).filter(|color| color.iter().all(|c| *c == T::zero()));
    unseen.for_each(|unseen| unseen.fill(T::lit(color)));
    let tables = vec![grid.density.tensor().detach(), Tensor::from_vec(colors, grid.color.shape())];
    VoxelGrid::with_tables(*grid.shape(), grid.lattice().clone(), tables)
}

/// Prepares a grid for training with a shape: resamples it if the resolution differs, and adds a layer of empty voxels that trilinear
/// interpolation will read. The grid keeps its box.
pub fn adapted<T: Real>(grid: &VoxelGrid<T>, shape: &GridShape) -> VoxelGrid<T> {
    let same = grid.shape().resolution == shape.resolution;
    let resampled = (!same).then(|| grid.resample(shape.resolution));
    let grid = resampled.as_ref().unwrap_or(grid);
    // Grow before colors change: zeros still mark voxels that no pixel shows.
    let grown = (shape.interpolation == Interpolation::Trilinear).then(|| grid.grown());
    let grid = grown.as_ref().unwrap_or(grid);
    // Reduce harmonics last, so that they are averaged over the voxels that training will use.
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
        // Matter that rays of all pixels miss is kept, and empty matter has an empty hull.
        let coarse: Vec<View> = views.iter().map(|view| view.reduced(32)).collect();
        let mut one = vec![false; cells.pow(3)];
        assert_eq!(hull_of(&of(&one), &all, &views, 0.5).fraction(), 0.0);
        one[cells.pow(3) / 2 + 5 * cells + 7] = true;
        assert!(hull_of(&of(&one), &all, &coarse, 0.0).intersection(&of(&one)).fraction() > 0.0);
    }
}
