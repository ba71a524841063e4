//! Tests of the server without a browser.

use super::http::Patience;
use super::order::{MOST_PIXELS, Studio, studio};
use super::server::{Door, Server};
use super::site::{Scene, Site};
use super::training::Training;
use ndarray::{Array2, Array3};
use plenoxel::camera::Camera;
use plenoxel::dataset::Dataset;
use plenoxel::dataset::procedural::ProceduralOptions;
use plenoxel::render::picture::Picture;
use serde_json::{Value, json};
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// A server with a renderer that paints each picture in one color.
struct Page {
    server: Option<Server>,
    address: SocketAddr,
    root: String,
    ends: Arc<AtomicBool>,
    renderer: Option<JoinHandle<()>>,
    /// Number of chunks rendered.
    chunks: Arc<AtomicUsize>,
}

/// Duration of a chunk of the renderer, of which a picture has 100.
const CHUNK: Duration = Duration::from_millis(1);

fn orange(camera: &Camera) -> Picture {
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    let rgb = Array3::from_shape_fn((h, w, 3), |(_, _, c)| [1.0, 0.5, 0.0][c]);
    Picture { rgb, depth: Array2::from_elem((h, w), 2.0), opacity: Array2::from_elem((h, w), 0.25) }
}

fn render(studio: &Studio, ends: &AtomicBool, chunks: &AtomicUsize) {
    while !ends.load(SeqCst) {
        let Some(order) = studio.next(Duration::from_millis(5)) else { continue };
        order.fill(1.5, |camera, stopped| {
            for _ in 0..if camera.intrinsics.width == 77 { 1000 } else { 1 } {
                if stopped() {
                    return None;
                }
                chunks.fetch_add(1, SeqCst);
                thread::sleep(CHUNK);
            }
            Some(orange(camera))
        });
    }
}

impl Page {
    fn open(patience: Patience, training: Option<Arc<Training>>) -> Self {
        let scene = ProceduralOptions { width: 40, height: 30, train: 3, val: 0, test: 0, supersample: 1 };
        let scene = Scene::of("<a run>".to_owned(), &Dataset::procedural(scene).expect("the built-in scene"));
        let (desk, studio) = studio();
        let mut door = Door::open(0).expect("a free port");
        door.patience = patience;
        let address = door.address();
        let (host, root) = address.strip_prefix("http://").and_then(|rest| rest.split_once('/')).expect("an address");
        let (address, root) = (host.parse().expect("a socket address"), format!("/{root}"));
        let (ends, chunks) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
        let renderer = {
            let (ends, chunks) = (ends.clone(), chunks.clone());
            thread::spawn(move || render(&studio, &ends, &chunks))
        };
        let server = Some(door.serve(Site::new(&scene, desk, training)).expect("a server"));
        Page { server, address, root, ends, renderer: Some(renderer), chunks }
    }

    fn usual() -> Self {
        Self::open(Patience::default(), None)
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).expect("a connection");
        stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a timeout");
        stream
    }

    /// Sends bytes on a connection of its own, and returns the status and the body of the first response; `None` if the connection is closed without one.
    fn ask(&self, bytes: &[u8]) -> Option<(u16, Vec<u8>)> {
        let mut stream = self.connect();
        // The server may refuse the request before it is complete.
        let _ = stream.write_all(bytes);
        answer(&mut stream)
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.ask(format!("GET {}{path} HTTP/1.1\r\nHost: x\r\n\r\n", self.root).as_bytes()).expect("a response")
    }

    fn post(&self, path: &str, body: &str) -> Vec<u8> {
        let length = body.len();
        format!("POST {}{path} HTTP/1.1\r\nHost: x\r\nContent-Length: {length}\r\n\r\n{body}", self.root).into_bytes()
    }

    /// Asks for a picture and decodes it.
    fn picture(&self, asked: &Value) -> image::RgbImage {
        let (status, body) = self.ask(&self.post("picture", &asked.to_string())).expect("a response");
        assert_eq!(status, 200, "{}", String::from_utf8_lossy(&body));
        image::load_from_memory(&body).expect("a picture").into_rgb8()
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.ends.store(true, SeqCst);
        self.server = None;
        let ended = self.renderer.take().map(JoinHandle::join);
        assert!(thread::panicking() || matches!(ended, Some(Ok(()))), "the renderer ended");
    }
}

