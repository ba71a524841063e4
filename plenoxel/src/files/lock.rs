//! Folder locks: one writer at a time.

use crate::error::{Error, Result};
use same_file::Handle;
use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// An advisory lock on a folder: an exclusive system lock on a file in the folder. It is held until it is dropped or its process ends. The file
/// names the process that holds the lock. It remains after the lock is released, so that two processes never lock different files of one name.
#[derive(Debug)]
pub struct FolderLock {
    file: File,
}

impl FolderLock {
    /// Locks a folder that exists, by its file `name`. `key` is the flag or argument that names the folder, for messages.
    ///
    /// Errors: another process, or another part of this one, holds the lock; the file cannot be created. On file systems without locks, this
    /// process always gets the lock.
    pub fn acquire(folder: &Path, name: &str, key: &str) -> Result<Self> {
        let path = folder.join(name);
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = opened.map_err(|e| Error::io(&path, e, "creating the lock"))?;
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            return Err(refusal(folder, &mut file, key));
        }
        // The name is for messages alone: a full disk is found when something that matters is written.
        let _ = file.set_len(0).and_then(|()| writeln!(file, "process {}", std::process::id()));
        Ok(FolderLock { file })
    }

    /// Takes a shared lock on a folder, which keeps others from [acquiring](Self::acquire) it. Returns `None` if the folder has no lock file.
    /// Writes nothing.
    ///
    /// Errors: another process holds the lock.
    pub fn share(folder: &Path, name: &str, key: &str) -> Result<Option<Self>> {
        // A lock file that cannot be opened is ignored: the next write will report the reason.
        let Ok(mut file) = File::open(folder.join(name)) else { return Ok(None) };
        match file.try_lock_shared() {
            Err(TryLockError::WouldBlock) => Err(refusal(folder, &mut file, key)),
            _ => Ok(Some(FolderLock { file })),
        }
    }

    /// True if the locked file still has that name in the folder, so that neither was moved, deleted or replaced.
    pub fn is_of(&self, folder: &Path, name: &str) -> bool {
        let own = self.file.try_clone().and_then(Handle::from_file);
        // Systems that cannot compare files report no change.
        own.is_ok_and(|own| Handle::from_path(folder.join(name)).map_or_else(|e| e.kind() != ErrorKind::NotFound, |there| own == there))
    }

    /// The locked file: a process that inherits it holds the lock too.
    pub fn file(&self) -> &File {
        &self.file
    }
}

/// The error for a folder whose lock is held by another process.
fn refusal(folder: &Path, file: &mut File, key: &str) -> Error {
    let found = format!("{} is being written by {}", folder.display(), holder(file));
    Error::usage(key, found, "choose another folder, or wait until that process has ended")
}

/// The process named by a lock file. A child process may have inherited the lock.
fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let read = file.seek(SeekFrom::Start(0)).and_then(|_| file.take(64).read_to_string(&mut text));
    let number = read.ok().and_then(|_| text.trim().strip_prefix("process ")?.parse::<u32>().ok());
    number.map_or_else(|| "another process".to_owned(), |number| format!("process {number} or one of its child processes"))
}

/// True for a temporary file that no process is writing: one of [`atomically`](super::atomically) whose process has ended, or one of the
/// safetensors library, named `.tmp` and six characters. Only the process with the lock of a run writes the latter, so call this only while
/// holding the lock.
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
    // Without /proc: a file that is being written was modified recently.
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
        let acquire = || FolderLock::acquire(&folder, "run.lock", "--out");
        let share = || FolderLock::share(&folder, "run.lock", "RUN");
        assert!(share().unwrap().is_none());
        let lock = acquire().unwrap();
        for (refused, key) in [(acquire().unwrap_err(), "--out"), (share().unwrap_err(), "RUN")] {
            let (code, text) = (refused.exit_code(), refused.to_string());
            assert!(code == 2 && text.contains(key) && text.contains(&format!("process {}", std::process::id())), "{text}");
        }
        assert!(lock.is_of(&folder, "run.lock"));
        std::fs::rename(folder.join("run.lock"), folder.join("moved")).unwrap();
        assert!(!lock.is_of(&folder, "run.lock"));
        std::fs::write(folder.join("run.lock"), "another").unwrap();
        assert!(!lock.is_of(&folder, "run.lock"));
        std::fs::rename(folder.join("moved"), folder.join("run.lock")).unwrap();
        drop(lock);
        let readers = [share().unwrap(), share().unwrap()];
        assert!(readers.iter().all(Option::is_some) && acquire().is_err());
        drop(readers);
        acquire().unwrap();
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
