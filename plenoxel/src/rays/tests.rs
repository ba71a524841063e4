use super::*;
use crate::camera::{Camera, Intrinsics};
use crate::dataset::image::RgbaImage;
use crate::dataset::mask::Mask;
use crate::dataset::procedural::ProceduralOptions;
use crate::dataset::{Dataset, Split};
use ndarray::{Array2, array};

/// Returns a view of a single row of pixels.
fn view(pixels: &[[u8; 4]]) -> View {
    let intrinsics = Intrinsics::from_fov_x(pixels.len(), 1, 0.7);
    let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, intrinsics);
    let image = RgbaImage::from_fn(pixels.len() as u32, 1, |x, _| pixels[x as usize].into());
    View { name: String::new(), camera, image, depth: None, mask: None }
}

#[test]
fn every_pixel_of_tiles_of_any_size_has_its_place() {
    let views = [view(&[[0; 4]; 1000])];
    let mut source = RaySource::new(views, [1.0; 3], 0);
    let tiles = [(3, 1), (4, 0), (10, 500), (600, 1), (601, 2), (700, 300)];
    source.set_tiles(tiles.map(|(x, width)| Tile { view: 0, x, y: 0, width, height: 1 }).into());
    let want: Vec<usize> = tiles.iter().flat_map(|&(x, width)| (x..x + width).map(|x| x as usize)).collect();
    assert!(source.len() == want.len() as u64 && source.guide.len() <= tiles.len());
    let places = (0..source.len()).map(|index| source.place(index));
    assert!(places.eq(want.iter().map(|&x| Place { view: 0, x: x as u32, y: 0, weight: 1.0 })));
}

#[test]
fn a_view_full_of_object_is_judged_by_alpha_if_another_one_has_some() {
    let alphas =
        |views: &[View]| -> Vec<f32> { RaySource::new(views, [1.0; 3], 0).in_order_with_alpha(3).flat_map(|(_, alphas)| alphas).collect() };
    let (white, red) = ([255, 255, 255, 255], [255, 0, 0, 255]);
    // White parts of an object that fills its image belong to the object.
    let [full, other] = [view(&[white, red]), view(&[white, [0; 4], [9, 9, 9, 51]])];
    assert_eq!(alphas(&[full.clone(), other]), [1.0, 1.0, 1.0, 0.0, 0.2]);
    assert_eq!(alphas(&[full.clone(), full]), [0.0, 1.0, 0.0, 1.0]);
}

fn scene() -> Vec<View> {
    let options = ProceduralOptions { width: 24, height: 16, train: 3, val: 0, test: 0, supersample: 1 };
    Dataset::procedural(options).unwrap().load(Split::Train, &|_, _| {}).unwrap()
}

/// Returns view, column and row of each pixel of a batch.
fn places(batch: &RayBatch<f64>) -> Vec<(u32, u32, u32)> {
    batch.view.iter().zip(&batch.pixel).map(|(&view, &[x, y])| (view, x, y)).collect()
}

fn assert_same(a: &RayBatch<f64>, b: &RayBatch<f64>) {
    assert_eq!((&a.rays, a.target.data(), a.alpha.data()), (&b.rays, b.target.data(), b.alpha.data()));
    assert_eq!(places(a), places(b));
}

#[test]
fn a_ray_knows_its_pixel_and_chosen_pixels_are_the_rays_that_a_batch_has_of_them() {
    let background = [0.3, 0.6, 0.9];
    let mut source = RaySource::new(scene(), background, 5);
    for reduction in [1, 4] {
        source.set_reduction(reduction);
        let n = source.len() as usize + 600;
        let batch = source.batch::<f64>(100, n);
        for (i, (v, x, y)) in places(&batch).into_iter().enumerate() {
            let view = &source.views()[v as usize];
            assert_eq!(batch.rays[i], view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5));
            assert_eq!(batch.target.data()[3 * i..3 * i + 3], view.color(x as usize, y as usize, background).map(f64::from));
            assert_eq!(batch.alpha.data()[i], f64::from(view.alpha(x as usize, y as usize)));
        }
        assert_same(&source.batch_of(&places(&batch)), &batch);
        assert!(batch.depth.is_none() && batch.channels.is_empty() && batch.channel("mask").is_none());
    }
}

