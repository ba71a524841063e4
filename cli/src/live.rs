//! Live pages: `plenoxel view`, and `plenoxel train --view`.
//!
//! The program renders; the browser sends cameras and shows pictures. Three parts know nothing of each other's work: the server (`http.rs`,
//! `server.rs`) answers requests within limits; the renderer (`order.rs`) fills orders for pictures, one after the other, on the thread that has the
//! model; the site (`site.rs`, `training.rs`) has the addresses of a page and turns requests into orders.
//!
//! A visitor writes nothing. Of a run in training it may ask what Ctrl-C asks, and for a checkpoint.

mod http;
mod order;
mod place;
mod server;
mod site;
#[cfg(test)]
mod tests;
mod training;

pub use order::{MOST_PIXELS, studio};
pub use server::Door;
pub use site::{Scene, Site};
pub use training::{LiveTraining, Training};
