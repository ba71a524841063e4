//! A sweep with the real program: its runs are processes, of which one fails and the others do not.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Two scenes that are the built-in one, two methods of a few steps, one that asks for a reduction by 5 of images of 24 pixels, and
/// a carved one.
const FILE: &str = r#"
set = ["rays_per_step=200"]

[[scenes]]
name = "few"
scene_size = 24
scene_views = [5, 0, 2]
methods = ["coarse", "fine", "odd"]

[[scenes]]
name = "files"
data = "scene"

[[methods]]
name = "coarse"
preset = "demo"
set = ["stages=[{resolution=6, steps=4, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]"]

[[methods]]
name = "fine"
preset = "demo"
set = ["stages=[{resolution=12, steps=6, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]"]

[[methods]]
name = "odd"
preset = "demo"
downscale = 5

[[methods]]
name = "hull"
command = "carve"
resolution = 16
evaluate_downscale = 2

[[published]]
name = "Elsewhere"
source = "a table"
psnr = { few = 12.25 }
"#;

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("plenoxel-sweep-{}-{name}", std::process::id()));
    drop(fs::remove_dir_all(&path));
    fs::create_dir_all(&path).expect("a temporary folder");
    path
}

fn plenoxel(root: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
    let Output { status, stdout, stderr } = command.current_dir(root).args(arguments).arg("--threads=2").output().expect("it runs");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("text");
    (status.code(), text(stdout), text(stderr))
}

