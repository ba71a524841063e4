//! Throw-away laboratory.
use plenoxel::dataset::Split;
use plenoxel::evaluate::evaluate;
use plenoxel::loss::{Objective, mse};
use plenoxel::model::tensorf::{Config, Tensorf};
use plenoxel::train::{TrainOptions, Trainer, ViewOptions};
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let data = plenoxel::dataset::open(args[1].as_ref(), &Default::default()).expect("data");
    let mut json = serde_json::to_value(Config::default()).unwrap();
    if let Some(change) = args.get(2) {
        let change: serde_json::Value = serde_json::from_str(change).expect("json");
        for (k, v) in change.as_object().unwrap() {
            json[k] = v.clone();
        }
    }
    let config: Config = serde_json::from_value(json).expect("config");
    let all = data.load(Split::Train, &|_, _| {}).expect("views");
    let (mut train, mut held) = (Vec::new(), Vec::new());
    let every: usize = std::env::var("EVERY").map_or(10, |v| v.parse().unwrap());
    for (i, view) in all.into_iter().enumerate() {
        if i % every == 5 { held.push(view) } else { train.push(view) }
    }
    let held: Vec<_> = held.into_iter().take(std::env::var("HELD").map_or(10, |v| v.parse().unwrap())).collect();
    let some: Vec<_> = train.iter().step_by(train.len() / 3).cloned().collect();
    let start = Instant::now();
    let objective = Objective::new().with("mse", 1.0, mse);
    let mut trainer = Trainer::<f32, _>::with_model(Tensorf::<f32>::new(config, plenoxel::geometry::Aabb::cube(1.5), 42).expect("config"), train, objective, TrainOptions::default()).expect("trainer");
    let (mut last, mut rays, mut samples, mut count) = (start, 0usize, 0usize, 0);
    while let Some(report) = trainer.step().expect("step") {
        rays += report.rays; samples += report.samples; count += 1;
        if last.elapsed().as_secs_f64() > 5.0 || report.ends_stage {
            let s = last.elapsed().as_secs_f64();
            eprintln!("{:6.1} s step {} stage {} psnr {:.2} rays/s {:.0} samples/ray {:.1} step {:.1} ms", start.elapsed().as_secs_f64(), report.step, report.stage, report.psnr, rays as f64 / s, samples as f64 / rays as f64, 1000.0 * s / count as f64);
            (last, rays, samples, count) = (Instant::now(), 0, 0, 0);
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    let psnr = |views: &[_]| evaluate(trainer.model(), views, &ViewOptions::over([1.0; 3])).psnr().unwrap();
    {
        use plenoxel::evaluate::Viewer;
        let viewer = Viewer::of(trainer.model(), &ViewOptions::over([1.0; 3]));
        let picture = viewer.see(&held[0].camera);
        let [h, w] = [picture.rgb.shape()[0], picture.rgb.shape()[1]];
        let mut out = image::RgbImage::new(2 * w as u32, h as u32);
        for y in 0..h { for x in 0..w {
            let c = [0, 1, 2].map(|c| (picture.rgb[[y, x, c]].clamp(0.0, 1.0) * 255.0) as u8);
            out.put_pixel(x as u32, y as u32, image::Rgb(c));
            out.put_pixel((x + w) as u32, y as u32, image::Rgb(held[0].color(x, y, [1.0; 3]).map(|c| (c * 255.0) as u8)));
        } }
        out.save("/tmp/w/tf.png").unwrap();
    }
    let t = Instant::now();
    let h = psnr(&held);
    let e = t.elapsed().as_secs_f64() / held.len() as f64;
    println!("{seconds:.1} s held {h:.2} train {:.2} picture {e:.2} s", psnr(&some));
}
