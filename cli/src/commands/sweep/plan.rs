//! The plan of a sweep: its scenes, its methods, and the command line of each run.

use super::flags::{self, Flag};
use super::job::{Asked, Call, Job};
use crate::commands::MOST_REDUCTION;
use crate::commands::table::Published;
use clap::Parser;
use plenoxel::error::{Error, Result};
use plenoxel::run::settings::{self, ConfigFile};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::Path;
use toml::{Table, Value};

/// Name of the built-in scene in place of a folder.
const BUILT_IN: &str = "procedural";
/// Largest length of the name of a scene or a method, in bytes. A folder is named after both, and file systems allow 255 bytes.
const LONGEST_NAME: usize = 100;
/// Largest number of runs of a sweep. Each has a folder, a process, and a line in the table.
const MOST_RUNS: usize = 10_000;
const COMMANDS: [&str; 2] = ["train", "carve"];

/// Key of a method: downscale factor of its evaluation.
const EVALUATE_DOWNSCALE: &str = "evaluate_downscale";

/// The runs of a sweep, scene by scene.
#[derive(Debug)]
pub struct Plan {
    pub scenes: Vec<String>,
    pub methods: Vec<String>,
    pub published: Vec<Published>,
    pub jobs: Vec<Job>,
}

/// Content of a sweep file with checked keys, or the equivalent of flags.
#[derive(Debug, Default, Clone, Deserialize)]
struct Sweep {
    /// Settings of all runs; those of scenes and methods override them.
    #[serde(default)]
    set: Vec<String>,
    scenes: Vec<Table>,
    methods: Vec<Table>,
    #[serde(default)]
    published: Vec<Published>,
}

/// A scene or a method, with its name.
struct Entry {
    name: String,
    /// Path of the entry in the file.
    path: String,
    table: Table,
}

impl Plan {
    /// Plans the sweep of a file in the folder `out`. `set` has settings of all runs, which override all others. `scenes`, if not empty, replace the
    /// scenes of the file; each is the name of a scene of the file, or a folder.
    pub fn from_file(path: &Path, scenes: &[String], set: &[String], out: &Path) -> Result<Self> {
        let file = ConfigFile::read_named(path)?;
        let wrong = |found: String| Error::input(path, found, "see the example in `plenoxel sweep --help`");
        let root: Table = toml::from_str(file.text()).map_err(|e| wrong(e.message().to_owned()))?;
        let known = |keys: &[&str]| keys.iter().map(|key| (*key).to_owned()).collect::<Vec<_>>();
        flags::check_keys(&root, &known(&["set", "scenes", "methods", "published"]), &|key| file.place(key))?;
        let tables = |key: &str| root.get(key).and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_table);
        for (index, table) in tables("published").enumerate() {
            let place = |key: &str| file.place(&format!("published[{index}].{key}"));
            flags::check_keys(table, &known(&["name", "source", "psnr", "ssim", "seconds"]), &place)?;
        }
        let mut sweep: Sweep = toml::from_str(file.text()).map_err(|e| {
            let line = e.span().map_or(0, |span| file.text()[..span.start].matches('\n').count() + 1);
            let found = e.message().strip_prefix("missing field ").map(|key| format!("the key {key} is missing"));
            wrong(format!("line {line}: {}", found.unwrap_or_else(|| e.message().to_owned())))
        })?;
        let base = path.parent().unwrap_or(Path::new(""));
        let plan = Self::new(sweep.clone(), set, base, out, &|path| file.place(path))?;
        if scenes.is_empty() {
            return Ok(plan);
        }
        sweep.scenes = scenes
            .iter()
            .map(|scene| match plan.scenes.iter().position(|name| name == scene) {
                Some(index) => sweep.scenes[index].clone(),
                None => with("data", &from_here(scene)),
            })
            .collect();
        Self::new(sweep, set, base, out, &|path| if path.starts_with("scenes") { "--scene".into() } else { file.place(path) })
    }

    /// Plans a sweep of scenes, which are folders or the built-in scene, with presets.
    pub fn from_flags(scenes: &[String], presets: &[String], set: &[String], out: &Path) -> Result<Self> {
        let tables = |key: &str, values: &[String]| values.iter().map(|value| with(key, value)).collect();
        let sweep = Sweep { scenes: tables("data", scenes), methods: tables("preset", presets), ..Sweep::default() };
        Self::new(sweep, set, Path::new(""), out, &|path| if path.starts_with("scenes") { "--scene".into() } else { "--preset".into() })
    }

    fn new(sweep: Sweep, set: &[String], base: &Path, out: &Path, place: &dyn Fn(&str) -> String) -> Result<Self> {
        let scenes = named("scenes", sweep.scenes, place, |table| {
            let data = folder_of(table).map(|data| Path::new(data).file_name().unwrap_or_default().to_string_lossy().into_owned());
            data.unwrap_or_else(|| BUILT_IN.to_owned())
        })?;
        let methods = named("methods", sweep.methods, place, |table| {
            let text = |key: &str| table.get(key).and_then(Value::as_str);
            let config = text("config").and_then(|path| Path::new(path).file_stem()?.to_str());
            text("preset").or(config).or(text("command")).unwrap_or("train").to_owned()
        })?;
        let mut plan = Plan { scenes: names(&scenes), methods: names(&methods), published: sweep.published, jobs: Vec::new() };
        plan.check_published(place)?;
        let chosen = |scene: &Entry| scene.table.get("methods").and_then(Value::as_array).map_or(methods.len(), Vec::len);
        let runs: usize = scenes.iter().map(chosen).sum();
        if runs > MOST_RUNS {
            let found =
                format!("{} scenes with {} methods make {runs} runs, but a sweep has at most {MOST_RUNS}", scenes.len(), methods.len());
            return Err(Error::usage(place("scenes"), found, "make several sweeps, or select the `methods` of each scene"));
        }
        for scene in &scenes {
            let chosen = chosen_methods(scene, &plan.methods, place)?;
            for method in methods.iter().filter(|method| chosen.contains(&method.name)) {
                plan.jobs.push(job(scene, method, &sweep.set, set, base, out, place)?);
            }
        }
        Ok(plan)
    }

    /// Checks that no published results are empty. Results for scenes that are not in the sweep are allowed.
    fn check_published(&self, place: &dyn Fn(&str) -> String) -> Result<()> {
        for (index, published) in self.published.iter().enumerate() {
            if published.scenes().is_empty() {
                let found = format!("`{}` has no results", published.name);
                let remedy = format!("add some, such as psnr = {{ {} = 30.0 }}", self.scenes.join(" = 30.0, "));
                return Err(Error::usage(place(&format!("published[{index}]")), found, remedy));
            }
        }
        Ok(())
    }
}

