//! What is written, and what is never lost: two runs at once, devices and links, a full disk, a run that was killed before its page.
#![cfg(unix)]

use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A run of a moment.
const TINY: [&str; 11] = [
    "train",
    "--preset=demo",
    "--scene-size=12",
    "--scene-views=4,0,1",
    "--no-images",
    "--no-report",
    "--set=stages[*].steps=3",
    "--set=stages[*].resolution=8",
    "--set=rays_per_step=64",
    "--preview-every=off",
    "--threads=1",
];

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("plenoxel-folders-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).expect("a temporary folder");
        Folder(path)
    }

    fn plenoxel(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
        command.current_dir(&self.0).args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn run(&self, arguments: &[&str]) -> Output {
        self.plenoxel(arguments).output().expect("the program starts")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            let _ = fs::remove_dir_all(&self.0);
        }
    }
}

fn code(output: &Output) -> i32 {
    output.status.code().expect("it was not killed")
}

fn err(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The seed in the settings of a run that ended, whose metrics are of one run.
fn seed_of(run: &Path) -> String {
    let lines = fs::read_to_string(run.join("metrics.jsonl")).expect("metrics");
    let finals = lines.lines().filter(|line| line.contains("\"final\"")).count();
    assert_eq!(finals, 1, "{}: the metrics of one run", run.display());
    assert!(run.join("checkpoint.safetensors").exists() && run.join("result.json").exists());
    let config = fs::read_to_string(run.join("config.toml")).expect("settings");
    config.lines().find(|line| line.starts_with("seed")).expect("a seed").to_owned()
}

#[test]
fn runs_that_start_at_the_same_moment_lose_nothing() {
    let folder = Folder::new("pairs");
    for pair in 0..6 {
        // Without --out each gets a folder of its own.
        let seeds = [2 * pair + 1, 2 * pair + 2].map(|seed| format!("--seed={seed}"));
        let children = seeds.each_ref().map(|seed| folder.plenoxel(&[&TINY[..], &[seed]].concat()).spawn().expect("it starts"));
        for child in children {
            let ended = child.wait_with_output().expect("it ends");
            assert_eq!(code(&ended), 0, "{}", err(&ended));
        }
        // With the same --out one writes, and the other is refused.
        let out = format!("--out=same-{pair}");
        let children = seeds.each_ref().map(|seed| folder.plenoxel(&[&TINY[..], &[seed, &out]].concat()).spawn().expect("it starts"));
        let ended = children.map(|child| child.wait_with_output().expect("it ends"));
        let mut codes = ended.each_ref().map(code);
        codes.sort_unstable();
        assert_eq!(codes, [0, 2], "{} {}", err(&ended[0]), err(&ended[1]));
        let refused = err(ended.iter().find(|output| code(output) == 2).expect("one was refused"));
        assert!(refused.contains("is being written by") || refused.contains("not empty"), "{refused}");
        assert_eq!(refused.matches("error: ").count(), 1, "{refused}");
        seed_of(&folder.0.join(format!("same-{pair}")));
    }
    let mut seeds: Vec<String> = (1..=12).map(|n| seed_of(&folder.0.join(format!("runs/procedural-{n}")))).collect();
    seeds.sort_unstable();
    seeds.dedup();
    assert_eq!(seeds.len(), 12, "each run is there: {seeds:?}");
}

#[test]
fn a_live_run_is_neither_overwritten_nor_resumed_by_another_process() {
    let folder = Folder::new("live");
    let long = [&TINY[..], &["--set=stages[*].steps=100000", "--out=live", "--checkpoint-every=1s"]].concat();
    let mut live = folder.plenoxel(&long).spawn().expect("it starts");
    let state = folder.0.join("live/training.safetensors");
    let start = std::time::Instant::now();
    while !state.exists() && start.elapsed().as_secs() < 60 {
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    for arguments in [&[&TINY[..], &["--out=live", "--force"]].concat()[..], &["train", "--resume", "live"]] {
        let refused = folder.run(arguments);
        assert!(code(&refused) == 2 && err(&refused).contains(&format!("process {}", live.id())), "{}", err(&refused));
    }
    live.kill().expect("it is there");
    live.wait().expect("it ends");
    // Its lock went with it.
    let forced = folder.run(&[&TINY[..], &["--out=live", "--force"]].concat());
    assert_eq!(code(&forced), 0, "{}", err(&forced));
}

#[test]
fn a_full_disk_is_found_before_the_first_step() {
    let folder = Folder::new("full");
    let program = env!("CARGO_BIN_EXE_plenoxel");
    let line =
        format!("ulimit -f 8; exec {program} {} --set 'stages[*].resolution=64' --out run", TINY.map(|a| format!("'{a}'")).join(" "));
    let refused = Command::new("sh").current_dir(&folder.0).args(["-c", &line]).output().expect("a shell");
    assert_eq!(refused.status.code(), Some(5), "{}", err(&refused));
    assert!(err(&refused).contains("ulimit -f") && err(&refused).contains("free disk space"), "{}", err(&refused));
    assert!(!folder.0.join("run/metrics.jsonl").exists());
    // A file that cannot be written in full is an error too, and not the end of the process.
    let line = format!("ulimit -f 1; exec {program} completions bash > completions");
    let cut = Command::new("sh").current_dir(&folder.0).args(["-c", &line]).output().expect("a shell");
    assert_eq!(cut.status.code(), Some(5), "{}", err(&cut));
}

#[test]
fn outputs_go_where_they_should() {
    let folder = Folder::new("outputs");
    assert_eq!(code(&folder.run(&[&TINY[..], &["--out=run"]].concat())), 0);
    let evaluate = |out: &str| folder.run(&["evaluate", "run", "--out", out]);
    let json = |text: &[u8]| serde_json::from_slice::<serde_json::Value>(text).is_ok_and(|value| value["psnr"].is_number());
    for stdout in ["-", "/dev/stdout"] {
        let shown = evaluate(stdout);
        assert!(code(&shown) == 0 && json(&shown.stdout), "{stdout}: {}", String::from_utf8_lossy(&shown.stdout));
    }
    assert_eq!(code(&evaluate("/dev/null")), 0);
    assert!(!fs::metadata("/dev/null").expect("a device").is_file());
    if Path::new("/dev/full").exists() {
        assert_eq!(code(&evaluate("/dev/full")), 5);
    }
    std::os::unix::fs::symlink("figures.json", folder.0.join("link.json")).expect("a link");
    assert_eq!(code(&evaluate("link.json")), 0);
    assert!(folder.0.join("link.json").is_symlink() && json(&fs::read(folder.0.join("figures.json")).expect("figures")));
    let exported = folder.run(&["export", "vox", "run", "--min-alpha", "0.001", "--out", "-"]);
    assert!(code(&exported) == 0 && exported.stdout.starts_with(b"VOX "), "{}", err(&exported));
    // A path file whose name has no stem of its own.
    let key = serde_json::json!({"R": [1, 0, 0, 0], "T": [0.5, 0.5, 2], "fov": 50, "scale": 0, "slice": 0, "aperture_size": 0});
    let path = serde_json::json!({"loop": false, "path": [key, key], "time": 0});
    fs::write(folder.0.join("...json"), path.to_string()).expect("a file");
    let film = folder.run(&["render", "run", "--path", "...json", "--frames", "1", "--size", "8x8"]);
    assert!(code(&film) == 0 && folder.0.join("run/renders/path/frame_0000.png").exists(), "{}", err(&film));
    assert!(!folder.0.join("run/frame_0000.png").exists());
}

#[test]
fn a_run_that_was_killed_before_its_page_gets_it_when_it_is_resumed() {
    let folder = Folder::new("page");
    assert_eq!(code(&folder.run(&[&TINY[..], &["--out=run"]].concat())), 0);
    let page = folder.0.join("run/report.html");
    assert!(!page.exists());
    let resumed = folder.run(&["train", "--resume", "run"]);
    assert!(code(&resumed) == 0 && page.exists(), "{}", err(&resumed));
    let ended = folder.run(&["train", "--resume", "run"]);
    assert!(code(&ended) == 3 && err(&ended).contains("is finished"), "{}", err(&ended));
}

#[test]
fn folders_with_names_that_are_not_text_are_refused_or_work() {
    let folder = Folder::new("names");
    let name = std::ffi::OsStr::from_bytes(b"sc\xffne");
    if fs::create_dir(folder.0.join(name)).is_err() {
        return; // A file system that has no such names.
    }
    let mut command = folder.plenoxel(&TINY.map(|a| if a.starts_with("--scene") { "--quiet" } else { a }));
    let refused = command.arg(name).output().expect("it starts");
    assert!(code(&refused) == 3 && err(&refused).contains("UTF-8"), "{}", err(&refused));
    let mut command = folder.plenoxel(&TINY);
    let ended = command.arg("--out").arg(folder.0.join(name).join("run")).output().expect("it starts");
    assert_eq!(code(&ended), 0, "{}", err(&ended));
}
