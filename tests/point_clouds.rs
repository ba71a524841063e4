//! Point clouds on the command line: a run as points, and the clouds of others cleaned.

use crate::command::{Folder, plenoxel};
use plenoxel::point_cloud::ply::PlyFile;
use std::fs;
use std::path::Path;

/// The built-in scene as files, and a short run on it.
fn trained(folder: &Folder) -> (String, String) {
    let (data, run) = (folder.path("scene"), folder.path("run"));
    plenoxel(&["scene", &data, "--size", "32", "--train", "8", "--val", "0", "--test", "0"]).done();
    let stages = "stages=[{resolution=16, steps=150, sampling={step=0.5}, density_rate=1.0, color_rate=0.05}]";
    plenoxel(&["train", &data, "--set", stages, "--set", "rays_per_step=512", "--no-images", "--quiet", "--out", &run]).done();
    (data, run)
}

fn points(path: &str) -> usize {
    PlyFile::open(Path::new(path)).unwrap().len()
}

#[test]
fn a_run_becomes_points_in_the_coordinates_of_its_data_that_filters_thin_out() {
    let folder = Folder::new("export");
    let (data, run) = trained(&folder);
    let cloud = format!("{run}/exports/cloud.ply");
    let said = plenoxel(&["export", "ply", &run]).done();
    assert!(said.contains("wrote") && said.contains(&cloud), "{said}");
    let file = PlyFile::open(Path::new(&cloud)).unwrap();
    assert_eq!(file.field_names(), ["opacity", "density", "weight", "object", "quality"]);
    assert!(file.header().remarks.contains(&"comment voxel_side 0.1875".to_owned()), "{:?}", file.header().remarks);
    let places = file.positions().unwrap();
    assert!(places.len() > 50 && places.len() < 16 * 16 * 16 && places.iter().all(|p| p.abs().max_element() < 1.5));
    assert!(file.values("opacity").unwrap().iter().all(|a| (0.05..=1.0).contains(a)));

    // All voxels with density, then fewer and fewer.
    let all = folder.path("all.ply");
    plenoxel(&["export", "ply", &run, "-o", &all, "--min-alpha", "0", "--min-weight", "0", "--min-object", "0"]).done();
    assert!(points(&all) > file.len());
    let thin = folder.path("thin.ply");
    let recipe = ["--min-value", "2", "--noise-radius", "1.28", "--sor-neighbours", "6", "--sor-sigma", "0.2"];
    let said = plenoxel(&[&["export", "ply", &run, "-o", &thin], &recipe[..]].concat()).done();
    assert!(["value", "noise", "sor"].iter().all(|step| said.contains(step)) && points(&thin) < file.len(), "{said}");
    // The same filters on the file keep the same points: it says how large its voxels are.
    let again = folder.path("again.ply");
    plenoxel(&[&["filter", &cloud, "-o", &again], &recipe[..]].concat()).done();
    let positions = |path: &str| PlyFile::open(Path::new(path)).unwrap().positions().unwrap();
    assert_eq!(positions(&again), positions(&thin));
    plenoxel(&[&["filter", &cloud, "-o", &again, "--units", "world"], &recipe[..2], &["--noise-radius", "0.24"], &recipe[4..]].concat())
        .done();
    assert_eq!(positions(&again), positions(&thin), "1.28 voxels are 0.24 world units");

    // Indices of voxels, and a box of them.
    let few = folder.path("few.ply");
    plenoxel(&["export", "ply", &run, "-o", &few, "--coords", "grid", "--bbox", "4,4,4,11,11,7.5", "--color", "0,0,-1"]).done();
    assert!(positions(&few).iter().all(|p| p.fract() == glam::DVec3::ZERO && p.min_element() >= 4.0 && p.z <= 7.0));

    // The data have gone: it can be said where they are, or done without.
    let moved = folder.path("moved");
    fs::rename(&data, &moved).unwrap();
    fs::remove_file(&cloud).unwrap();
    plenoxel(&["export", "ply", &run]).refused(3, &[&data, "no longer exists", "--data DIR", "--min-weight 0 --min-object 0 --color mean"]);
    assert!(!Path::new(&cloud).exists(), "half an export");
    plenoxel(&["export", "ply", &run, "--min-weight", "0", "--min-object", "0", "--color", "mean"]).done();
    plenoxel(&["export", "ply", &run, "--data", &moved]).done();
    assert_eq!(points(&cloud), file.len());

    plenoxel(&["export", "ply", &folder.path("missing")]).refused(3, &["missing", "this run folder does not exist"]);
    plenoxel(&["export", "ply", &run, "--data", &moved, "-o", &folder.path("no/where.ply")]).refused(5, &["no/where.ply"]);
    let none = ["export", "ply", &run, "--data", &moved, "--min-value", "1e9"];
    plenoxel(&none).refused(2, &["no point is left", "value 0", "a lower minimum"]);
    for (flag, value, part) in [
        ("--color", "blue", "seen, mean, or a direction"),
        ("--color", "0,0,0", "direction"),
        ("--min-alpha", "1.5", "in [0, 1)"),
        ("--min-weight", "1.5", "from 0 to 1"),
        ("--coords", "camera", "world"),
        ("--noise-radius", "0", "--noise-radius"),
        ("--noise-radius", "nan", "--noise-radius"),
        ("--sor-neighbours", "1", "from 2 to 1000"),
        ("--noise-error", "0.1", "--noise-radius"),
        ("--bbox", "1,2,3", "6 numbers"),
        ("--bbox", "1,0,0,-1,1,1", "no minimum above"),
        ("--value-field", "density", "--min-value"),
    ] {
        plenoxel(&["export", "ply", &run, "--data", &moved, flag, value]).refused(2, &[flag, part]);
    }
    // Before the views are looked for.
    let unknown = ["export", "ply", &run, "--min-value", "1", "--value-field", "depth"];
    plenoxel(&unknown).refused(2, &["--value-field", "depth", "opacity, density, weight, object"]);
    let help = plenoxel(&["export"]);
    assert!(help.code == 2 && ["ply", "vox", "mesh"].iter().all(|format| help.err.contains(format)), "{}", help.err);
}

