//! The machine: threads, vector instructions and the time.

use crate::error::{Error, Result};
use autograd::Precision;
use std::num::NonZero;
use std::time::{SystemTime, UNIX_EPOCH};

/// Maximum number of threads that a user may request; a larger number is considered a typing error.
pub const MOST_THREADS: usize = 1024;

/// Calls `f` on a pool of `threads` threads, or of one thread per core if `None`. Results do not depend on the number of threads.
///
/// Errors: the system cannot start the threads; the message names the setting `threads`.
pub fn with_threads<R: Send>(threads: Option<usize>, f: impl FnOnce() -> R + Send) -> Result<R> {
    let available = std::thread::available_parallelism().map_or(1, NonZero::get);
    let threads = threads.unwrap_or(available);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| {
        let found = format!("the system cannot start {threads} threads ({e})");
        let remedy = format!("use fewer threads (the default is {available}), or raise the system's limits for threads and memory");
        Error::usage("threads", found, remedy)
    })?;
    Ok(pool.install(f))
}

/// Returns the number of threads of the current pool.
pub fn threads() -> usize {
    rayon::current_num_threads()
}

/// Returns the wall-clock time in seconds since 1970-01-01 UTC.
pub fn time() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// Returns the name of the vector instructions that the numeric loops and products in mixed precision use on this machine. They are detected at run time.
pub fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        let avx512 = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq");
        match (avx2, avx512) {
            (true, true) if Precision::Mixed.is_available() => "x86-64 with AVX-512 and BF16",
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
