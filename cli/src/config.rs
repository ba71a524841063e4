//! From layers to a configuration: defaults < preset < file < flags.
//!
//! Layers are merged as tables, so that a layer says only what it changes. Each value remembers where it was written, and an error
//! names that place: a line of a file, a preset, a flag.

mod keys;
mod table;

use plenoxel::error::{Error, Result};
use plenoxel::files;
use plenoxel::train::config::Config;
use std::collections::BTreeMap;
use std::path::Path;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// The presets by name: what they are for, and their text.
pub const PRESETS: [(&str, &str, &str); 6] = [
    ("demo", "the built-in scene in minutes", include_str!("../presets/demo.toml")),
    ("fast", "a minute or two", include_str!("../presets/fast.toml")),
    ("quality", "the best in eleven to fifteen minutes", include_str!("../presets/quality.toml")),
    ("standard", "a dataset of your own", include_str!("../presets/standard.toml")),
    ("plenoxels", "Plenoxels as published: hours", include_str!("../presets/plenoxels.toml")),
    ("paper", "\"Plenoxels and extension to point clouds\", bugs repaired", include_str!("../presets/paper.toml")),
];

/// What `carve` starts from: no preset of training.
pub const CARVE: (&str, &str, &str) = ("carve", "an opaque grid from silhouettes", include_str!("../presets/carve.toml"));

/// A configuration in the making.
#[derive(Debug)]
pub struct Layers {
    table: Table,
    /// Path of each value that was written, and where; later entries win.
    places: Vec<(String, String)>,
}

impl Layers {
    /// The defaults alone.
    pub fn defaults() -> Result<Self> {
        let mut layers = Layers { table: Table::new(), places: Vec::new() };
        let text = toml::to_string(&Config::default()).map_err(|e| Error::config("the defaults", e, "a defect of the program"))?;
        layers.text(&text, &|_| "the defaults".to_owned())?;
        Ok(layers)
    }

    /// Lays a preset over what is there.
    pub fn preset(&mut self, name: &str) -> Result<()> {
        let preset = PRESETS.iter().chain([&CARVE]).find(|(known, ..)| *known == name);
        let Some((name, _, text)) = preset else {
            let names: Vec<&str> = PRESETS.iter().map(|(name, ..)| *name).collect();
            return Err(Error::config("--preset", name, names.join(", ")));
        };
        self.text(text, &|_| format!("preset {name}"))
    }

    /// Lays a text over what is there, once `place` can say for each path where it stands.
    fn text(&mut self, text: &str, place: &dyn Fn(&str) -> String) -> Result<()> {
        let layer: Table = text.parse().map_err(|e: toml::de::Error| Error::config(place(""), e.message(), "valid TOML"))?;
        keys::check_table(&layer, place)?;
        leaves("", &Value::Table(layer.clone()), &mut |path| {
            self.places.push((path.to_owned(), place(path)));
        });
        table::merge(&mut self.table, layer);
        Ok(())
    }

    /// Lays a file over what is there.
    pub fn file(&mut self, file: &ConfigFile) -> Result<()> {
        let place = |path: &str| match file.line(path) {
            Some(line) => format!("{}, line {line}", file.name),
            None => file.name.clone(),
        };
        self.text(&file.text, &place)
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
        let config: Config = Value::Table(self.table).try_into().map_err(|e: toml::de::Error| {
            let (key, accepted) = explain(&e.to_string());
            Error::config(placed(&key), "the value", accepted)
        })?;
        config.validate().map_err(|e| match e {
            Error::Config { key, found, accepted } => Error::config(placed(&key), found, accepted),
            other => other,
        })?;
        Ok(config)
    }
}

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
        let remedy = "give the path of a TOML file, such as the config.toml of a run";
        let bytes = std::fs::read(path).map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Error::input(path, "there is no such file", remedy),
            std::io::ErrorKind::IsADirectory => Error::input(path, "this is a folder", remedy),
            _ => Error::io(path, e, "reading the configuration"),
        })?;
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

    fn line(&self, path: &str) -> Option<usize> {
        self.lines.get(path).copied()
    }
}

