//! A film is an MP4 too where there is `ffmpeg`, and a GIF alone where there is none.
#![cfg(unix)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

/// Runs the program with `path` as the only place where other programs are looked for.
fn plenoxel(arguments: &[&str], path: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_plenoxel")).args(arguments).env("PATH", path).output().expect("the program")
}

#[test]
fn there_may_be_an_ffmpeg_or_none_and_one_that_fails_is_quoted() {
    let folder = std::env::temp_dir().join(format!("plenoxel-ffmpeg-{}", std::process::id()));
    let (bin, run) = (folder.join("bin"), folder.join("run"));
    fs::create_dir_all(&bin).expect("a temporary folder");
    let run_text = run.to_str().expect("a plain name");
    let stages = "stages=[{resolution=6, steps=2, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]";
    let tiny =
        ["train", "--scene-size=8", "--scene-views=2,0,0", "--no-images", "--set", stages, "--set", "rays_per_step=64", "--out", run_text];
    assert!(plenoxel(&tiny, &bin).status.success());

    let render = || {
        let output = plenoxel(&["render", run_text, "--path", "orbit", "--frames", "2"], &bin);
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (gif, mp4) = (run.join("renders/orbit.gif"), run.join("renders/orbit.mp4"));
    let (code, told) = render();
    assert!(code == Some(0) && told.contains("ffmpeg is not in PATH") && gif.exists() && !mp4.exists(), "{told}");

    let ffmpeg = |script: &str| {
        let path = bin.join("ffmpeg");
        fs::write(&path, format!("#!/bin/sh\n[ \"$1\" = -version ] && exit 0\n{script}\n")).expect("a script");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("its permissions");
    };
    // What it is told to write to comes last.
    ffmpeg("for file; do :; done; echo film > \"$file\"");
    let (code, told) = render();
    assert!(code == Some(0) && fs::read(&mp4).expect("the film") == b"film\n", "{told}");

    ffmpeg("echo 'a warning' >&2; echo 'Unknown encoder' >&2; exit 1");
    let (code, told) = render();
    assert!(code == Some(5) && told.contains("orbit.mp4") && told.contains("Unknown encoder") && !told.contains("a warning"), "{told}");
    assert!(gif.exists() && !mp4.exists(), "the film of before is gone");
    let left: Vec<_> = fs::read_dir(run.join("renders")).expect("the folder").flatten().map(|entry| entry.file_name()).collect();
    assert_eq!(left.len(), 2, "no fragment is left: {left:?}");
    fs::remove_dir_all(folder).expect("removing it");
}
