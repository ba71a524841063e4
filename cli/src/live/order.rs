//! Orders for pictures: from the threads of connections to the thread that has the model.

use crate::images::{self, Channel, DepthRange};
use crate::interrupt;
use glam::{DAffine3, DMat3, DVec3};
use image::RgbImage;
use plenoxel::camera::lens::Lens;
use plenoxel::camera::{Camera, Intrinsics};
use plenoxel::evaluate::Viewer;
use plenoxel::render::picture::Picture;
use serde::Deserialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender, SyncSender};
use std::time::{Duration, Instant};

/// Largest number of pixels of a picture.
pub const MOST_PIXELS: usize = 1 << 22;
/// Largest side of a picture, in pixels.
const LONGEST: usize = 8192;
/// Focal lengths, in sides of the picture.
const FOCAL: std::ops::RangeInclusive<f64> = 1e-3..=1e3;
/// Largest error of the entries of Rᵀ R.
const TURNED: f64 = 1e-3;
/// Interval at which a waiting connection checks whether its client is still there.
const CHECK: Duration = Duration::from_millis(20);

/// File format of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FileFormat {
    /// Small, for motion.
    Jpeg,
    /// Exact.
    Png,
}

/// A picture that is asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    pub camera: Camera,
    pub channel: Channel,
    pub format: FileFormat,
}

impl Shot {
    /// Parses the body of a request: a JSON object. `far` is the largest coordinate of a camera.
    ///
    /// Errors: it is not one, or its numbers are out of bounds.
    pub fn parse(json: &[u8], far: f64) -> Result<Self, String> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Asked {
            /// Right, up and backward axes, and position.
            pose: [f64; 12],
            width: usize,
            height: usize,
            fx: f64,
            fy: f64,
            cx: f64,
            cy: f64,
            channel: Channel,
            format: FileFormat,
        }
        let Asked { pose, width, height, fx, fy, cx, cy, channel, format } = serde_json::from_slice(json).map_err(|e| e.to_string())?;
        let sides = [width, height];
        if !sides.iter().all(|side| (1..=LONGEST).contains(side)) || width * height > MOST_PIXELS {
            return Err(format!("a picture has at most {LONGEST} pixels per side and {MOST_PIXELS} in all"));
        }
        let rotation = DMat3::from_cols_slice(&pose[..9]);
        let position = DVec3::from_slice(&pose[9..]);
        if !(rotation.transpose() * rotation).abs_diff_eq(DMat3::IDENTITY, TURNED) || rotation.determinant() < 0.0 {
            return Err("the axes of the camera are not those of a rotation".to_owned());
        }
        if !(0.0..=far).contains(&position.abs().max_element()) {
            return Err(format!("the coordinates of a camera are at most {far}"));
        }
        for (side, focal, center) in [(width, fx, cx), (height, fy, cy)] {
            let side = side as f64;
            if !FOCAL.contains(&(focal / side)) || !(0.0..=LONGEST as f64).contains(&center.abs()) {
                return Err("the focal length or the principal point is out of bounds".to_owned());
            }
        }
        if channel == Channel::Normal {
            return Err("expected the channel color, depth or opacity".to_owned());
        }
        let intrinsics = Intrinsics { width, height, fx, fy, cx, cy, lens: Lens::Pinhole };
        Ok(Shot { camera: Camera { intrinsics, camera_to_world: DAffine3::from_mat3_translation(rotation, position) }, channel, format })
    }
}

/// A rendered picture.
pub struct Frame {
    pub image: RgbImage,
    /// Duration of rendering, in seconds.
    pub seconds: f64,
}

/// An order for a picture.
pub struct Order {
    shot: Shot,
    cancelled: Arc<AtomicBool>,
    reply: SyncSender<Frame>,
}

impl Order {
    /// Number of pixels of the picture.
    pub fn pixels(&self) -> usize {
        let intrinsics = self.shot.camera.intrinsics;
        intrinsics.width * intrinsics.height
    }

    /// True if the client has gone.
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Relaxed)
    }

    /// Renders the picture with `see`, which is given the camera and a function that says when to stop, and sends it. The depth of the colors is that of a
    /// box with this half width. Returns the duration in seconds; `None` if `see` was stopped.
    pub fn fill(self, half_width: f64, see: impl FnOnce(&Camera, &dyn Fn() -> bool) -> Option<Picture>) -> Option<f64> {
        let Order { shot: Shot { camera, channel, .. }, cancelled, reply } = self;
        let start = Instant::now();
        let picture = see(&camera, &|| cancelled.load(Relaxed))?;
        let image = images::to_rgb8(&images::shown(channel, &picture, DepthRange::of(&camera, half_width)));
        let seconds = start.elapsed().as_secs_f64();
        // Nobody may be waiting any more.
        drop(reply.send(Frame { image, seconds }));
        Some(seconds)
    }

    /// Renders the picture with a viewer of a model and sends it, as [`Order::fill`] does. It stops if the client has gone or the program is interrupted.
    pub fn fill_with(self, half_width: f64, viewer: &Viewer<'_, f32>) -> Option<f64> {
        self.fill(half_width, |camera, stopped| viewer.see_unless(camera, || stopped() || interrupt::requested()))
    }
}

/// The place where orders are given.
#[derive(Clone)]
pub struct Desk(Sender<Order>);

/// The place where orders are filled, one after the other.
pub struct Studio(Receiver<Order>);

/// Creates a desk and its studio.
pub fn studio() -> (Desk, Studio) {
    let (desk, studio) = mpsc::channel();
    (Desk(desk), Studio(studio))
}

impl Desk {
    /// Orders a picture and waits for it; `None` if the client has gone meanwhile, which cancels the order, if the program is interrupted, or if the studio is closed.
    pub fn picture(&self, shot: Shot, gone: &dyn Fn() -> bool) -> Option<Frame> {
        let (reply, frame) = mpsc::sync_channel(1);
        let cancelled = Arc::new(AtomicBool::new(false));
        self.0.send(Order { shot, cancelled: cancelled.clone(), reply }).ok()?;
        loop {
            match frame.recv_timeout(CHECK) {
                Ok(frame) => return Some(frame),
                Err(RecvTimeoutError::Timeout) if !gone() => {}
                Err(_) => break,
            }
        }
        cancelled.store(true, Relaxed);
        None
    }
}

impl Studio {
    /// Waits for the next order whose client is still there.
    pub fn next(&self, wait: Duration) -> Option<Order> {
        let mut order = self.0.recv_timeout(wait).ok()?;
        while order.is_cancelled() {
            order = self.0.try_recv().ok()?;
        }
        Some(order)
    }
}
