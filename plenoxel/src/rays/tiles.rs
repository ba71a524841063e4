//! Tiles of the views that can show matter.

use crate::camera::projection::{Projection, Rectangle};
use crate::dataset::View;
use crate::sampling::Occupancy;
use autograd::lattice::BrickGrid;
use autograd::{dispatched, parallel};

/// Side of a tile in pixels.
const SIDE: u32 = 8;

/// Rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tile {
    /// Number of the view.
    pub view: u32,
    /// First column and first row.
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

impl Tile {
    /// Returns a tile that covers a whole view.
    pub fn of_view(number: usize, view: &View) -> Self {
        let (width, height) = view.image.dimensions();
        Tile { view: number as u32, x: 0, y: 0, width, height }
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Returns the parts of the tile, at most 8 pixels wide and high.
    pub fn parts(&self) -> impl Iterator<Item = Self> + use<> {
        let Tile { view, x, y, width, height } = *self;
        let along = |from: u32, count: u32| (from..from + count).step_by(SIDE as usize).map(move |at| (at, SIDE.min(from + count - at)));
        along(y, height).flat_map(move |(y, height)| along(x, width).map(move |(x, width)| Tile { view, x, y, width, height }))
    }

    /// Returns the parts of the tile that the mask of its view keeps: itself without a mask, otherwise runs of its rows.
    pub fn kept(self, view: &View) -> Vec<Self> {
        let Some(mask) = &view.mask else { return vec![self] };
        let (from, to) = (self.x as usize, (self.x + self.width) as usize);
        let of_row = |y: u32| {
            let run = move |(x, width): (usize, usize)| Tile { x: x as u32, y, width: width as u32, height: 1, ..self };
            mask.runs(y as usize, from, to).map(run)
        };
        (self.y..self.y + self.height).flat_map(of_row).collect()
    }
}

/// Returns the tiles that show matter: those that intersect the bounding rectangle of a projected brick of cells. If a brick is beside or behind a camera, or
/// partly not shown by its lens, returns all tiles of the view.
pub fn showing(views: &[View], matter: &Occupancy) -> Vec<Tile> {
    let (aabb, cells) = (matter.aabb(), matter.cells());
    // A ray through an interior brick, whose six neighbours have matter, also crosses a border brick, so only border bricks are projected.
    let has_matter = |brick: usize| matter.masks()[brick] != 0;
    let is_interior = |brick: usize| neighbours(matter.bricks(), brick).is_some_and(|all| all.into_iter().all(has_matter));
    let bricks = (0..matter.masks().len()).filter(|&brick| has_matter(brick) && !is_interior(brick));
    let boxes: Vec<[[usize; 3]; 2]> = bricks.map(|brick| matter.bricks().bounds(brick)).collect();
    let of_views = parallel::map_indices(views.len(), |v| {
        let all = Tile::of_view(v, &views[v]);
        let (columns, rows) = (all.width.div_ceil(SIDE), all.height.div_ceil(SIDE));
        let mut shows = vec![false; (columns * rows) as usize];
        mark(&Projection::of(&views[v].camera, views[v].size(), aabb, cells), &boxes, [columns, rows], &mut shows);
        all.parts().zip(shows).filter(|(_, shows)| *shows).map(|(tile, _)| tile).collect::<Vec<_>>()
    });
    of_views.concat()
}

/// Returns the bricks that share a face with a brick; `None` if the brick is at a face of the box.
fn neighbours(bricks: BrickGrid, brick: usize) -> Option<[usize; 6]> {
    let (place, count) = (bricks.place(brick), bricks.count());
    let inner = (0..3).all(|a| place[a] > 0 && place[a] + 1 < count[a]);
    inner.then(|| {
        std::array::from_fn(|n| {
            let mut next = place;
            next[n / 2] = if n % 2 == 0 { place[n / 2] - 1 } else { place[n / 2] + 1 };
            bricks.number(next)
        })
    })
}

dispatched! {
/// Marks the tiles, of which there are `columns` by `rows`, that show one of the boxes of cells.
fn mark(projection: &Projection, boxes: &[[[usize; 3]; 2]], [columns, rows]: [u32; 2], shows: &mut [bool]) {
    for &[low, high] in boxes {
        let Some(Rectangle { low, high }) = projection.bounds(low, high, 0.0) else {
            shows.fill(true);
            return;
        };
        let range = |a: usize, n: u32| {
            let clamped = |x: f64| (x / f64::from(SIDE)).floor().clamp(0.0, f64::from(n)) as u32;
            clamped(low[a])..(clamped(high[a]) + 1).min(n)
        };
        for row in range(1, rows) {
            let own = range(0, columns);
            shows[(row * columns + own.start) as usize..(row * columns + own.end.max(own.start)) as usize].fill(true);
        }
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::procedural::ProceduralOptions;
    use crate::dataset::{Dataset, Split};
    use crate::geometry::Aabb;
    use crate::sampling::walk::Walk;
    use glam::dvec3;
    use std::ops::ControlFlow;

    #[test]
    fn every_pixel_whose_ray_meets_matter_is_in_one_tile_and_many_others_in_none() {
        let options = ProceduralOptions { width: 50, height: 37, train: 6, val: 0, test: 0, supersample: 1 };
        let views = Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap();
        let cells = [30; 3];
        let ball = |v: usize| {
            let at = [v / 900, v / 30 % 30, v % 30].map(|k| (k as f64 + 0.5) / 15.0 - 1.0);
            dvec3(at[0] - 0.2, at[1], at[2]).length() < 0.45
        };
        let matter = Occupancy::new(Aabb::cube(1.0), cells, &(0..27000).map(ball).collect::<Vec<_>>());
        let has_matter = |brick: usize| matter.masks()[brick] != 0;
        let interior = |brick: &usize| neighbours(matter.bricks(), *brick).is_some_and(|all| all.into_iter().all(has_matter));
        assert!((0..matter.masks().len()).filter(interior).count() > 0, "bricks inside of matter");
        let mut times = vec![vec![0; 50 * 37]; views.len()];
        for tile in showing(&views, &matter) {
            for (x, y) in (0..tile.pixels() as u32).map(|p| (tile.x + p % tile.width, tile.y + p / tile.width)) {
                times[tile.view as usize][(y * 50 + x) as usize] += 1;
            }
        }
        let walk = Walk::new(Aabb::cube(1.0), cells);
        for (view, times) in views.iter().zip(&times) {
            for (p, &times) in times.iter().enumerate() {
                let mut meets = false;
                let ray = view.camera.ray((p % 50) as f64 + 0.5, (p / 50) as f64 + 0.5);
                walk.along(
                    &ray,
                    |_| 0,
                    |crossing| {
                        meets |= matter.contains(crossing.voxel);
                        ControlFlow::Continue(())
                    },
                );
                assert!(times == 1 || times == 0 && !meets, "{} pixel {p}: {times}, {meets}", view.name);
            }
            assert!(times.iter().filter(|n| **n == 0).count() > 600, "{}", view.name);
        }
    }
}
