//! Cameras of photographs, with a script in the place of COLMAP.
#![cfg(unix)]

#[path = "../../tests/support/captures.rs"]
#[allow(dead_code)]
mod captures;

use captures::{Folder, cameras_bin, images_bin, pinhole, points_bin};
use glam::DVec3;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::dataset::{Dataset, Split, View};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Writes its calls to `calls`, and says what COLMAP says. The files fail-COMMAND and hang-COMMAND make a command fail or hang.
const SCRIPT: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$*" in
  "feature_extractor -h") printf 'COLMAP 3.8 (script)\n  --SiftExtraction.use_gpu arg (=1)\n'; exit 1 ;;
  *" -h") printf '  --SiftMatching.use_gpu arg (=1)\n'; exit 1 ;;
esac
echo "$*" >> "$here/calls"
[ -e "$here/fail-$1" ] && { echo "ERROR: no luck with $1" >&2; echo "the end"; exit 7; }
[ -e "$here/hang-$1" ] && { echo "half" > colmap/models/0; echo $$ > "$here/hanging"; sleep 600; }
case $1 in
  feature_extractor)
    for list; do [ "$before" = --image_list_path ] && names=$list; before=$list; done
    all=$(grep -c . "$names"); i=0
    while read -r name; do i=$((i + 1)); [ -e "images/$name" ] || exit 8; echo "Processed file [$i/$all]"; done < "$names"
    echo features >> colmap/database.db ;;
  *_matcher) echo "Matching block [1/1, 1/1] in 0.1s"; echo matches >> colmap/database.db ;;
  mapper)
    [ -e "$here/models" ] || { echo "ERROR: failed to create sparse model"; exit 1; }
    echo "Registering image #3 (3)"; cp -R "$here/models/." colmap/models ;;
esac
"#;

const SHORT: Duration = Duration::from_millis(5);
const LONG: Duration = Duration::from_secs(60);

/// Views of the built-in scene: a large model of COLMAP has all but the last.
fn views() -> Vec<View> {
    let options = ProceduralOptions { width: 16, height: 12, train: 9, val: 0, test: 0, supersample: 1 };
    Dataset::procedural(options).and_then(|scene| scene.load(Split::Train, &|_, _| ())).expect("the built-in scene")
}

/// A folder with photographs, a script for COLMAP, and what the script makes: a small model and one of `large` images.
fn prepared(large: usize) -> Folder {
    let folder = Folder::new();
    let views = views();
    folder.images("photos", &views);
    folder.write("photos/notes.txt", "");
    folder.write("photos/._r_0.png", "");
    // Copied by another process: a file that this one has open for writing cannot be run, and threads share their open files while they start a process.
    folder.write("bin/script", SCRIPT);
    let copied = Command::new("cp").current_dir(folder.path("bin")).args(["script", "colmap"]).status().expect("cp");
    assert!(copied.success());
    fs::set_permissions(folder.path("bin/colmap"), fs::Permissions::from_mode(0o755)).expect("permissions");
    for (name, images) in [("0", 2), ("1", large)] {
        let cameras: Vec<_> = (0..images).map(|k| pinhole(7 + k, &views[k].camera)).collect();
        folder.write(&format!("bin/models/{name}/cameras.bin"), cameras_bin(&cameras));
        folder.write(&format!("bin/models/{name}/images.bin"), images_bin(&views[..images]));
        folder.write(&format!("bin/models/{name}/points3D.bin"), points_bin(&[DVec3::X, DVec3::Y]));
    }
    folder
}

fn start(folder: &Folder, arguments: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
    command.current_dir(&folder.0).arg("cameras").args(arguments).arg("--threads=2");
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the program starts")
}