/// Who stops a sweep tells it alone; it passes the wish on.
#[cfg(unix)]
#[test]
fn an_interrupted_sweep_has_its_run_saved_and_goes_on_with_it() {
    use std::time::{Duration, Instant};

    let root = folder("interrupted");
    let stage = "stages=[{resolution=12, steps=2000, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]";
    let plan = format!(
        "[[scenes]]\nscene_size = 24\nscene_views = [4, 0, 1]\n[[methods]]\nname = \"long\"\nset = [\"rays_per_step=100\", \"{stage}\"]\n[[methods]]\npreset=\"fast\"\ndownscale=7\n"
    );
    fs::write(root.join("plan.toml"), plan).expect("the file");
    let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
    let command =
        command.current_dir(&root).args(["sweep", "plan.toml"]).stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
    let mut child = command.spawn().expect("it runs");
    let start = Instant::now();
    while child.try_wait().expect("its state").is_none() && start.elapsed() < Duration::from_secs(60) {
        if fs::metadata(root.join("sweeps/plan/procedural/long/metrics.jsonl")).is_ok_and(|file| file.len() > 0) {
            break;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    // While it works nobody else does, there.
    let (code, _, err) = plenoxel(&root, &["sweep", "plan.toml"]);
    assert!(code == Some(2) && err.contains("process"), "{err}");
    let sent = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().expect("kill");
    assert!(sent.success());
    let output = child.wait_with_output().expect("it ends");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(130), "{err}");
    assert!(err.contains("repeat the command to resume") && !err.contains("2/2") && out.contains("| procedural | – | – |"), "{err}{out}");
    assert!(root.join("sweeps/plan/procedural/long/training.safetensors").exists());

    let (code, out, err) = plenoxel(&root, &["sweep", "plan.toml"]);
    assert!(code == Some(2) && err.contains("1/2 procedural long: resuming\n"), "{err}");
    assert!(out.contains("| procedural | **") && out.contains("| failed (2) |"), "{out}");
    fs::remove_dir_all(root).expect("it is removed");
}

#[test]
fn a_sweep_survives_a_failed_run_and_repeats_only_that() {
    let root = folder("whole");
    let read = |name: &str| fs::read_to_string(root.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    let sweep = |more: &[&str]| plenoxel(&root, &[&["sweep", "plan.toml", "--out", "swept"], more].concat());
    fs::write(root.join("plan.toml"), FILE).expect("the file");
    let scene = ["scene", "scene", "--size", "24", "--train", "5", "--val", "0", "--test", "2"];
    assert_eq!(plenoxel(&root, &scene).0, Some(0));

    let (code, out, err) = sweep(&["--dry-run"]);
    assert_eq!((code, out.matches(": to run").count()), (Some(0), 7), "{out}{err}");
    assert!(out.contains("few fine: to run\n    plenoxel train --set=rays_per_step=200 ") && !root.join("swept").exists(), "{out}");

    // The first run to fail has an invalid setting.
    let (code, out, err) = sweep(&[]);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("3/7 few odd: failed with exit code 2: downscale: 5") && err.contains("2 of 7 runs failed"), "{err}");
    assert!(out.contains("| scene | coarse | fine | odd | hull | Elsewhere (published) |\n"), "{out}");
    let cells: Vec<Vec<&str>> =
        out.lines().filter(|line| line.starts_with('|')).map(|line| line.split('|').map(str::trim).collect()).collect();
    assert!(cells[2][1] == "few" && cells[2][2].starts_with("**") && cells[2][3].starts_with("**"), "{out}");
    assert_eq!((cells[2][4], cells[2][5], cells[2][6]), ("failed (2)", "–", "**12.25** · – · –"), "{out}");
    assert!(cells[3][1] == "files" && cells[3][5].starts_with("**") && cells[4][1] == "mean" && cells[4][2].starts_with("**"), "{out}");
    assert_eq!(out, read("swept/table.md"));
    let (csv, html) = (read("swept/table.csv"), read("swept/table.html"));
    assert_eq!((csv.lines().count(), csv.matches(",finished,").count(), csv.matches(",failed,").count()), (1 + 8, 5, 2), "{csv}");
    // Photographs of two scenes and five renderings, of 24 or 12 pixels, enlarged.
    assert_eq!(html.matches("data:image/jpeg;base64,").count(), 2 + 5);
    assert_eq!((html.matches("<img width=\"192\"").count(), html.matches("Pictures: ").count()), (2 + 5, 1));
    assert!(read("swept/few/odd.log").contains("error: downscale") && read("swept/few/fine.log").starts_with("$ plenoxel train "));
    assert!(read("swept/few/fine/result.json").contains("\"psnr\""));
    let evaluation = read("swept/files/hull/evaluation.json");
    assert!(evaluation.contains("\"psnr\"") && evaluation.contains("\"width\": 12,"), "{evaluation}");

    // Once more: what is finished stays as it is, what was killed before it had its figures gets them.
    let modified = |name: &str| fs::metadata(root.join(name)).and_then(|file| file.modified()).expect("its time");
    let (before, grid) =
        (modified("swept/few/coarse/result.json"), fs::read(root.join("swept/few/fine/checkpoint.safetensors")).expect("it"));
    fs::remove_file(root.join("swept/few/fine/result.json")).expect("it is removed");
    let (code, again, err) = sweep(&[]);
    assert_eq!((code, err.matches("already finished: PSNR ").count()), (Some(2), 4), "{err}");
    assert!(err.contains("2/7 few fine: resuming") && err.contains("3/7 few odd: starting"), "{err}");
    assert_eq!(modified("swept/few/coarse/result.json"), before);
    assert!(fs::read(root.join("swept/few/fine/checkpoint.safetensors")).expect("it") == grid);
    let psnr = |text: &str| text.lines().find_map(|line| line.strip_prefix("| few | ")?.split(" · ").next().map(str::to_owned));
    assert_eq!(psnr(&again), psnr(&out));

    // Without what fails nothing runs; with other settings nothing is overwritten.
    fs::write(root.join("plan.toml"), FILE.replace("downscale = 5", "downscale = 2").replace("steps=6", "steps=7")).expect("the file");
    let (code, _, err) = sweep(&[]);
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("swept/few/fine is a run with other settings (stages[0].steps is 6, not 7); choose another folder"), "{err}");
    fs::write(
        root.join("plan.toml"),
        FILE.replace(", \"odd\"]", "]")
            .replace("name = \"odd\"\npreset = \"demo\"\ndownscale = 5", "name = \"odd\"\ncommand = \"carve\"\nresolution = 8"),
    )
    .expect("the file");
    let (code, _, err) = sweep(&["--quiet"]);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let (code, _, err) = sweep(&[]);
    assert_eq!((code, err.matches("already finished").count()), (Some(0), 6), "{err}");
    fs::remove_dir_all(root).expect("it is removed");
}

