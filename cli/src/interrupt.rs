//! Handling of Ctrl-C, SIGTERM and SIGHUP (sent when a terminal is closed). The first signal asks a training run or a sweep to save and stop. Otherwise,
//! signals end the process.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::sync::{Mutex, Once, PoisonError};
use std::time::{Duration, Instant};

/// Exit code of an interrupted process.
pub const EXIT_CODE: u8 = 130;

/// Time during which further signals count as the first one: a process often receives a signal twice, directly and through its process group.
const SAME_WISH: Duration = Duration::from_secs(1);

static WATCHED: AtomicBool = AtomicBool::new(false);
static REQUESTED: Mutex<Option<Instant>> = Mutex::new(None);
/// Message for an interruption that ends the process at once.
static LAST_WORDS: Mutex<String> = Mutex::new(String::new());

/// Installs the signal handler: interruptions end the process with [`EXIT_CODE`] and a message. If it cannot be installed, they end the process as
/// usual.
pub fn install() {
    static LISTENING: Once = Once::new();
    LISTENING.call_once(listen);
}

/// Sets the message on stderr for an interruption that ends the process at once.
pub fn on_exit(words: String) {
    *LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner) = words;
}

/// A guard during which the first interruption is only recorded.
pub struct Watch(());

impl Watch {
    /// Starts recording interruptions. If no handler can be installed, they end the process as usual.
    pub fn begin() -> Self {
        install();
        *wished() = None;
        WATCHED.store(true, SeqCst);
        Watch(())
    }

    /// True if an interruption was recorded.
    pub fn requested(&self) -> bool {
        requested()
    }
}

/// True if an interruption was recorded since the last [`Watch::begin`].
pub fn requested() -> bool {
    wished().is_some()
}

/// Records an interruption that a page asks for. Unlike a signal, it never ends the process.
pub fn request() {
    if WATCHED.load(SeqCst) {
        wished().get_or_insert_with(Instant::now);
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        WATCHED.store(false, SeqCst);
    }
}

fn wished() -> std::sync::MutexGuard<'static, Option<Instant>> {
    REQUESTED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Handles an interruption.
fn wish() {
    let first = *wished().get_or_insert_with(Instant::now);
    if !WATCHED.load(SeqCst) || first.elapsed() > SAME_WISH {
        let words = LAST_WORDS.lock().unwrap_or_else(PoisonError::into_inner);
        let mut err = std::io::stderr();
        // Clears the progress bar with the `^C` of the terminal. A failure to print cannot be reported.
        let clear = if err.is_terminal() { "\r\x1b[2K" } else { "" };
        drop(writeln!(err, "{clear}error: {}", if words.is_empty() { "interrupted" } else { &words }));
        std::process::exit(EXIT_CODE.into());
    }
}

/// Starts a thread that handles signals, except those that the process ignores: shells make background processes ignore Ctrl-C, and `nohup` makes
/// programs ignore SIGHUP.
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