/// The settings of a command, defaults < preset < file < flags, and the preset they started from: the one asked for, or `default` unless the
/// file is complete.
pub fn layered<'a>(
    preset: Option<&'a str>,
    default: &'a str,
    file: Option<&Path>,
    flags: impl FnOnce(&mut Layers) -> Result<()>,
) -> Result<(Config, Option<&'a str>)> {
    let file = file.map(ConfigFile::read).transpose()?;
    let complete = file.as_ref().is_some_and(ConfigFile::is_complete);
    let preset = preset.or((!complete).then_some(default));
    let mut layers = Layers::defaults()?;
    if let Some(preset) = preset {
        layers.preset(preset)?;
    }
    if let Some(file) = &file {
        layers.file(file)?;
    }
    flags(&mut layers)?;
    Ok((layers.resolve()?, preset))
}

/// Writes a configuration so that reading it gives the same one.
pub fn write(path: &Path, config: &Config, origin: &str) -> Result<()> {
    let text = toml::to_string(config).map_err(|e| Error::input(path, e.to_string(), "this is a defect of the program"))?;
    let heading = format!(
        "# {origin}\n# Complete: it needs no preset. `plenoxel train DATA --config THIS_FILE` (`carve`, if there are no stages) repeats the run.\n\n"
    );
    files::write_atomically(path, (heading + &text).as_bytes())
}

/// Reads what [`write`] wrote.
pub fn read(path: &Path) -> Result<Config> {
    alone(&ConfigFile::read(path)?)
}

/// What a file says that stands by itself.
pub fn alone(file: &ConfigFile) -> Result<Config> {
    let mut layers = Layers { table: Table::new(), places: Vec::new() };
    layers.file(file)?;
    layers.resolve().map_err(|e| match e {
        // A key that is not there has no line.
        Error::Config { key, found, accepted } if !key.contains(&file.name) => {
            Error::config(format!("{}: {key}", file.name), found, accepted)
        }
        other => other,
    })
}

