//! Square patches of pixels, for losses that compare a pixel with its neighbours.

use super::RaySource;
use crate::random::{Purpose, bits};

impl RaySource {
    /// Returns random patches of `side` × `side` pixels of the reduced views, as (view, column, row) for [`batch_of`](Self::batch_of). They
    /// are listed patch after patch and row after row, so the colors of the batch can be reshaped to `[count, side, side, 3]`.
    ///
    /// Patches are uniformly distributed over all positions inside a view, and may overlap. Aiming does not restrict them. They depend only
    /// on the seed of the source and on `step`.
    ///
    /// Panics if `side` is 0, or if no view contains a patch.
    #[track_caller]
    pub fn patches(&self, step: u64, count: usize, side: u32) -> Vec<(u32, u32, u32)> {
        assert!(side > 0, "patches: the side is 0");
        // Number of columns and rows at which a patch can begin.
        let places = self.views().iter().map(|view| {
            let (width, height) = view.image.dimensions();
            ((width + 1).saturating_sub(side), (height + 1).saturating_sub(side))
        });
        let places: Vec<(u32, u32)> = places.collect();
        let area = |&(columns, rows): &(u32, u32)| u64::from(columns) * u64::from(rows);
        let total: u64 = places.iter().map(area).sum();
        assert!(total > 0, "patches: no view has {side} x {side} pixels");
        let corner = |square: usize| {
            let random = bits(self.seed, Purpose::Patches, step, square as u64);
            let mut place = ((u128::from(random) * u128::from(total)) >> 64) as u64;
            let mut view = 0;
            while place >= area(&places[view]) {
                place -= area(&places[view]);
                view += 1;
            }
            let columns = u64::from(places[view].0);
            (view as u32, (place % columns) as u32, (place / columns) as u32)
        };
        let square = |(view, x, y): (u32, u32, u32)| (y..y + side).flat_map(move |y| (x..x + side).map(move |x| (view, x, y)));
        (0..count).map(corner).flat_map(square).collect()
    }
}
