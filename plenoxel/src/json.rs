//! JSON: values on one line, and files with what is wrong with them.

use crate::error::{Error, Result};
use crate::files;
use crate::text::is_unprintable;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;

/// The value in the bytes of the file `path`, which are UTF-8 or UTF-16.
///
/// Errors: it is not JSON, with the line.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<Value> {
    serde_json::from_str(&files::text(path, bytes)?).map_err(|error| {
        let place = format!("line {}, column {}", error.line(), error.column());
        let (found, remedy) = if error.is_eof() {
            (format!("the JSON ends early, at {place}"), "the file is cut short: copy or download it again")
        } else {
            (format!("this is not valid JSON: {error}"), "correct it there; numbers must be finite")
        };
        Error::input(path, found, remedy)
    })
}

/// A value as JSON on one line, its keys in the order of its fields. Numbers that are not finite become null, and what would do something to a
/// terminal is escaped.
///
/// Errors: the value has no JSON form, such as a map whose keys are no strings.
pub fn line(value: &impl Serialize) -> Result<String> {
    let defect = |e: serde_json::Error| Error::input("result", e.to_string(), "this is a defect of the program");
    let text = serde_json::to_string(value).map_err(defect)?;
    // JSON escapes the first 32 itself. Outside of strings there are none of the others, and all have four digits.
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if is_unprintable(c) { line += &format!("\\u{:04x}", u32::from(c)) } else { line.push(c) }
    }
    Ok(line)
}

/// A value for a message: a file may have anything in its place.
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
