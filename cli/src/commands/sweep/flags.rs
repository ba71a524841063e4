//! Flags of `train` and `carve` as keys of a sweep file: `downscale = 4` means `--downscale=4`. The flags and their values are taken from the
//! definition of the command line.

use clap::error::{ContextKind, ContextValue};
use clap::{Arg, ArgAction, CommandFactory, ValueHint};
use plenoxel::error::{Error, Result};
use plenoxel::run::settings;
use std::path::Path;
use toml::{Table, Value};

/// Flags that a sweep sets itself.
const DECIDED: [&str; 3] = ["out", "force", "resume"];

/// A flag with its value.
#[derive(Debug, Clone, PartialEq)]
pub struct Flag {
    /// Key in the file.
    pub key: String,
    /// Argument on the command line.
    pub text: String,
}

/// Returns the keys for the flags of a command.
pub fn keys(command: &str) -> Vec<String> {
    let cli = crate::Cli::command();
    let arguments = cli.find_subcommand(command).into_iter().flat_map(clap::Command::get_arguments);
    arguments.filter_map(key).filter(|key| !DECIDED.contains(&key.as_str())).collect()
}

/// Returns the arguments of a command for a key with a value: none for `false`, and several for a list. Paths are relative to `base`. `place` names the
/// key in messages.
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
        let text = text(value).ok_or_else(|| Error::config(place, value, format!("a value of --{flag}")))?;
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

/// Formats a value for the command line.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Integer(number) => Some(number.to_string()),
        Value::Float(number) => Some(number.to_string()),
        Value::Array(values) => values.iter().map(text).collect::<Option<Vec<_>>>().map(|texts| texts.join(",")),
        Value::Boolean(_) | Value::Datetime(_) | Value::Table(_) => None,
    }
}

/// Checks the keys of a table. `place` names the place of a key in messages.
pub fn check_keys(table: &Table, known: &[String], place: &dyn Fn(&str) -> String) -> Result<()> {
    let names: Vec<&str> = known.iter().map(String::as_str).collect();
    match table.keys().find(|key| !names.contains(&key.as_str())) {
        Some(key) => Err(settings::unknown_name("key", key, &names, &place(key))),
        None => Ok(()),
    }
}

/// The error for invalid arguments, at a place of a file.
pub fn refusal(answer: &clap::Error, command: &str, place: &str) -> Error {
    let said = |kind| match answer.get(kind) {
        Some(ContextValue::String(text)) => Some(text.clone()),
        Some(ContextValue::Strings(texts)) => Some(texts.join(", ")),
        _ => None,
    };
    let flag = said(ContextKind::InvalidArg).unwrap_or_else(|| "its flags".to_owned());
    let found = match (said(ContextKind::InvalidValue), said(ContextKind::PriorArg)) {
        (Some(value), _) => format!("invalid value `{value}` for {flag}"),
        (None, Some(other)) => format!("{flag} conflicts with {other}"),
        (None, None) => format!("{flag} is invalid"),
    };
    let reason = std::error::Error::source(answer).map(ToString::to_string);
    let expected = reason.or_else(|| said(ContextKind::ValidValue).map(|values| format!("expected {values}")));
    Error::usage(place, found, expected.unwrap_or_else(|| format!("see `plenoxel {command} --help`")))
}
