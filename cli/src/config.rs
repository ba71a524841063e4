//! From layers to a configuration: defaults < preset < file < flags.
//!
//! Layers are merged as tables, so that a layer says only what it changes. Each value remembers where it was written, and an error
//! names that place: a line of a file, a preset, a flag.

mod difference;
mod keys;
mod presets;
mod table;

pub use difference::{differences, values};
pub use keys::unknown;

use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::model::plenoxels::config::Config;
pub use presets::{CARVE, PRESETS, find};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// A configuration in the making.
#[derive(Debug, Default, Clone)]
pub struct Layers {
    table: Table,
    /// Path of each value that was written, and where; later entries win.
    places: Vec<(String, String)>,
}

impl Layers {
    /// The defaults alone.
    pub fn defaults() -> Result<Self> {
        let mut layers = Layers::default();
        let text = toml::to_string(&Config::default()).map_err(|e| Error::config("the defaults", e, "a defect of the program"))?;
        layers.text(&text, &|_| "the defaults".to_owned())?;
        Ok(layers)
    }

    /// With a preset laid over what is there.
    pub fn with_preset(mut self, name: &str) -> Result<Self> {
        let preset = find(name)?;
        self.text(preset.text, &|_| format!("preset {name}"))?;
        Ok(self)
    }

    /// Lays a text over what is there, once `place` can say for each path where it stands.
    fn text(&mut self, text: &str, place: &dyn Fn(&str) -> String) -> Result<()> {
        let layer: Table = text.parse().map_err(|e: toml::de::Error| Error::config(place(""), e.message(), "valid TOML"))?;
        keys::check_table(&layer, place)?;
        leaves("", &Value::Table(layer.clone()), &mut |path, _| {
            self.places.push((path.to_owned(), place(path)));
        });
        table::merge(&mut self.table, layer);
        Ok(())
    }

    /// Lays a file over what is there.
    pub fn file(&mut self, file: &ConfigFile) -> Result<()> {
        self.text(&file.text, &|path| file.place(path))
    }

    /// Sets one value from the command line: `path` as in `stages[0].sampling.step`, `flag` for messages. No value removes it.
    pub fn set(&mut self, path: &str, value: Option<Value>, flag: &str) -> Result<()> {
        keys::check_path(path, flag)?;
        table::set(&mut self.table, path, value.as_ref(), flag)?;
        self.places.push((path.replace("[*]", "[]"), flag.to_owned()));
        Ok(())
    }

    /// Sets one value from an assignment as `--set` takes it, `path=value`. The value is TOML; a bare word is a string; nothing
    /// removes the key.
    pub fn assign(&mut self, assignment: &str) -> Result<()> {
        let Some((path, text)) = assignment.split_once('=') else {
            let found = format!("`{assignment}`");
            return Err(Error::config("--set", found, "key=value, as in --set stages[0].epochs=4"));
        };
        let (path, text) = (path.trim(), text.trim());
        let value = match text {
            "" => None,
            text => Some(match format!("value = {text}").parse::<Table>() {
                Ok(mut table) => table.remove("value").unwrap_or_else(|| Value::String(text.to_owned())),
                Err(_) => Value::String(text.to_owned()),
            }),
        };
        self.set(path, value, &format!("--set {path}"))
    }

    /// The configuration, checked.
    ///
    /// Errors: a value of the wrong type or out of its range, with the place where it was written.
    pub fn resolve(self) -> Result<Config> {
        let places = self.places;
        let placed = |key: &str| match place_of(&places, key) {
            Some(place) if place.ends_with(key) => place.to_owned(),
            Some(place) => format!("{key} ({place})"),
            None => key.to_owned(),
        };
        let config: Config = serde_path_to_error::deserialize(Value::Table(self.table)).map_err(|e| {
            let key = e.path().to_string();
            let (found, accepted) = explain(e.inner().message());
            Error::config(placed(&key), found, accepted)
        })?;
        config.validate().map_err(|e| match e {
            Error::Config { key, found, accepted } => Error::config(placed(&key), found, accepted),
            other => other,
        })?;
        Ok(config)
    }
}

