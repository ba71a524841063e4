//! JSON: parsing of files with error positions, and values on one line.

mod tree;

use crate::error::{Error, Result};
use crate::files;
use crate::memory::{self, Allowance};
use crate::text::is_unprintable;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;
use tree::Room;

/// Content of a file that is kept.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Kept {
    /// Returns true for the keys whose values are kept, at any depth. Other values are skipped.
    pub keys: fn(&str) -> bool,
    /// Largest number of entries of a list.
    pub entries: usize,
    /// Percentage of the available memory that the content may take. The rest is for what is made of it.
    pub share: u64,
}

/// Parses the bytes of the file `path`, in UTF-8 or UTF-16, and returns the content that is kept.
///
/// Errors if the bytes are not JSON, naming the line; if a list has too many entries; or if there is not enough memory.
pub(crate) fn parse(path: &Path, bytes: &[u8], kept: &Kept) -> Result<Value> {
    attempt(path, bytes, kept, memory::allowance()).map_err(|Refusal { error, .. }| error)
}

/// Parses a file as [`parse`] does, but returns `None` if it is not JSON.
///
/// Errors if a list has too many entries or if there is not enough memory.
pub(crate) fn parse_if_whole(path: &Path, bytes: &[u8], kept: &Kept) -> Result<Option<Value>> {
    match attempt(path, bytes, kept, memory::allowance()) {
        Ok(value) => Ok(Some(value)),
        Err(Refusal { is_damage: true, .. }) => Ok(None),
        Err(Refusal { error, .. }) => Err(error),
    }
}

/// Reason why a file is not read.
#[derive(Debug)]
struct Refusal {
    error: Error,
    /// True if the file is not JSON.
    is_damage: bool,
}

fn attempt(path: &Path, bytes: &[u8], kept: &Kept, allowance: Option<Allowance>) -> std::result::Result<Value, Refusal> {
    let damage = |error| Refusal { error, is_damage: true };
    let too_large = |error| Refusal { error, is_damage: false };
    let text = files::text(path, bytes).map_err(damage)?;
    let left = |allowance: &Allowance| allowance.bytes.saturating_sub(bytes.len() as u64) / 100 * kept.share;
    let room = Room::new(kept, allowance.as_ref().map_or(u64::MAX, left));
    let mut reader = serde_json::Deserializer::from_str(&text);
    let read = room.read(&mut reader).and_then(|value| reader.end().map(|()| value));
    read.map_err(|error| {
        if let Some(allowance) = allowance.as_ref().filter(|_| room.is_exceeded()) {
            let what = format!("{} of JSON", memory::bytes(bytes.len() as u64));
            return too_large(memory::refusal_of_content(path, &what, allowance));
        }
        let place = format!("line {}, column {}", error.line(), error.column());
        let (found, remedy) = if error.is_eof() {
            (format!("the JSON ends early, at {place}"), "the file is truncated: copy or download it again")
        } else if room.is_long() {
            let found = format!("the list at {place} has more than {} entries", kept.entries);
            return too_large(Error::input(path, found, "split it, because longer lists are not supported"));
        } else {
            (format!("this is not valid JSON: {error}"), "correct the file at this position; numbers must be finite")
        };
        damage(Error::input(path, found, remedy))
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const ALL: Kept = Kept { keys: |_| true, entries: 1000, share: 100 };

    fn read(text: &str, kept: &Kept, bytes: u64) -> std::result::Result<Value, String> {
        let allowance = Allowance { bytes: bytes + text.len() as u64 + 99, is_limit: true };
        attempt(Path::new("t.json"), text.as_bytes(), kept, Some(allowance)).map_err(|refusal| refusal.error.to_string())
    }

    #[test]
    fn what_is_kept_is_as_serde_json_has_it() {
        let text = r#" {"a": [1, -2, 1.5, 1e300, true, null, "x\ty", "\u00e4", [], {}, {"b": [[0]]}], "b": 18446744073709551615, "b": 2} "#;
        assert_eq!(read(text, &ALL, 1 << 30).unwrap(), serde_json::from_str::<Value>(text).unwrap());
        let some = Kept { keys: |key| key == "b", ..ALL };
        assert_eq!(read(r#"{"a": {"b": 1}, "b": [{"a": 1, "b": 2}]}"#, &some, 1 << 30).unwrap(), json!({"b": [{"b": 2}]}));
        for text in ["", "{", "[1,]", "{} {}", "[NaN]", r#"{"a": oops}"#, "[1e999]", r#"{"a": }"#] {
            for kept in [&ALL, &some] {
                let message = read(text, kept, 1 << 30).unwrap_err();
                assert!(message.contains("ends early") || message.contains("not valid JSON"), "{text}: {message}");
            }
        }
        assert!(read(&"[".repeat(100_000), &ALL, 1 << 30).unwrap_err().contains("recursion limit"));
    }

    #[test]
    fn memory_is_counted_while_a_file_is_read_and_only_for_what_is_kept() {
        let junk = format!(r#"{{"zz": [{}[]], "b": 7}}"#, r#"{"a":[]},"#.repeat(500));
        let message = read(&junk, &ALL, 300_000).unwrap_err();
        assert!(message.contains("t.json: the content of 5 kB of JSON needs too much memory: --max-memory allows 305 kB"), "{message}");
        assert!(read(&junk, &ALL, 600_000).is_ok());
        assert_eq!(read(&junk, &Kept { keys: |key| key == "b", ..ALL }, 1000), Ok(json!({"b": 7})));
        for text in ["[[],[],[],[],[]]".to_owned(), format!("[{}0]", "0,".repeat(900)), format!("\"{}\"", "a".repeat(900))] {
            assert!(read(&text, &ALL, 100).is_err() && read(&text, &ALL, 60_000).is_ok(), "{text}");
        }
    }

    #[test]
    fn long_lists_are_not_read_to_their_end() {
        let long = format!("{{\"b\": [{}", "0,".repeat(1001));
        assert_eq!(
            read(&long, &ALL, 1 << 30).unwrap_err(),
            "t.json: the list at line 1, column 2009 has more than 1000 entries; split it, because longer lists are not supported"
        );
        assert!(read(&format!("[{}0]", "0,".repeat(999)), &ALL, 1 << 30).is_ok());
    }

    #[test]
    fn what_is_cut_short_counts_as_none() {
        let parse = |text: &str| parse_if_whole(Path::new("t.json"), text.as_bytes(), &ALL);
        assert_eq!((parse("{\"a\": 1}").unwrap(), parse("{\"a\": ").unwrap()), (Some(json!({"a": 1})), None));
        assert!(parse(&format!("[{}0]", "0,".repeat(1000))).is_err());
    }
}