/// Calls `f` with the path of every value that is not a table.
fn leaves(path: &str, value: &Value, f: &mut dyn FnMut(&str)) {
    match value {
        Value::Table(table) => table.iter().for_each(|(key, value)| match path {
            "" => leaves(key, value, f),
            path => leaves(&format!("{path}.{key}"), value, f),
        }),
        Value::Array(values) if values.iter().any(Value::is_table) => {
            let entries = values.iter().enumerate();
            entries.for_each(|(i, value)| leaves(&format!("{path}[{i}]"), value, f));
        }
        _ => f(path),
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
                        spans(&format!("{inner}[{i}]"), table, f);
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

/// The key and the complaint in the message of a failed conversion: "complaint\nin `a.b`".
fn explain(message: &str) -> (String, String) {
    let mut lines = message.lines();
    let complaint = lines.next().unwrap_or_default().to_owned();
    let key = lines.find_map(|line| line.trim().strip_prefix("in `")?.strip_suffix('`'));
    let accepted = if complaint.contains("enum Sampling") {
        "{ step = voxel sides } or { samples = points, far = largest t }".to_owned()
    } else if complaint.contains("enum Weight") {
        "a number, { weight = …, until = step } or { from = …, to = …, steps = … }".to_owned()
    } else {
        complaint
    };
    (key.unwrap_or("the configuration").to_owned(), accepted)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn preset(name: &str) -> Layers {
        let mut layers = Layers::defaults().unwrap();
        layers.preset(name).unwrap();
        layers
    }

    fn refusal(assignments: &[&str]) -> String {
        let mut layers = preset("paper");
        let set = assignments.iter().try_for_each(|a| layers.assign(a));
        set.and_then(|()| layers.resolve()).unwrap_err().to_string()
    }

    #[test]
    fn every_preset_is_a_valid_configuration_that_survives_its_file() {
        let path = std::env::temp_dir().join(format!("plenoxel-config-{}", std::process::id()));
        for (name, ..) in PRESETS {
            let config = preset(name).resolve().unwrap();
            write(&path, &config, name).unwrap();
            assert_eq!(read(&path).unwrap(), config, "{name}");
            assert!(ConfigFile::read(&path).unwrap().is_complete());
        }
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn numbers_that_no_decimal_ends_survive_the_file() {
        let path = std::env::temp_dir().join(format!("plenoxel-thirds-{}", std::process::id()));
        let mut config = preset("paper").resolve().unwrap();
        config.background = [1.0 / 3.0, 0.1, 2.0 / 3.0];
        config.half_width = 4.0 / 3.0;
        config.stages[0].density_rate = 1e-29 / 3.0;
        write(&path, &config, "").unwrap();
        assert_eq!(read(&path).unwrap(), config);
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn the_command_line_reaches_every_kind_of_knob() {
        let mut layers = preset("paper");
        for assignment in [
            "interpolation = trilinear",
            "stages[3].epochs=0.5",
            "stages[*].color_rate=7",
            "evaluation={step=0.25}",
            "losses.sparsity.from=1e-3",
            "losses.sparsity.to=1e-5",
            "losses.sparsity.steps=100",
            "optimizer={kind=\"momentum\", decay=0.9}",
            "background=[0, 0, 0]",
            "prune_from_stage=2",
        ] {
            layers.assign(assignment).unwrap();
        }
        let config = layers.resolve().unwrap();
        assert_eq!(config.stages[3].epochs, Some(0.5));
        assert!(config.stages.iter().all(|stage| stage.color_rate == 7.0));
        assert_eq!(config.background, [0.0; 3]);
        assert_eq!(config.prune_from_stage, Some(2));
    }

    #[test]
    fn a_refused_value_names_the_place_where_it_was_written() {
        let message = refusal(&["stages[1].density_rate=-1"]);
        assert!(message.starts_with("--set stages[1].density_rate: -1 cannot be used"), "{message}");
        let message = refusal(&["stages[*].density_rate=-1"]);
        assert!(message.starts_with("stages[0].density_rate (--set stages[*].density_rate): -1"), "{message}");
        let message = refusal(&["half_width=wide"]);
        assert!(message.starts_with("--set half_width") && message.contains("expected f64"), "{message}");
        let message = refusal(&["evaluation={samples=5}"]);
        assert!(message.starts_with("--set evaluation") && message.contains("far ="), "{message}");
        let message = refusal(&["losses.mse=often"]);
        assert!(message.contains("a number, { weight = ") && message.contains("{ from = "), "{message}");
        assert!(refusal(&["stages"]).contains("key=value"));
    }

    #[test]
    fn an_unknown_key_in_a_file_is_reported_with_its_line() {
        let path = std::env::temp_dir().join(format!("plenoxel-unknown-{}.toml", std::process::id()));
        std::fs::write(&path, "seed = 1\n\n[initial]\ndensitty = 1\n").unwrap();
        let message = preset("paper").file(&ConfigFile::read(&path).unwrap()).unwrap_err().to_string();
        assert!(message.contains(", line 4: the unknown key `densitty`"), "{message}");
        assert!(message.contains("the nearest known key is `density`"), "{message}");
        std::fs::write(&path, "seed = 1\nhalf_width = = 2\n").unwrap();
        let error = ConfigFile::read(&path).unwrap_err();
        assert!(error.exit_code() == 3 && error.to_string().contains("line 2 is not TOML"), "{error}");
        std::fs::write(&path, "seed = 1\nhalf_width = -2\n").unwrap();
        let mut layers = preset("paper");
        layers.file(&ConfigFile::read(&path).unwrap()).unwrap();
        let message = layers.resolve().unwrap_err().to_string();
        assert!(message.starts_with("half_width (") && message.contains("line 2): -2"), "{message}");
        std::fs::remove_file(path).unwrap();
    }
}