#[test]
fn a_cloud_of_another_program_is_cleaned_and_keeps_its_properties() {
    let folder = Folder::new("filter");
    let (cloud, clean) = (folder.path("scan.ply"), folder.path("clean.ply"));
    // Ten points in a row, one far away; a list; faces.
    let mut text = "ply\nformat ascii 1.0\nelement vertex 11\nproperty double x\nproperty double y\nproperty double z\n\
                    property list uchar int tags\nproperty float height\nproperty float scalar_time\nelement face 1\n\
                    property list uchar int vertex_indices\nend_header\n"
        .to_owned();
    (0..10).for_each(|i| text += &format!("{i}.5 0 0 2 {i} 7 0.{i} {i}\n"));
    text += "400 0 0 0 0.95 10\n3 0 1 2\n";
    fs::write(&cloud, &text).unwrap();
    let filtered = plenoxel(&["filter", &cloud, "--out", &clean, "--sor-neighbours", "3", "--sor-sigma", "1"]);
    assert!(
        filtered.err.contains("left out 1 row of element `face`") && filtered.err.contains("scalar fields: height, time; 1 list"),
        "{}",
        filtered.err
    );
    assert!(filtered.done().contains("wrote 10 points"));
    let lines: Vec<String> = fs::read_to_string(&clean).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(lines[lines.len() - 2..], ["8.5 0 0 2 8 7 0.8 8", "9.5 0 0 2 9 7 0.9 9"]);
    assert!(lines.contains(&"element vertex 10".to_owned()) && lines.contains(&"property list uchar int tags".to_owned()));

    let refused = |more: &[&str], code: u8, parts: &[&str]| {
        let out = folder.path("never.ply");
        plenoxel(&[&["filter", &cloud, "--out", &out], more].concat()).refused(code, parts);
        assert!(!Path::new(&out).exists());
    };
    refused(&[], 2, &["filters", "at least one of"]);
    refused(&["--max-value", "0.5"], 2, &["error: --max-value", "several scalar fields", "height, time"]);
    refused(&["--min-value", "0.5", "--value-field", "depth"], 2, &["--value-field", "depth", "height, time"]);
    refused(&["--noise-radius", "2", "--units", "voxel"], 2, &["--units", "voxel_side", "world"]);
    refused(&["--sor-neighbours", "11"], 2, &["error: --sor-neighbours: invalid value 11", "fewer than the 11 points"]);
    plenoxel(&["filter", &cloud, "-o", &clean, "--min-value", "0.5", "--value-field", "scalar_time", "--max-value", "6"]).done();
    assert_eq!(points(&clean), 6);
    let noise = plenoxel(&["filter", &cloud, "-o", &clean, "--noise-radius", "2.5", "--remove-isolated"]);
    assert!(noise.err.contains("units of the file"), "{}", noise.err);
    // Of the neighbours in a row three lie on a line, and four have a plane through it.
    assert_eq!((noise.code, points(&clean)), (0, 6));

    fs::write(&cloud, &text.as_bytes()[..text.len() - 12]).unwrap();
    refused(&["--sor-sigma", "1"], 3, &["scan.ply", "truncated"]);
    fs::write(&cloud, text.replace("0.5 0 0", "0,5 0 0")).unwrap();
    refused(&["--sor-sigma", "1"], 3, &["scan.ply", "row 0", "0,5"]);
    fs::write(&cloud, "solid cube").unwrap();
    refused(&["--sor-sigma", "1"], 3, &["scan.ply", "not a PLY file", "solid cube"]);
    plenoxel(&["filter", &folder.path("missing.ply"), "-o", &clean, "--sor-sigma", "1"]).refused(3, &["missing.ply", "does not exist"]);
}