/// Bytes that a configuration file may have: a hundred times those of the longest preset.
const LARGEST_FILE: u64 = 1 << 20;

/// The text of a configuration file.
#[derive(Debug)]
pub struct ConfigFile {
    name: String,
    text: String,
    /// The line that each key is on, from 1, by its path.
    lines: BTreeMap<String, usize>,
}

impl ConfigFile {
    /// Reads a file. Errors: it is not there, or not TOML (with the line).
    pub fn read(path: &Path) -> Result<Self> {
        let remedy = "a TOML file is expected there";
        let mut bytes = Vec::new();
        let read = std::fs::File::open(path).and_then(|file| file.take(LARGEST_FILE + 1).read_to_end(&mut bytes));
        read.map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Error::input(path, "there is no such file", remedy),
            std::io::ErrorKind::IsADirectory => Error::input(path, "this is a folder", remedy),
            _ => Error::io(path, e, "reading the configuration"),
        })?;
        if bytes.len() as u64 > LARGEST_FILE {
            return Err(Error::input(path, "this file is larger than 1 MiB", remedy));
        }
        Self::parse(path, bytes)
    }

    /// The same from the bytes of a file; `path` names it in messages.
    pub fn parse(path: &Path, bytes: Vec<u8>) -> Result<Self> {
        let text = String::from_utf8(bytes)
            .map_err(|_| Error::input(path, "this is not a text file", "a TOML file is expected, such as the config.toml of a run"))?;
        let ends: Vec<usize> = text.match_indices('\n').map(|(end, _)| end).collect();
        let line_of = |offset: usize| ends.partition_point(|end| *end < offset) + 1;
        let mut lines = BTreeMap::new();
        match DeTable::parse(&text) {
            Ok(table) => spans("", table.get_ref(), &mut |path, offset| {
                lines.entry(path).or_insert(line_of(offset));
            }),
            Err(e) => {
                let line = e.span().map_or(1, |span| line_of(span.start));
                let found = format!("line {line} is not TOML: {}", e.message());
                return Err(Error::input(path, found, "correct it there"));
            }
        }
        let name = path.display().to_string();
        Ok(ConfigFile { name, text, lines })
    }

    /// True if the file leaves nothing open, as the resolved config.toml of a run: then it stands by itself and no preset shines through.
    pub fn is_complete(&self) -> bool {
        toml::from_str::<Config>(&self.text).is_ok()
    }

    /// What the file says.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The file and the line at which a key is written, for messages.
    pub fn place(&self, path: &str) -> String {
        match self.lines.get(path) {
            Some(line) => format!("{}, line {line}", self.name),
            None => self.name.clone(),
        }
    }
}

/// The settings of a command, defaults < preset < file < flags, and the preset they started from: the one asked for, or `default` unless the
/// file is complete.
///
/// Errors: a preset beside a complete file, of which nothing would be left but its name; and those of [`Layers`].
pub fn layered<'a>(
    preset: Option<&'a str>,
    default: &'a str,
    file: Option<&Path>,
    flags: impl FnOnce(&mut Layers) -> Result<()>,
) -> Result<(Config, Option<&'a str>)> {
    let file = file.map(ConfigFile::read).transpose()?;
    let complete = file.as_ref().is_some_and(ConfigFile::is_complete);
    if let (Some(preset), true) = (preset, complete) {
        return Err(Error::config("--preset", format!("{preset} beside a --config that says everything"), "one of the two"));
    }
    let preset = preset.or((!complete).then_some(default));
    let mut layers = match preset {
        Some(preset) => Layers::defaults()?.with_preset(preset)?,
        // Not even the defaults shine through: a loss that they have may be none of the file's.
        None => Layers::default(),
    };
    if let Some(file) = &file {
        layers.file(file)?;
    }
    flags(&mut layers)?;
    Ok((layers.resolve()?, preset))
}

/// A configuration as a text of which reading gives the same one, below a remark of one line or more.
pub fn text(config: &Config, remark: &str) -> Result<String> {
    let text = toml::to_string(config).map_err(|e| Error::config("the settings", e, "a defect of the program"))?;
    let heading: String = remark.lines().map(|line| format!("# {line}\n")).collect();
    Ok(format!("{heading}# Complete: no preset and no default shows through.\n\n{text}"))
}