/// Reads a response.
fn answer(stream: &mut TcpStream) -> Option<(u16, Vec<u8>)> {
    let (mut received, mut bytes) = (Vec::new(), [0; 4096]);
    loop {
        let text = String::from_utf8_lossy(&received).into_owned();
        if let Some(end) = received.windows(4).position(|four| four == b"\r\n\r\n") {
            let length = text.split("Content-Length: ").nth(1)?.split("\r\n").next()?.parse::<usize>().ok()?;
            if received.len() >= end + 4 + length {
                return Some((text.split(' ').nth(1)?.parse().ok()?, received[end + 4..end + 4 + length].to_vec()));
            }
        }
        match stream.read(&mut bytes) {
            Ok(0) => return None,
            Ok(n) => received.extend_from_slice(&bytes[..n]),
            Err(e) if e.kind() == ErrorKind::ConnectionReset => return None,
            Err(e) => panic!("no response: {e}"),
        }
    }
}

/// A request for a picture of this size.
fn shot(width: usize, height: usize) -> Value {
    json!({
        "pose": [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, -3.0, 0.0],
        "width": width, "height": height, "fx": 50.0, "fy": 50.0, "cx": 20.0, "cy": 15.0, "channel": "color", "format": "png",
    })
}

#[test]
fn the_page_its_scene_and_pictures_are_served() {
    let page = Page::usual();
    let (status, html) = page.get("");
    let html = String::from_utf8(html).expect("text");
    assert!(status == 200 && html.contains("&lt;a run&gt;") && html.contains("class Orbit") && html.contains("class Live"), "{status}");
    assert!(!["http://", "https://", "src=\"/"].iter().any(|address| html.contains(address)), "it loads nothing else");
    let scene: Value = serde_json::from_slice(&page.get("scene").1).expect("JSON");
    assert_eq!(
        (scene["views"].as_array().map(Vec::len), &scene["up"], &scene["training"]),
        (Some(3), &json!([0.0, 0.0, 1.0]), &json!(false))
    );
    let picture = page.picture(&shot(40, 30));
    assert_eq!((picture.dimensions(), picture.get_pixel(7, 9).0), ((40, 30), [255, 128, 0]));
    let mut asked = shot(33, 20);
    (asked["channel"], asked["format"]) = (json!("opacity"), json!("jpeg"));
    let picture = page.picture(&asked);
    // A quarter of white; JPEG is not exact.
    assert!(
        picture.dimensions() == (33, 20) && picture.get_pixel(7, 9).0.iter().all(|c| c.abs_diff(64) < 4),
        "{:?}",
        picture.get_pixel(7, 9)
    );
    asked["channel"] = json!("depth");
    assert_eq!(page.picture(&asked).dimensions(), (33, 20));
}

#[test]
fn a_connection_serves_several_requests_and_ends_when_the_client_says_so() {
    let page = Page::usual();
    let mut stream = page.connect();
    // Both at once, and the second in pieces.
    let two =
        [page.post("picture", &shot(8, 8).to_string()), format!("GET {}scene HTTP/1.1\r\nConnection: close\r\n\r\n", page.root).into()];
    let (first, rest) = (two.concat(), two[1].len() - 9);
    let cut = first.len() - rest;
    stream.write_all(&first[..cut]).expect("sent");
    assert_eq!(answer(&mut stream).expect("a picture").0, 200);
    for byte in &first[cut..] {
        stream.write_all(&[*byte]).expect("sent");
    }
    let (status, scene) = answer(&mut stream).expect("the scene");
    assert!(status == 200 && serde_json::from_slice::<Value>(&scene).is_ok());
    assert_eq!(stream.read(&mut [0]).expect("the end"), 0);
}

