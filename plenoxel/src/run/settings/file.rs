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
    /// Reads a plain file, such as that of a run.
    ///
    /// Errors: the file cannot be read, is larger than a file of settings may be, or is not TOML; the last names the line.
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(path, &files::read(path, files::SETTINGS)?)
    }

    /// The same of what a user named to be read, which may be a pipe too.
    pub fn read_named(path: &Path) -> Result<Self> {
        Self::parse(path, &files::read_named(path, files::SETTINGS)?)
    }

    /// Reads the bytes of a file; `path` names it in messages.
    ///
    /// Errors, with the line: the bytes are not text in UTF-8 or UTF-16, or not TOML.
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
                let found = format!("line {line} is not TOML: {}", e.message());
                return Err(Error::input(path, found, "correct it there"));
            }
        }
        let name = path.display().to_string();
        Ok(ConfigFile { name, text, lines })
    }

    /// True if the file has every required key, as the resolved `config.toml` of a run: it then needs no layer under it.
    pub fn is_complete(&self) -> bool {
        toml::from_str::<Config>(&self.text).is_ok()
    }

    /// The text of the file.
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

    /// The settings of a complete file by itself, or of any other as a layer over the defaults.
    ///
    /// Errors as for [`Layers`].
    pub fn resolve(&self) -> Result<Config> {
        if self.is_complete() {
            return self.complete();
        }
        let mut layers = Layers::defaults()?;
        layers.file(self)?;
        layers.resolve()
    }

    /// The settings of the file alone, without defaults.
    ///
    /// Errors: a required key is missing, and those of [`Layers`].
    pub fn complete(&self) -> Result<Config> {
        let mut layers = Layers::default();
        layers.file(self)?;
        layers.resolve().map_err(|e| match e {
            // A key that is not there has no line.
            Error::Config { key, found, accepted } if !key.contains(&self.name) => {
                Error::config(format!("{}: {key}", self.name), found, accepted)
            }
            other => other,
        })
    }
}

/// A complete configuration as TOML text, below a remark of one or more lines. Reading it gives the same configuration.
pub fn to_toml(config: &Config, remark: &str) -> Result<String> {
    let text = toml::to_string(config).map_err(|e| Error::config("the settings", e, "a defect of the program"))?;
    let heading: String = remark.lines().map(|line| format!("# {line}\n")).collect();
    Ok(format!("{heading}# Complete: no preset and no default shows through.\n\n{text}"))
}

/// Writes a complete configuration to a file, below a remark. Reading it gives the same configuration.
pub fn write(path: &Path, config: &Config, remark: &str) -> Result<()> {
    files::write_atomically(path, to_toml(config, remark)?.as_bytes())
}

/// No key of ours has a path of so many letters; those that have would take that much again for every key below.
const LONGEST: usize = 500;

/// Calls `f` with the path and the offset in the text of every key whose path is not too long.
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
