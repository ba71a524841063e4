//! Changes of the grid between stages: resampling at a finer resolution, and pruning of empty voxels.

use super::config::{Sampling, Scout, Stage};
use super::start::Silhouettes;
use super::{Plenoxels, start};
use crate::error::{Error, Result};
use crate::field::Field;
use crate::field::voxel_grid::fused::largest_weights;
use crate::field::voxel_grid::{GridSpace, VoxelGrid};
use crate::rays::RaySource;
use crate::render::RenderOptions;
use crate::sampling::{Jitter, Occupancy};
use autograd::{Real, release_free_buffers};

/// Number of rays rendered at a time when finding visible voxels. It bounds the memory.
const RAYS_PER_BATCH: usize = 1 << 15;

/// Returns the expected duration of a ray at a resolution, relative to a grid of a single voxel.
pub(crate) fn ray_cost(resolution: usize) -> f64 {
    /// Exponent for 128 to 448 voxels per side. The measured mean is 0.73 on a machine without AVX-512 and 0.93 on one with it, where memory access dominates.
    /// The larger value makes planned runs end early rather than late.
    const GROWTH: f64 = 0.9;
    (resolution as f64).powf(GROWTH)
}

impl<T: Real> Plenoxels<T> {
    /// Prepares the grid and the rays for a stage.
    pub(super) fn begin(&mut self, index: usize, rays: &mut RaySource) -> Result<()> {
        let stage = self.stages[index];
        if let (Sampling::Points { .. }, true) = (stage.sampling, self.grid.shape().coordinates != GridSpace::WORLD) {
            let found = "points on straight rays cannot sample a grid of a capture";
            return Err(Error::usage("stages[*].sampling", found, "set sampling.step"));
        }
        if let Some(scout) = self.config.scout.as_ref().filter(|_| (1..=self.scouts).contains(&index)) {
            self.grid = self.after_scout(scout, index, rays)?;
        }
        // The densities alone determine which voxels will exist. With all colors, voxels that are pruned at once might not fit into memory.
        release_free_buffers();
        let changes = stage.resolution != self.grid.shape().resolution;
        let mut outline = self.grid.outline();
        if changes {
            outline = self.refined(outline, index, rays)?;
        }
        if let Some(silhouettes) = self.silhouettes.as_ref().filter(|_| changes || index == 0) {
            outline = outline.pruned(&silhouettes.voxels(&outline));
            if outline.lattice().present() == 0 {
                return Err(Silhouettes::nothing_inside());
            }
        }
        if stage.image_reduction != rays.reduction() {
            rays.set_reduction(stage.image_reduction);
        }
        self.aim(Field::<T>::reach(&outline), rays);
        if self.prunes(index) {
            outline = outline.pruned(&self.worth_keeping(&outline, &stage, None, rays)?);
            self.aim(Field::<T>::reach(&outline), rays);
            self.check_rows(&outline)?;
        }
        if changes {
            self.grid = self.grid.resample_as(&outline);
        } else if outline.lattice().present() < self.grid.lattice().present() {
            self.grid = self.grid.pruned(&outline.voxels_where(|_| true));
        }
        if self.config.project {
            self.grid.project();
        }
        Ok(())
    }

    /// Returns the grid of stage `index` that follows a stage of the scout.
    fn after_scout(&self, scout: &Scout, index: usize, rays: &RaySource) -> Result<VoxelGrid<T>> {
        let kept = self.worth_keeping(&self.grid, &self.stages[index - 1], Some(scout), rays)?;
        let initial = self.config.initial_of(index < self.scouts);
        let resolution = self.stages[index].resolution;
        Ok(start::scouted(&self.grid, &kept, rays.views(), self.config.carve.margin, resolution, &initial))
    }

    /// Returns an outline at the resolution of a stage. After a scout, the cube is only as tight as the scout's large voxels allow. The
    /// outline is therefore pruned before it is resampled, and the cube shrinks to the kept voxels. At the coarse resolution this takes a
    /// fraction of the time.
    fn refined(&self, outline: VoxelGrid<T>, index: usize, rays: &RaySource) -> Result<VoxelGrid<T>> {
        let resolution = self.stages[index].resolution;
        if self.scouts == 0 || !self.prunes(index) {
            return Ok(outline.resample(resolution));
        }
        let kept = self.worth_keeping(&outline, &self.stages[index - 1], None, rays)?;
        let half_width = kept.half_width().unwrap_or(outline.shape().half_width);
        Ok(outline.pruned(&kept).resample_in(resolution, half_width))
    }

