//! The settings of a run, resolved from layers: defaults < preset < file < assignments.
//!
//! Layers are merged as tables, so a layer holds only the keys that it changes. Each value remembers where it was set: in a line of a file, a
//! preset or a flag. Errors name that place.
//!
//! [`Config::preset`], [`Config::from_toml`] and [`Config::read`] resolve a configuration without explicit layers.

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

/// A stack of settings, from which [`Layers::resolve`] makes a [`Config`].
#[derive(Debug, Default, Clone)]
pub struct Layers {
    table: Table,
    /// Path of each value that was set, and the place where it was set; later entries take precedence.
    places: Vec<(String, String)>,
    /// Outermost key of each value that a flag has set.
    flagged: Vec<String>,
}

impl Layers {
    /// A stack with the defaults only.
    pub fn defaults() -> Result<Self> {
        let mut layers = Layers::default();
        let text =
            toml::to_string(&Config::default()).map_err(|e| Error::usage("the defaults", e.to_string(), "this is a bug in the program"))?;
        layers.text(&text, &|_| "the defaults".to_owned())?;
        Ok(layers)
    }

    /// Adds a preset on top.
    pub fn with_preset(mut self, name: &str) -> Result<Self> {
        let preset = presets::preset(name)?;
        self.text(preset.text, &|_| format!("preset {name}"))?;
        Ok(self)
    }

    /// Adds a TOML text on top. `place(path)` names the place of a key in messages.
    fn text(&mut self, text: &str, place: &dyn Fn(&str) -> String) -> Result<()> {
        let layer: Table = text
            .parse()
            .map_err(|e: toml::de::Error| Error::usage(place(""), format!("invalid TOML: {}", e.message()), "fix the syntax"))?;
        keys::check_table(&layer, place)?;
        leaves("", &Value::Table(layer.clone()), &mut |path, _| {
            self.places.push((path.to_owned(), place(path)));
        });
        table::merge(&mut self.table, layer);
        Ok(())
    }

    /// Adds a file on top.
    pub fn file(&mut self, file: &ConfigFile) -> Result<()> {
        self.text(file.text(), &|path| file.place(path))
    }

    /// Sets the value at a path such as `stages[0].sampling.step`. `None` removes the key. `flag` names the place in messages.
    pub fn set(&mut self, path: &str, value: Option<Value>, flag: &str) -> Result<()> {
        keys::check_path(path, flag)?;
        table::set(&mut self.table, path, value.as_ref(), flag)?;
        self.places.push((path.replace("[*]", "[]"), flag.to_owned()));
        self.flagged.extend(value.and(path.split(['.', '[']).next()).map(str::to_owned));
        Ok(())
    }

    /// Sets one value from an assignment `path=value`, as in `--set`. The value is TOML; a string needs no quotes. An empty value removes the
    /// key.
    pub fn assign(&mut self, assignment: &str) -> Result<()> {
        let Some((path, text)) = assignment.split_once('=') else {
            let found = format!("`{assignment}`");
            return Err(Error::config("--set", found, "key=value, such as --set stages[0].epochs=4"));
        };
        let (path, text) = (path.trim(), text.trim());
        let value = match text {
            "" => None,
            text => Some(match format!("value = {text}").parse::<Table>() {
                Ok(mut table) => table.remove("value").unwrap_or_else(|| Value::String(text.to_owned())),
                Err(_) if is_whole_number(text) => {
                    let expected = format!("a whole number from {} to {}", i64::MIN, i64::MAX);
                    return Err(Error::config(format!("--set {path}"), text, expected));
                }
                Err(_) => Value::String(text.to_owned()),
            }),
        };
        self.set(path, value, &format!("--set {path}"))
    }

    /// Builds the configuration and checks it.
    ///
    /// Errors: a key is missing, or a value has the wrong type or is out of range; the message names the place where it was set.
    pub fn resolve(self) -> Result<Config> {
        let places = self.places;
        let placed = |key: &str| match place_of(&places, key) {
            Some(place) if place.ends_with(key) => place.to_owned(),
            Some(place) => format!("{key} ({place})"),
            None => key.to_owned(),
        };
        let config: Config = serde_path_to_error::deserialize(Value::Table(self.table.clone())).map_err(|e| {
            let (path, complaint) = (e.path().to_string(), e.inner().message());
            // A table in place of a name such as "auto" is reported at the key inside it.
            let key =
                path.rsplit_once('.').filter(|_| complaint.starts_with("expected table, found")).map_or(&path[..], |(outer, _)| outer);
            refusal(placed(key), value_at(&self.table, key), complaint)
        })?;
        config.validate().and_then(|()| config.check_effect(self.flagged.iter().map(String::as_str))).map_err(|e| e.with_key(placed))?;
        Ok(config)
    }
}

