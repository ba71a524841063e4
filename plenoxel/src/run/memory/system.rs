//! The memory that there is: what the system has free, the limit that the user set, and what this process has.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Bytes that a command may take in all, if the user set them; 0 if not.
static LIMIT: AtomicU64 = AtomicU64::new(0);

/// Limits the memory that later commands of this process may take; `None` lifts the limit.
pub fn limit(bytes: Option<u64>) {
    LIMIT.store(bytes.unwrap_or(0), Relaxed);
}

/// True if the limit is what leaves so many bytes.
pub fn is_limit(bytes: u64) -> bool {
    let limit = LIMIT.load(Relaxed);
    limit != 0 && limit == bytes
}

/// Bytes of memory that can be taken now: the free memory or the limit, whichever is less. `None` where there is no limit and the system does
/// not say how much is free.
pub fn available() -> Option<u64> {
    match LIMIT.load(Relaxed) {
        0 => free(),
        limit => Some(free().map_or(limit, |free| free.min(limit))),
    }
}

/// What Linux counts as available, within the limits of the control group and of the process; elsewhere unknown.
fn free() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let free = kilobytes(&text, "MemAvailable:")?;
    let number = |path: &str| -> Option<u64> { std::fs::read_to_string(path).ok()?.trim().parse().ok() };
    let limit = number("/sys/fs/cgroup/memory.max");
    let used = number("/sys/fs/cgroup/memory.current").unwrap_or(0);
    let free = limit.map_or(free, |limit| free.min(limit.saturating_sub(used)));
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    Some(address_space(&limits).map_or(free, |limit| free.min(limit.saturating_sub(taken()))))
}

/// Bytes of addresses this process may have (`ulimit -v`), by the kernel's table of limits.
fn address_space(limits: &str) -> Option<u64> {
    limits.lines().find_map(|line| line.strip_prefix("Max address space"))?.split_whitespace().next()?.parse().ok()
}

/// Bytes of addresses that it has.
fn taken() -> u64 {
    of_process("VmSize:").unwrap_or(0)
}

/// The largest resident memory of this process so far, in bytes; `None` where the system does not say.
pub fn peak() -> Option<u64> {
    of_process("VmHWM:")
}

/// The resident memory of this process now, in bytes; `None` where the system does not say.
pub fn now() -> Option<u64> {
    of_process("VmRSS:")
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
    fn numbers_are_found_in_the_text_of_the_kernel() {
        let text = "Name:\tx\nVmHWM:\t   2048 kB\nVmRSS:\t 1 kB\n";
        assert_eq!(kilobytes(text, "VmHWM:"), Some(2048 * 1024));
        assert_eq!(kilobytes(text, "VmSwap:"), None);
        let limits = "Limit                     Soft Limit           Hard Limit           Units\nMax address space         6144000000           unlimited            bytes\n";
        assert_eq!(address_space(limits), Some(6_144_000_000));
        assert_eq!(address_space("Max address space         unlimited            unlimited            bytes\n"), None);
    }
}
