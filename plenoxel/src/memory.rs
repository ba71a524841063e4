//! Memory: the available amount, the limit set by the user, and the amount that this process uses.

use crate::error::{Error, Result};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use sysinfo::{MemoryRefreshKind, ProcessRefreshKind, ProcessesToUpdate, System};

/// Limit set by the user for the memory of a command, in bytes; 0 without a limit.
static LIMIT: AtomicU64 = AtomicU64::new(0);

/// The largest resident memory that [`now`] has returned.
static PEAK: AtomicU64 = AtomicU64::new(0);

/// Limits the memory that later commands of this process may use, in bytes; `None` removes the limit.
pub fn limit(bytes: Option<u64>) {
    LIMIT.store(bytes.unwrap_or(0), Relaxed);
}

/// Memory available now, in bytes: the free memory or the limit, whichever is smaller. `None` without a limit on systems that do not report
/// free memory.
pub fn available() -> Option<u64> {
    match LIMIT.load(Relaxed) {
        0 => free(),
        limit => Some(free().map_or(limit, |free| free.min(limit))),
    }
}

/// Available memory and its reason, displayed as "--max-memory allows 500 MB" or "2.3 GB are available".
pub(crate) struct Allowance {
    /// The bytes returned by [`available`].
    pub bytes: u64,
    /// True if the user's limit is smaller than the free memory.
    pub is_limit: bool,
}

impl std::fmt::Display for Allowance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let bytes = bytes(self.bytes);
        if self.is_limit { write!(f, "--max-memory allows {bytes}") } else { write!(f, "{bytes} are available") }
    }
}

/// The memory available now; `None` if it is unknown.
pub(crate) fn allowance() -> Option<Allowance> {
    available().map(|bytes| Allowance { bytes, is_limit: LIMIT.load(Relaxed) == bytes })
}

/// Checks that `needed` bytes of memory are available for `what`, an operation on the file `path`.
///
/// Errors: bad input, because the file is too large for the available memory.
pub(crate) fn check(path: &Path, what: &str, needed: u64) -> Result<()> {
    match allowance() {
        Some(allowance) if needed > allowance.bytes => Err(refusal(path, what, needed, &allowance)),
        _ => Ok(()),
    }
}

/// The error of [`check`].
pub(crate) fn refusal(path: &Path, what: &str, needed: u64, allowance: &Allowance) -> Error {
    let found = format!("{what} needs about {} of memory, but {allowance}", bytes(needed));
    Error::input(path, found, remedy(allowance))
}

/// The error for content that needs more memory than is available and thus was not read to the end; `what` names the kind of file.
pub(crate) fn refusal_of_content(path: &Path, what: &str, allowance: &Allowance) -> Error {
    Error::input(path, format!("the content of {what} needs too much memory: {allowance}"), remedy(allowance))
}

/// What to do about a file that is too large.
fn remedy(allowance: &Allowance) -> String {
    let more = if allowance.is_limit { "or a higher --max-memory" } else { "or a machine with more memory" };
    format!("use a smaller file, {more}")
}

/// Formats bytes with two or three digits and a decimal unit, such as `2.3 GB` or `99 kB`.
pub fn bytes(n: u64) -> String {
    match n as f64 {
        n if n >= 1e10 => format!("{:.0} GB", n / 1e9),
        n if n >= 1e9 => format!("{:.1} GB", n / 1e9),
        n if n >= 1e6 => format!("{:.0} MB", n / 1e6),
        n => format!("{:.0} kB", n / 1e3),
    }
}

/// Memory that the system reports as available; on Linux within the limits of the control group and of the process.
fn free() -> Option<u64> {
    let mut system = System::new().ok()?;
    system.refresh_memory_specifics(MemoryRefreshKind::nothing().with_ram());
    let free = Some(system.available_memory()).filter(|free| *free > 0)?;
    let number = |path: &str| -> Option<u64> { std::fs::read_to_string(path).ok()?.trim().parse().ok() };
    let limit = number("/sys/fs/cgroup/memory.max");
    // The page cache of the group is reclaimed when memory is needed.
    let files = std::fs::read_to_string("/sys/fs/cgroup/memory.stat").map_or(0, |text| cached(&text));
    let used = number("/sys/fs/cgroup/memory.current").unwrap_or(0).saturating_sub(files);
    let free = limit.map_or(free, |limit| free.min(limit.saturating_sub(used)));
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    Some(address_space(&limits).map_or(free, |limit| free.min(limit.saturating_sub(taken()))))
}

/// Bytes of the page cache, from the `memory.stat` of a control group.
fn cached(stat: &str) -> u64 {
    let number = |line: &str| line.strip_prefix("active_file ").or(line.strip_prefix("inactive_file "))?.trim().parse::<u64>().ok();
    stat.lines().filter_map(number).sum()
}

/// Limit of the address space of this process (`ulimit -v`) in bytes, from `/proc/self/limits`.
fn address_space(limits: &str) -> Option<u64> {
    limits.lines().find_map(|line| line.strip_prefix("Max address space"))?.split_whitespace().next()?.parse().ok()
}

/// Size of the address space of this process, in bytes.
fn taken() -> u64 {
    of_process("VmSize:").unwrap_or(0)
}

/// Returns the peak resident memory of this process, in bytes. On systems other than Linux it is the largest value that [`now`] has returned.
/// `None` if the system does not report it.
pub fn peak() -> Option<u64> {
    let now = now();
    of_process("VmHWM:").or_else(|| now.map(|_| PEAK.load(Relaxed)))
}

/// Returns the current resident memory of this process, in bytes; `None` if the system does not report it.
pub fn now() -> Option<u64> {
    let process = sysinfo::get_current_pid().ok()?;
    let mut system = System::new().ok()?;
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[process]), false, ProcessRefreshKind::nothing().with_memory());
    let bytes = system.process(process)?.memory();
    PEAK.fetch_max(bytes, Relaxed);
    Some(bytes)
}

fn of_process(key: &str) -> Option<u64> {
    kilobytes(&std::fs::read_to_string("/proc/self/status").ok()?, key)
}

fn kilobytes(text: &str, key: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    let number: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(1024 * number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_read_well() {
        assert_eq!(bytes(2_345_678_901), "2.3 GB");
        assert_eq!(bytes(99_000), "99 kB");
    }

    #[test]
    fn the_system_says_what_is_free_and_what_this_process_has() {
        let (now, peak, free) = (now().unwrap(), peak().unwrap(), free().unwrap());
        assert!(1_000_000 < now && now <= peak && peak < 1_000_000_000_000 && free > 1_000_000, "{now} {peak} {free}");
        if let Some(resident) = of_process("VmRSS:") {
            assert!(now.abs_diff(resident) < 50_000_000, "{now} {resident}");
        }
    }

    #[test]
    fn numbers_are_found_in_the_text_of_the_kernel() {
        let text = "Name:\tx\nVmHWM:\t   2048 kB\nVmRSS:\t 1 kB\n";
        assert_eq!(kilobytes(text, "VmHWM:"), Some(2048 * 1024));
        assert_eq!(kilobytes(text, "VmSwap:"), None);
        assert_eq!(cached("anon 7\nfile 90\ninactive_file 40\nactive_file 20\nunevictable 3\n"), 60);
        let limits = "Limit                     Soft Limit           Hard Limit           Units\nMax address space         6144000000           unlimited            bytes\n";
        assert_eq!(address_space(limits), Some(6_144_000_000));
        assert_eq!(address_space("Max address space         unlimited            unlimited            bytes\n"), None);
    }
}
