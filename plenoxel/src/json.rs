//! JSON: parsing of files with error positions, and values on one line.

use crate::error::{Error, Result};
use crate::files;
use crate::text::is_unprintable;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// Parses the bytes of the file `path`, in UTF-8 or UTF-16.
///
/// Errors if they are not JSON, naming the line.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Value> {
    serde_json::from_str(&files::text(path, bytes)?).map_err(|error| {
        let place = format!("line {}, column {}", error.line(), error.column());
        let (found, remedy) = if error.is_eof() {
            (format!("the JSON ends early, at {place}"), "the file is cut short: copy or download it again")
        } else {
            (format!("this is not valid JSON: {error}"), "correct the file at this position; numbers must be finite")
        };
        Error::input(path, found, remedy)
    })
}

/// Formats a value as JSON on one line, with keys in the order of its fields. Numbers that are not finite become null. Characters that
/// control a terminal are escaped.
///
/// Errors if the value has no JSON form, for example a map whose keys are not strings.
pub fn line(value: &impl Serialize) -> Result<String> {
    let defect = |e: serde_json::Error| Error::input("result", e.to_string(), "this is a defect of the program");
    let text = serde_json::to_string(value).map_err(defect)?;
    // serde_json escapes the first 32 characters. The other unprintable characters occur only inside strings, and all have four digits.
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if is_unprintable(c) { line += &format!("\\u{:04x}", u32::from(c)) } else { line.push(c) }
    }
    Ok(line)
}

/// Formats a value for an error message, shortened, because a file may contain anything in its place.
pub(crate) fn shown(value: &Value) -> String {
    const MOST: usize = 60;
    match value {
        Value::Array(list) if list.len() > 16 => format!("a list of {}", list.len()),
        Value::Object(_) => "an object".to_owned(),
        value => {
            let text = value.to_string();
            match text.char_indices().nth(MOST) {
                Some((end, _)) => format!("{}…", &text[..end]),
                None => text,
            }
        }
    }
}
