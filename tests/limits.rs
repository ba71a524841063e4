//! `--max-memory` and what files say: a command takes no more, or refuses the file by name.

#[path = "support/command.rs"]
mod command;
#[path = "support/memory.rs"]
mod memory;

use command::{Answer, Folder, plenoxel, train};
use std::fs::{self, File};
use std::io::Write;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The limit belongs to the process, and so does what it takes.
fn alone() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    ONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A command that may take so many megabytes, and takes no more.
fn limited(megabytes: usize, args: &[&str]) -> Answer {
    let limit = format!("--max-memory={megabytes}MB");
    let (answer, peak) = memory::peak_of(|| plenoxel(&[args, &[&limit]].concat()));
    assert!(peak <= megabytes * 1_000_000, "{peak} bytes where {megabytes} MB are allowed: {}", answer.err);
    answer
}

const XYZ: &str = "property float x\nproperty float y\nproperty float z\nend_header\n";

#[test]
fn points_are_counted_by_the_header() {
    let _alone = alone();
    let folder = Folder::new("limit-points");
    let (cloud, out) = (folder.path("sparse.ply"), folder.path("out.ply"));
    let mut file = File::create(&cloud).unwrap();
    let header = format!("ply\nformat binary_little_endian 1.0\nelement vertex 500000\n{XYZ}");
    file.write_all(header.as_bytes()).unwrap();
    file.set_len(header.len() as u64 + 6_000_000).unwrap();
    let sor = ["filter", &cloud, "--out", &out, "--sor-neighbours", "6", "--sor-sigma", "1"];
    let noise = ["filter", &cloud, "--out", &out, "--noise-radius", "1e-9"];
    let bbox = ["filter", &cloud, "--out", &out, "--bbox", "0,0,0,1e6,1,1"];
    let few = ["filter", &cloud, "--out", &out, "--bbox", "1,1,1,2,2,2"];
    for (args, too_little) in [(&sor[..], 40), (&noise, 45), (&bbox, 20)] {
        limited(too_little, args)
            .refused(3, &["sparse.ply: filtering 500000 points needs about", "--max-memory allows", "higher --max-memory"]);
    }
    assert!(!fs::exists(&out).unwrap());
    limited(5, &sor).refused(3, &["sparse.ply: reading 6 MB as a PLY file"]);
    limited(23, &bbox).done();
    limited(23, &few).refused(2, &["no point is left"]);

    let mut text = format!("ply\nformat ascii 1.0\nelement vertex 500000\n{XYZ}").into_bytes();
    (0..500_000).for_each(|i| text.extend(format!("{i} 0 0\n").into_bytes()));
    fs::write(&cloud, text).unwrap();
    limited(8, &bbox).refused(3, &["sparse.ply: reading 500000 points needs about 9 MB"]);
    limited(20, &bbox).refused(3, &["sparse.ply: filtering 500000 points"]);
    limited(28, &sor).refused(3, &["sparse.ply: filtering 500000 points"]);
    limited(28, &bbox).done();
    limited(47, &sor).done();
}

#[test]
fn headers_of_clouds_have_a_size() {
    let _alone = alone();
    let folder = Folder::new("limit-header");
    let (cloud, out) = (folder.path("long.ply"), folder.path("out.ply"));
    for lines in ["comment hello\n".repeat(700_000), (0..500_000).map(|i| format!("property char p{i}\n")).collect()] {
        fs::write(&cloud, format!("ply\nformat ascii 1.0\nelement vertex 0\n{lines}{XYZ}")).unwrap();
        limited(30, &["filter", &cloud, "--out", &out, "--bbox", "0,0,0,1,1,1"])
            .refused(3, &["long.ply: the header is longer than the limit of 1 MB"]);
    }
}

