//! Occupancy that follows a density during training (Müller et al. 2022, appendix C).
//!
//! Each cell has an estimate of its largest density. A refresh multiplies all estimates by a decay, draws a random point in some cells, and
//! sets their estimates to the density there if it is larger. A cell is occupied if its estimate is above min(limit, mean of all estimates).

use super::Occupancy;
use autograd::lattice::{BRICK_ROWS, bits};
use autograd::random::Stream;
use autograd::{Real, Tensor, no_grad};
use glam::DVec3;

/// How an occupancy follows a density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refresh {
    /// Factor of the estimates in a refresh.
    pub decay: f64,
    /// Density, 1 / world length, above which a cell is always occupied.
    pub limit: f64,
    /// Largest number of steps between two refreshes. At step k they are k / `every` steps apart, but at least 1 and at most `every`.
    pub every: u64,
    /// Number of steps during which a refresh visits all cells. Later ones visit a half as many: a quarter anywhere, and a quarter among
    /// the occupied cells.
    pub warm_up: u64,
}

impl Refresh {
    /// Returns true if the occupancy is refreshed before a step.
    pub fn is_due(&self, step: u64) -> bool {
        step.is_multiple_of((step / self.every.max(1)).clamp(1, self.every.max(1)))
    }
}

/// Estimates of the density of the cells of a box.
#[derive(Clone, Debug)]
pub struct RunningOccupancy {
    /// Cells that may be occupied.
    among: Occupancy,
    /// Number of each of them: brick · 64 + bit.
    cells: Vec<u32>,
    /// Estimate of each of them.
    density: Vec<f32>,
    refresh: Refresh,
}

impl RunningOccupancy {
    /// Creates estimates of 0 for the cells `among`. Other cells are never occupied.
    pub fn new(among: Occupancy, refresh: Refresh) -> Self {
        let cells: Vec<u32> =
            (0..).zip(among.masks()).flat_map(|(b, &mask)| bits(mask).map(move |bit| b * BRICK_ROWS as u32 + bit as u32)).collect();
        RunningOccupancy { density: vec![0.0; cells.len()], cells, among, refresh }
    }

    /// Returns the cells that may be occupied.
    pub fn among(&self) -> &Occupancy {
        &self.among
    }

    /// Returns how the occupancy follows the density.
    pub fn refresh(&self) -> Refresh {
        self.refresh
    }

    /// Returns the estimates of the cells that may be occupied, brick after brick.
    pub fn estimates(&self) -> &[f32] {
        &self.density
    }

    /// Sets the estimates, as returned by [`estimates`](Self::estimates).
    ///
    /// Panics if the number is another.
    #[track_caller]
    pub fn set_estimates(&mut self, density: Vec<f32>) {
        assert_eq!(density.len(), self.cells.len(), "set_estimates: there must be one for each cell");
        self.density = density;
    }

    /// Returns the density above which a cell is occupied.
    fn threshold(&self) -> f64 {
        let sum: f64 = self.density.iter().map(|&density| f64::from(density)).sum();
        self.refresh.limit.min(sum / self.density.len().max(1) as f64)
    }

    /// Returns the occupied cells.
    pub fn occupied(&self) -> Occupancy {
        let mut masks = vec![0; self.among.masks().len()];
        let threshold = self.threshold();
        for (&cell, _) in self.cells.iter().zip(&self.density).filter(|(_, density)| f64::from(**density) > threshold) {
            masks[cell as usize / BRICK_ROWS] |= 1 << (cell as usize % BRICK_ROWS);
        }
        Occupancy::from_masks(self.among.aabb(), self.among.cells(), masks)
    }

    /// Refreshes the estimates before a step. `density` maps world positions `[m, 3]` to `[m]` and may be that of any field; it is evaluated
    /// without recording a gradient. The result is a function of the estimates, the density, the seed and the step.
    pub fn update<T: Real>(&mut self, seed: u64, step: u64, density: impl Fn(&Tensor<T>) -> Tensor<T>) {
        let random = Stream::new(seed).named("occupancy").numbered(step);
        let visited = self.visited(step, random.named("cells"));
        self.density.iter_mut().for_each(|density| *density *= self.refresh.decay as f32);
        let inside = random.named("positions");
        let bricks = self.among.bricks();
        let (aabb, sides) = (self.among.aabb(), self.among.sides());
        const TOGETHER: usize = 1 << 16;
        for (first, visited) in (0..).step_by(TOGETHER).zip(visited.chunks(TOGETHER)) {
            let position = |(k, &i): (u64, &u32)| {
                let cell = self.cells[i as usize] as usize;
                let corner = DVec3::from_array(bricks.node(cell / BRICK_ROWS, cell % BRICK_ROWS).map(|k| k as f64));
                let share = DVec3::from_array([0, 1, 2].map(|a| inside.uniform(3 * k + a)));
                (aabb.min + sides * (corner + share)).to_array().map(T::lit)
            };
            let positions = (first..).zip(visited).flat_map(position).collect();
            let found = no_grad(|| density(&Tensor::from_vec(positions, &[visited.len(), 3])));
            for (&i, found) in visited.iter().zip(found.data()) {
                let estimate = &mut self.density[i as usize];
                *estimate = estimate.max(found.as_f64() as f32);
            }
        }
    }

