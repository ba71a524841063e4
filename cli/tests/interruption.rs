//! A training run that is interrupted or killed goes on as if nothing had happened.
#![cfg(unix)]

#[path = "../../tests/support/events.rs"]
mod events;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A run of some seconds, of the built-in scene: two stages, pruning, and an optimizer with a memory.
const SETTINGS: [&str; 12] = [
    "--preset=demo",
    "--scene-size=32",
    "--scene-views=8,0,1",
    "--no-images",
    "--set=stages[0].resolution=12",
    "--set=stages[0].steps=60",
    "--set=stages[1].steps=60",
    "--set=stages[2].steps=60",
    "--set=stages[3].resolution=32",
    "--set=stages[3].steps=200",
    "--set=rays_per_step=600",
    "--threads=2",
];

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("plenoxel-interruption-{name}-{}", std::process::id()));
    fs::create_dir_all(&path).expect("a temporary folder");
    path
}

fn plenoxel(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
    command.arg("train").args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Waits until a run has written so many lines of metrics, or has ended.
fn wait_for_lines(run: &Path, lines: usize, child: &mut Child) {
    let start = Instant::now();
    while child.try_wait().expect("its state").is_none() && start.elapsed() < Duration::from_secs(60) {
        if fs::read_to_string(run.join("metrics.jsonl")).is_ok_and(|text| text.lines().count() >= lines) {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The trained grid, and the metrics without times.
fn result(run: &Path) -> (Vec<u8>, Vec<serde_json::Value>) {
    let lines = fs::read_to_string(run.join("metrics.jsonl")).expect("metrics");
    let mut lines: Vec<serde_json::Value> = lines.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect();
    // The last line is of the evaluation.
    lines.pop();
    for line in &mut lines {
        line.as_object_mut().expect("an object").remove("seconds");
    }
    (fs::read(run.join("checkpoint.safetensors")).expect("the trained grid"), lines)
}

#[test]
fn a_run_that_is_interrupted_and_killed_goes_on_bit_by_bit() {
    let root = folder("bits");
    let path = |name: &str| root.join(name).to_string_lossy().into_owned();
    let (straight, cut) = (path("straight"), path("cut"));
    let begin = |out: &str| plenoxel(&[&SETTINGS[..], &["--out", out]].concat());
    let output = begin(&straight).output().expect("it runs");
    assert!(output.status.success(), "{}", text(&output));
    let want = result(Path::new(&straight));
    assert!(!Path::new(&straight).join("training.safetensors").exists(), "a run that has ended needs no state");

    let mut child = begin(&cut).spawn().expect("it runs");
    wait_for_lines(Path::new(&cut), 80, &mut child);
    // Twice within a second is the same wish.
    for signal in ["-INT", "-TERM"] {
        let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().expect("kill");
        assert!(sent.success());
    }
    let output = child.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(130), "{}", text(&output));
    assert!(text(&output).contains("saved; resume with: plenoxel train --resume"), "{}", text(&output));
    assert!(Path::new(&cut).join("training.safetensors").exists() && !Path::new(&cut).join("checkpoint.safetensors").exists());

    for lines in [150, 210, 300] {
        let mut child =
            plenoxel(&["--resume", &cut, "--no-images", "--checkpoint-every", "0.05s", "--threads", "1"]).spawn().expect("it runs");
        wait_for_lines(Path::new(&cut), lines, &mut child);
        child.kill().expect("it is killed");
        child.wait().expect("it ends");
    }
    let output = plenoxel(&["--resume", &cut, "--no-images"]).output().expect("it runs");
    assert!(output.status.success() && text(&output).contains("resumed after step"), "{}", text(&output));
    let found = result(Path::new(&cut));
    assert!(found.0 == want.0, "another grid");
    assert_eq!(found.1.last(), want.1.last());
    // TensorBoard is told each step once, in five files.
    let curves = events::scalars(Path::new(&cut));
    let told: Vec<(Option<u64>, Option<f32>)> = curves["loss"].iter().map(|&(step, loss)| (Some(step), Some(loss))).collect();
    let wanted = found.1.iter().map(|line| (line["step"].as_u64(), line["loss"].as_f64().map(|loss| loss as f32)));
    assert!(events::files(Path::new(&cut)).len() == 5 && told == wanted.collect::<Vec<_>>(), "{told:?}");
    let names: Vec<_> = fs::read_dir(&cut).expect("its folder").flatten().map(|entry| entry.file_name()).collect();
    assert!(!names.iter().any(|name| name.to_string_lossy().contains("tmp")), "{names:?}");

    // It has ended, and a folder without a run has nothing to go on with; what a run was told when it began is not told again.
    for (arguments, code, reason) in [
        (&["--resume", &cut][..], 3, "this run is finished"),
        (&["--resume", &path("nowhere")], 3, "this run folder does not exist"),
        (&["--resume", &cut, "--seed", "1"], 2, "cannot be used with"),
    ] {
        let output = plenoxel(arguments).output().expect("it runs");
        assert_eq!(output.status.code(), Some(code), "{}", text(&output));
        assert!(text(&output).contains(reason), "{}", text(&output));
    }
    fs::remove_dir_all(root).expect("it is removed");
}

/// Sends a signal to a process.
fn send(signal: &str, child: &Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().expect("kill").success());
}

#[test]
fn a_terminal_that_is_closed_stops_a_run_as_ctrl_c_does() {
    let root = folder("hangup");
    let run = root.join("run");
    let mut child = plenoxel(&[&SETTINGS[..], &["--out", &run.to_string_lossy()]].concat()).spawn().expect("it runs");
    wait_for_lines(&run, 80, &mut child);
    send("-HUP", &child);
    let output = child.wait_with_output().expect("it ends");
    if ignores_hangups() {
        assert!(output.status.success(), "a run under nohup goes on: {}", text(&output));
    } else {
        assert_eq!(output.status.code(), Some(130), "{}", text(&output));
        assert!(
            text(&output).contains("resume with: plenoxel train --resume") && run.join("training.safetensors").exists(),
            "{}",
            text(&output)
        );
    }
    fs::remove_dir_all(root).expect("it is removed");
}

/// Returns true if this process ignores hangups, as under `nohup` on Linux. Its children do so too.
fn ignores_hangups() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & 1 != 0)
}

