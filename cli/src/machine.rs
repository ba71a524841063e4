//! The machine a command runs on: threads and vector instructions.

use plenoxel::error::{Error, Result};
use std::num::NonZero;
use std::time::{SystemTime, UNIX_EPOCH};

/// More threads than any machine of today has cores are a slip of the finger.
pub const MOST_THREADS: usize = 1024;

/// Calls `f` on a pool of so many threads; all cores if none are given. The number changes how long a command takes and no number it
/// computes.
pub fn with_threads<R: Send>(threads: Option<usize>, f: impl FnOnce() -> Result<R> + Send) -> Result<R> {
    let available = std::thread::available_parallelism().map_or(1, NonZero::get);
    let threads = threads.unwrap_or(available);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| {
        let found = format!("{threads} (the system refuses them: {e})");
        Error::config("--threads", found, format!("about {available}"))
    })?;
    pool.install(f)
}

/// Threads of the pool a command runs on.
pub fn threads() -> usize {
    rayon::current_num_threads()
}

/// Seconds since 1970.
pub fn time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// The vector instructions that the numeric loops use on this machine; they are chosen at run time.
pub fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        let avx512 = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq");
        match (avx2, avx512) {
            (true, true) => "x86-64 with AVX-512",
            (true, false) => "x86-64 with AVX2 and FMA",
            _ => "x86-64 with SSE2",
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        std::env::consts::ARCH
    }
}