/// Returns a table with one key.
fn with(key: &str, value: &str) -> Table {
    Table::from_iter([(key.to_owned(), value.into())])
}

/// Makes a folder of the command line absolute, because folders of a sweep file are relative to that file. The built-in scene is unchanged.
fn from_here(data: &str) -> String {
    match std::path::absolute(data) {
        Ok(path) if data != BUILT_IN => path.to_string_lossy().into_owned(),
        _ => data.to_owned(),
    }
}

fn names(entries: &[Entry]) -> Vec<String> {
    entries.iter().map(|entry| entry.name.clone()).collect()
}

/// Dataset folder of a scene; `None` for the built-in scene.
fn folder_of(table: &Table) -> Option<&str> {
    table.get("data").and_then(Value::as_str).filter(|data| *data != BUILT_IN)
}

/// Returns the entries with their names: the key `name`, or the result of `default`. Names become folder names.
fn named(list: &str, tables: Vec<Table>, place: &dyn Fn(&str) -> String, default: impl Fn(&Table) -> String) -> Result<Vec<Entry>> {
    if tables.is_empty() {
        return Err(Error::usage(place(list), format!("there are no {list}"), format!("add at least one entry [[{list}]]")));
    }
    let plain = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_');
    let (mut entries, mut taken) = (Vec::new(), BTreeSet::new());
    for (index, mut table) in tables.into_iter().enumerate() {
        let path = format!("{list}[{index}]");
        let name = match table.remove("name") {
            Some(Value::String(name)) => name,
            Some(other) => return Err(Error::config(place(&format!("{path}.name")), other, "a name in quotes")),
            None => default(&table).chars().map(|c| if plain(c) { c } else { '-' }).collect(),
        };
        if name.is_empty() || name.len() > LONGEST_NAME || !name.chars().all(plain) {
            let place = place(&format!("{path}.name"));
            let expected = format!("a name of at most {LONGEST_NAME} letters, digits, - and _, because it becomes a folder name");
            return Err(Error::config(place, format!("\"{name}\""), expected));
        }
        if !taken.insert(name.clone()) {
            return Err(Error::usage(
                place(&path),
                format!("the name `{name}` is used twice"),
                "give each entry a different name: name = \"…\" in the file",
            ));
        }
        entries.push(Entry { name, path, table });
    }
    Ok(entries)
}

/// Names of the methods for a scene: its key `methods`, or all.
fn chosen_methods(scene: &Entry, methods: &[String], place: &dyn Fn(&str) -> String) -> Result<Vec<String>> {
    let Some(value) = scene.table.get("methods") else {
        return Ok(methods.to_vec());
    };
    let place = place(&format!("{}.methods", scene.path));
    let names = value.as_array().and_then(|names| names.iter().map(Value::as_str).collect::<Option<Vec<_>>>());
    let names = names.ok_or_else(|| Error::config(&place, value, "a list of names, such as [\"fast\", \"paper\"]"))?;
    let known: Vec<&str> = methods.iter().map(String::as_str).collect();
    match names.iter().find(|name| !known.contains(name)) {
        Some(name) => Err(settings::unknown_name("method", name, &known, &place)),
        None => Ok(names.into_iter().map(str::to_owned).collect()),
    }
}

