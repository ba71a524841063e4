//! The addresses of a live page: the page, its scene, pictures, and the training.

use super::http::{Method, Request, Response};
use super::order::{Desk, FileFormat, Frame, Shot};
use super::place::Places;
use super::server;
use super::training::Training;
use crate::html;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use plenoxel::camera::Camera;
use plenoxel::camera_path::{Turntable, up_axis};
use plenoxel::dataset::{Dataset, Split};
use plenoxel::space::Space;
use serde_json::{Value, json};
use std::sync::Arc;

/// Largest number of pictures that are waited for, or sent, at once.
const PICTURES: usize = 8;
/// JPEG quality of pictures in motion.
const QUALITY: u8 = 85;
const JSON: &str = "application/json";
const SVG: &str = "image/svg+xml";

/// Cameras and axes of a scene, for the page.
pub struct Scene {
    /// Title of the page.
    pub title: String,
    views: Vec<Value>,
    /// Vertical axis of the world.
    up: [f64; 3],
    /// Smallest distance of the point around which the camera turns from a view.
    near: f64,
    /// Largest coordinate of a camera.
    far: f64,
}

/// Largest coordinate of a camera in a space that is not bent.
const FAR: f64 = 1e6;
/// Largest coordinate of a camera in contracted space, where the samples on a ray grow in number with the distance of the camera. It is at least
/// `FAR_OF_CAMERAS` times the largest of the training cameras.
const FAR_IN_CONTRACTED: f64 = 10.0;
const FAR_OF_CAMERAS: f64 = 2.0;

/// Returns the largest coordinate of a camera in a space with these cameras.
fn far<'c>(space: Space, cameras: impl Iterator<Item = &'c Camera>) -> f64 {
    let farthest = cameras.map(|camera| camera.position().abs().max_element()).fold(0.0, f64::max);
    match space {
        Space::Contracted => FAR_IN_CONTRACTED.max(FAR_OF_CAMERAS * farthest),
        Space::Box | Space::Ndc { .. } => FAR,
    }
}

impl Scene {
    /// Creates the scene of a dataset with its training cameras.
    pub fn of(title: String, dataset: &Dataset) -> Self {
        let (cameras, names) = (dataset.cameras(Split::Train), dataset.view_names(Split::Train));
        let views = names.iter().zip(&cameras).map(|(name, camera)| html::camera(name, camera)).collect();
        let near = match dataset.space() {
            Space::Box => 0.1,
            Space::Contracted => 0.5,
            // Nothing is seen before depth 1.
            Space::Ndc { .. } => 2.0,
        };
        let far = far(dataset.space(), cameras.iter());
        Scene { title, views, up: up_axis(dataset.space(), &cameras).to_array(), near, far }
    }

    /// Creates a scene without a dataset: a camera that sees the box with this half width in a space.
    pub fn around_box(title: String, half_width: f64, space: Space) -> Self {
        const SIZE: (usize, usize) = (800, 600);
        let cameras: Vec<Camera> = Turntable::around_box(half_width).orbit(1).iter().map(|shot| shot.camera(SIZE)).collect();
        Scene {
            title,
            views: cameras.iter().map(|camera| html::camera("outside", camera)).collect(),
            up: [0.0, 0.0, 1.0],
            near: 0.1,
            far: far(space, cameras.iter()),
        }
    }
}

/// The site of a live page.
pub struct Site {
    page: String,
    scene: String,
    /// Largest coordinate of a camera.
    far: f64,
    desk: Desk,
    /// The run, while it is trained.
    training: Option<Arc<Training>>,
    pictures: Places,
}

impl Site {
    pub fn new(scene: &Scene, desk: Desk, training: Option<Arc<Training>>) -> Self {
        let Scene { title, views, up, near, far } = scene;
        let scene = json!({ "views": views, "up": up, "near": near, "far": far, "most_pixels": super::MOST_PIXELS, "training": training.is_some() });
        let body = format!("{}<script>\n{}{}</script>\n", include_str!("page.html"), html::CAMERA, include_str!("page.js"));
        let page = html::page(title, include_str!("page.css"), &body);
        Site { page, scene: scene.to_string(), far: *far, desk, training, pictures: Places::new(PICTURES) }
    }

    fn picture(&self, request: &Request, gone: &dyn Fn() -> bool) -> Response {
        let shot = match Shot::parse(&request.body, self.far) {
            Ok(shot) => shot,
            Err(why) => return Response::refusal(400, &why),
        };
        let Some(place) = self.pictures.take() else {
            return Response::refusal(503, "there are too many requests for pictures");
        };
        let format = shot.format;
        match self.desk.picture(shot, gone) {
            Some(frame) => Response { place: Some(place), ..encoded(&frame, format) },
            None => Response::refusal(503, "the program renders no more pictures"),
        }
    }
}

impl server::Site for Site {
    fn answer(&self, path: &str, request: &Request, gone: &dyn Fn() -> bool) -> Response {
        match (request.method, path, &self.training) {
            (Method::Get, "", _) => Response::new("text/html; charset=utf-8", self.page.as_str()),
            (Method::Get, "scene", _) => Response::new(JSON, self.scene.as_str()),
            (Method::Post, "picture", _) => self.picture(request, gone),
            (Method::Get, "training", Some(training)) => Response::new(JSON, training.status().to_string()),
            (Method::Get, "loss.svg", Some(training)) => Response::new(SVG, training.loss()),
            (Method::Get, "psnr.svg", Some(training)) => Response::new(SVG, training.psnr()),
            (Method::Post, "stop", Some(training)) => {
                training.stop();
                Response::new(JSON, training.status().to_string())
            }
            (Method::Post, "checkpoint", Some(training)) => {
                training.ask_for_checkpoint();
                Response::new(JSON, training.status().to_string())
            }
            _ => Response::refusal(404, "not found"),
        }
    }
}

/// Encodes a picture.
fn encoded(frame: &Frame, format: FileFormat) -> Response {
    let mut bytes = Vec::new();
    let (media, written) = match format {
        FileFormat::Jpeg => ("image/jpeg", frame.image.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, QUALITY))),
        FileFormat::Png => {
            let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive);
            ("image/png", frame.image.write_with_encoder(encoder))
        }
    };
    match written {
        Ok(()) => Response { seconds: Some(frame.seconds), ..Response::new(media, bytes) },
        Err(e) => Response::refusal(503, &format!("the picture cannot be encoded: {e}")),
    }
}
