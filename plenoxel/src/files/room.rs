//! Checks of disk space and open files, made before files are written.

use std::io::{Error, ErrorKind, Result};
use std::path::Path;

/// Checks that files of `bytes` bytes in total, the largest of `largest` bytes, fit into a folder: the file system has enough free space, and
/// the process may write files of that size. Limits that the system does not report are not checked.
///
/// Errors: [`ErrorKind::StorageFull`] or [`ErrorKind::FileTooLarge`]; the message has the needed and the available size.
pub fn check_room(folder: &Path, bytes: u64, largest: u64) -> Result<()> {
    // A folder that does not exist yet will be on the file system of its parent.
    let there = folder.ancestors().find(|path| path.exists()).filter(|path| !path.as_os_str().is_empty()).unwrap_or(Path::new("."));
    refuse(bytes, fs4::available_space(there).ok(), largest, largest_file())
}

fn refuse(bytes: u64, free: Option<u64>, largest: u64, limit: Option<u64>) -> Result<()> {
    let size = |bytes: u64| format!("{:.1} MB", bytes as f64 / 1e6);
    if let Some(free) = free.filter(|free| *free < bytes) {
        return Err(Error::new(ErrorKind::StorageFull, format!("{} are needed, but {} are free", size(bytes), size(free))));
    }
    if let Some(limit) = limit.filter(|limit| *limit < largest) {
        let found = format!("a file of {} is needed, but the limit is {} (ulimit -f)", size(largest), size(limit));
        return Err(Error::new(ErrorKind::FileTooLarge, found));
    }
    Ok(())
}

/// Checks that this process can open as many files as a run needs: a checkpoint needs a file and its folder.
///
/// Errors: the error of the system if too many files are open.
pub fn check_handles() -> Result<()> {
    const NEEDED: usize = 16;
    // A file that can be opened.
    let Ok(program) = std::env::current_exe() else { return Ok(()) };
    (0..NEEDED).map(|_| std::fs::File::open(&program)).collect::<Result<Vec<_>>>().map(drop)
}

/// Size limit of the files that this process may write, in bytes, if there is one.
#[cfg(unix)]
fn largest_file() -> Option<u64> {
    rustix::process::getrlimit(rustix::process::Resource::Fsize).current
}

#[cfg(not(unix))]
fn largest_file() -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_room_is_refused_with_both_numbers() {
        assert!(refuse(5, Some(5), 5, Some(5)).is_ok() && refuse(5, None, 5, None).is_ok());
        let full = refuse(30_000_000, Some(2_500_000), 1, None).unwrap_err();
        assert_eq!((full.kind(), full.to_string().as_str()), (ErrorKind::StorageFull, "30.0 MB are needed, but 2.5 MB are free"));
        let limited = refuse(30, None, 20_000_000, Some(1_000_000)).unwrap_err();
        assert!(limited.kind() == ErrorKind::FileTooLarge && limited.to_string().contains("ulimit -f"), "{limited}");
        assert!(check_room(&std::env::temp_dir(), 1, 1).is_ok() && check_handles().is_ok());
        let full = check_room(&std::env::temp_dir().join("not/there/yet"), u64::MAX, 1).unwrap_err();
        assert_eq!(full.kind(), ErrorKind::StorageFull);
    }
}
