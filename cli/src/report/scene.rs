//! The embedded grid of a report, for its viewer, and the loss of quality by its compression. Other fields are baked into a grid first.

use super::Report;
use crate::html::{self, escaped};
use crate::progress::{Console, thousands};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use plenoxel::bake::{self, BakeOptions, Source, bake};
use plenoxel::camera::Camera;
use plenoxel::camera_path::up_axis;
use plenoxel::dataset::Split;
use plenoxel::error::{Error, Result};
use plenoxel::evaluate::Viewer;
use plenoxel::export::web::WebGrid;
use plenoxel::field::voxel_grid::{GridSpace, VoxelGrid};
use plenoxel::metrics;
use plenoxel::model::Model;
use plenoxel::model::plenoxels::config::Sampling;
use plenoxel::model::plenoxels::grid_viewer;
use plenoxel::run::evenly_spaced;
use plenoxel::run::memory::bytes;
use plenoxel::space::Space;
use plenoxel::train::ViewOptions;
use serde_json::{Value, json};

/// Maximum size of the embedded grid in bytes, which becomes 30 MB in base64.
const MOST_BYTES: usize = 22_500_000;
/// Number of test views for the PSNR of the embedded grid.
const COMPARED: usize = 3;
/// Maximum number of start views in a box of the world, and in other spaces, where they are training views.
const VIEWS: usize = 25;
const TRAINING_VIEWS: usize = 120;

/// Most voxels along each axis of a grid that is baked for the page, in a box of the world and in other spaces, whose boxes hold much more.
const BAKED_VOXELS: usize = 256;
const BAKED_VOXELS_OF_CAPTURES: usize = 384;
/// Most voxels of that grid.
const MOST_BAKED: usize = 4_000_000;
/// Degree of its harmonics.
const BAKED_DEGREE: usize = 2;
/// Length of a step in other spaces, in sides of voxels.
const STEP: f64 = 0.5;

/// The embedded grid.
pub struct Scene {
    /// True if the grid was baked.
    baked: bool,
    coordinates: GridSpace,
    small: WebGrid,
    bytes: Vec<u8>,
    settings: Value,
    cost: Option<Cost>,
    /// Width and height of the first view.
    size: [usize; 2],
}

/// Loss of quality by baking, quantization and, if necessary, resampling: mean PSNR over a few test views, in dB.
struct Cost {
    views: usize,
    /// PSNR of the trained model.
    whole: f64,
    /// PSNR of the embedded grid.
    small: f64,
    /// PSNR of the embedded grid relative to the trained model.
    between: f64,
}

impl Scene {
    /// Compresses the voxel grid of a report, or bakes and compresses its field; `None` if its model has neither, or if the field cannot be
    /// baked.
    pub fn of(report: &Report<'_>, console: &Console<'_>) -> Result<Option<Self>> {
        let Some(model) = report.model else { return Ok(None) };
        let baked = match Source::of(model).map(|source| baked(source, report, console)) {
            Some(Ok(grid)) => Some(grid),
            Some(Err(error)) => {
                console.note(&format!("the field cannot be shown: {error}"));
                return Ok(None);
            }
            None => None,
        };
        let Some(grid) = baked.as_ref().or_else(|| model.content()?.downcast_ref()) else { return Ok(None) };
        let packed = WebGrid::within(grid, MOST_BYTES);
        let (small, bytes) = packed.map_err(|e| Error::io("report.html", e, "compressing the grid"))?;
        let shown = Shown { grid: small.to_grid() };
        let coordinates = shown.coordinates();
        let train = report.dataset.cameras(Split::Train);
        let (split, most) = match coordinates.space {
            Space::Box if report.dataset.count(Split::Test) > 0 => (Split::Test, VIEWS),
            Space::Box => (Split::Train, VIEWS),
            Space::Ndc { .. } | Space::Contracted => (Split::Train, TRAINING_VIEWS),
        };
        let (cameras, names) = (report.dataset.cameras(split), report.dataset.view_names(split));
        let chosen = evenly_spaced(cameras.len(), most);
        let focus = shown.focus();
        let view = |i: usize| {
            let mut view = html::camera(names[i], &cameras[i]);
            view["focus"] = json!(focus(&cameras[i]));
            view
        };
        let views: Vec<Value> = chosen.into_iter().map(view).collect();
        let size = cameras.first().map_or([1, 1], |camera| [camera.intrinsics.width, camera.intrinsics.height]);
        let settings = json!({
            "grid": small.header(),
            "coordinates": coordinates,
            "up": up_axis(coordinates.space, &train).to_array(),
            "sampling": shown.sampling(report.config.evaluation),
            "background": report.config.background,
            "views": views,
        });
        let cost = Cost::of(report, model, &shown)?;
        Ok(Some(Scene { baked: baked.is_some(), coordinates, small, bytes, settings, cost, size }))
    }

