//! Ctrl-C, SIGTERM and SIGHUP, which a terminal sends when it is closed: the first time while a run trains, or a sweep has runs made, it is asked to save and stop; else the process ends.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::sync::{Mutex, Once, PoisonError};
use std::time::{Duration, Instant};

/// Exit code of a process that was interrupted.
pub const EXIT_CODE: u8 = 130;

/// Who stops a process often tells it twice, as its parent and as its group: what comes so soon after the first is the same wish.
const SAME_WISH: Duration = Duration::from_secs(1);

static WATCHED: AtomicBool = AtomicBool::new(false);
static REQUESTED: Mutex<Option<Instant>> = Mutex::new(None);
/// Message for an interruption that ends the process at once.
static LAST_WORDS: Mutex<String> = Mutex::new(String::new());

/// Has interruptions end the process with [`EXIT_CODE`] and a clean line on a terminal. Where the system does not let it, they end the process as ever.
pub fn install() {
    static LISTENING: Once = Once::new();
    LISTENING.call_once(listen);
}

/// Sets the message on stderr for an interruption that ends the process at once.
pub fn on_exit(words: String) {
    *LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner) = words;
}

/// While it lives, an interruption is something to ask for.
pub struct Watch(());

impl Watch {
    /// Begins to watch. Where the system does not let it, an interruption ends the process as ever.
    pub fn begin() -> Self {
        install();
        *wished() = None;
        WATCHED.store(true, SeqCst);
        Watch(())
    }

    /// True if somebody asked.
    pub fn requested(&self) -> bool {
        requested()
    }
}

/// True if somebody asked since the last watch began.
pub fn requested() -> bool {
    wished().is_some()
}

impl Drop for Watch {
    fn drop(&mut self) {
        WATCHED.store(false, SeqCst);
    }
}

fn wished() -> std::sync::MutexGuard<'static, Option<Instant>> {
    REQUESTED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Somebody wants the process to stop.
fn wish() {
    let first = *wished().get_or_insert_with(Instant::now);
    if !WATCHED.load(SeqCst) || first.elapsed() > SAME_WISH {
        let words = LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner);
        let mut err = std::io::stderr();
        // The bar goes, and with it what the terminal wrote behind it. Nobody can be told that stderr cannot be written.
        let clear = if err.is_terminal() { "\r\x1b[2K" } else { "" };
        drop(writeln!(err, "{clear}error: {}", if words.is_empty() { "interrupted" } else { &words }));
        std::process::exit(EXIT_CODE.into());
    }
}

/// Has a thread listen, for as long as the process lives, to what it does not ignore: shells have what runs in the background ignore Ctrl-C, and `nohup` has a
/// program ignore SIGHUP.
#[cfg(unix)]
fn listen() {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    let heard = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| mask.is_none_or(|mask| mask >> (signal - 1) & 1 == 0));
    if let Ok(mut signals) = signal_hook::iterator::Signals::new(heard) {
        std::thread::spawn(move || signals.forever().for_each(|_| wish()));
    }
}

#[cfg(not(unix))]
fn listen() {
    drop(ctrlc::set_handler(wish));
}
