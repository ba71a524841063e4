//! The grid in the page, for its viewer: how it is embedded, and what that costs.

use super::Report;
use crate::html::escaped;
use crate::progress::thousands;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use plenoxel::camera::Camera;
use plenoxel::dataset::Split;
use plenoxel::error::{Error, Result};
use plenoxel::export::web::WebGrid;
use plenoxel::field::voxel_grid::VoxelGrid;
use plenoxel::metrics;
use plenoxel::model::plenoxels::grid_viewer;
use plenoxel::run::evenly_spaced;
use plenoxel::run::memory::bytes;
use serde_json::{Value, json};

/// The most bytes of a grid in a page, before base64 makes four of three: 30 MB after it.
const MOST_BYTES: usize = 22_500_000;
/// Test views on which its cost is measured.
const COMPARED: usize = 3;
/// Views to begin from.
const VIEWS: usize = 25;

/// A grid in a page.
pub struct Scene {
    small: WebGrid,
    bytes: Vec<u8>,
    settings: Value,
    cost: Option<Cost>,
    /// Width and height of the first view.
    size: [usize; 2],
}

/// What is lost by quantising, and by resampling if that was necessary: means over a few test views, in dB.
struct Cost {
    views: usize,
    /// The whole grid's picture against the photograph.
    whole: f64,
    /// The small grid's.
    small: f64,
    /// The small grid's picture against the whole one's.
    between: f64,
}

impl Scene {
    /// The voxel grid of a report, made small; `None` if its model has none.
    pub fn of(report: &Report<'_>) -> Result<Option<Self>> {
        let Some(grid) = report.model.and_then(|model| model.content()?.downcast_ref()) else { return Ok(None) };
        let packed = WebGrid::within(grid, MOST_BYTES);
        let (small, bytes) = packed.map_err(|e| Error::io("report.html", e, "compressing the grid"))?;
        let split = if report.dataset.count(Split::Test) > 0 { Split::Test } else { Split::Train };
        let (cameras, names) = (report.dataset.cameras(split), report.dataset.view_names(split));
        let chosen = evenly_spaced(cameras.len(), VIEWS);
        let views: Vec<Value> = chosen.into_iter().map(|i| view(names[i], &cameras[i])).collect();
        let size = cameras.first().map_or([1, 1], |camera| [camera.intrinsics.width, camera.intrinsics.height]);
        let settings = json!({
            "grid": small.header(),
            "sampling": report.config.evaluation,
            "background": report.config.background,
            "views": views,
        });
        let cost = Cost::of(report, grid, &small)?;
        Ok(Some(Scene { small, bytes, settings, cost, size }))
    }

    /// The viewer.
    pub fn figure(&self) -> String {
        let [width, height] = self.size;
        format!(
            "<section><h2>Look around</h2>\n<figure id=\"viewer\"><canvas tabindex=\"0\" style=\"--shape: calc({height} / {width})\" \
             aria-label=\"interactive view of the trained grid\"></canvas>\n<figcaption>Drag to turn, wheel or pinch to zoom, shift and drag or two \
             fingers to move; arrow keys, + and −. <label>begin at <select></select></label> <button type=\"button\" \
             id=\"fill\">full screen</button> <button type=\"button\" id=\"save\">save picture</button><br>\n\
             <output></output><br>{}</figcaption></figure></section>",
            escaped(&self.note())
        )
    }

    /// What is in the page, and what it costs.
    pub fn note(&self) -> String {
        let (shape, header) = (self.small.shape(), self.small.header());
        let reduction =
            if shape.sh_reduction > 1 { format!(", harmonics for each {} voxels", shape.sh_reduction.pow(3)) } else { String::new() };
        let what = format!(
            "the page holds {} voxels of {}³{reduction} in {}",
            thousands(header.voxels as u64),
            shape.resolution,
            bytes(self.bytes.len() as u64)
        );
        match &self.cost {
            Some(Cost { views, whole, small, between }) => format!(
                "{what}, which show {views} test views with {small:.2} dB, the grid itself with {whole:.2} dB ({between:.1} dB between the two)"
            ),
            None => what,
        }
    }

    /// What makes the viewer work.
    pub fn scripts(&self) -> String {
        // A name of a view may hold anything, but no end of the script.
        let settings = self.settings.to_string().replace('<', "\\u003c");
        format!(
            "<script type=\"application/json\" id=\"scene\">{settings}</script>\n<script type=\"text/plain\" id=\"grid\">{}</script>\n\
             <script>\n{}</script>\n",
            STANDARD.encode(&self.bytes),
            include_str!("viewer.js"),
        )
    }
}

impl Cost {
    /// Renders a few test views with both grids.
    fn of(report: &Report<'_>, grid: &VoxelGrid<f32>, small: &WebGrid) -> Result<Option<Self>> {
        let chosen = evenly_spaced(report.dataset.count(Split::Test), COMPARED);
        let background = report.config.background;
        let small = small.to_grid();
        let [whole, small] =
            [grid, &small].map(|grid| grid_viewer(grid, report.config.evaluation, report.config.engine, report.config.background));
        let mut sums = [0.0; 3];
        for &i in &chosen {
            let view = report.dataset.load_view(Split::Test, i)?;
            let target = view.composite(background);
            let [whole, small] = [&whole, &small].map(|viewer| viewer.see(&view.camera).rgb);
            let clamped = whole.mapv(|value| value.clamp(0.0, 1.0));
            let pairs = [(&whole, &target), (&small, &target), (&small, &clamped)];
            for (sum, (prediction, reference)) in sums.iter_mut().zip(pairs) {
                *sum += metrics::psnr(prediction.view(), reference.view()) / chosen.len() as f64;
            }
        }
        let [whole, small, between] = sums;
        Ok((!chosen.is_empty()).then_some(Cost { views: chosen.len(), whole, small, between }))
    }
}

/// A camera as the viewer takes it: its right, up and backward axes and its position, and the lens in pixels.
fn view(name: &str, camera: &Camera) -> Value {
    let k = &camera.intrinsics;
    json!({
        "name": name,
        "pose": camera.camera_to_world.to_cols_array(),
        "width": k.width,
        "height": k.height,
        "fx": k.fx,
        "fy": k.fy,
        "cx": k.cx,
        "cy": k.cy,
    })
}
