//! Squares of neighbouring pixels, for losses that compare a pixel with those around it.

use super::RaySource;
use crate::random::{Purpose, bits};

impl RaySource {
    /// Random squares of `side` × `side` pixels of the views as reduced now, as (view, column, row) for [`batch_of`](Self::batch_of): square
    /// after square, row after row, so that colors of the batch have the shape `[count, side, side, 3]`.
    ///
    /// Every square that lies in a view is as likely as any other, and they may overlap; whether rays are aimed does not matter. They are a function
    /// of the source's seed and of `step`.
    ///
    /// Panics if `side` is 0 or larger than all views.
    #[track_caller]
    pub fn patches(&self, step: u64, count: usize, side: u32) -> Vec<(u32, u32, u32)> {
        assert!(side > 0, "patches: squares of 0 x 0 pixels");
        // Columns and rows in which a square can begin.
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