/// Resolves the settings of a command, defaults < preset < file < `flags`. Returns them with the name of their preset, which is `default` if
/// `preset` is `None`. A complete file has no preset.
///
/// Errors: `preset` is given together with a complete file, which would override all of it; those of [`Layers`].
pub fn layered<'a>(
    preset: Option<&'a str>,
    default: &'a str,
    file: Option<&Path>,
    flags: impl FnOnce(&mut Layers) -> Result<()>,
) -> Result<(Config, Option<&'a str>)> {
    let file = file.map(ConfigFile::read_named).transpose()?;
    let complete = file.as_ref().is_some_and(ConfigFile::is_complete);
    if let (Some(preset), true) = (preset, complete) {
        return Err(Error::usage(
            "--preset",
            format!("the file of --config is complete, so the preset {preset} would have no effect"),
            "leave out --preset or --config",
        ));
    }
    let preset = preset.or((!complete).then_some(default));
    let mut layers = match preset {
        Some(preset) => Layers::defaults()?.with_preset(preset)?,
        // Without the defaults: they have a loss that the file may leave out.
        None => Layers::default(),
    };
    if let Some(file) = &file {
        layers.file(file)?;
    }
    flags(&mut layers)?;
    Ok((layers.resolve()?, preset))
}

impl Config {
    /// Parses settings from TOML text. A complete text, with every required key, is used alone; any other text is a layer over the defaults.
    /// Messages call the text "the settings".
    ///
    /// Errors: the text is not TOML, or has an unknown key or an invalid value; the message names the line.
    pub fn from_toml(text: &str) -> Result<Self> {
        ConfigFile::parse(Path::new("the settings"), text.as_bytes())?.resolve()
    }

    /// Reads settings from a TOML file of at most 1 MiB ([`SETTINGS`](crate::files::SETTINGS)), such as the `config.toml` of a run, like
    /// [`Config::from_toml`].
    ///
    /// Errors: the file cannot be read; those of [`Config::from_toml`]. The message names file and line.
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

/// The place where the value at `key` was set last: `key` itself, a key inside it, or a table that contains it.
fn place_of<'a>(places: &'a [(String, String)], key: &str) -> Option<&'a str> {
    // `stages[*]` on the command line means every entry.
    let general: String = key.split('[').map(|part| part.trim_start_matches(|c: char| c.is_ascii_digit())).collect::<Vec<_>>().join("[");
    let inside = |part: &str, whole: &str| part.strip_prefix(whole).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']));
    let related = |path: &str| inside(path, key) || inside(key, path) || inside(path, &general) || inside(&general, path);
    let last = places.iter().rev().find(|(path, _)| related(path));
    last.map(|(_, place)| place.as_str())
}

/// The value at a path such as `stages[0].sampling`.
fn value_at<'v>(table: &'v Table, path: &str) -> Option<&'v Value> {
    let mut segments = path.split(['.', '[']).map(|segment| segment.trim_end_matches(']'));
    let first = table.get(segments.next()?)?;
    segments.try_fold(first, |value, segment| match value {
        Value::Array(entries) => entries.get(segment.parse::<usize>().ok()?),
        value => value.get(segment),
    })
}

/// The error for the setting `key` with a value, from the message of a failed conversion.
fn refusal(key: String, value: Option<&Value>, complaint: &str) -> Error {
    if let Some(missing) = complaint.strip_prefix("missing field ") {
        return Error::usage(key, format!("the key {missing} is missing"), "set it, because it has no default");
    }
    let expected = match complaint.split_once(", expected ").map_or(complaint, |(_, expected)| expected) {
        sampling if sampling.contains("enum Sampling") => "{ step = voxel sides } or { samples = points, far = largest t }".to_owned(),
        weight if weight.contains("enum Weight") => "a number, { weight = …, until = step } or { from = …, to = …, steps = … }".to_owned(),
        // The words of serde for its own types, and of the parser for a table in place of a name.
        "f64" | "f32" => "a number".to_owned(),
        "u64" | "usize" => "a whole number of at least 0".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a sequence" => "a list".to_owned(),
        "path string" => "a path in quotes".to_owned(),
        "an array of length 3" => "a list of three numbers".to_owned(),
        "internally tagged enum OptimizerConfig" => "a table such as { kind = \"sgd\" }".to_owned(),
        "string only" | "variant identifier" => "a string".to_owned(),
        table if table.starts_with("struct ") || table == "a map" => "a table".to_owned(),
        text if text == complaint => "a string".to_owned(),
        other => other.replace('`', ""),
    };
    let name = complaint.strip_prefix("unknown variant `").and_then(|rest| rest.split('`').next());
    match (name, value) {
        (Some(name), _) => Error::config(key, format!("\"{name}\""), expected),
        (None, Some(value)) => Error::config(key, value, expected),
        (None, None) => Error::usage(key, "invalid value", format!("expected {expected}")),
    }
}

/// True for an optional sign and digits.
fn is_whole_number(text: &str) -> bool {
    let digits = text.strip_prefix(['+', '-']).unwrap_or(text);
    !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit())
}

#[cfg(test)]
mod tests;