#[test]
fn runs_that_were_planned_by_time_are_recognized() {
    let root = folder("planned");
    let methods = r#"
        [[methods]]
        preset = "demo"
        time = "1s"
        set = ["rays_per_step=200", "stages=[{resolution=6, steps=4, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]"]
        [[methods]]
        preset = "quality"
        time = "8s"
        "#;
    fs::write(root.join("plan.toml"), format!("[[scenes]]\nscene_size = 24\nscene_views = [4, 0, 1]\n{methods}")).expect("the file");
    let (code, _, err) = plenoxel(&root, &["sweep", "plan.toml"]);
    assert_eq!(code, Some(0), "{err}");
    let (_, out, err) = plenoxel(&root, &["sweep", "plan.toml", "--dry-run"]);
    assert_eq!(out.matches("finished").count(), 2, "{out}{err}");
    // Other settings make other runs.
    fs::write(root.join("plan.toml"), format!("set = [\"seed=5\"]\n[[scenes]]\nscene_size = 24\nscene_views = [4, 0, 1]\n{methods}"))
        .expect("the file");
    let (_, out, _) = plenoxel(&root, &["sweep", "plan.toml", "--dry-run"]);
    assert_eq!(out.matches("seed is 42, not 5").count(), 2, "{out}");
    fs::remove_dir_all(root).expect("it is removed");
}

/// Two small runs of the built-in scene.
const TWO: &str = r#"
set = ["rays_per_step=100", "stages=[{resolution=6, steps=4, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]"]

[[scenes]]
scene_size = 24
scene_views = [4, 0, 1]

[[methods]]
name = "one"

[[methods]]
name = "two"
set = ["seed=5"]
"#;

/// The columns of table.csv that do not depend on the machine.
fn results(root: &Path, out: &str) -> Vec<String> {
    let csv = fs::read_to_string(root.join(out).join("table.csv")).expect("a table");
    let names: Vec<&str> = csv.lines().next().expect("names").split(',').collect();
    let psnr = names.iter().position(|name| *name == "psnr").expect("a column");
    csv.lines().map(|line| line.split(',').take(2).chain(line.split(',').nth(psnr)).collect::<Vec<_>>().join(",")).collect()
}

#[test]
fn runs_at_the_same_time_have_the_results_of_runs_one_after_another() {
    let root = folder("together");
    fs::write(root.join("plan.toml"), TWO).expect("the file");
    for (out, more) in [("alone", &[][..]), ("both", &["--jobs=2"])] {
        let (code, _, err) = plenoxel(&root, &[&["sweep", "plan.toml", "--out", out], more].concat());
        assert_eq!(code, Some(0), "{err}");
    }
    assert_eq!(results(&root, "alone"), results(&root, "both"));
    // Both had one of the two threads.
    let log = fs::read_to_string(root.join("both/procedural/one.log")).expect("a log");
    assert!(log.contains("1 thread"), "{log}");
    fs::remove_dir_all(root).expect("removed");
}

/// Programs that stand for Slurm: `sbatch` prints a number and keeps its arguments, `squeue` prints a file.
#[cfg(unix)]
fn fake_slurm(root: &Path) -> String {
    use std::os::unix::fs::PermissionsExt;
    let bin = root.join("bin");
    fs::create_dir_all(&bin).expect("a folder");
    let here = root.display();
    for (name, text) in [
        ("sbatch", format!("#!/bin/sh\nprintf '%s\\n' \"$@\" >> {here}/asked\necho 41\n")),
        ("squeue", format!("#!/bin/sh\ncat {here}/queue 2> /dev/null || exit 1\n")),
    ] {
        fs::write(bin.join(name), text).expect("a program");
        fs::set_permissions(bin.join(name), fs::Permissions::from_mode(0o755)).expect("executable");
    }
    format!("{}:{}", bin.display(), std::env::var("PATH").unwrap_or_default())
}