fn ended(child: Child) -> (Option<i32>, String, String) {
    let output = child.wait_with_output().expect("it ends");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

fn run(folder: &Folder, arguments: &[&str]) -> (Option<i32>, String, String) {
    ended(start(folder, arguments))
}

/// `cameras photos --out room` with the script.
const USUAL: [&str; 5] = ["photos", "--out", "room", "--colmap", "bin/colmap"];

/// The commands of COLMAP since the last question.
fn calls(folder: &Folder) -> Vec<String> {
    let calls = fs::read_to_string(folder.path("bin/calls")).unwrap_or_default();
    drop(fs::remove_file(folder.path("bin/calls")));
    calls.lines().map(|line| line.split(' ').next().unwrap_or_default().to_owned()).collect()
}

fn wait_for(folder: &Folder, name: &str) -> String {
    let begin = Instant::now();
    while begin.elapsed() < LONG {
        if let Some(text) = fs::read_to_string(folder.path(name)).ok().filter(|text| text.ends_with('\n')) {
            return text.trim().to_owned();
        }
        std::thread::sleep(SHORT);
    }
    panic!("{name} does not come");
}

const ALL: [&str; 3] = ["feature_extractor", "exhaustive_matcher", "mapper"];

#[test]
fn photographs_become_a_folder_that_training_opens() {
    let folder = prepared(8);
    let before = folder.read("photos/r_0.png");
    let (code, out, err) = run(&folder, &USUAL);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("9 photographs; COLMAP 3.8 (script)\n") && err.contains("other files are not read: notes.txt\n"), "{err}");
    assert!(err.contains("step 1/3, features: begins\n") && err.contains("step 3/3, mapping: begins\n"), "{err}");
    assert!(out.contains("without a camera: r_8.png\n8 of 9 photographs have a camera: features 0:0"), "{out}");
    assert!(out.contains("wrote room; train it with `plenoxel train room`\n"), "{out}");
    let record: serde_json::Value = serde_json::from_str(out.lines().last().expect("results")).expect("JSON");
    assert_eq!(
        (&record["photographs"], &record["with_camera"], record["without_camera"][0].as_str()),
        (&9.into(), &8.into(), Some("r_8.png"))
    );
    assert!(record["seconds"]["mapping"].is_number(), "{record}");
    // The larger of the two models.
    assert_eq!(folder.read("room/sparse/0/images.bin"), folder.read("bin/models/1/images.bin"));
    assert_eq!(folder.read("room/colmap/models/0/images.bin"), folder.read("bin/models/0/images.bin"));
    let log = String::from_utf8(folder.read("room/colmap/colmap.log")).expect("text");
    let options =
        "--ImageReader.single_camera 1 --ImageReader.camera_model OPENCV --SiftExtraction.use_gpu 0 --SiftExtraction.num_threads 2\n";
    assert!(
        log.contains("bin/colmap feature_extractor --database_path colmap/database.db --image_path images ") && log.contains(options),
        "{log}"
    );
    assert!(log.contains("Processed file [9/9]\n") && log.contains("Registering image #3 (3)\n"), "{log}");
    assert_eq!(calls(&folder), ALL);
    // The photographs are where they were; the link still leads to them when all is moved.
    assert!(folder.read("photos/r_0.png") == before && fs::read_dir(folder.path("photos")).expect("it").count() == 11);
    assert_eq!(fs::read_link(folder.path("room/images")).expect("a link").to_str(), Some("../photos"));
    let mut info = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
    let info = info.current_dir(&folder.0).args(["info", "room"]).output().expect("it runs");
    let told = String::from_utf8_lossy(&info.stdout).into_owned();
    assert!(info.status.success() && told.contains("COLMAP (binary)") && told.contains("1 images of room/images have no camera"), "{told}");

    // Once more, nothing is left to do; something else is not done in this folder unasked.
    let (code, again, err) = run(&folder, &USUAL);
    assert_eq!((code, again, calls(&folder).len()), (Some(0), out, 0), "{err}");
    assert_eq!(err.matches("finished earlier, in 0:0").count(), 3, "{err}");
    let (code, _, err) = run(&folder, &[&USUAL[..], &["--matcher", "sequential"]].concat());
    assert!(code == Some(2) && err.contains("--out: room was begun with something else (matcher was exhaustive, not sequential)"), "{err}");
    let (code, _, err) = run(&folder, &[&USUAL[..], &["--matcher", "sequential", "--force"]].concat());
    assert_eq!((code, calls(&folder)), (Some(0), vec!["sequential_matcher".to_owned(), "mapper".to_owned()]), "{err}");
    fs::remove_file(folder.path("photos/r_8.png")).expect("it is removed");
    let (code, _, err) = run(&folder, &[&USUAL[..], &["--matcher", "sequential"]].concat());
    assert!(code == Some(2) && err.contains("the photographs have changed: 9 then, 8 now"), "{err}");
    assert!(folder.path("room/sparse/0").exists() && calls(&folder).is_empty());
}

