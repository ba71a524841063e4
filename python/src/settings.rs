//! Settings of a run from Python values: the keys of config.toml, as arguments or as nested dicts.

use crate::errors::{array, dtype, invalid, raised};
use plenoxel::model::plenoxels::config::Config;
use plenoxel::run::settings::{Layers, PRESETS, layered};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use std::path::PathBuf;
use toml::{Table, Value};

/// Resolves settings, defaults < preset < file < `settings`. Returns them with the name of their preset.
///
/// Errors: a key is unknown; a value is invalid, or of a type that TOML does not have.
pub fn resolve<'p>(
    preset: Option<&'p str>,
    default: &'p str,
    file: Option<&PathBuf>,
    settings: &Bound<'_, PyDict>,
) -> PyResult<(Config, Option<&'p str>)> {
    let mut assignments = Vec::new();
    flatten("", settings, &mut assignments)?;
    let assign = |layers: &mut Layers| assignments.into_iter().try_for_each(|(path, value)| layers.set(&path, value, &path));
    layered(preset, default, file.map(PathBuf::as_path), assign).map_err(raised)
}

/// Nesting at which a value is refused: it may contain itself.
const DEEPEST: usize = 16;

/// Lists the paths of all values of nested dicts. `None` removes a key.
fn flatten(path: &str, settings: &Bound<'_, PyDict>, into: &mut Vec<(String, Option<Value>)>) -> PyResult<()> {
    for (key, value) in settings {
        let key: String = key.extract().map_err(|_| dtype(path, "a key is not a string", "use the keys of config.toml"))?;
        let path = if path.is_empty() { key } else { format!("{path}.{key}") };
        if path.matches('.').count() > DEEPEST {
            return Err(array(&path, "the tables are nested too deeply", "use the keys of config.toml"));
        }
        match value.cast::<PyDict>() {
            Ok(table) if table.is_empty() => into.push((path, Some(Value::Table(Table::new())))),
            Ok(table) => flatten(&path, table, into)?,
            Err(_) if value.is_none() => into.push((path, None)),
            Err(_) => {
                let value = toml_value(&value, &path, 0)?;
                into.push((path, Some(value)));
            }
        }
    }
    Ok(())
}

fn toml_value(value: &Bound<'_, PyAny>, path: &str, depth: usize) -> PyResult<Value> {
    if depth > DEEPEST {
        return Err(array(path, "the lists are nested too deeply", "use the values of config.toml"));
    }
    if value.is_instance_of::<PyBool>() {
        Ok(Value::Boolean(value.extract()?))
    } else if value.is_instance_of::<PyInt>() {
        let expected = format!("a whole number from {} to {}", i64::MIN, i64::MAX);
        value.extract().map(Value::Integer).map_err(|_| invalid(path, value, &expected))
    } else if value.is_instance_of::<PyFloat>() {
        Ok(Value::Float(value.extract()?))
    } else if value.is_instance_of::<PyString>() {
        Ok(Value::String(value.extract()?))
    } else if value.is_instance_of::<PyList>() || value.is_instance_of::<PyTuple>() {
        let values = value.try_iter()?.map(|entry| toml_value(&entry?, path, depth + 1)).collect::<PyResult<_>>()?;
        Ok(Value::Array(values))
    } else if let Ok(table) = value.cast::<PyDict>() {
        let entry = |(key, value): (Bound<'_, PyAny>, Bound<'_, PyAny>)| Ok((key.extract()?, toml_value(&value, path, depth + 1)?));
        Ok(Value::Table(table.iter().map(entry).collect::<PyResult<_>>()?))
    } else if let Ok(plain) = value.call_method0("tolist").or_else(|_| value.call_method0("__fspath__")) {
        // Numbers and arrays of NumPy; paths.
        toml_value(&plain, path, depth + 1)
    } else {
        let found = format!("this is a {}", value.get_type().name()?);
        Err(dtype(path, found, "expected a number, a string, a bool, a list, a dict, or None to remove the key"))
    }
}

/// Returns the names of the presets with their purpose and their duration.
#[pyfunction]
pub fn presets() -> Vec<(&'static str, &'static str, &'static str)> {
    PRESETS.iter().map(|preset| (preset.name, preset.purpose, preset.time)).collect()
}
