//! Tensor files: a NumPy file holds one tensor, and a safetensors file holds the parameters of a module.
//!
//! Files are written atomically: a temporary file in the same folder is written completely and then renamed.

mod npy;
mod safetensors;

pub use self::safetensors::{load_safetensors, save_safetensors};

use crate::error::FileError;
use crate::real::Real;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use tempfile::TempPath;

/// The type of the numbers in a file, which are little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Dtype {
    F32,
    F64,
}

impl Dtype {
    /// Returns the type with the precision of `T`.
    fn of<T: Real>() -> Self {
        if size_of::<T>() == 8 { Dtype::F64 } else { Dtype::F32 }
    }

    /// Returns the size of a number in bytes.
    fn size(self) -> usize {
        match self {
            Dtype::F32 => 4,
            Dtype::F64 => 8,
        }
    }
}

/// Converts numbers to little-endian bytes.
fn bytes_of<T: Real>(values: &[T]) -> Vec<u8> {
    match Dtype::of::<T>() {
        Dtype::F32 => values.iter().flat_map(|x| (x.as_f64() as f32).to_le_bytes()).collect(),
        Dtype::F64 => values.iter().flat_map(|x| x.as_f64().to_le_bytes()).collect(),
    }
}

/// Fills a slice from little-endian bytes. The numbers are rounded if `dtype` has a higher precision than `T`.
fn read_numbers<T: Real>(bytes: &[u8], dtype: Dtype, out: &mut [T]) {
    match dtype {
        Dtype::F32 => out.iter_mut().zip(bytes.as_chunks().0).for_each(|(x, b)| *x = T::lit(f64::from(f32::from_le_bytes(*b)))),
        Dtype::F64 => out.iter_mut().zip(bytes.as_chunks().0).for_each(|(x, b)| *x = T::lit(f64::from_le_bytes(*b))),
    }
}

/// Reads the bytes of a plain file.
fn read(path: &Path) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    let read = open_plain(path).and_then(|mut file| file.read_to_end(&mut bytes));
    read.map_err(|source| FileError::Io { path: path.to_owned(), doing: "reading the file", source })?;
    Ok(bytes)
}

/// Opens a plain (regular) file for reading. Symbolic links are followed. Pipes, devices and sockets are refused, because reading them might never end.
///
/// Errors: [`io::ErrorKind::IsADirectory`] for a folder; [`io::ErrorKind::InvalidInput`] for a pipe, a device or a socket, with a message that names the kind;
/// and the errors of the operating system.
pub fn open_plain(path: &Path) -> io::Result<File> {
    // The kind is checked before the file is opened, because opening a device can have side effects.
    check_plain(&fs::metadata(path)?)?;
    let mut options = OpenOptions::new();
    options.read(true);
    // The path may have been replaced by a pipe since the check, and a blocking open of a pipe would wait for a writer.
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NONBLOCK);
    let file = options.open(path)?;
    check_plain(&file.metadata()?)?;
    Ok(file)
}

fn check_plain(metadata: &fs::Metadata) -> io::Result<()> {
    let kind = metadata.file_type();
    match kind {
        _ if kind.is_file() => Ok(()),
        _ if kind.is_dir() => Err(io::ErrorKind::IsADirectory.into()),
        _ => Err(io::Error::new(io::ErrorKind::InvalidInput, format!("this is {}, not a plain file", name_of(kind)))),
    }
}

/// Returns the name of the kind of a file that is neither plain nor a folder.
#[cfg(unix)]
fn name_of(kind: fs::FileType) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    match kind {
        _ if kind.is_fifo() => "a pipe",
        _ if kind.is_socket() => "a socket",
        _ => "a device",
    }
}

#[cfg(not(unix))]
fn name_of(_: fs::FileType) -> &'static str {
    "something special"
}

/// Writes a file by [`atomically`] and adds its path to an error.
fn replace(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), FileError> {
    atomically(path, write).map_err(|source| FileError::Io { path: path.to_owned(), doing: "writing the file", source })
}