    /// The HTML of the viewer.
    pub fn figure(&self) -> String {
        let [width, height] = self.size;
        format!(
            "<section><h2>Interactive viewer</h2>\n<figure id=\"viewer\"><canvas tabindex=\"0\" style=\"--shape: calc({height} / {width})\" \
             aria-label=\"interactive view of the grid\"></canvas>\n<figcaption>Rotate: drag, or arrow keys. Zoom: wheel, pinch, or + and −. \
             Move: shift and drag, or two fingers. Look around: ctrl and drag. Fly: W, A, S, D, Q, E. <label>Start view: <select></select></label> \
             <button type=\"button\" id=\"previous\">previous</button> <button type=\"button\" id=\"next\">next</button> \
             <button type=\"button\" id=\"fill\">full screen</button> <button type=\"button\" id=\"save\">save picture</button><br>\n\
             <output></output><br>{}</figcaption></figure></section>",
            escaped(&self.note())
        )
    }

    /// Describes the embedded grid and its loss of quality.
    pub fn note(&self) -> String {
        let (shape, header) = (self.small.shape(), self.small.header());
        let reduction = match shape.sh_reduction {
            1 => String::new(),
            k => format!(", with view-dependent color on a {k} times coarser grid"),
        };
        let box_of = match self.coordinates.space {
            Space::Box => "",
            Space::Ndc { .. } => " of normalized device coordinates",
            Space::Contracted => " of the contracted world",
        };
        let what = format!(
            "the viewer has a compressed grid of {} voxels at {}³{box_of}{reduction}{}, in {}",
            thousands(header.voxels as u64),
            shape.resolution,
            if self.baked { ", baked from the field" } else { "" },
            bytes(self.bytes.len() as u64)
        );
        match &self.cost {
            Some(Cost { views, whole, small, between }) => {
                let s = if *views == 1 { "" } else { "s" };
                let trained = if self.baked { "field" } else { "trained grid" };
                format!(
                    "{what}; its PSNR on {views} test view{s} is {small:.2} dB, that of the {trained} {whole:.2} dB; the PSNR between both is {between:.1} dB"
                )
            }
            None => what,
        }
    }

    /// The data and the script of the viewer.
    pub fn scripts(&self) -> String {
        // The name of a view may contain `</script>`.
        let settings = self.settings.to_string().replace('<', "\\u003c");
        format!(
            "<script type=\"application/json\" id=\"scene\">{settings}</script>\n<script type=\"text/plain\" id=\"grid\">{}</script>\n\
             <script>\n{}{}</script>\n",
            STANDARD.encode(&self.bytes),
            html::CAMERA,
            include_str!("viewer.js"),
        )
    }
}

/// The grid as the viewer shows it.
struct Shown {
    grid: VoxelGrid<f32>,
}

impl Shown {
    fn coordinates(&self) -> GridSpace {
        self.grid.shape().coordinates
    }

    /// Sampling of the viewer.
    fn sampling(&self, evaluation: Sampling) -> Sampling {
        if self.coordinates().space == Space::Box { evaluation } else { Sampling::Step { step: STEP } }
    }

    /// A renderer with the rays and samples of the viewer.
    fn viewer(&self, report: &Report<'_>) -> Viewer<'_, f32> {
        grid_viewer(&self.grid, self.sampling(report.config.evaluation), report.config.engine, report.config.background)
    }

    /// A function to the distance of what a camera looks at; `None` in a box of the world, whose middle is the pivot.
    fn focus(&self) -> impl Fn(&Camera) -> Option<f64> + '_ {
        let matter = (self.coordinates().space != Space::Box).then(|| self.grid.matter());
        move |camera| bake::focus(&self.grid, matter.as_ref()?, camera)
    }
}

impl Cost {
    /// Measures the loss on a few test views.
    fn of(report: &Report<'_>, model: &dyn Model<f32>, small: &Shown) -> Result<Option<Self>> {
        let chosen = evenly_spaced(report.dataset.count(Split::Test), COMPARED);
        let background = report.config.background;
        let whole = Viewer::of(model, &ViewOptions::over(background));
        let small = small.viewer(report);
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

/// Bakes a field for the page.
fn baked(source: Source<'_>, report: &Report<'_>, console: &Console<'_>) -> Result<VoxelGrid<f32>> {
    let most = if source.space == Space::Box { BAKED_VOXELS } else { BAKED_VOXELS_OF_CAPTURES };
    let options = BakeOptions {
        resolution: source.resolution().min(most),
        most_voxels: MOST_BAKED,
        degree: BAKED_DEGREE,
        least_weight: source.least_weight(),
    };
    let count = console.count("baking for the viewer, voxel", 1);
    bake(source, &options, &report.dataset.cameras(Split::Train), &|done, all| count.at(done, all))
}