#[test]
fn each_size_has_a_camera_and_the_folder_may_be_that_of_the_photographs() {
    let folder = prepared(8);
    fs::create_dir(folder.path("room")).expect("a folder");
    fs::rename(folder.path("photos"), folder.path("room/images")).expect("moved");
    let other = plenoxel::dataset::image::RgbaImage::new(12, 16);
    plenoxel::dataset::image::write_rgba(&folder.path("room/images/r_8.png"), &other).expect("an upright image");
    let (code, out, err) = run(&folder, &["room/images", "--out=room", "--colmap=bin/colmap", "--verbose"]);
    assert!(code == Some(0) && out.contains("8 of 9 photographs have a camera"), "{err}{out}");
    assert!(err.contains("the photographs have 2 sizes\n") && err.contains("Processed file [8/8]\n"), "{err}");
    assert_eq!(calls(&folder), [&ALL[..1], &ALL].concat());
    assert_eq!(folder.read("room/colmap/photos_0.txt"), b"r_8.png\n");
    assert!(!folder.path("room/images").is_symlink());

    let (code, _, err) = run(&folder, &["room/images", "--colmap", "bin/colmap", "--camera-per-photo", "--quiet"]);
    assert_eq!((code, err.as_str(), calls(&folder)), (Some(0), "", ALL.map(str::to_owned).to_vec()));
    let log = String::from_utf8(folder.read("room/images-cameras/colmap/colmap.log")).expect("text");
    assert!(log.contains("--ImageReader.single_camera_per_image 1 --ImageReader.camera_model SIMPLE_RADIAL"), "{log}");
}

#[test]
fn a_step_that_fails_is_quoted_and_the_next_call_continues_with_it() {
    let folder = prepared(8);
    folder.write("bin/fail-exhaustive_matcher", "");
    let (code, _, err) = run(&folder, &USUAL);
    let told =
        "error: room/colmap/colmap.log: step 2/3, matching failed: exhaustive_matcher of COLMAP ended with exit code 7: no luck with";
    assert!(code == Some(3) && err.contains(told) && err.contains("repeat the command to continue"), "{err}");
    assert_eq!(calls(&folder), ALL[..2]);
    assert!(
        String::from_utf8(folder.read("room/colmap/colmap.log"))
            .expect("text")
            .contains("ERROR: no luck with exhaustive_matcher\nthe end\n")
    );
    fs::remove_file(folder.path("bin/fail-exhaustive_matcher")).expect("it is removed");
    folder.write("bin/fail-mapper", "");
    let (code, _, err) = run(&folder, &USUAL);
    assert!(code == Some(3) && err.contains("step 1/3, features: finished earlier") && err.contains("step 3/3, mapping failed"), "{err}");
    assert_eq!(calls(&folder), ALL[1..]);
    assert!(!folder.path("room/sparse").exists());
    fs::remove_file(folder.path("bin/fail-mapper")).expect("it is removed");
    let (code, _, err) = run(&folder, &USUAL);
    assert_eq!((code, calls(&folder)), (Some(0), ALL[2..].iter().map(|name| (*name).to_owned()).collect()), "{err}");
}

#[test]
fn an_interruption_ends_colmap_and_nothing_half_written_counts() {
    let folder = prepared(8);
    for step in [0, 2] {
        let hang = format!("bin/hang-{}", ALL[step]);
        folder.write(&hang, "");
        let child = start(&folder, &USUAL);
        let script = wait_for(&folder, "bin/hanging");
        // While it works nobody else does, there.
        let (code, _, err) = run(&folder, &USUAL);
        assert!(code == Some(2) && err.contains("is being written by process"), "{err}");
        assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().expect("kill").success());
        let (code, out, err) = ended(child);
        assert_eq!((code, out.as_str()), (Some(130), ""), "{err}");
        assert!(err.contains(&format!("interrupted; repeat the command to continue with step {}/3", step + 1)), "{err}");
        let is_alive = || Command::new("kill").args(["-0", &script]).stderr(Stdio::null()).status().expect("kill").success();
        assert!(!is_alive(), "the process of COLMAP has ended");
        assert!(!folder.path("room/sparse").exists());
        fs::remove_file(folder.path(&hang)).and_then(|()| fs::remove_file(folder.path("bin/hanging"))).expect("removed");
        assert_eq!(calls(&folder).last().map(String::as_str), Some(ALL[step]));
        if step == 0 {
            folder.write("room/colmap/database.db", "half");
            folder.write("room/colmap/database.db-wal", "half");
        }
    }
    let (code, out, err) = run(&folder, &USUAL);
    assert!(code == Some(0) && out.contains("8 of 9 photographs have a camera"), "{err}{out}");
    assert_eq!(calls(&folder), ALL[2..]);
    assert_eq!(folder.read("room/colmap/database.db"), b"features\nmatches\n");
    assert!(!folder.path("room/colmap/database.db-wal").exists());
}

