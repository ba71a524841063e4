//! The settings of a run, resolved from layers: defaults < preset < file < assignments.
//!
//! Layers are merged as tables, so that a layer holds only what it changes. Each value remembers where it was written, and an error
//! names that place: a line of a file, a preset, a flag.
//!
//! Without layers of one's own: [`Config::preset`], [`Config::from_toml`], [`Config::read`].

mod difference;
mod file;
mod keys;
mod presets;
mod table;

pub use difference::{differences, values};
pub use file::{ConfigFile, to_toml, write};
pub use keys::unknown_name;
pub use presets::{CARVE, PRESETS, Preset, preset};

use crate::error::{Error, Result};
use crate::model::plenoxels::config::Config;
use std::path::Path;
use toml::{Table, Value};

/// Settings laid over each other, of which [`Layers::resolve`] makes a [`Config`].
#[derive(Debug, Default, Clone)]
pub struct Layers {
    table: Table,
    /// Path of each value that was written, and the place where it was; later entries win.
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

    /// Lays a preset over what is there.
    pub fn with_preset(mut self, name: &str) -> Result<Self> {
        let preset = presets::preset(name)?;
        self.text(preset.text, &|_| format!("preset {name}"))?;
        Ok(self)
    }

    /// Lays a text over what is there. `place(path)` names the place of a key in messages.
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
        self.text(file.text(), &|path| file.place(path))
    }

    /// Sets the value at a path such as `stages[0].sampling.step`. `None` removes the key. `flag` names the place in messages.
    pub fn set(&mut self, path: &str, value: Option<Value>, flag: &str) -> Result<()> {
        keys::check_path(path, flag)?;
        table::set(&mut self.table, path, value.as_ref(), flag)?;
        self.places.push((path.replace("[*]", "[]"), flag.to_owned()));
        Ok(())
    }

    /// Sets one value from an assignment as `--set` takes it, `path=value`. The value is TOML, or a bare word for a string. An empty value
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
                Err(_) if is_whole_number(text) => {
                    let accepted = format!("a whole number from {} to {}", i64::MIN, i64::MAX);
                    return Err(Error::config(format!("--set {path}"), text, accepted));
                }
                Err(_) => Value::String(text.to_owned()),
            }),
        };
        self.set(path, value, &format!("--set {path}"))
    }

    /// Makes the configuration and checks it.
    ///
    /// Errors: a key is missing, or a value has the wrong type or is out of its range; the message names the place where it was written.
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

/// The settings of a command, defaults < preset < file < `flags`, and the name of the preset under them. Without `preset` it is `default`.
/// A complete file has no preset under it.
///
/// Errors: a preset beside a complete file, which would replace all of the preset; and those of [`Layers`].
pub fn layered<'a>(
    preset: Option<&'a str>,
    default: &'a str,
    file: Option<&Path>,
    flags: impl FnOnce(&mut Layers) -> Result<()>,
) -> Result<(Config, Option<&'a str>)> {
    let file = file.map(ConfigFile::read_named).transpose()?;
    let complete = file.as_ref().is_some_and(ConfigFile::is_complete);
    if let (Some(preset), true) = (preset, complete) {
        return Err(Error::config("--preset", format!("{preset} beside a --config that says everything"), "one of the two"));
    }
    let preset = preset.or((!complete).then_some(default));
    let mut layers = match preset {
        Some(preset) => Layers::defaults()?.with_preset(preset)?,
        // Not even the defaults: they have a loss that the file may be without.
        None => Layers::default(),
    };
    if let Some(file) = &file {
        layers.file(file)?;
    }
    flags(&mut layers)?;
    Ok((layers.resolve()?, preset))
}

impl Config {
    /// Settings from TOML text. A complete text, which has every required key, stands alone; any other is a layer over the defaults.
    /// Messages call the text "the settings".
    ///
    /// Errors: the text is not TOML, has an unknown key, or a value that cannot be used; the message names the line.
    pub fn from_toml(text: &str) -> Result<Self> {
        ConfigFile::parse(Path::new("the settings"), text.as_bytes())?.resolve()
    }

    /// Settings from a TOML file of at most 1 MiB ([`SETTINGS`](crate::files::SETTINGS)), such as the `config.toml` of a run; as [`Config::from_toml`] otherwise.
    ///
    /// Errors: the file cannot be read, and those of [`Config::from_toml`]; the message names file and line.
    pub fn read(path: &Path) -> Result<Self> {
        ConfigFile::read_named(path)?.resolve()
    }
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

/// True for an optional sign and digits.
fn is_whole_number(text: &str) -> bool {
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit())
}

#[cfg(test)]
mod tests;