#[test]
fn nothing_is_found_without_the_secret_and_addresses_differ() {
    let page = Page::usual();
    let wrong = page.root.chars().map(|c| if c == '/' { c } else { '0' }).collect::<String>();
    let (short, upper) = (&page.root[..page.root.len() - 2], page.root.to_uppercase());
    for path in ["/", "/favicon.ico", "", "*", "/../", &wrong, short, &format!("{wrong}scene"), &format!("/x{}", page.root)] {
        let (status, body) = page.ask(format!("GET {path} HTTP/1.1\r\n\r\n").as_bytes()).expect("a response");
        assert!([400, 404].contains(&status) && !String::from_utf8_lossy(&body).contains("class"), "{path}: {status}");
    }
    assert!(upper == page.root || page.ask(format!("GET {upper} HTTP/1.1\r\n\r\n").as_bytes()).is_some_and(|(status, _)| status == 404));
    assert_eq!(
        page.ask(format!("POST {wrong}picture HTTP/1.1\r\nContent-Length: 2\r\n\r\n{{}}").as_bytes()).map(|(status, _)| status),
        Some(404)
    );
    assert!(page.root.len() == 34 && page.root != Page::usual().root);
    // With the secret, only what a site has.
    for path in ["x", "scene/", "../", "training", "loss.svg", "picture"] {
        assert_eq!(page.get(path).0, 404, "{path}");
    }
    for path in ["stop", "checkpoint", "scene", ""] {
        assert_eq!(page.ask(&page.post(path, "")).map(|(status, _)| status), Some(404), "{path}");
    }
}

#[test]
fn malformed_requests_are_refused_with_a_status() {
    let page = Page::usual();
    let root = &page.root;
    let huge = "x".repeat(10_000);
    let many: String = (0..100).map(|i| format!("h{i}: x\r\n")).collect();
    for (request, status) in [
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: 99999999999999999999999999\r\n\r\n"), 413),
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: 1000000000\r\n\r\n{{"), 413),
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: 5000\r\n\r\n{}", &huge[..5000]), 413),
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: -1\r\n\r\n"), 400),
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: \r\n\r\n"), 400),
        (format!("POST {root}picture HTTP/1.1\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{{}}"), 400),
        (format!("POST {root}picture HTTP/1.1\r\n\r\n"), 411),
        (format!("POST {root}picture HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n"), 501),
        (format!("GET {root}{huge} HTTP/1.1\r\n\r\n"), 431),
        (format!("GET {root} HTTP/1.1\r\nh: {huge}\r\n\r\n"), 431),
        (format!("GET {root} HTTP/1.1\r\n{many}\r\n"), 431),
        (format!("GET {root} HTTP/3.0\r\n\r\n"), 400),
        (format!("GET {root}\r\n\r\n"), 400),
        (format!("DELETE {root} HTTP/1.1\r\n\r\n"), 405),
        ("\0\0\0\0\r\n\r\n".to_owned(), 400),
    ] {
        let found = page.ask(request.as_bytes()).map(|(status, _)| status);
        assert_eq!(found, Some(status), "{:.80}", request);
    }
}

#[test]
fn cameras_that_are_none_are_refused() {
    let page = Page::usual();
    let change = |key: &str, value: Value| {
        let mut asked = shot(40, 30);
        asked[key] = value;
        asked.to_string()
    };
    let most = MOST_PIXELS;
    let turned = |k: usize, x: f64| {
        let mut asked = shot(40, 30);
        asked["pose"][k] = json!(x);
        asked.to_string()
    };
    for body in [
        String::new(),
        "{}".to_owned(),
        "[".repeat(2000),
        "null".to_owned(),
        change("width", json!(0)),
        change("width", json!(-1)),
        change("width", json!(1.5)),
        change("width", json!(most)),
        change("width", json!(u64::MAX)),
        change("height", json!(8193)),
        shot(4096, 4096).to_string(),
        change("fx", json!(0)),
        change("fy", json!(1e9)),
        change("cx", json!(1e9)),
        change("channel", json!("normal")),
        change("channel", json!("x")),
        change("format", json!("gif")),
        change("x", json!(1)),
        change("pose", json!([1, 2, 3])),
        turned(0, 1.1),
        turned(0, -1.0),
        turned(9, 1e7),
        turned(10, f64::NAN),
        shot(40, 30).to_string().replace("50.0", "1e999"),
    ] {
        let (status, why) = page.ask(&page.post("picture", &body)).expect("a response");
        assert_eq!(status, 400, "{body:.80}: {}", String::from_utf8_lossy(&why));
    }
    assert_eq!(page.chunks.load(SeqCst), 0);
}

/// Numbers from a seed (xorshift).
struct Numbers(u64);

impl Numbers {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n as u64) as usize
    }
}