#[test]
fn json_takes_memory_for_what_is_used_of_it() {
    let _alone = alone();
    let folder = Folder::new("limit-json");
    let cameras = |json: &str| fs::write(folder.path("transforms_train.json"), json).unwrap();
    let info = ["info", &folder.path("")];
    let junk = "{\"a\":[]},".repeat(300_000);
    cameras(&format!("{{\"zz\": [{junk}[]], \"camera_angle_x\": 0.69, \"frames\": []}}"));
    limited(20, &info).refused(3, &["transforms_train.json: frames is empty"]);
    for junk in ["{\"w\":[]},", "[],", "{},", "0,"] {
        cameras(&format!("{{\"camera_angle_x\": 0.69, \"frames\": [{}{{}}]}}", junk.repeat(2_000_000 / junk.len())));
        limited(20, &info)
            .refused(3, &["transforms_train.json: the content of 2 MB of JSON needs too much memory", "--max-memory allows 20 MB"]);
    }
    cameras(&format!("{{\"camera_angle_x\": 0.69, \"frames\": [{}{{}}]}}", "{},".repeat(10_000)));
    limited(20, &info).refused(3, &["frame 0 has no key"]);
}

#[test]
fn settings_with_long_names_take_no_more_than_others() {
    let _alone = alone();
    let folder = Folder::new("limit-settings");
    let config = folder.path("long.toml");
    fs::write(&config, format!("{} = [{}{{}}]\n", "k".repeat(100_000), "{},".repeat(2000))).unwrap();
    let refused = limited(60, &["train", "--config", &config, "--out", &folder.path("run")]);
    refused.refused(2, &["long.toml", "unknown key `kkk"]);
    assert!(refused.err.len() < 2000, "{}", refused.err);
}

#[test]
fn pictures_for_the_page_of_a_training_count() {
    let _alone = alone();
    let folder = Folder::new("limit-view");
    let run = folder.path("run");
    let small = ["--preset", "demo", "--scene-size", "16x12", "--scene-views", "2,1,1", "--no-report"];
    let train = [&["train", "--view", "--out", &run][..], &small].concat();
    limited(300, &train).refused(2, &["--view: the command needs about", "--max-memory allows 300 MB; leave it out"]);
}

#[test]
fn what_a_run_says_of_itself_is_bounded_too() {
    let _alone = alone();
    let folder = Folder::new("limit-run");
    let (run, page, path) = (folder.path("run"), folder.path("page.html"), folder.path("path.json"));
    train("3,0,0", &run, &["--no-images"]).done();
    let compare = ["compare", &run, &run, "--out", &page];
    let render = ["render", &run, "--path", &path, "--size", "8", "--frames", "2"];
    limited(60, &compare).done();

    let entry = "{\"R\":[0,0,0,1],\"T\":[0,0,0]},";
    fs::write(&path, format!("{{\"path\": [{}0]}}", entry.repeat(40_000))).unwrap();
    limited(30, &render).refused(3, &["path.json: the content of 1 MB of JSON needs too much memory", "--max-memory allows 30 MB"]);
    fs::write(&path, format!("{{\"path\": [{}0]}}", "0,".repeat(100_001))).unwrap();
    limited(60, &render).refused(3, &["path.json: the list at line 1", "has more than 100000 entries"]);

    let metrics = folder.path("run/metrics.jsonl");
    let (written, losses) = (fs::read_to_string(&metrics).unwrap(), (0..200_000).map(|i| format!("\"a{i}\":1")).collect::<Vec<_>>());
    let first = written.lines().next().unwrap();
    for text in [first.replacen("\"losses\":{", &format!("\"losses\":{{{},", losses.join(",")), 1), format!("{first}\n").repeat(20_000)] {
        assert!(text.len() > 2_000_000);
        fs::write(&metrics, text).unwrap();
        limited(25, &compare).refused(3, &["metrics.jsonl: reading", "of metrics needs about", "--max-memory allows 25 MB"]);
    }
    fs::write(&metrics, format!("{first}\n").repeat(20_000)).unwrap();
    limited(60, &compare).done();
    fs::write(&metrics, written).unwrap();

    for name in ["result.json", "evaluation.json"] {
        let file = folder.path(&format!("run/{name}"));
        let written = fs::read(&file);
        fs::write(&file, format!("{{\"per_view\": [{}0]}}", "{\"a\":1},".repeat(100_000))).unwrap();
        limited(50, &compare).refused(3, &[name, "the content of 800 kB of JSON needs too much memory", "--max-memory allows 50 MB"]);
        match written {
            Ok(written) => fs::write(&file, written).unwrap(),
            Err(_) => fs::remove_file(&file).unwrap(),
        }
    }
    // Half of a file counts as none.
    fs::write(folder.path("run/result.json"), "{\"psnr\": ").unwrap();
    limited(50, &compare).done();
}