    /// Errors if pruning leaves more rows than fit into memory.
    fn check_rows(&self, outline: &VoxelGrid<T>) -> Result<()> {
        let (rows, resolution, most) = (outline.lattice().rows(), outline.shape().resolution, self.most_rows);
        if rows <= most {
            return Ok(());
        }
        let found = format!("pruning leaves {rows} voxels at {resolution}³, but the available memory holds {most}");
        Err(Error::usage("prune_unseen_below", found, "increase it, or reduce the resolution of the last stages"))
    }

    /// Restricts training rays to the remaining voxels, if the config sets `aim` and the grid is one of the world.
    pub(super) fn aim(&self, reach: Option<&Occupancy>, rays: &mut RaySource) {
        if let Some(reach) = reach.filter(|_| self.config.aim && self.grid.shape().coordinates == GridSpace::WORLD) {
            rays.aim_at(reach);
        }
    }

    /// Returns the first stage that begins with pruning, if any. The index refers to [`Plenoxels::stages`]: it accounts for the scout's
    /// stages and for stages that were left out because training starts from a grid.
    pub fn prunes_from(&self) -> Option<usize> {
        let left_out = self.config.stages.len() + self.scouts - self.stages.len();
        self.config.prune_from_stage.map(|first| self.scouts + first.saturating_sub(left_out))
    }

    fn prunes(&self, index: usize) -> bool {
        self.prunes_from().is_some_and(|first| index >= first)
    }

    /// Returns the voxels that pruning or a scout keeps: voxels that hold matter and, if the config sets a threshold, are visible in a
    /// training ray.
    ///
    /// Errors if no voxel is kept.
    fn worth_keeping(&self, grid: &VoxelGrid<T>, stage: &Stage, scout: Option<&Scout>, rays: &RaySource) -> Result<Occupancy> {
        let (below, least) = (self.config.prune_below, scout.map_or(self.config.prune_unseen_below, |scout| scout.prune_unseen_below));
        let full = grid.occupancy(below);
        let kept = if least == 0.0 { full } else { full.intersection(&self.seen(grid, stage, least, rays)) };
        if kept.fraction() > 0.0 {
            return Ok(kept);
        }
        let remedy = match scout {
            Some(_) => format!("set prune_below lower than {below}, or scout.prune_unseen_below lower than {least}"),
            None => format!("set prune_below lower than {below}, prune_unseen_below lower than {least}, or prune_from_stage later"),
        };
        // The trainer adds the number of the step.
        Err(Error::Numeric { place: String::new(), found: "pruning would remove every voxel".to_owned(), remedy })
    }