/// Plans the run of a scene with a method.
fn job(
    scene: &Entry,
    method: &Entry,
    first: &[String],
    last: &[String],
    base: &Path,
    out: &Path,
    place: &dyn Fn(&str) -> String,
) -> Result<Job> {
    let command = match method.table.get("command") {
        None => COMMANDS[0],
        Some(value) => match COMMANDS.iter().find(|command| value.as_str() == Some(command)) {
            Some(command) => command,
            None => return Err(Error::config(place(&format!("{}.command", method.path)), value, "\"train\" or \"carve\"")),
        },
    };
    let set =
        |assignments: &[String]| assignments.iter().map(|a| Flag { key: "set".to_owned(), text: format!("--set={a}") }).collect::<Vec<_>>();
    let mut all = set(first);
    for (entry, own) in [(scene, &["name", "data", "methods"][..]), (method, &["name", "command", EVALUATE_DOWNSCALE])] {
        let known =
            || own.iter().map(|key| (*key).to_owned()).chain(COMMANDS.iter().flat_map(|command| flags::keys(command))).collect::<Vec<_>>();
        flags::check_keys(&entry.table, &known(), &|key| place(&format!("{}.{key}", entry.path)))?;
        for (key, value) in entry.table.iter().filter(|(key, _)| !own.contains(&key.as_str())) {
            let place =
                format!("{} (`{}` with `{}`, which is of `{command}`)", place(&format!("{}.{key}", entry.path)), scene.name, method.name);
            all.extend(flags::flags(command, key, value, base, &place)?);
        }
    }
    all.extend(set(last));
    let data = match scene.table.get("data") {
        Some(value) if !value.is_str() => return Err(Error::config(place(&format!("{}.data", scene.path)), value, "a folder in quotes")),
        _ => folder_of(&scene.table).map(|data| base.join(data)),
    };
    let mut call = Call { command, flags: all, data };
    let asked = asked(&call, &format!("{}, `{}` with `{}`", place(&method.path), scene.name, method.name))?;
    let evaluate_downscale = match method.table.get(EVALUATE_DOWNSCALE) {
        None => None,
        Some(value) => {
            Some(reduction(value, &place(&format!("{}.{EVALUATE_DOWNSCALE}", method.path)))?).filter(|k| *k != asked.config.downscale)
        }
    };
    if evaluate_downscale.is_some() && asked.with_evaluation {
        let found =
            format!("{EVALUATE_DOWNSCALE} evaluates after the training, and including_evaluation counts the evaluation of the training");
        return Err(Error::usage(place(&method.path), found, "leave out one of them"));
    }
    // The evaluation at another image size follows the training.
    let skips = evaluate_downscale.is_some() && command == COMMANDS[0] && !call.flags.iter().any(|flag| flag.key == "no_evaluate");
    call.flags.extend(skips.then(|| Flag { key: "no_evaluate".to_owned(), text: "--no-evaluate".to_owned() }));
    let folder = out.join(&scene.name).join(&method.name);
    Ok(Job { scene: scene.name.clone(), method: method.name.clone(), folder, call, asked, evaluate_downscale })
}

/// Parses a downscale factor.
fn reduction(value: &Value, place: &str) -> Result<usize> {
    let number = value.as_integer().and_then(|number| u64::try_from(number).ok()).filter(|number| (1..=MOST_REDUCTION).contains(number));
    let number = number.ok_or_else(|| Error::config(place, value, format!("a whole number from 1 to {MOST_REDUCTION}")))?;
    Ok(number as usize)
}

/// Parses the command line of a run, and resolves its settings.
fn asked(call: &Call, place: &str) -> Result<Asked> {
    let cli = crate::Cli::try_parse_from(["plenoxel".into()].into_iter().chain(call.arguments(&[])));
    let asked = match cli.map(|cli| cli.command) {
        Ok(crate::Command::Train(args)) => args.config().map(|(config, _)| {
            let with_evaluation = args.including_evaluation;
            Asked { config, source: args.source(), time: args.time, with_evaluation }
        }),
        Ok(crate::Command::Carve(args)) => {
            args.config().map(|(config, _)| Asked { config, source: args.source(), time: None, with_evaluation: false })
        }
        Ok(_) => Err(Error::config("command", call.command, COMMANDS.join(" or "))),
        Err(answer) => return Err(flags::refusal(&answer, call.command, place)),
    };
    asked.map_err(|e| e.with_key(|key| format!("{place}: {key}")))
}

#[cfg(test)]
mod tests;