#[test]
fn a_thousand_damaged_requests_are_answered_or_closed_and_the_server_lives() {
    const SEED: u64 = 20_261_125;
    let patience = Patience { request: Duration::from_millis(20), ..Patience::default() };
    let page = Page::open(patience, None);
    let whole = page.post("picture", &shot(4, 3).to_string());
    let mut numbers = Numbers(SEED);
    for case in 0..1000 {
        let mut bytes = whole.clone();
        for _ in 0..=numbers.below(8) {
            let at = numbers.below(bytes.len());
            match numbers.below(5) {
                0 => bytes[at] = numbers.below(256) as u8,
                1 => bytes.truncate(at.max(1)),
                2 => bytes.insert(at, numbers.below(256) as u8),
                3 => drop(bytes.remove(at.min(bytes.len() - 1))),
                _ => {
                    let piece = bytes[at..(at + 40).min(bytes.len())].to_vec();
                    bytes.splice(at..at, piece);
                }
            }
            if bytes.is_empty() {
                bytes.push(b'G');
            }
        }
        if let Some((status, _)) = page.ask(&bytes) {
            let known = [200, 400, 404, 405, 408, 411, 413, 431, 501];
            assert!(known.contains(&status), "seed {SEED}, case {case}: {status}");
        }
    }
    assert_eq!(page.picture(&shot(4, 3)).dimensions(), (4, 3));
}

#[test]
fn slow_clients_are_closed_in_time() {
    let second = Duration::from_secs(1);
    let page = Page::open(Patience { idle: second / 2, request: second, response: second }, None);
    // One says nothing, one never ends its request, and one sends its body byte by byte.
    let (silent, mut half, mut drip) = (page.connect(), page.connect(), page.connect());
    half.write_all(b"GET / HT").expect("sent");
    let head = format!("POST {}picture HTTP/1.1\r\nContent-Length: 1000\r\n\r\n", page.root);
    drip.write_all(head.as_bytes()).expect("sent");
    let start = Instant::now();
    let dripping = thread::spawn(move || {
        while drip.write_all(b" ").is_ok() && start.elapsed() < 5 * second {
            thread::sleep(second / 10);
        }
        start.elapsed()
    });
    assert_eq!(answer(&mut half).map(|(status, _)| status), Some(408));
    let mut silent = silent;
    assert_eq!(silent.read(&mut [0]).expect("the end"), 0);
    assert!(start.elapsed() < 3 * second);
    assert!(dripping.join().expect("a duration") < 4 * second, "a client that drips is closed");
}

#[test]
fn a_client_that_does_not_read_its_picture_holds_up_nobody() {
    let page = Page::open(Patience { response: Duration::from_secs(1), ..Patience::default() }, None);
    let mut stalled = page.connect();
    for _ in 0..20 {
        // Responses fill the buffers of the system.
        stalled.write_all(&page.post("picture", &shot(2000, 2000).to_string())).expect("sent");
    }
    let start = Instant::now();
    assert_eq!(page.picture(&shot(5, 5)).dimensions(), (5, 5));
    assert!(start.elapsed() < Duration::from_secs(15));
}

