//! JSON: parsing files with helpful errors, and values as one line of text.

use crate::error::{Error, Result};
use crate::files;
use crate::text::is_unprintable;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// Parses the bytes of the JSON file `path`, in UTF-8 or UTF-16.
///
/// Errors: the bytes are not JSON; the message names the line.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Value> {
    serde_json::from_str(&files::text(path, bytes)?).map_err(|error| {
        let place = format!("line {}, column {}", error.line(), error.column());
        let (found, remedy) = if error.is_eof() {
            (format!("the JSON ends early, at {place}"), "the file is truncated: copy or download it again")
        } else {
            (format!("this is not valid JSON: {error}"), "fix the syntax there; numbers must be finite")
        };
        Error::input(path, found, remedy)
    })
}

/// Serializes a value as JSON on one line, with keys in the order of its fields. Numbers that are not finite become null. Characters that a
/// terminal would interpret are escaped.
///
/// Errors: the value has no JSON form, such as a map whose keys are not strings.
pub fn line(value: &impl Serialize) -> Result<String> {
    let defect = |e: serde_json::Error| Error::input("result", e.to_string(), "this is a bug in the program");
    let text = serde_json::to_string(value).map_err(defect)?;
    // JSON escapes the first 32 characters itself. The others occur in strings only, and all have four hexadecimal digits.
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if is_unprintable(c) { line += &format!("\\u{:04x}", u32::from(c)) } else { line.push(c) }
    }
    Ok(line)
}

/// A short description of a value of any type, for messages.
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
