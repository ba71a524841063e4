//! What can go wrong between this crate and the world: files, settings, numbers.
//!
//! Mistakes of a programmer (shapes that do not fit) panic at the caller's line. Everything that comes from a file, a flag or
//! the data is an [`Error`], and its message says where it happened, what was found, what is accepted and what to do.

use crate::text::{brief, one_line};
use std::path::{Path, PathBuf};

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Everything a user, a disk or a diverging training run can cause. Displayed, it is one line that can be printed, of bounded length: see [`brief`].
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder does not hold what it should.
    #[error("{}: {}; {}", shown(path), brief(found), brief(remedy))]
    Input {
        /// The file or folder.
        path: PathBuf,
        /// What is there, with frame index, key or line where that helps.
        found: String,
        /// What is accepted, or what to do about it.
        remedy: String,
    },
    /// A setting (flag or configuration key) has a value that cannot be used.
    #[error("{}: {} cannot be used; accepted: {}", brief(key), brief(found), brief(accepted))]
    Config {
        /// Name of the setting as the user writes it.
        key: String,
        /// The value given.
        found: String,
        /// The values that would do.
        accepted: String,
    },
    /// A computation left the finite numbers.
    #[error("{}: {}; {}", brief(place), brief(found), brief(remedy))]
    Numeric {
        /// Step, tensor or formula where it was noticed.
        place: String,
        /// The value seen.
        found: String,
        /// What usually helps.
        remedy: String,
    },
    /// The operating system refused to read or write.
    #[error("{}: {} while {doing}; {}", shown(path), brief(&source.to_string()), remedy(source))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The reason the operating system gave.
        source: std::io::Error,
        /// The activity, as a participle: "writing the image".
        doing: String,
    },
}

impl Error {
    /// Bad data in `path`.
    pub fn input(path: impl Into<PathBuf>, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Error::Input { path: path.into(), found: found.into(), remedy: remedy.into() }
    }

    /// A setting that cannot be used.
    pub fn config(key: impl Into<String>, found: impl ToString, accepted: impl Into<String>) -> Self {
        Error::Config { key: key.into(), found: found.to_string(), accepted: accepted.into() }
    }

    /// A refusal of the operating system while `doing` something with `path`.
    pub fn io(path: impl Into<PathBuf>, source: std::io::Error, doing: impl Into<String>) -> Self {
        Error::Io { path: path.into(), source, doing: doing.into() }
    }

    /// Exit code of a process that ends with this error: 2 setting, 3 data, 4 numbers, 5 reading or writing.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Config { .. } => 2,
            Error::Input { .. } => 3,
            Error::Numeric { .. } => 4,
            Error::Io { .. } => 5,
        }
    }
}

/// A path as it can be printed.
fn shown(path: &Path) -> String {
    one_line(&path.display().to_string())
}

/// True if the process, or the system, has as many open files as it may have.
fn has_too_many_files(refusal: &std::io::Error) -> bool {
    #[cfg(unix)]
    const CODES: [i32; 2] = [libc::EMFILE, libc::ENFILE];
    // ERROR_TOO_MANY_OPEN_FILES
    #[cfg(not(unix))]
    const CODES: [i32; 1] = [4];
    refusal.raw_os_error().is_some_and(|code| CODES.contains(&code))
}

/// What helps against a refusal of the operating system.
fn remedy(refusal: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::*;
    if has_too_many_files(refusal) {
        return "allow more open files, for instance with `ulimit -n 4096`, or close other programs";
    }
    match refusal.kind() {
        NotFound => "check that the path is spelled rightly",
        PermissionDenied => "change its permissions, or choose another path",
        ReadOnlyFilesystem => "choose a place that may be written",
        InvalidData | UnexpectedEof => "the file is damaged: use an undamaged copy",
        AlreadyExists | NotADirectory | IsADirectory => "choose another path: a file is where a folder should be, or the other way round",
        OutOfMemory => "use a smaller file, or a machine with more memory",
        StorageFull | QuotaExceeded | FileTooLarge => "make room on the disk, or choose another one",
        InvalidFilename => "choose a shorter or plainer name",
        _ => "check the disk, or choose another path",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_of_error_has_its_own_exit_code_and_a_complete_sentence() {
        let input = Error::input("a.json", "frames is empty", "list at least one frame");
        assert_eq!((input.exit_code(), input.to_string().as_str()), (3, "a.json: frames is empty; list at least one frame"));
        let config = Error::config("downscale", 3, "1, 2, 4");
        assert_eq!((config.exit_code(), config.to_string().as_str()), (2, "downscale: 3 cannot be used; accepted: 1, 2, 4"));
        let io = Error::io("out", std::io::Error::other("disk full"), "writing");
        assert_eq!((io.exit_code(), io.to_string().as_str()), (5, "out: disk full while writing; check the disk, or choose another path"));
        for (kind, remedy) in [
            (std::io::ErrorKind::NotFound, "spelled rightly"),
            (std::io::ErrorKind::PermissionDenied, "permissions"),
            (std::io::ErrorKind::ReadOnlyFilesystem, "may be written"),
            (std::io::ErrorKind::InvalidData, "undamaged"),
            (std::io::ErrorKind::NotADirectory, "the other way round"),
            (std::io::ErrorKind::StorageFull, "make room"),
            (std::io::ErrorKind::InvalidFilename, "shorter"),
        ] {
            let text = Error::io("out", kind.into(), "writing").to_string();
            assert!(text.contains(remedy), "{text}");
        }
        for code in [24, 23] {
            #[cfg(unix)]
            assert!(Error::io("out", std::io::Error::from_raw_os_error(code), "reading").to_string().contains("ulimit -n"), "{code}");
        }
        let foreign = Error::input("a\x1b[1mb", "the key \"x\ny\"", "a\u{9b}");
        assert_eq!(foreign.to_string(), "a\\u{1b}[1mb: the key \"x\\ny\"; a\\u{9b}");
        let long = Error::config("engine", "a".repeat(900_000), "b").to_string();
        assert!(long.starts_with("engine: aaa") && long.ends_with("aaa cannot be used; accepted: b") && long.len() < 250, "{long}");
        let numeric = Error::Numeric { place: "step 7".into(), found: "loss is NaN".into(), remedy: "lower the learning rate".into() };
        assert_eq!((numeric.exit_code(), numeric.to_string().as_str()), (4, "step 7: loss is NaN; lower the learning rate"));
    }
}
