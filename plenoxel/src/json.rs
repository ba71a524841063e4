//! JSON files, and what is wrong with them.

use crate::error::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// The value in the bytes of the file `path`.
///
/// Errors: it is not JSON, with the line.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Value> {
    serde_json::from_slice(bytes).map_err(|error| {
        let place = format!("line {}, column {}", error.line(), error.column());
        let (found, remedy) = if error.is_eof() {
            (format!("the JSON ends early, at {place}"), "the file is cut short: copy or download it again")
        } else {
            (format!("this is not valid JSON: {error}"), "correct it there; numbers must be finite")
        };
        Error::input(path, found, remedy)
    })
}
