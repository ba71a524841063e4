//! One writer for each folder.

use crate::error::{Error, Result};
use std::fs::{File, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// An advisory lock on a folder, held until it is dropped or its process ends: an exclusive lock of the system on a file in the folder. The file
/// names the process that holds the lock and stays when the lock is released, so that no two processes can lock different files of one name.
#[derive(Debug)]
pub struct FolderLock {
    file: File,
}

impl FolderLock {
    /// Locks a folder that exists, by its file `name`.
    ///
    /// Errors: another process, or another part of this one, holds the lock; the file cannot be created. Where a file system has no locks, the folder
    /// counts as locked by this process alone.
    pub fn acquire(folder: &Path, name: &str) -> Result<Self> {
        let path = folder.join(name);
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = opened.map_err(|e| Error::io(&path, e, "creating the lock"))?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            let found = format!("{}, which {} is writing,", folder.display(), holder(&mut file));
            return Err(Error::config("--out", found, "another folder, or the same when that process has ended"));
        }
        // The name is for messages alone: a full disk is found when something that matters is written.
        let _ = file.set_len(0).and_then(|()| writeln!(file, "process {}", std::process::id()));
        Ok(FolderLock { file })
    }

    /// Refuses a folder that another process holds a lock of, without locking it.
    ///
    /// Errors as for [`acquire`](Self::acquire).
    pub fn check(folder: &Path, name: &str) -> Result<()> {
        if folder.join(name).is_file() { Self::acquire(folder, name).map(drop) } else { Ok(()) }
    }

    /// The locked file: a process that inherits it holds the lock too.
    pub fn file(&self) -> &File {
        &self.file
    }
}

/// The process that a lock file names.
fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let read = file.seek(SeekFrom::Start(0)).and_then(|_| file.take(64).read_to_string(&mut text));
    let number = read.ok().and_then(|_| text.trim().strip_prefix("process ")?.parse::<u32>().ok());
    number.map_or_else(|| "another process".to_owned(), |number| format!("process {number}"))
}

/// True for a temporary file of [`atomically`](super::atomically) whose process has ended, and for one of the safetensors library, `.tmp` and six
/// characters, which only the process that holds the lock of a run writes: so ask only while you hold it.
pub fn is_abandoned(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if name.starts_with(".tmp") {
        return true;
    }
    let inner = name.strip_prefix('.').and_then(|name| name.strip_suffix(".tmp"));
    let process = inner.and_then(|inner| inner.split('-').next()).filter(|process| process.parse::<u32>().is_ok());
    let Some(process) = process else { return false };
    let processes = PathBuf::from("/proc");
    if processes.join("self").exists() {
        return !processes.join(process).exists();
    }
    // Without a list of processes: a file that is being written has just been changed.
    const LONG: std::time::Duration = std::time::Duration::from_secs(60);
    path.metadata().and_then(|facts| facts.modified()).is_ok_and(|time| time.elapsed().is_ok_and(|age| age > LONG))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_writer_at_a_time_and_the_refusal_names_it() {
        let folder = std::env::temp_dir().join(format!("plenoxel-lock-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let lock = FolderLock::acquire(&folder, "run.lock").unwrap();
        let refused = FolderLock::acquire(&folder, "run.lock").unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains(&format!("process {}", std::process::id())), "{refused}");
        assert!(FolderLock::check(&folder, "run.lock").is_err() && FolderLock::check(&folder, "other.lock").is_ok());
        drop(lock);
        FolderLock::check(&folder, "run.lock").unwrap();
        FolderLock::acquire(&folder, "run.lock").unwrap();
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn temporary_files_of_processes_that_ended_are_abandoned() {
        let own = format!(".{}-3.tmp", std::process::id());
        assert!(is_abandoned(Path::new("runs/x/.tmpAbCdEf")));
        assert!(!is_abandoned(Path::new(&own)) && !is_abandoned(Path::new("notes.tmp")) && !is_abandoned(Path::new(".hidden")));
        if Path::new("/proc/self").exists() {
            // No process has a number this large.
            assert!(is_abandoned(Path::new("a/.4294967295-0.tmp")));
        }
    }
}