#[test]
fn reduced_views_have_the_rays_of_a_source_of_such_views_and_none_of_them_is_left_out() {
    let views = scene();
    let mut source = RaySource::new(views.clone(), [1.0; 3], 7);
    let whole = source.batch::<f64>(0, 900);
    let nothing = Occupancy::new(Aabb::cube(1.0), [4; 3], &[false; 64]);
    for reduction in [2, 1] {
        source.aim_at(&nothing);
        assert!(source.is_empty());
        source.set_reduction(reduction);
        let by_hand: Vec<View> = views.iter().map(|view| view.reduced(reduction)).collect();
        let by_hand = RaySource::new(by_hand, [1.0; 3], 7);
        assert_same(&source.batch(3, 900), &by_hand.batch(3, 900));
        assert_eq!((source.reduction(), source.len(), source.share()), (reduction, by_hand.len(), 1.0));
    }
    assert_same(&source.batch(0, 900), &whole);
    assert_eq!(source.all_views()[0].image, views[0].image);
}

#[test]
fn depth_is_that_of_the_pixel_and_not_a_number_where_a_view_has_none() {
    let mut views = scene();
    let ask = |views: &[View]| RaySource::new(views, [1.0; 3], 1).with_depth().batch::<f64>(0, 500);
    views[1].depth = None;
    let batch = ask(&views);
    let depth = batch.depth.as_ref().unwrap();
    assert_eq!(depth.shape(), [500]);
    for (&depth, (v, x, y)) in depth.data().iter().zip(places(&batch)) {
        let want = views[v as usize].depth.as_ref().map_or(f64::NAN, |image| f64::from(image[[y as usize, x as usize]]));
        assert!(depth == want || depth.is_nan() && v == 1 && want.is_nan());
    }
    assert!(depth.data().iter().any(|d| d.is_finite()));
    views.iter_mut().for_each(|view| view.depth = None);
    assert!(ask(&views).depth.is_none());
}

#[test]
fn channels_and_depth_of_a_reduced_pixel_are_the_mean_of_its_block() {
    // Two views of 4 x 2 and 3 x 2 pixels: a reduction by 2 leaves the second unchanged.
    let image = |width| RgbaImage::from_pixel(width, 2, [0, 0, 0, 255].into());
    let views = [4, 3].map(|width| {
        let intrinsics = Intrinsics::from_fov_x(width, 2, 0.7);
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, intrinsics);
        let depth = (width == 4).then(|| array![[1.0, 2.0, 5.0, f32::INFINITY], [3.0, 4.0, 5.0, 5.0]]);
        View { name: format!("r_{width}"), camera, image: image(width as u32), depth, mask: None }
    });
    let numbers = |width: usize| Array3::from_shape_fn((2, width, 2), |(y, x, c)| (100 * c + 10 * y + x) as f32);
    let masks = [4, 3].map(|width| Array3::from_elem((2, width, 1), 1.0));
    let source = RaySource::new(views, [1.0; 3], 0).with_depth();
    let mut source = source.with_channel("features", [4, 3].map(numbers)).with_channel("mask", masks);
    let whole = source.batch_of::<f64>(&[(0, 3, 1), (1, 2, 0)]);
    assert_eq!(whole.expect_channel("features").to_array(), array![[13.0, 113.0], [2.0, 102.0]].into_dyn());
    assert_eq!(whole.channel("mask").unwrap().to_array(), array![[1.0], [1.0]].into_dyn());
    assert_eq!(whole.depth.unwrap().data()[0], 5.0);
    source.set_reduction(2);
    let reduced = source.batch_of::<f64>(&[(0, 0, 0), (0, 1, 0), (1, 2, 1)]);
    let want = array![[5.5, 105.5], [7.5, 107.5], [12.0, 112.0]];
    assert_eq!(reduced.expect_channel("features").to_array(), want.into_dyn());
    let depth = reduced.depth.unwrap();
    assert_eq!(depth.data()[..2], [2.5, f64::INFINITY]);
    assert!(depth.data()[2].is_nan());
}

