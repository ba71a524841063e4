//! Errors of files, settings and computations.
//!
//! Programming mistakes, such as shapes that do not match, panic at the caller's line. Problems with a file, a flag or data are an
//! [`Error`]. Its message says where the problem is, what is wrong, and then what is accepted or what to do:
//!
//! - `key: invalid value VALUE; expected EXPECTED` for the value of a setting ([`Error::config`]),
//! - `key: PROBLEM; REMEDY` for any other problem with a setting ([`Error::usage`]),
//! - `path: PROBLEM; REMEDY` for the content of a file ([`Error::input`]).

use crate::text::{brief, one_line};
use std::path::{Path, PathBuf};

/// [`Result`](std::result::Result) with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Error caused by a user, the operating system or a diverging training run. Displayed, it is one line of printable text of bounded length ([`brief`]).
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder has invalid content.
    #[error("{}: {}; {}", shown(path), brief(found), brief(remedy))]
    Input {
        /// File or folder.
        path: PathBuf,
        /// Problem, with the frame index, key or line where that helps.
        found: String,
        /// Accepted content, or what to do.
        remedy: String,
    },
    /// A setting (flag or configuration key) cannot be used as it is given.
    #[error("{}: {}; {}", brief(key), brief(problem), brief(remedy))]
    Config {
        /// Name of the setting as the user writes it.
        key: String,
        /// Problem, such as "invalid value 3".
        problem: String,
        /// Accepted values, such as "expected 1, 2 or 4", or what to do.
        remedy: String,
    },
    /// A computation produced a number that is not finite, or another unusable result.
    #[error("{}: {}; {}", brief(place), brief(found), brief(remedy))]
    Numeric {
        /// Step, tensor or formula that produced it.
        place: String,
        /// Problem.
        found: String,
        /// Remedy that usually helps.
        remedy: String,
    },
    /// The operating system failed to read or write.
    #[error("{}: {} while {doing}; {}", shown(path), brief(&source.to_string()), remedy(source))]
    Io {
        /// File or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
        /// Activity, as a participle: "writing the image".
        doing: String,
    },
}

impl Error {
    /// Creates an error for invalid content of `path`.
    pub fn input(path: impl Into<PathBuf>, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Error::Input { path: path.into(), found: found.into(), remedy: remedy.into() }
    }

    /// Creates an error for a setting with an invalid value, displayed as `key: invalid value VALUE; expected EXPECTED`.
    pub fn config(key: impl Into<String>, value: impl ToString, expected: impl Into<String>) -> Self {
        Self::usage(key, format!("invalid value {}", value.to_string()), format!("expected {}", expected.into()))
    }

    /// Creates an error for another problem with a setting than its value, displayed as `key: PROBLEM; REMEDY`.
    pub fn usage(key: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Error::Config { key: key.into(), problem: problem.into(), remedy: remedy.into() }
    }

    /// Returns the error with another name of its setting. Errors of other kinds are unchanged.
    pub fn with_key(self, rename: impl FnOnce(&str) -> String) -> Self {
        match self {
            Error::Config { key, problem, remedy } => Error::Config { key: rename(&key), problem, remedy },
            other => other,
        }
    }

    /// Creates an error of the operating system during `doing` with `path`.
    pub fn io(path: impl Into<PathBuf>, source: std::io::Error, doing: impl Into<String>) -> Self {
        Error::Io { path: path.into(), source, doing: doing.into() }
    }

    /// Returns the exit code of a process that ends with this error: 2 setting, 3 data, 4 numbers, 5 reading or writing.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Config { .. } => 2,
            Error::Input { .. } => 3,
            Error::Numeric { .. } => 4,
            Error::Io { .. } => 5,
        }
    }
}

/// Returns a path as printable text.
fn shown(path: &Path) -> String {
    one_line(&path.display().to_string())
}

/// Returns true if the process, or the system, has reached its limit of open files.
fn has_too_many_files(refusal: &std::io::Error) -> bool {
    #[cfg(unix)]
    const CODES: [i32; 2] = [libc::EMFILE, libc::ENFILE];
    // ERROR_TOO_MANY_OPEN_FILES
    #[cfg(not(unix))]
    const CODES: [i32; 1] = [4];
    refusal.raw_os_error().is_some_and(|code| CODES.contains(&code))
}

/// Returns advice for an error of the operating system.
fn remedy(refusal: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::*;
    if has_too_many_files(refusal) {
        return "allow more open files, for example with `ulimit -n 4096`, or close other programs";
    }
    match refusal.kind() {
        NotFound => "check the spelling of the path",
        PermissionDenied => "change its permissions, or choose another path",
        ReadOnlyFilesystem => "choose a path on a writable file system",
        InvalidData | UnexpectedEof => "the file is damaged: use an undamaged copy",
        AlreadyExists | NotADirectory | IsADirectory => {
            "choose another path: there is a file in place of a folder, or a folder in place of a file"
        }
        OutOfMemory => "use a smaller file, or a machine with more memory",
        StorageFull | QuotaExceeded | FileTooLarge => "free disk space, or choose another disk",
        InvalidFilename => "choose a shorter name without special characters",
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
        assert_eq!((config.exit_code(), config.to_string().as_str()), (2, "downscale: invalid value 3; expected 1, 2, 4"));
        let missing = Error::usage("stages", "there is no stage", "add one").with_key(|key| format!("a.toml: {key}"));
        assert_eq!((missing.exit_code(), missing.to_string().as_str()), (2, "a.toml: stages: there is no stage; add one"));
        let io = Error::io("out", std::io::Error::other("disk full"), "writing");
        assert_eq!((io.exit_code(), io.to_string().as_str()), (5, "out: disk full while writing; check the disk, or choose another path"));
        for (kind, remedy) in [
            (std::io::ErrorKind::NotFound, "spelling"),
            (std::io::ErrorKind::PermissionDenied, "permissions"),
            (std::io::ErrorKind::ReadOnlyFilesystem, "writable"),
            (std::io::ErrorKind::InvalidData, "undamaged"),
            (std::io::ErrorKind::NotADirectory, "in place of a folder"),
            (std::io::ErrorKind::StorageFull, "free disk space"),
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
        assert!(long.starts_with("engine: invalid value aaa") && long.ends_with("aaa; expected b") && long.len() < 250, "{long}");
        let numeric = Error::Numeric { place: "step 7".into(), found: "loss is NaN".into(), remedy: "lower the learning rate".into() };
        assert_eq!((numeric.exit_code(), numeric.to_string().as_str()), (4, "step 7: loss is NaN; lower the learning rate"));
    }
}