#[test]
fn sixty_four_connections_are_served_at_once_and_too_many_are_refused() {
    let page = Page::usual();
    let request = format!("GET {}scene HTTP/1.1\r\n\r\n", page.root);
    let mut idle: Vec<TcpStream> = (0..64).map(|_| page.connect()).collect();
    for stream in &mut idle {
        stream.write_all(request.as_bytes()).expect("sent");
    }
    assert!(idle.iter_mut().all(|stream| answer(stream).is_some_and(|(status, _)| status == 200)));
    assert_eq!(page.picture(&shot(6, 4)).dimensions(), (6, 4));
    // They stay open; so do as many more as there are places.
    let more: Vec<TcpStream> = (0..64).map(|_| page.connect()).collect();
    let refused = (0..20).filter(|_| page.ask(request.as_bytes()).is_none_or(|(status, _)| status == 503)).count();
    assert!(refused > 0, "more than 128 connections");
    drop((idle, more));
    let start = Instant::now();
    while page.ask(request.as_bytes()).is_none_or(|(status, _)| status != 200) {
        assert!(start.elapsed() < Duration::from_secs(10), "places are free again");
        thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_picture_is_not_finished_for_a_client_that_has_gone() {
    let page = Page::usual();
    // The renderer needs a second for this size, in a thousand chunks.
    let mut stream = page.connect();
    stream.write_all(&page.post("picture", &shot(77, 4).to_string())).expect("sent");
    while page.chunks.load(SeqCst) == 0 {
        thread::sleep(CHUNK);
    }
    drop(stream);
    assert_eq!(page.picture(&shot(5, 5)).dimensions(), (5, 5));
    assert!(page.chunks.load(SeqCst) < 900, "{} chunks", page.chunks.load(SeqCst));
}

#[test]
fn few_pictures_are_waited_for_at_once() {
    let page = Page::usual();
    let mut waiting: Vec<TcpStream> = (0..8).map(|_| page.connect()).collect();
    for stream in &mut waiting {
        stream.write_all(&page.post("picture", &shot(77, 4).to_string())).expect("sent");
    }
    thread::sleep(Duration::from_millis(300));
    assert_eq!(page.ask(&page.post("picture", &shot(5, 5).to_string())).map(|(status, _)| status), Some(503));
}

#[test]
fn a_port_has_one_server_and_is_free_after_it() {
    let page = Page::usual();
    let port = page.address.port();
    assert!(page.address.ip().is_loopback());
    let refused = Door::open(port).err().expect("the port is in use");
    assert_eq!(
        (refused.to_string(), refused.exit_code()),
        (format!("--port: port {port} is in use; choose another, or 0 for any free port"), 2)
    );
    drop(page);
    let start = Instant::now();
    while TcpStream::connect(("127.0.0.1", port)).is_ok() && start.elapsed() < Duration::from_secs(5) {
        thread::sleep(Duration::from_millis(10));
    }
    assert!(TcpStream::connect(("127.0.0.1", port)).is_err());
}

#[test]
fn a_run_in_training_has_figures_and_curves_and_is_asked_for_a_checkpoint() {
    let training = Arc::new(Training::default());
    let page = Page::open(Patience::default(), Some(training.clone()));
    let state: Value = serde_json::from_slice(&page.get("training").1).expect("JSON");
    assert_eq!((&state["step"], &state["goes_on"], &state["loss"]), (&json!(0), &json!(true), &Value::Null));
    for curve in ["loss.svg", "psnr.svg"] {
        assert!(page.get(curve).1.starts_with(b"<svg"));
    }
    assert!(!training.wants_checkpoint());
    assert_eq!(page.get("checkpoint").0, 404, "a page that is only read asks for nothing");
    assert_eq!(page.ask(&page.post("checkpoint", "")).map(|(status, _)| status), Some(200));
    assert!(training.wants_checkpoint() && !training.wants_checkpoint());
    let (_, state) = page.ask(&page.post("stop", "")).expect("a response");
    let state: Value = serde_json::from_slice(&state).expect("JSON");
    assert_eq!(state["goes_on"], json!(false));
}