#[test]
fn a_run_whose_folder_is_moved_and_replaced_keeps_its_model_and_touches_nothing() {
    let root = folder("moved");
    let (run, moved) = (root.join("run"), root.join("moved"));
    let mut child = plenoxel(&[&SETTINGS[..], &["--out", &run.to_string_lossy()]].concat()).spawn().expect("it runs");
    wait_for_lines(&run, 40, &mut child);
    fs::rename(&run, &moved).expect("moved");
    fs::create_dir(&run).expect("another folder");
    let output = child.wait_with_output().expect("it ends");
    let said = text(&output);
    assert_eq!(output.status.code(), Some(5), "{said}");
    assert!(said.contains("moved, deleted or replaced") && said.contains("the trained model was saved as"), "{said}");
    assert_eq!(fs::read_dir(&run).expect("a folder").count(), 0);
    let kept: Vec<_> = fs::read_dir(&root).expect("a folder").flatten().filter(|file| file.path().is_file()).collect();
    assert!(kept.len() == 1 && kept[0].file_name().to_string_lossy().ends_with(".safetensors"), "{kept:?}");
    // As the message says.
    fs::rename(kept[0].path(), moved.join("checkpoint.safetensors")).expect("moved");
    let output = plenoxel(&["--resume", &moved.to_string_lossy(), "--no-images"]).output().expect("it runs");
    assert!(output.status.success() && moved.join("result.json").exists(), "{}", text(&output));
    fs::remove_dir_all(root).expect("it is removed");
}
