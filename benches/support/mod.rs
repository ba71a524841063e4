//! The protocol of every benchmark: warm up twice, repeat, report the median, as the scripts it is compared with do.
//! One JSON line a row. Peak memory is the process's own high-water mark, so workloads that are compared by it run one to a process.

use autograd::{Buffer, Tensor};
use std::time::Instant;

/// Runs a benchmark as the program runs its commands: on a thread of the pool, so that an op does not wake one up to begin with.
pub fn on_the_pool(f: impl FnOnce() + Send) {
    rayon::scope(|_| f());
}

/// Times of `repeats` calls of `f` in milliseconds, ascending, after two calls that are not counted.
pub fn repeat(repeats: usize, mut f: impl FnMut()) -> Vec<f64> {
    f();
    f();
    let mut times: Vec<f64> = (0..repeats)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times
}

/// The middle one.
pub fn median(times: &[f64]) -> f64 {
    times[times.len() / 2]
}

/// Largest resident set of this process so far, in megabytes (Linux).
pub fn peak_memory_mb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kb| kb / 1024)
}

/// Arguments that are not Cargo's: `--repeats N`, `--data DIR`, and names of the rows to run (all, if none are given).
pub struct Arguments {
    pub names: Vec<String>,
    pub repeats: usize,
    pub data: Option<String>,
}

pub fn arguments() -> Arguments {
    let mut parsed = Arguments { names: Vec::new(), repeats: 31, data: None };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        match word.as_str() {
            "--bench" | "--test" => {}
            "--repeats" => {
                parsed.repeats = words.next().and_then(|n| n.parse().ok()).filter(|&n| n > 0).expect("--repeats takes a number above 0")
            }
            "--data" => parsed.data = Some(words.next().expect("--data takes a folder")),
            name => parsed.names.push(name.to_owned()),
        }
    }
    parsed
}

impl Arguments {
    pub fn wants(&self, name: &str) -> bool {
        self.names.is_empty() || self.names.iter().any(|n| name.starts_with(n.as_str()))
    }
}

/// Suffix of the names of rows in this precision.
#[allow(dead_code)] // `workloads` does not use it.
pub fn suffix(precision: autograd::Precision) -> &'static str {
    if precision == autograd::Precision::Mixed { "_mixed" } else { "" }
}

/// Deterministic numbers in [0, 1).
pub fn numbers(n: usize, seed: u64) -> Vec<f32> {
    (0..n as u64).map(|i| plenoxel::random::uniform(seed, plenoxel::random::Purpose::Initial, 0, i) as f32).collect()
}

/// A tensor of such numbers in a pooled buffer, like the tables of a model: on Linux its pages have 2 MB, those of a `Vec` 4 KB.
#[allow(dead_code)] // `roofline` does not use it.
pub fn tensor(shape: &[usize], seed: u64) -> Tensor<f32> {
    Tensor::from_buffer(Buffer::copy_of(&numbers(shape.iter().product(), seed)), shape)
}