#[test]
fn what_does_not_fit_is_refused_by_its_name() {
    let message = |act: fn(RaySource)| {
        let panic = std::panic::catch_unwind(|| act(RaySource::new(scene(), [1.0; 3], 0))).unwrap_err();
        *panic.downcast::<String>().unwrap()
    };
    let two = message(|source| drop(source.with_channel("mask", vec![Array3::zeros((16, 24, 1)); 2])));
    assert_eq!(two, "channel `mask`: 2 images for 3 views");
    let turned = message(|source| drop(source.with_channel("mask", [(16, 24, 1), (24, 16, 1), (16, 24, 1)].map(Array3::zeros))));
    assert!(turned.starts_with("channel `mask`, view 1 ("), "{turned}");
    assert!(turned.ends_with("the image has shape (24, 16, 1), expected (16, 24, 1)"), "{turned}");
    let wider = message(|source| drop(source.with_channel("mask", [(16, 24, 1), (16, 24, 1), (16, 24, 2)].map(Array3::zeros))));
    assert!(wider.contains("view 2 (") && wider.ends_with("shape (16, 24, 2), expected (16, 24, 1)"), "{wider}");
    let mask = |source: RaySource| source.with_channel("mask", vec![Array3::zeros((16, 24, 1)); 3]);
    let twice = mask(RaySource::new(scene(), [1.0; 3], 0));
    let twice = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| drop(mask(twice)))).unwrap_err();
    assert_eq!(*twice.downcast::<String>().unwrap(), "with_channel: channel `mask` exists already");
    let missing = message(|source| {
        let source = source.with_channel("weight", vec![Array3::zeros((16, 24, 1)); 3]);
        source.batch::<f64>(0, 1).expect_channel("mask");
    });
    assert_eq!(missing, "the batch has no channel `mask`; its channels: [`weight`]");
    let outside = message(|source| drop(source.batch_of::<f64>(&[(2, 23, 15), (1, 24, 0)])));
    assert_eq!(outside, "batch_of: pixel (1, 24, 0), as view, column and row, is not in a view of 24 x 16 pixels");
    let nowhere = message(|source| drop(source.batch_of::<f64>(&[(3, 0, 0)])));
    assert!(nowhere.ends_with("is not in 3 views"), "{nowhere}");
    let large = message(|source| drop(source.patches(0, 1, 17)));
    assert_eq!(large, "patches: no view has 17 x 17 pixels");
}

#[test]
fn patches_are_squares_of_a_view_anywhere_in_it_and_change_with_step_and_seed() {
    // Views of 6 x 5 and 3 x 3 pixels: 4 x 3 positions of a 3 x 3 patch in the first, one in the second.
    let view = |width: usize, height: usize| {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, Intrinsics::from_fov_x(width, height, 0.7));
        View { name: String::new(), camera, image: RgbaImage::new(width as u32, height as u32), depth: None, mask: None }
    };
    let source = |seed| RaySource::new([view(6, 5), view(3, 3), view(9, 2)], [1.0; 3], seed);
    let patches = source(1).patches(4, 13_000, 3);
    let mut times = Array2::<u32>::zeros((3, 4));
    let mut small = 0;
    for square in patches.as_chunks::<9>().0 {
        let (view, x, y) = square[0];
        assert_eq!(*square, std::array::from_fn(|i| (view, x + i as u32 % 3, y + i as u32 / 3)));
        match view {
            0 => times[[y as usize, x as usize]] += 1,
            _ => small += u32::from((view, x, y) == (1, 0, 0)),
        }
    }
    // 1000 expected of each, standard deviation 30.
    assert!(times.iter().chain([&small]).all(|n| (850..1150).contains(n)) && times.sum() + small == 13_000, "{times} {small}");
    let few = source(1).patches(4, 5, 3);
    assert!(few == patches[..45] && few != source(1).patches(5, 5, 3) && few != source(2).patches(4, 5, 3));
    let batch = source(1).batch_of::<f64>(&few);
    assert_eq!(batch.target.reshape(&[5, 3, 3, 3]).shape(), [5, 3, 3, 3]);
}

#[test]
fn ignored_pixels_are_never_trained_and_the_others_once_in_an_epoch() {
    let intrinsics = Intrinsics::from_fov_x(13, 6, 0.7);
    let camera = Camera::look_at(DVec3::X * 3.0, DVec3::ZERO, DVec3::Z, intrinsics);
    let view = |mask| View { name: String::new(), camera, image: RgbaImage::new(13, 6), depth: None, mask };
    let mask = Mask::new([13, 6], |x, y| (x + 2 * y) % 5 > 1 && y != 3);
    let kept = mask.kept();
    let mut source = RaySource::new(vec![view(None), view(Some(mask.clone())), view(None)], [0.0; 3], 3);
    let check = |source: &RaySource, expected: u64| {
        assert_eq!(source.len(), expected);
        let batch = source.batch::<f32>(0, expected as usize);
        let mut seen: Vec<(u32, [u32; 2])> = batch.view.iter().copied().zip(batch.pixel.iter().copied()).collect();
        assert!(seen.iter().all(|&(v, [x, y])| v != 1 || mask.keeps(x as usize, y as usize)));
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len() as u64, expected);
    };
    check(&source, (2 * 13 * 6 + kept) as u64);
    // Aimed at the whole box, which all pixels show.
    source.aim_at(&Occupancy::new(Aabb::cube(2.0), [4; 3], &[true; 64]));
    check(&source, (2 * 13 * 6 + kept) as u64);
    assert_eq!(source.share(), 1.0);
}

