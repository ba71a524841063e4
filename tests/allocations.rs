//! Once its first steps are over, training takes its arrays from the pool and next to nothing from the system.

use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split};
use plenoxel::field::voxel_grid::Interpolation;
use plenoxel::model::plenoxels::Trainer;
use plenoxel::model::plenoxels::config::{ColorKind, Config, OptimizerConfig, Stage};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Bytes from which an allocation counts as large. Below are nodes of the graph, lists of chunks and of marches, what rayon needs.
const LARGE: usize = 16 * 1024;

static LARGE_ONES: AtomicUsize = AtomicUsize::new(0);
static ALL: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: every call goes to the system's allocator as it came.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALL.fetch_add(1, Relaxed);
        LARGE_ONES.fetch_add(usize::from(layout.size() >= LARGE), Relaxed);
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_step_in_the_steady_state_takes_hardly_any_memory_from_the_system() {
    const STEPS: usize = 20;
    let scene = Dataset::procedural(ProceduralOptions { width: 32, height: 32, train: 20, val: 0, test: 3, supersample: 2 })
        .expect("the built-in scene");
    let views = scene.load(Split::Train, &|_, _| {}).expect("it renders");
    let stage = Stage { color_rate: 0.05, ..Stage::new(64, 1000) };
    for (interpolation, color) in [(Interpolation::Nearest, ColorKind::Rgb), (Interpolation::Trilinear, ColorKind::Sh)] {
        let stages = vec![stage];
        let config = Config { interpolation, color, rays_per_step: 4096, stages, optimizer: OptimizerConfig::Sgd, ..Config::default() };
        let mut trainer = Trainer::<f32>::new(config, &views[..]).expect("a valid config");
        let mut steps = || (0..STEPS).for_each(|_| drop(trainer.step().expect("finite numbers")));
        steps();
        let before = [&ALL, &LARGE_ONES].map(|n| n.load(Relaxed));
        steps();
        let [all, large] = [&ALL, &LARGE_ONES].map(|n| n.load(Relaxed));
        let (all, large) = ((all - before[0]) as f64 / STEPS as f64, (large - before[1]) as f64 / STEPS as f64);
        // Three are the lists of the batch's rays, of their views and of their pixels; now and then a batch has more samples than any before. With a pool for larger ones only, from
        // 64 KiB on, and lists made anew it was 144 and 118.
        println!("{interpolation:?}: {all} allocations a step, {large} of at least {LARGE} bytes");
        assert!(large <= 5.0, "{interpolation:?}: {large} large allocations a step");
        assert!(all < 1500.0, "{interpolation:?}: {all} allocations a step");
    }
}
