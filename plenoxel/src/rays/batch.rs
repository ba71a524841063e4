//! A batch of rays with what is known along each.

use crate::camera::Ray;
use autograd::{Real, Tensor};

/// Rays with what the photographs show along them.
///
/// Every list and tensor is in the order of `rays`, n of them.
#[derive(Debug, Clone)]
pub struct RayBatch<T: Real> {
    /// Origins and unit directions, world frame.
    pub rays: Vec<Ray>,
    /// `[n, 3]`, sRGB in [0, 1], composited over the background.
    pub target: Tensor<T>,
    /// `[n]`, in [0, 1]: how much of the pixel is object, where the images have an alpha channel; 1 where they have none.
    pub alpha: Tensor<T>,
    /// Number of each ray's view in its source, from 0: an index for tables of a row for each view.
    pub view: Vec<u32>,
    /// Column and row of each ray's pixel, from 0 at the top left, in the image of its view as reduced at the time; the ray passes through the
    /// pixel's centre, at + ½.
    pub pixel: Vec<[u32; 2]>,
    /// `[n]`, world length: distance along the unit ray to the first surface ([`View::depth`](crate::dataset::View::depth)), infinite where the ray
    /// meets none, NaN for rays of views without a depth image. `None` unless it was asked for
    /// ([`RaySource::with_depth`](crate::rays::RaySource::with_depth)) and some view has it.
    pub depth: Option<Tensor<T>>,
    /// `[n, width]` by name, in the order in which the source was given them ([`RaySource::with_channel`](crate::rays::RaySource::with_channel)).
    pub channels: Vec<(String, Tensor<T>)>,
}

impl<T: Real> RayBatch<T> {
    /// The number of rays.
    pub fn len(&self) -> usize {
        self.rays.len()
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.rays.is_empty()
    }

    /// The channel of this name, `[n, width]`; `None` if the source was given none.
    pub fn channel(&self, name: &str) -> Option<&Tensor<T>> {
        self.channels.iter().find(|(found, _)| found == name).map(|(_, values)| values)
    }

    /// The channel of this name, `[n, width]`, for a loss that cannot do without.
    ///
    /// Panics at the caller's line, naming the channels that there are, if the source was given none of this name.
    #[track_caller]
    pub fn expect_channel(&self, name: &str) -> &Tensor<T> {
        let names = || self.channels.iter().map(|(name, _)| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        self.channel(name).unwrap_or_else(|| panic!("the batch has no channel `{name}`; its channels: [{}]", names()))
    }
}
