//! Differences between two configurations, by key.

use super::leaves;
use crate::model::plenoxels::config::Config;
use std::collections::{BTreeMap, BTreeSet};
use toml::Value;

/// The keys whose [`values`] differ from the requested ones, each as `key is x, not y`.
pub fn differences(found: &BTreeMap<String, String>, asked: &BTreeMap<String, String>) -> Vec<String> {
    let keys: BTreeSet<&String> = found.keys().chain(asked.keys()).collect();
    let said = |value: Option<&String>| value.map_or_else(|| "unset".to_owned(), String::clone);
    let differs = keys.into_iter().filter(|key| found.get(*key) != asked.get(*key));
    differs.map(|key| format!("{key} is {}, not {}", said(found.get(key)), said(asked.get(key)))).collect()
}

/// The value of every key as TOML, by path.
pub fn values(config: &Config) -> BTreeMap<String, String> {
    let mut values = BTreeMap::new();
    if let Ok(value) = Value::try_from(config) {
        leaves("", &value, &mut |path, value| drop(values.insert(path.to_owned(), value.to_string())));
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_named_by_key_with_both_values() {
        let found = Config::default();
        assert!(differences(&values(&found), &values(&found)).is_empty());
        let mut asked = found.clone();
        asked.seed = 7;
        asked.stages.truncate(1);
        asked.stages[0].resolution = 5;
        let said = differences(&values(&found), &values(&asked));
        assert!(said.contains(&"seed is 42, not 7".to_owned()), "{said:?}");
        let resolution = format!("stages[0].resolution is {}, not 5", found.stages[0].resolution);
        assert!(said.contains(&resolution), "{said:?}");
        assert!(said.iter().any(|line| line.starts_with("stages[1].resolution is") && line.ends_with(", not unset")), "{said:?}");
    }
}