/// Returns the variance of the colors around a pixel by its definition.
fn variance(view: &View, x: i64, y: i64, background: [f32; 3]) -> f64 {
    let [width, height] = view.size().map(|n| n as i64);
    let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y)));
    let inside = around.filter(|(x, y)| (0..width).contains(x) && (0..height).contains(y));
    let colors: Vec<[f64; 3]> = inside.map(|(x, y)| view.color(x as usize, y as usize, background).map(f64::from)).collect();
    let n = colors.len() as f64;
    let of_channel = |c: usize| {
        let mean = colors.iter().map(|color| color[c]).sum::<f64>() / n;
        colors.iter().map(|color| (color[c] - mean).powi(2)).sum::<f64>() / n
    };
    (0..3).map(of_channel).sum::<f64>() / 3.0
}

#[test]
fn pixels_are_drawn_in_proportion_to_their_contrast_and_weights_make_up_for_it() {
    const FLOOR: f64 = 0.05;
    let background = [0.3, 0.6, 0.9];
    let mut views = scene();
    views[1].mask = Some(Mask::new([24, 16], |x, y| (x + y) % 3 > 0));
    let uniform = RaySource::new(views.clone(), background, 5);
    let mut source = RaySource::new(views, background, 5).with_contrast_floor(FLOOR);
    for reduction in [1, 2] {
        source.set_reduction(reduction);
        let n = source.draws();
        assert!(reduction > 1 || source.len() == uniform.len() && source.share() == 1.0);
        assert!(n > 4 * source.len());
        let epoch = source.batch::<f64>(n, n as usize);
        let mut times = std::collections::BTreeMap::new();
        places(&epoch).into_iter().for_each(|place| *times.entry(place).or_insert(0) += 1);
        assert_eq!(times.len() as u64, source.len());
        for (&(v, x, y), &times) in &times {
            let want = (variance(&source.views()[v as usize], x.into(), y.into(), background) + FLOOR * FLOOR).sqrt() / FLOOR;
            assert!((f64::from(times) / 4.0 - want).abs() < 0.126, "{v} {x} {y}: {times}, {want}");
        }
        // Over an epoch, the weighted mean is the mean over all pixels; without weights it is not.
        let pixels: Vec<(u32, u32, u32)> = times.into_keys().collect();
        let all = source.batch_of::<f64>(&pixels);
        assert!(all.weight.is_none());
        let [exact, weighted, biased] = [all.target.mean(), epoch.mean(&epoch.target), epoch.target.mean()].map(|mean| mean.item());
        assert!((weighted / exact - 1.0).abs() < 1e-6 && (biased / exact - 1.0).abs() > 1e-3, "{weighted} {biased} {exact}");
        let of_alpha = epoch.mean(&epoch.alpha).item() / all.alpha.mean().item();
        assert!((of_alpha - 1.0).abs() < 1e-6);
    }
    source.set_reduction(1);
    source.aim_at(&Occupancy::new(Aabb::cube(0.1), [1; 3], &[true]));
    assert!(source.share() < 0.9, "{}", source.share());
    let batch = source.batch::<f64>(0, source.draws() as usize);
    assert!((batch.weight.unwrap().mean().item() - 1.0).abs() < 1e-6);
}

#[test]
fn without_contrast_pixels_have_no_weights() {
    let source = RaySource::new([view(&[[7, 8, 9, 255]; 20])], [1.0; 3], 0).with_contrast_floor(0.02);
    let batch = source.batch::<f32>(0, 80);
    assert!(batch.weight.is_none());
    let mut columns: Vec<u32> = batch.pixel.iter().map(|pixel| pixel[0]).collect();
    columns.sort_unstable();
    assert!(columns.chunks(4).zip(0..).all(|(same, x)| same == [x; 4]));
}
