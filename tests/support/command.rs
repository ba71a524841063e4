//! A command line, called like any function, and a folder for it.
#![allow(dead_code)]

use plenoxel_cli::Streams;
use serde_json::Value;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Two short stages on a coarse grid, for `--set`.
pub const SHORT: &str = "stages=[\
    {resolution=8, steps=5, sampling={step=1.0}, density_rate=0.5, color_rate=0.05},\
    {resolution=12, steps=5, sampling={step=1.0}, density_rate=0.5, color_rate=0.05}]";

/// What a command line came to.
pub struct Answer {
    pub code: u8,
    pub out: String,
    pub err: String,
}

impl Answer {
    /// The last line on stdout, which is JSON.
    pub fn json(&self) -> Value {
        assert_eq!(self.code, 0, "{}", self.err);
        serde_json::from_str(self.out.lines().last().unwrap()).unwrap()
    }

    /// Checks that it went well, and returns what stdout says.
    #[track_caller]
    pub fn done(self) -> String {
        assert_eq!(self.code, 0, "{}", self.err);
        self.out
    }

    /// Checks the exit code and that stderr says all of `parts`.
    #[track_caller]
    pub fn refused(&self, code: u8, parts: &[&str]) {
        assert_eq!(self.code, code, "{}", self.err);
        assert!(parts.iter().all(|part| self.err.contains(part)), "{parts:?} in {}", self.err);
        assert_eq!(self.err.matches("error: ").count(), 1, "one message: {}", self.err);
    }
}

pub fn plenoxel(args: &[&str]) -> Answer {
    let (mut out, mut err) = (Vec::new(), Vec::new());
    let line = ["plenoxel"].iter().chain(args);
    let code = plenoxel_cli::run(line, Streams { out: &mut out, err: &mut err, terminal: false, read_by_people: false });
    Answer { code, out: String::from_utf8(out).unwrap(), err: String::from_utf8(err).unwrap() }
}

/// `train` on the built-in scene, 24 x 24, so many views of each split, as plainly as can be and two short stages, into `out`.
pub fn train(views: &str, out: &str, more: &[&str]) -> Answer {
    let tiny =
        ["train", "--preset=demo", "--scene-size=24", "--set", SHORT, "--set=rays_per_step=256", "--scene-views", views, "--out", out];
    plenoxel(&[&tiny, more].concat())
}

/// A folder of a test's own, removed when the test has passed.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new(name: &str) -> Self {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let unique = format!("plenoxel-cli-{}-{}-{name}", std::process::id(), COUNT.fetch_add(1, Relaxed));
        let path = std::env::temp_dir().join(unique);
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    pub fn path(&self, name: &str) -> String {
        self.0.join(name).display().to_string()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            let _ = fs::remove_dir_all(&self.0);
        }
    }
}