/// Creates or replaces the file at `path` atomically: other processes see either the old or the new content.
///
/// `write` is called with the path of a temporary file, which has a hidden name in the same folder; the temporary file is then synced and renamed. If a step
/// fails, it is removed. Symbolic links are followed, and the new file gets the permissions of the file that it replaces. A device, a pipe and an open file of the
/// process (`/dev/stderr`, `/dev/fd/3`) are not replaced: the temporary file, which is then in the system's folder for temporary files, is copied into them.
///
/// Errors: the errors of `write`, and of syncing, renaming or copying the file.
pub fn atomically(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> io::Result<()> {
    let there = fs::metadata(path).ok();
    if is_open_file(path) || there.as_ref().is_some_and(|there| !there.is_file() && !there.is_dir()) {
        let temporary = temporary_in(&std::env::temp_dir())?;
        write(&temporary)?;
        // Text is added at the end of an open file.
        let mut stream = OpenOptions::new().append(true).open(path)?;
        io::copy(&mut File::open(&temporary)?, &mut stream)?;
        return stream.flush();
    }
    let path = followed(path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let temporary = temporary_in(folder)?;
    write(&temporary)?;
    OpenOptions::new().write(true).open(&temporary)?.sync_all()?;
    // The permissions are set after syncing, because they may forbid opening the file.
    there.map_or(Ok(()), |there| fs::set_permissions(&temporary, there.permissions()))?;
    temporary.persist(&path).map_err(|failed| failed.error)
}

/// Returns true for the names under which a process finds its own open files.
fn is_open_file(path: &Path) -> bool {
    let named = ["/dev/stdin", "/dev/stdout", "/dev/stderr"].iter().any(|name| path == Path::new(name));
    named || path.starts_with("/dev/fd") || (path.starts_with("/proc") && path.parent().is_some_and(|folder| folder.ends_with("fd")))
}

/// Creates an empty hidden file in a folder; it is removed when the returned path is dropped. Its name has the number of this process and six random characters.
/// It does not contain the name of the replaced file, since that name may already have the maximum length.
fn temporary_in(folder: &Path) -> io::Result<TempPath> {
    let mut builder = tempfile::Builder::new();
    let prefix = format!(".{}-", std::process::id());
    builder.prefix(&prefix).suffix(".tmp");
    // The permissions that other new files have: the user's mask is subtracted.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    Ok(builder.tempfile_in(folder)?.into_temp_path())
}

/// Returns the path that a chain of symbolic links leads to. That path need not exist.
fn followed(path: &Path) -> io::Result<PathBuf> {
    // The limit of Linux.
    const MOST_LINKS: usize = 40;
    let mut path = path.to_owned();
    for _ in 0..MOST_LINKS {
        if !path.is_symlink() {
            return Ok(path);
        }
        let target = fs::read_link(&path)?;
        path = path.parent().unwrap_or(Path::new("")).join(target);
    }
    Err(io::Error::other("too many levels of symbolic links"))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("autograd-files-{}-{name}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        path
    }

    #[test]
    fn links_are_followed_and_modes_are_kept() {
        let folder = folder("links");
        let [file, link, next, dangling] = ["file", "link", "next", "dangling"].map(|name| folder.join(name));
        fs::write(&file, "old").unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
        symlink("file", &link).unwrap();
        symlink("link", &next).unwrap();
        symlink("created", &dangling).unwrap();
        for path in [&file, &next, &dangling] {
            atomically(path, |temporary| fs::write(temporary, "new")).unwrap();
        }
        assert_eq!(fs::read_to_string(&file).unwrap(), "new");
        assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(link.is_symlink() && next.is_symlink() && dangling.is_symlink());
        assert_eq!(fs::read_to_string(folder.join("created")).unwrap(), "new");
        symlink("circle", folder.join("circle")).unwrap();
        assert!(atomically(&folder.join("circle"), |temporary| fs::write(temporary, "new")).is_err());
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn devices_are_written_to_and_stay_devices() {
        atomically(Path::new("/dev/null"), |temporary| fs::write(temporary, "x")).unwrap();
        assert!(fs::metadata("/dev/null").unwrap().file_type().is_char_device());
        if Path::new("/dev/full").exists() {
            let error = atomically(Path::new("/dev/full"), |temporary| fs::write(temporary, "x")).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::StorageFull);
        }
    }

    #[test]
    fn open_files_of_the_process_are_written_on_and_not_replaced() {
        use std::os::fd::AsRawFd;
        let folder = folder("open");
        let path = folder.join("log");
        fs::write(&path, "before ").unwrap();
        let open = OpenOptions::new().append(true).open(&path).unwrap();
        let name = PathBuf::from(format!("/dev/fd/{}", open.as_raw_fd()));
        if name.exists() {
            atomically(&name, |temporary| fs::write(temporary, "after")).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), "before after");
        }
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn nothing_is_left_behind_by_a_write_that_fails() {
        let folder = folder("fails");
        let failed = atomically(&folder.join("file"), |temporary| {
            fs::write(temporary, "half")?;
            Err(io::ErrorKind::StorageFull.into())
        });
        assert_eq!(failed.unwrap_err().kind(), io::ErrorKind::StorageFull);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
        fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn what_is_no_plain_file_is_refused_without_waiting_for_it() {
        let place = std::env::temp_dir().join(format!("autograd-plain-{}", std::process::id()));
        fs::create_dir_all(&place).expect("a folder");
        let (link, pipe) = (place.join("link"), place.join("pipe"));
        std::os::unix::fs::symlink("/dev/zero", &link).expect("a link");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
        for (path, found) in [(&link, "this is a device"), (&pipe, "this is a pipe")] {
            let error = crate::Tensor::<f32>::load_npy(path).expect_err("no file").to_string();
            assert!(error.contains(found) && error.contains(&path.display().to_string()), "{error}");
        }
        assert_eq!(open_plain(&place).expect_err("a folder").kind(), io::ErrorKind::IsADirectory);
        fs::write(place.join("file"), b"x").expect("written");
        assert_eq!(read(&place.join("file")).expect("a file"), b"x");
        fs::remove_dir_all(place).expect("removed");
    }
}
