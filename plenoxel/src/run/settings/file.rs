//! Settings as TOML: reading a file with its line numbers, and writing a complete one.

use super::Layers;
use crate::error::{Error, Result};
use crate::files;
use crate::model::plenoxels::config::Config;
use std::collections::BTreeMap;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// The text of a configuration file, with the line of each key.
#[derive(Debug)]
pub struct ConfigFile {
    name: String,
    text: String,
    /// The line that each key is on, from 1, by its path.
    lines: BTreeMap<String, usize>,
}

impl ConfigFile {
    /// Reads a regular file, such as the `config.toml` of a run.
    ///
    /// Errors: the file cannot be read, is too large for a settings file, or is not TOML; the message then names the line.
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(path, &files::read(path, files::SETTINGS)?)
    }

    /// Reads a path given on the command line, which may also be a pipe, like [`ConfigFile::read`].
    pub fn read_named(path: &Path) -> Result<Self> {
        Self::parse(path, &files::read_named(path, files::SETTINGS)?)
    }

    /// Parses the bytes of a file; `path` names it in messages.
    ///
    /// Errors: the bytes are not text in UTF-8 or UTF-16, or not TOML; the message names the line.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let text = files::text(path, bytes)?.into_owned();
        let ends: Vec<usize> = text.match_indices('\n').map(|(end, _)| end).collect();
        let line_of = |offset: usize| ends.partition_point(|end| *end < offset) + 1;
        let mut lines = BTreeMap::new();
        match DeTable::parse(&text) {
            Ok(table) => spans("", table.get_ref(), &mut |path, offset| {
                lines.entry(path).or_insert(line_of(offset));
            }),
            Err(e) => {
                let line = e.span().map_or(1, |span| line_of(span.start));
                let found = format!("line {line} is not valid TOML: {}", e.message());
                return Err(Error::input(path, found, "fix the syntax there"));
            }
        }
        let name = path.display().to_string();
        Ok(ConfigFile { name, text, lines })
    }

    /// True if the file has every required key, like the resolved `config.toml` of a run. It then needs no defaults.
    pub fn is_complete(&self) -> bool {
        toml::from_str::<Config>(&self.text).is_ok()
    }

    /// The text of the file.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The file name and the line of a key, for messages.
    pub fn place(&self, path: &str) -> String {
        match self.lines.get(path) {
            Some(line) => format!("{}, line {line}", self.name),
            None => self.name.clone(),
        }
    }

    /// Resolves the settings: a complete file is used alone, any other file is a layer over the defaults.
    ///
    /// Errors: those of [`Layers`].
    pub fn resolve(&self) -> Result<Config> {
        if self.is_complete() {
            return self.complete();
        }
        let mut layers = Layers::defaults()?;
        layers.file(self)?;
        layers.resolve()
    }

    /// Resolves the settings of the file alone, without defaults.
    ///
    /// Errors: a required key is missing; those of [`Layers`].
    pub fn complete(&self) -> Result<Config> {
        let mut layers = Layers::default();
        layers.file(self)?;
        // A missing key has no line.
        let placed = |key: &str| match (key, key.contains(&self.name)) {
            ("" | ".", _) => self.name.clone(),
            (_, true) => key.to_owned(),
            (_, false) => format!("{}: {key}", self.name),
        };
        layers.resolve().map_err(|e| e.with_key(placed))
    }
}

/// Formats a complete configuration as TOML text, below a comment of one or more lines. Parsing it gives the same configuration.
pub fn to_toml(config: &Config, remark: &str) -> Result<String> {
    let text = toml::to_string(config).map_err(|e| Error::usage("the settings", e.to_string(), "this is a bug in the program"))?;
    let heading: String = remark.lines().map(|line| format!("# {line}\n")).collect();
    Ok(format!("{heading}# This file is complete: it overrides every preset and default.\n\n{text}"))
}

/// Writes a complete configuration to a file, below a comment. Reading it gives the same configuration.
pub fn write(path: &Path, config: &Config, remark: &str) -> Result<()> {
    files::write_atomically(path, to_toml(config, remark)?.as_bytes())
}

/// Longest path of a key whose place is kept. Settings have shorter paths, and a longer path would be copied for every key below it.
const LONGEST: usize = 500;

/// Calls `f` with the path of every key and its offset in the text, except keys with very long paths.
fn spans(path: &str, table: &DeTable<'_>, f: &mut dyn FnMut(String, usize)) {
    for (key, value) in table.iter() {
        let inner = match path {
            "" => key.get_ref().to_string(),
            path => format!("{path}.{}", key.get_ref()),
        };
        if inner.len() > LONGEST {
            continue;
        }
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