/// Writes a configuration so that reading it gives the same one.
pub fn write(path: &Path, config: &Config, remark: &str) -> Result<()> {
    files::write_atomically(path, text(config, remark)?.as_bytes())
}

/// Reads what [`write`] wrote.
pub fn read(path: &Path) -> Result<Config> {
    alone(&ConfigFile::read(path)?)
}

/// What a file says that stands by itself.
pub fn alone(file: &ConfigFile) -> Result<Config> {
    let mut layers = Layers::default();
    layers.file(file)?;
    layers.resolve().map_err(|e| match e {
        // A key that is not there has no line.
        Error::Config { key, found, accepted } if !key.contains(&file.name) => {
            Error::config(format!("{}: {key}", file.name), found, accepted)
        }
        other => other,
    })
}

/// Calls `f` with the path of every value that is not a table, and the value.
fn leaves(path: &str, value: &Value, f: &mut dyn FnMut(&str, &Value)) {
    match value {
        Value::Table(table) => table.iter().for_each(|(key, value)| match path {
            "" => leaves(key, value, f),
            path => leaves(&format!("{path}.{key}"), value, f),
        }),
        Value::Array(values) if values.iter().any(Value::is_table) => {
            let entries = values.iter().enumerate();
            entries.for_each(|(i, value)| leaves(&format!("{path}[{i}]"), value, f));
        }
        _ => f(path, value),
    }
}

/// Calls `f` with the path and the offset in the text of every key.
fn spans(path: &str, table: &DeTable<'_>, f: &mut dyn FnMut(String, usize)) {
    for (key, value) in table.iter() {
        let inner = match path {
            "" => key.get_ref().to_string(),
            path => format!("{path}.{}", key.get_ref()),
        };
        f(inner.clone(), key.span().start);
        match value.get_ref() {
            DeValue::Table(table) => spans(&inner, table, f),
            DeValue::Array(values) => {
                for (i, value) in values.iter().enumerate() {
                    if let DeValue::Table(table) = value.get_ref() {
                        let entry = format!("{inner}[{i}]");
                        f(entry.clone(), value.span().start);
                        spans(&entry, table, f);
                    }
                }
            }
            _ => {}
        }
    }
}

/// Where the value at `key` was written last: `key` itself, or a part or the whole of it.
fn place_of<'a>(places: &'a [(String, String)], key: &str) -> Option<&'a str> {
    // `stages[*]` on the command line stands for every entry.
    let general: String = key.split('[').map(|part| part.trim_start_matches(|c: char| c.is_ascii_digit())).collect::<Vec<_>>().join("[");
    let inside = |part: &str, whole: &str| part.strip_prefix(whole).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']));
    let related = |path: &str| inside(path, key) || inside(key, path) || inside(path, &general) || inside(&general, path);
    let last = places.iter().rev().find(|(path, _)| related(path));
    last.map(|(_, place)| place.as_str())
}

/// What was found and what is accepted, from the message of a failed conversion.
fn explain(complaint: &str) -> (&str, &str) {
    if complaint.contains("enum Sampling") {
        return ("the value", "{ step = voxel sides } or { samples = points, far = largest t }");
    }
    if complaint.contains("enum Weight") {
        return ("the value", "a number, { weight = …, until = step } or { from = …, to = …, steps = … }");
    }
    let Some((found, accepted)) = complaint.split_once(", expected ") else {
        return (complaint, "a value for every key");
    };
    let found = ["invalid type: ", "invalid value: "].iter().fold(found, |found, start| found.trim_start_matches(start));
    let accepted = match accepted {
        "f64" | "f32" => "a number",
        "u64" | "usize" => "a whole number of at least 0",
        "a boolean" => "a boolean: true or false",
        "a sequence" => "a list",
        "path string" => "a path",
        table if table.starts_with("struct ") || table == "a map" => "a table",
        other => other,
    };
    (found, accepted)
}

#[cfg(test)]
mod tests;
