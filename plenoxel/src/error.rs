//! Errors in files, settings and numbers.
//!
//! Programming errors, such as mismatched shapes, panic at the caller's line. Everything that depends on a file, a flag or the data is an
//! [`Error`]. Its message names the place, says what is wrong, and then what is accepted or what to do.

use crate::text::one_line;
use std::path::{Path, PathBuf};

/// Result with this crate's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// An error caused by the user, the disk or a diverging training run. It is displayed as one line that is safe to print: see [`one_line`].
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder with unusable contents.
    #[error("{}: {}; {}", shown(path), one_line(found), one_line(remedy))]
    Input {
        /// The file or folder.
        path: PathBuf,
        /// The problem, with frame index, key or line where that helps.
        found: String,
        /// The accepted contents, or the remedy.
        remedy: String,
    },
    /// An unusable setting (flag or configuration key).
    #[error("{}: {}; {}", one_line(key), one_line(found), one_line(accepted))]
    Config {
        /// Name of the setting as the user writes it.
        key: String,
        /// The problem, such as "invalid value 3".
        found: String,
        /// The accepted values, such as "expected 1, 2, 4", or the remedy.
        accepted: String,
    },
    /// A computation with a result that is not finite.
    #[error("{}: {}; {}", one_line(place), one_line(found), one_line(remedy))]
    Numeric {
        /// Step, tensor or formula at which it was detected.
        place: String,
        /// The problem.
        found: String,
        /// The usual remedy.
        remedy: String,
    },
    /// A read or write that the operating system refused.
    #[error("{}: {} while {doing}; {}", shown(path), one_line(&source.to_string()), remedy(source))]
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
    /// An error for the contents of `path`: the problem, and the remedy.
    pub fn input(path: impl Into<PathBuf>, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Error::Input { path: path.into(), found: found.into(), remedy: remedy.into() }
    }

    /// An error for a setting with an invalid value, displayed as `key: invalid value VALUE; expected EXPECTED`.
    pub fn config(key: impl Into<String>, value: impl ToString, expected: impl Into<String>) -> Self {
        Self::usage(key, format!("invalid value {}", value.to_string()), format!("expected {}", expected.into()))
    }

    /// An error for a setting that cannot be used for another reason than its value, displayed as `key: PROBLEM; REMEDY`.
    pub fn usage(key: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Error::Config { key: key.into(), found: problem.into(), accepted: remedy.into() }
    }

    /// The error with another name for its setting. Errors of other kinds are returned unchanged.
    pub fn with_key(self, rename: impl FnOnce(&str) -> String) -> Self {
        match self {
            Error::Config { key, found, accepted } => Error::Config { key: rename(&key), found, accepted },
            other => other,
        }
    }

    /// An error that the operating system returned while `doing` something with `path`.
    pub fn io(path: impl Into<PathBuf>, source: std::io::Error, doing: impl Into<String>) -> Self {
        Error::Io { path: path.into(), source, doing: doing.into() }
    }

    /// Exit code of a process that ends with this error: 2 for settings, 3 for bad input, 4 for numbers that are not finite, 5 for reading or writing.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Config { .. } => 2,
            Error::Input { .. } => 3,
            Error::Numeric { .. } => 4,
            Error::Io { .. } => 5,
        }
    }
}

/// A path on one line.
fn shown(path: &Path) -> String {
    one_line(&path.display().to_string())
}

/// True if the process or the system has reached its limit of open files.
fn has_too_many_files(refusal: &std::io::Error) -> bool {
    #[cfg(unix)]
    const CODES: [i32; 2] = [libc::EMFILE, libc::ENFILE];
    // ERROR_TOO_MANY_OPEN_FILES
    #[cfg(not(unix))]
    const CODES: [i32; 1] = [4];
    refusal.raw_os_error().is_some_and(|code| CODES.contains(&code))
}

/// The remedy for an error of the operating system.
fn remedy(refusal: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::*;
    if has_too_many_files(refusal) {
        return "allow more open files, for instance with `ulimit -n 4096`, or close other programs";
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
        InvalidFilename => "choose a shorter name, or one without special characters",
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
            (std::io::ErrorKind::NotADirectory, "in place of"),
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
        let numeric = Error::Numeric { place: "step 7".into(), found: "loss is NaN".into(), remedy: "lower the learning rate".into() };
        assert_eq!((numeric.exit_code(), numeric.to_string().as_str()), (4, "step 7: loss is NaN; lower the learning rate"));
    }
}