#[test]
fn too_few_cameras_are_an_error_that_says_what_to_do() {
    let folder = prepared(4);
    let (code, out, err) = run(&folder, &USUAL);
    assert!(code == Some(3) && out.is_empty() && err.contains("room: only 4 of 9 photographs got a camera"), "{err}");
    assert!(err.contains("(see room/colmap/models/1)") && err.contains("take more photographs that overlap"), "{err}");
    assert!(!folder.path("room/sparse").exists());
    fs::remove_dir_all(folder.path("bin/models")).expect("removed");
    let (code, _, err) = run(&folder, &[&USUAL[..], &["--matcher=sequential", "--force"]].concat());
    assert!(
        code == Some(3) && err.contains("none of 9 photographs got a camera; match all pairs with --matcher exhaustive --force"),
        "{err}"
    );
}

#[test]
fn what_cannot_work_is_refused_before_anything_is_written() {
    let folder = prepared(8);
    let refused = |arguments: &[&str], code: i32, parts: &[&str]| {
        let (found, _, err) = run(&folder, arguments);
        assert!(found == Some(code) && parts.iter().all(|part| err.contains(part)), "{arguments:?}: {found:?} {err}");
    };
    refused(&["photos", "--colmap", "bin/none"], 2, &["--colmap: there is no program `", "apt install colmap", "brew install colmap"]);
    refused(&["photos", "--colmap", "none"], 2, &["--colmap: there is no program `none`"]);
    refused(&["photos", "--colmap", "bin/models"], 2, &["cannot be run"]);
    refused(&["photos", "--colmap", "true"], 2, &["`true` does not have the options of COLMAP"]);
    refused(&["nowhere", "--colmap", "bin/colmap"], 3, &["nowhere: there is no such folder"]);
    refused(&["photos/r_0.png", "--colmap", "bin/colmap"], 3, &["photos/r_0.png: this is a file"]);
    folder.write("empty/.hidden", "");
    refused(&["empty"], 3, &["empty: there is no photograph"]);
    folder.write("empty/IMG_1.HEIC", "");
    refused(&["empty"], 3, &["only others such as IMG_1.HEIC", "convert the photographs to JPEG or PNG"]);
    folder.write("empty/r.png", folder.read("photos/r_0.png"));
    refused(&["empty"], 3, &["there is only one photograph, r.png"]);
    let whole = folder.read("photos/r_1.png");
    folder.write("empty/s.png", &whole[..whole.len() / 2]);
    refused(&["empty"], 3, &["empty/s.png: "]);
    // Folders of others, and other photographs under the name of the link, stay as they are.
    refused(&["photos", "--out", "bin", "--colmap", "bin/colmap"], 2, &["--out: bin is not empty"]);
    refused(&["photos", "--out", "photos", "--colmap", "bin/colmap"], 2, &["--out: photos is not empty"]);
    refused(&["photos", "--out", "bin/colmap", "--colmap", "bin/colmap"], 2, &["--out: bin/colmap is a file"]);
    folder.write("other/images/a.png", folder.read("photos/r_0.png"));
    folder.write("other/cameras.lock", "");
    refused(&["photos", "--out", "other", "--colmap", "bin/colmap", "--force"], 2, &["--out: other is not empty"]);
    assert!(!folder.path("photos-cameras").exists() && calls(&folder).is_empty());
    // A damaged record is no reason to begin anew unasked.
    folder.write("mine/cameras.lock", "");
    folder.write("mine/cameras.json", "{");
    refused(&["photos", "--out", "mine", "--colmap", "bin/colmap"], 3, &["mine/cameras.json: this is no record of `plenoxel cameras`"]);
    let (code, _, err) = run(&folder, &["photos", "--out", "mine", "--colmap", "bin/colmap", "--force"]);
    assert_eq!((code, calls(&folder)), (Some(0), ALL.map(str::to_owned).to_vec()), "{err}");
}