    /// Returns the voxels whose largest weight in a pixel is at least `least`, dilated by a margin.
    fn seen(&self, grid: &VoxelGrid<T>, stage: &Stage, least: f64, rays: &RaySource) -> Occupancy {
        // As in svox2: its weights are attributed to the samples around a voxel, and voxels behind a surface must stay so that the surface
        // can move.
        const MARGIN: usize = 2;
        // No sample weighs more than the transmittance before it.
        let stop_below = self.config.stop_below.max(least);
        let options = RenderOptions { stop_below, ..self.config.render_options(grid, stage.sampling, Jitter::None) };
        let coordinates = grid.shape().coordinates;
        // In the contracted space a voxel looks at least as large as a cube of its size at the far end of a box of the world, and in normalized device
        // coordinates about as large with usual lenses.
        let stride = rays.stride(grid.shape().voxel_side(), grid.aabb());
        let rays = rays.lattice_of_rays(stride, RAYS_PER_BATCH).map(|rays| coordinates.rays(&rays).into_owned());
        let weights = largest_weights(grid, rays, &options);
        grid.voxels_where(|row| f64::from(weights[row]) >= least).dilated(MARGIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split, View};
    use crate::field::voxel_grid::GridShape;
    use crate::model::plenoxels::Trainer;
    use crate::model::plenoxels::config::{Config, Hull};
    use crate::train::Model;
    use autograd::Tensor;
    use glam::DVec3;
    use std::ops::Range;

    fn views() -> Vec<View> {
        let options = ProceduralOptions { width: 32, height: 32, train: 8, val: 0, test: 0, supersample: 1 };
        Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap()
    }

    fn config(scout: Option<usize>, prune_from_stage: Option<usize>) -> Config {
        let scout = scout.map(|n| Scout { density: 1.0, prune_unseen_below: 0.5, stages: vec![Stage::new(n, 1)] });
        let stages = vec![Stage::new(16, 1), Stage::new(32, 1)];
        Config { scout, prune_from_stage, prune_unseen_below: 0.1, hull: Hull::Off, stages, ..Config::default() }
    }

    /// Returns the initial grid of a stage if the previous stage learned `density` at these distances from the origin.
    fn after(config: Config, stage: usize, matter: Range<f64>, density: f64) -> Result<VoxelGrid<f64>> {
        let views = views();
        let trainer = Trainer::<f64>::new(config, &views[..]).unwrap();
        let plan = trainer.plan().to_vec();
        let n = plan[stage - 1].resolution.unwrap();
        let grid = VoxelGrid::uniform(trainer.config().grid_shape(n), 0.0, 0.0);
        let half = n as f64 / 2.0;
        let place = |node: [usize; 3]| DVec3::from(node.map(|k| ((k as f64 + 0.5) / half - 1.0) * grid.shape().half_width));
        let densities = (0..n.pow(3) as u32).map(|row| {
            let inside = grid.lattice().node(row).is_some_and(|node| matter.contains(&place(node).length()));
            if inside { density } else { 0.0 }
        });
        let mut rays = RaySource::new(&views[..], trainer.config().background, trainer.config().seed);
        let mut model = trainer.into_model();
        model.grid = grid.with_density(Tensor::from_vec(densities.collect(), &[n.pow(3), 1]));
        model.begin_stage(&plan[stage], &mut rays).map(|()| model.grid)
    }

    #[test]
    fn after_a_scout_what_its_matter_hides_is_there_and_the_cube_is_that_of_matter() {
        let config = config(Some(24), None);
        let whole = config.half_width;
        let grid = after(config, 1, 0.6..0.8, 50.0).unwrap();
        let GridShape { resolution, half_width, .. } = *grid.shape();
        assert!(resolution == 16 && (0.8..0.8 * whole).contains(&half_width), "{half_width}");
        // Three voxels from matter are more than the margin.
        assert!(grid.lattice().row([8; 3]).is_some());
        assert!(grid.lattice().row([0; 3]).is_none());
    }

    #[test]
    fn after_a_scout_the_cube_shrinks_to_what_a_finer_stage_begins_with() {
        let half_width = |scout: Option<usize>, prune_from_stage| {
            let stage = 1 + scout.iter().len();
            let grid = after(config(scout, prune_from_stage), stage, 0.0..0.4, 50.0).unwrap();
            assert_eq!(grid.shape().resolution, 32);
            grid.shape().half_width
        };
        let whole = Config::default().half_width;
        let fitted = half_width(Some(8), Some(1));
        assert!((0.4..0.8 * whole).contains(&fitted), "{fitted}");
        assert_eq!(half_width(Some(8), None), whole);
        assert_eq!(half_width(None, Some(1)), whole);
    }

    #[test]
    fn thin_matter_is_nothing_to_a_scout_and_something_to_pruning_which_say_what_to_lower() {
        // A sample weighs about a fifth of a pixel.
        let refusal = |result: Result<VoxelGrid<f64>>| result.err().map(|e| e.to_string()).unwrap_or_default();
        let said = refusal(after(config(Some(24), None), 1, 0.0..0.4, 4.0));
        assert!(said.contains("scout.prune_unseen_below lower than 0.5") && !said.contains("prune_from_stage"), "{said}");
        assert!(after(config(None, Some(1)), 1, 0.0..0.4, 4.0).is_ok());
        let said = refusal(after(config(None, Some(1)), 1, 0.0..0.4, 0.05));
        assert!(said.contains(" prune_unseen_below lower than 0.1, or prune_from_stage later"), "{said}");
    }
}
