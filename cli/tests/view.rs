//! The live page of the program: a run, a run in training, and what is refused.
#![cfg(unix)]

#[path = "../../tests/support/command.rs"]
mod command;

use command::{Folder, plenoxel, train};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A program with a page.
struct Program {
    child: Child,
    host: String,
    root: String,
}

impl Program {
    fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_plenoxel"));
        let mut child = command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it runs");
        let mut lines = BufReader::new(child.stdout.take().expect("its output")).lines();
        let address = lines.find_map(|line| Some(line.expect("text").strip_prefix("view: http://")?.to_owned()));
        let Some(address) = address else {
            panic!("no address: {}", child.wait_with_output().map_or_else(|e| e.to_string(), |output| text(&output.stderr)))
        };
        // The rest is read, so that the program can print.
        std::thread::spawn(move || lines.for_each(drop));
        let (host, root) = address.split_once('/').expect("a path");
        Program { child, host: host.to_owned(), root: format!("/{root}") }
    }

    /// The status and the body of a response.
    fn ask(&self, method: &str, path: &str, body: &str) -> (u16, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.host).expect("a connection");
        let (root, length) = (&self.root, body.len());
        write!(stream, "{method} {root}{path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n{body}").expect("sent");
        let mut received = Vec::new();
        stream.read_to_end(&mut received).expect("a response");
        let end = received.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
        let status = text(&received[..end]).split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
        (status, received[end + 4..].to_vec())
    }

    fn json(&self, method: &str, path: &str) -> Value {
        let (status, body) = self.ask(method, path, "");
        assert_eq!(status, 200, "{}", text(&body));
        serde_json::from_slice(&body).expect("JSON")
    }

    /// The picture of a view of the scene, in its own size.
    fn picture(&self, view: &Value, channel: &str) -> image::RgbImage {
        let mut asked = view.clone();
        asked.as_object_mut().expect("a view").remove("name");
        (asked["channel"], asked["format"]) = (json!(channel), json!("png"));
        let (status, body) = self.ask("POST", "picture", &asked.to_string());
        assert_eq!(status, 200, "{}", text(&body));
        image::load_from_memory(&body).expect("a picture").into_rgb8()
    }

    /// Sends SIGTERM and returns the exit code and stderr.
    fn end(self) -> (Option<i32>, String) {
        assert!(Command::new("kill").arg(self.child.id().to_string()).status().expect("kill").success());
        self.wait()
    }

    fn wait(self) -> (Option<i32>, String) {
        let output = self.child.wait_with_output().expect("it ends");
        (output.status.code(), text(&output.stderr))
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_run_is_shown_as_render_renders_it_until_the_program_is_ended() {
    let folder = Folder::new("view");
    let run = folder.path("run");
    train("4,0,0", &run, &["--no-report"]).done();
    let program = Program::start(&["view", &run]);
    assert!(program.host.starts_with("127.0.0.1:"));
    let (status, page) = program.ask("GET", "", "");
    assert!(status == 200 && text(&page).contains("<canvas"));
    let scene = program.json("GET", "scene");
    let views = scene["views"].as_array().expect("views");
    assert_eq!(views.len(), 4);
    plenoxel(&["render", &run, "--split=train", "--view=0"]).done();
    for (channel, suffix) in [("color", ""), ("depth", "_depth"), ("opacity", "_opacity")] {
        let name = format!("train_000_{}{suffix}.png", views[0]["name"].as_str().expect("a name"));
        let rendered = image::open(Path::new(&run).join("renders").join(name)).expect("a picture").into_rgb8();
        assert_eq!(program.picture(&views[0], channel), rendered, "{channel}");
    }
    // The farthest camera that is accepted, and the narrowest and widest lenses.
    let mut far = views[0].clone();
    far["pose"][9] = json!(1e6);
    assert!(program.picture(&far, "depth").pixels().all(|pixel| pixel.0 == [255; 3]));
    for focal in [0.024, 24_000.0] {
        let mut lens = views[1].clone();
        (lens["fx"], lens["fy"]) = (json!(focal), json!(focal));
        program.picture(&lens, "color");
    }
    let (code, said) = program.end();
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn a_run_is_shown_without_its_dataset() {
    let folder = Folder::new("view-moved");
    let (data, run) = (folder.path("data"), folder.path("run"));
    plenoxel(&["scene", &data, "--size=24", "--train=4", "--val=0", "--test=0"]).done();
    let settings = format!("--set={}", command::SHORT);
    plenoxel(&["train", &data, "--preset=demo", &settings, "--set=rays_per_step=256", "--no-report", "--out", &run]).done();
    std::fs::remove_dir_all(&data).expect("the dataset");
    let program = Program::start(&["view", &run]);
    let scene = program.json("GET", "scene");
    assert_eq!(scene["views"].as_array().map(Vec::len), Some(1));
    assert!(program.picture(&scene["views"][0], "opacity").pixels().any(|pixel| pixel.0[0] > 0));
    let (code, said) = program.end();
    assert!(code == Some(0) && said.contains("begins outside of the box"), "{said}");
    plenoxel(&["view", &run, "--data", &data]).refused(3, &[&data]);
}

#[test]
fn missing_runs_ports_in_use_and_wrong_flags_are_refused() {
    let folder = Folder::new("view-refused");
    let run = folder.path("run");
    plenoxel(&["view", &run]).refused(3, &["this run folder does not exist"]);
    train("4,0,0", &run, &["--no-report"]).done();
    let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = taken.local_addr().expect("its address").port().to_string();
    plenoxel(&["view", &run, "--port", &port]).refused(2, &["--port", "is in use", "0 for any free port"]);
    let other = folder.path("other");
    train("4,0,0", &other, &["--view", "--port", &port]).refused(2, &["--port", "is in use"]);
    assert!(!Path::new(&other).exists(), "nothing is written");
    for wrong in ["65536", "-1", "x"] {
        assert_eq!(plenoxel(&["view", &run, "--port", wrong]).code, 2);
    }
    assert_eq!(train("4,0,0", &other, &["--port", "0"]).code, 2, "--port is for --view");
}

#[test]
fn a_watched_run_has_the_same_bits_and_stops_and_saves_when_it_is_asked() {
    const LONG: &str = "--set=stages=[{resolution=12, steps=4000, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]";
    let folder = Folder::new("view-training");
    let (plain, watched) = (folder.path("plain"), folder.path("watched"));
    let settings = |out: &'static str| {
        [
            "train",
            "--preset=demo",
            "--scene-size=24",
            "--set=rays_per_step=256",
            "--scene-views=4,0,1",
            LONG,
            "--no-images",
            "--no-report",
            out,
        ]
    };
    let program = {
        let mut arguments = settings("--out").to_vec();
        arguments.extend([watched.as_str(), "--view"]);
        Program::start(&arguments)
    };
    let scene = program.json("GET", "scene");
    assert_eq!(scene["training"], json!(true));
    let picture = program.picture(&scene["views"][0], "color");
    assert_eq!(picture.dimensions(), (24, 24));
    // A checkpoint is saved after the next step.
    program.json("POST", "checkpoint");
    let start = Instant::now();
    while program.json("GET", "training")["saved"].is_null() {
        assert!(start.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(Path::new(&watched).join("training.safetensors").exists());
    assert!(text(&program.ask("GET", "loss.svg", "").1).starts_with("<svg"));
    let state = program.json("POST", "stop");
    assert!(state["message"].as_str().is_some_and(|message| message.contains("plenoxel train --resume")), "{state}");
    let (code, said) = program.wait();
    assert!(code == Some(130) && said.contains("saved; resume with"), "{code:?}: {said}");
    // It goes on with a page, and ends with the bits of a run without.
    let program = Program::start(&["train", "--resume", &watched, "--no-images", "--no-report", "--view"]);
    let state = program.json("GET", "training");
    assert!(state["step"].as_u64() > Some(0) && state["steps"] == json!(4000), "{state}");
    program.picture(&scene["views"][0], "depth");
    let (code, said) = program.wait();
    assert_eq!(code, Some(0), "{said}");
    let mut arguments = settings("--out").to_vec();
    arguments.push(&plain);
    plenoxel(&arguments).done();
    let bits = |run: &str| std::fs::read(Path::new(run).join("checkpoint.safetensors")).expect("a checkpoint");
    assert!(bits(&plain) == bits(&watched), "another grid");
}