#[cfg(unix)]
#[test]
fn a_sweep_is_submitted_as_a_job_array_whose_tasks_make_its_runs() {
    let root = folder("slurm");
    fs::write(root.join("plan.toml"), TWO).expect("the file");
    let path = fake_slurm(&root);
    let sweep = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
        let command =
            command.current_dir(&root).env("PATH", &path).args(["sweep", "plan.toml", "--out", "swept", "--threads=2"]).args(more);
        let Output { status, stdout, stderr } = command.output().expect("it runs");
        (status.code(), String::from_utf8_lossy(&stdout).into_owned(), String::from_utf8_lossy(&stderr).into_owned())
    };
    let slurm = ["--engine=slurm", "--jobs=3", "--slurm", "partition=long", "--slurm", "mem=900M"];

    let (code, out, err) = sweep(&[&slurm[..], &["--dry-run"]].concat());
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("sbatch --parsable --array=1-2%3") && out.contains("--task \"$run\""), "{out}");
    assert!(!root.join("asked").exists() && !root.join("swept").exists());

    let (code, _, err) = sweep(&slurm);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("submitted 2 runs as job 41"), "{err}");
    let asked = fs::read_to_string(root.join("asked")).expect("arguments");
    for option in ["--array=1-2%3", "--cpus-per-task=2", "--mem=900M", "--partition=long", "--requeue", "--dependency=afterany:41"] {
        assert!(asked.lines().any(|line| line == option), "{option} in {asked}");
    }

    // Nothing is submitted or made here while Slurm still has runs.
    fs::write(root.join("queue"), "2|PENDING|Resources\n").expect("a queue");
    for more in [&slurm[..], &[]] {
        let (code, _, err) = sweep(more);
        assert!(
            code == Some(2) && err.contains("Slurm still has 1 of its runs: procedural/two is pending (Resources), task 41_2"),
            "{err}"
        );
    }
    let (code, out, _) = sweep(&["--status"]);
    assert!(code == Some(0) && out.contains("procedural one: to run\n") && out.contains("procedural two: to run; Slurm: pending"), "{out}");
    fs::remove_file(root.join("queue")).expect("removed");

    // Slurm would run these scripts.
    let script = |name: &str, task: &str| {
        let mut command = Command::new("sh");
        let done =
            command.arg(root.join("swept/slurm").join(name)).current_dir(&root).env("SLURM_ARRAY_TASK_ID", task).output().expect("it runs");
        (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
    };
    for (name, task) in [("task.sh", "1"), ("task.sh", "2"), ("task.sh", "2"), ("table.sh", "")] {
        let (code, err) = script(name, task);
        assert_eq!(code, Some(0), "{err}");
    }
    let (code, _, err) = plenoxel(&root, &["sweep", "plan.toml", "--out", "local"]);
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(results(&root, "swept"), results(&root, "local"));
    let (_, out, _) = sweep(&["--status"]);
    assert_eq!(out.lines().filter(|line| line.contains(": finished: ")).count(), 2, "{out}");
    // All runs are finished: nothing is submitted.
    fs::remove_file(root.join("asked")).expect("removed");
    assert!(sweep(&slurm).0 == Some(0) && !root.join("asked").exists());

    for (more, says) in [
        (&["--slurm", "time=3"][..], "add --engine slurm"),
        (&["--engine=slurm", "--slurm", "array=1-3"], "`array` is set by the sweep"),
        (&["--engine=slurm", "--slurm=--time=3"], "without dashes"),
        (&["--task", "procedural/three"], "unknown run `procedural/three`"),
        (&["--engine=ssh"], "local, slurm"),
    ] {
        let (code, _, err) = sweep(more);
        assert!(code == Some(2) && err.contains(says), "{says} in {err}");
    }
    fs::remove_dir_all(root).expect("removed");
}