    /// Returns the cells that a refresh visits, as indices of `cells`.
    fn visited(&self, step: u64, random: Stream) -> Vec<u32> {
        let all = self.cells.len() as u32;
        if step < self.refresh.warm_up {
            return (0..all).collect();
        }
        let threshold = self.threshold();
        let occupied: Vec<u32> = (0..all).filter(|&i| f64::from(self.density[i as usize]) > threshold).collect();
        let quarter = u64::from(all / 4);
        let below = |k: u64, count: usize| (random.bits(k) % count as u64) as usize;
        let anywhere = (0..quarter).map(|k| below(k, all as usize) as u32);
        let among = if occupied.is_empty() { 0..0 } else { quarter..2 * quarter };
        let mut visited: Vec<u32> = anywhere.chain(among.map(|k| occupied[below(k, occupied.len())])).collect();
        // Neighbouring cells read the same rows of a field.
        visited.sort_unstable();
        visited
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Aabb;

    const REFRESH: Refresh = Refresh { decay: 0.5, limit: 1.0, every: 4, warm_up: 10 };

    fn ball(positions: &Tensor<f64>) -> Tensor<f64> {
        let inside = positions.data().as_chunks::<3>().0.iter().map(|p| if DVec3::from_array(*p).length() < 0.6 { 8.0 } else { 0.0 });
        Tensor::from_vec(inside.collect(), &[positions.shape()[0]])
    }

    fn whole() -> Occupancy {
        Occupancy::new(Aabb::cube(1.0), [10; 3], &[true; 1000])
    }

    #[test]
    fn cells_with_matter_are_occupied_and_are_forgotten_when_it_goes() {
        let mut running = RunningOccupancy::new(whole(), REFRESH);
        (0..8).for_each(|step| running.update(1, step, ball));
        let occupied = running.occupied();
        // The ball touches the cells within 0.6 and half a diagonal of a cell, 0.17, of the middle.
        for i in 0..1000 {
            let cell = [i / 100, i / 10 % 10, i % 10];
            let distance = DVec3::from_array(cell.map(|k| 0.2 * k as f64 - 0.9)).length();
            assert!(occupied.contains(cell) || distance > 0.6 - 0.18, "{cell:?}");
            assert!(!occupied.contains(cell) || distance < 0.6 + 0.18, "{cell:?}");
        }
        // Four halvings of 8 leave 0.5, below the limit of 1 but above the mean; with the matter gone, the mean falls with the estimates.
        (8..12).for_each(|step| running.update(1, step, |at| ball(at) * 0.0));
        assert!(running.estimates().iter().all(|&estimate| estimate <= 0.5));
    }

    #[test]
    fn later_refreshes_visit_half_as_many_cells_the_same_for_the_same_seed() {
        let mut running = RunningOccupancy::new(whole(), REFRESH);
        running.update(1, 0, ball);
        let visited = |running: &RunningOccupancy, step: u64, seed: u64| {
            let count = std::cell::Cell::new(0);
            let mut after = running.clone();
            after.update(seed, step, |at: &Tensor<f64>| {
                count.set(count.get() + at.shape()[0]);
                ball(at)
            });
            (count.get(), after.density)
        };
        assert_eq!((visited(&running, 9, 1).0, visited(&running, 10, 1).0), (1000, 500));
        assert_eq!(visited(&running, 10, 1), visited(&running, 10, 1));
        assert_ne!(visited(&running, 10, 1).1, visited(&running, 10, 2).1);
    }

    #[test]
    fn refreshes_are_frequent_at_first() {
        let due: Vec<u64> = (0..30).filter(|&step| REFRESH.is_due(step)).collect();
        assert_eq!(due, [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 16, 20, 24, 28]);
    }
}
