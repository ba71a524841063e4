//! Ctrl-C: the first time while a run trains, or a sweep has runs made, it is asked to save and stop; else the process ends.

use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};

/// Exit code of a process that was interrupted.
pub const EXIT_CODE: u8 = 130;

static WATCHED: AtomicBool = AtomicBool::new(false);
static REQUESTED: AtomicBool = AtomicBool::new(false);

/// While it lives, an interruption is something to ask for.
pub struct Watch(());

impl Watch {
    /// Begins to watch. Where the system does not let it, an interruption ends the process as ever.
    pub fn begin() -> Self {
        static HANDLER: Once = Once::new();
        HANDLER.call_once(|| {
            if ignored() {
                return;
            }
            let handled = ctrlc::set_handler(|| {
                if !WATCHED.load(SeqCst) || REQUESTED.swap(true, SeqCst) {
                    std::process::exit(EXIT_CODE.into());
                }
            });
            drop(handled);
        });
        REQUESTED.store(false, SeqCst);
        WATCHED.store(true, SeqCst);
        Watch(())
    }

    /// True if somebody asked.
    pub fn requested(&self) -> bool {
        REQUESTED.load(SeqCst)
    }
}

/// True if whoever started the process had it ignore Ctrl-C, as shells do for what runs in the background.
fn ignored() -> bool {
    const SIGINT: u64 = 1 << 1;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & SIGINT != 0)
}

impl Drop for Watch {
    fn drop(&mut self) {
        WATCHED.store(false, SeqCst);
    }
}
