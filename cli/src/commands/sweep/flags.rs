//! Flags of `train` and `carve` as keys of a sweep's file: `downscale = 4` is `--downscale=4`. Which there are, and what they take, is asked
//! of the command line itself.

use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, CommandFactory, ValueHint};
use plenoxel::error::{Error, Result};
use plenoxel::run::settings;
use std::path::Path;
use toml::{Table, Value};

/// What a sweep decides itself.
const DECIDED: [&str; 3] = ["out", "force", "resume"];

/// A flag with its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Flag {
    /// As the file spells it.
    pub key: String,
    /// As the command line has it.
    pub text: String,
}

/// The keys that stand for flags of a command.
pub fn keys(command: &str) -> Vec<String> {
    let cli = crate::Cli::command();
    let arguments = cli.find_subcommand(command).into_iter().flat_map(clap::Command::get_arguments);
    arguments.filter_map(key).filter(|key| !DECIDED.contains(&key.as_str())).collect()
}

/// The flag of a command that a key with a value stands for: none if it is switched off, several where it may be repeated. Paths are relative
/// to `base`. `place` is where the key stands.
pub fn flags(command: &str, name: &str, value: &Value, base: &Path, place: &str) -> Result<Vec<Flag>> {
    let cli = crate::Cli::command();
    let mut arguments = cli.find_subcommand(command).into_iter().flat_map(clap::Command::get_arguments);
    let Some(argument) = arguments.find(|argument| key(argument).as_deref() == Some(name)) else {
        let known = keys(command);
        return Err(settings::unknown_name("key", name, &known.iter().map(String::as_str).collect::<Vec<_>>(), place));
    };
    let flag = argument.get_long().unwrap_or_default();
    let is_path = matches!(argument.get_value_hint(), ValueHint::DirPath | ValueHint::FilePath | ValueHint::AnyPath);
    let valued = |value: &Value| {
        let text = text(value).ok_or_else(|| Error::config(place, format!("`{name} = {value}`"), "a value as the flag takes it"))?;
        let text = if is_path { base.join(text).to_string_lossy().into_owned() } else { text };
        Ok(format!("--{flag}={text}"))
    };
    let texts = match (value, argument.get_action()) {
        (Value::Boolean(on), _) => on.then(|| format!("--{flag}")).into_iter().collect(),
        (Value::Array(values), ArgAction::Append) => values.iter().map(valued).collect::<Result<_>>()?,
        _ => vec![valued(value)?],
    };
    Ok(texts.into_iter().map(|text| Flag { key: name.to_owned(), text }).collect())
}

fn key(argument: &Arg) -> Option<String> {
    argument.get_long().map(|long| long.replace('-', "_"))
}

/// A value as the command line spells it.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Integer(number) => Some(number.to_string()),
        Value::Float(number) => Some(number.to_string()),
        Value::Array(values) => values.iter().map(text).collect::<Option<Vec<_>>>().map(|texts| texts.join(",")),
        Value::Boolean(_) | Value::Datetime(_) | Value::Table(_) => None,
    }
}

/// Refuses a table with a key that is not known. `place` says where a key of it stands.
pub fn check_keys(table: &Table, known: &[String], place: &dyn Fn(&str) -> String) -> Result<()> {
    let names: Vec<&str> = known.iter().map(String::as_str).collect();
    match table.keys().find(|key| !names.contains(&key.as_str())) {
        Some(key) => Err(settings::unknown_name("key", key, &names, &place(key))),
        None => Ok(()),
    }
}

/// What the command line says of arguments it does not take, at a place of a file.
pub fn refusal(answer: &clap::Error, command: &str, place: &str) -> Error {
    let said = |kind| match answer.get(kind) {
        Some(ContextValue::String(text)) => Some(text.clone()),
        Some(ContextValue::Strings(texts)) => Some(texts.join(", ")),
        _ => None,
    };
    let flag = said(ContextKind::InvalidArg).unwrap_or_else(|| "its flags".to_owned());
    let found = match (said(ContextKind::InvalidValue), said(ContextKind::PriorArg)) {
        (Some(value), _) => format!("`{value}` for {flag}"),
        (None, Some(other)) => format!("{flag} together with {other}"),
        (None, None) => flag,
    };
    let reason = std::error::Error::source(answer).map(ToString::to_string);
    let accepted = reason.or_else(|| said(ContextKind::ValidValue));
    Error::config(place, found, accepted.unwrap_or_else(|| format!("what `plenoxel {command} --help` lists")))
}
