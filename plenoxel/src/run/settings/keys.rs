//! The keys that a configuration may have, so that a misspelled one is an error that names the right one.

use crate::error::{Error, Result};
use crate::model::plenoxels::{LEARNED_LOSSES, LOSSES};
use strsim::levenshtein;
use toml::{Table, Value};

/// The keys of a stage.
const STAGE: &[&str] = &[
    "resolution",
    "epochs",
    "steps",
    "sampling",
    "image_reduction",
    "density_rate",
    "color_rate",
    "harmonics_rate",
    "density_warm_up",
    "rate_decay",
    "color_decay",
];

/// The two ways to place samples.
const SAMPLING: &[&str] = &["step", "samples", "far"];

/// Every table with its keys. In a path, `[]` stands for any index and `*` for any name.
const TABLES: &[(&str, &[&str])] = &[
    (
        "",
        &[
            "seed",
            "downscale",
            "validation_every",
            "background",
            "half_width",
            "interpolation",
            "color",
            "sh_degree",
            "sh_reduction",
            "sh_offset",
            "engine",
            "stop_below",
            "rays_per_step",
            "aim",
            "jitter",
            "project",
            "pixels_per_voxel",
            "prune_from_stage",
            "prune_below",
            "prune_unseen_below",
            "scout",
            "init_from",
            "hull",
            "initial",
            "optimizer",
            "losses",
            "loss_rates",
            "stages",
            "evaluation",
            "carve",
        ],
    ),
    ("initial", &["density", "color", "random"]),
    ("optimizer", &["kind", "decay", "beta", "beta1", "beta2", "epsilon"]),
    ("losses", &LOSSES),
    ("loss_rates", &LEARNED_LOSSES),
    ("losses.*", &["weight", "until", "from", "to", "steps"]),
    ("stages[]", STAGE),
    ("stages[].sampling", SAMPLING),
    ("scout", &["density", "prune_unseen_below", "stages"]),
    ("scout.stages[]", STAGE),
    ("scout.stages[].sampling", SAMPLING),
    ("evaluation", SAMPLING),
    ("carve", &["resolution", "rule", "margin", "depth", "photo", "fit", "ridge", "sweeps"]),
    ("carve.photo", &["noise"]),
];

/// Checks every key of a table and of the tables in it. `place(path)` says where a path was written.
///
/// Errors: the first unknown key, with where it is and the nearest known one.
pub fn check_table(table: &Table, place: &dyn Fn(&str) -> String) -> Result<()> {
    walk("", "", &Value::Table(table.clone()), place)
}

/// Checks a path such as `stages[0].sampling.step`, which `place` describes.
pub fn check_path(path: &str, place: &str) -> Result<()> {
    let mut pattern = String::new();
    for segment in path.split('.') {
        let (name, index) = match segment.split_once('[') {
            Some((name, _)) => (name, "[]"),
            None => (segment, ""),
        };
        check_key(&pattern, name, place)?;
        pattern = joined(&pattern, name) + index;
    }
    Ok(())
}

fn walk(path: &str, pattern: &str, value: &Value, place: &dyn Fn(&str) -> String) -> Result<()> {
    match value {
        Value::Table(table) => table.iter().try_for_each(|(key, value)| {
            let inner = joined(path, key);
            check_key(pattern, key, &place(&inner))?;
            walk(&inner, &joined(pattern, key), value, place)
        }),
        Value::Array(values) => {
            values.iter().enumerate().try_for_each(|(i, value)| walk(&format!("{path}[{i}]"), &format!("{pattern}[]"), value, place))
        }
        _ => Ok(()),
    }
}

fn joined(path: &str, key: &str) -> String {
    match path {
        "" => key.to_owned(),
        path => format!("{path}.{key}"),
    }
}

fn check_key(pattern: &str, key: &str, place: &str) -> Result<()> {
    let fits = |table: &str| match (table.strip_suffix('*'), table == pattern) {
        // The name is one of any, but nothing is below it.
        (Some(start), _) => pattern.strip_prefix(start).is_some_and(|name| !name.contains(['.', '['])),
        (None, same) => same,
    };
    let known = TABLES.iter().find(|(table, _)| fits(table));
    // A damaged file may have one of any length, which is neither printed nor compared whole.
    let key = key.char_indices().nth(60).map_or(key, |(end, _)| &key[..end]);
    let is_list = TABLES.iter().any(|(table, _)| table.strip_suffix("[]") == Some(pattern));
    let Some((_, known)) = known else {
        if is_list {
            let found = format!("the key `{key}` below the list `{pattern}`");
            return Err(Error::config(place, found, format!("{pattern}[0] or {pattern}[*] with --set, [[{pattern}]] in a file")));
        }
        let found = format!("the key `{key}` below `{pattern}`, which is not a table");
        return Err(Error::config(place, found, format!("a value for `{pattern}`")));
    };
    if known.contains(&key) {
        return Ok(());
    }
    // One that stands elsewhere; one that is spelled alike; one that ends in the same word.
    let last_word = |key: &str| key.rsplit_once('_').map(|(_, word)| word.to_owned());
    let word = last_word(key).filter(|_| nearest(key, known).is_none());
    let places = match places(&|other| other == key) {
        same if !same.is_empty() => same,
        _ => places(&|other| word.is_some() && last_word(other) == word),
    };
    match places.is_empty() {
        true => Err(unknown_name("key", key, known, place)),
        false => Err(Error::config(place, format!("the key `{key}` here"), places.join(", "))),
    }
}

/// Where in a configuration keys may stand that are wanted.
fn places(wanted: &dyn Fn(&str) -> bool) -> Vec<String> {
    let keys = TABLES.iter().flat_map(|(table, keys)| keys.iter().map(move |key| (table.replace("[]", "[*]"), *key)));
    keys.filter(|(_, key)| wanted(key)).map(|(table, key)| joined(&table, key)).collect()
}

/// The known name that is nearest in spelling, if one is near.
fn nearest<'k>(name: &str, known: &[&'k str]) -> Option<&'k str> {
    let nearest = known.iter().min_by_key(|known| levenshtein(name, known));
    nearest.filter(|known| levenshtein(name, known) <= 2 + known.len() / 4).copied()
}

/// The refusal of a name that is not among the known ones: it says which is nearest in spelling, if one is near; a word that resembles
/// nothing gets the whole list.
pub fn unknown_name(what: &str, name: &str, known: &[&str], place: &str) -> Error {
    let accepted = match nearest(name, known) {
        Some(known) => format!("the nearest known {what} is `{known}`"),
        None => format!("one of {}", known.join(", ")),
    };
    Error::config(place, format!("the unknown {what} `{name}`"), accepted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::plenoxels::config::Config;

    #[test]
    fn the_top_level_keys_are_those_of_the_library() {
        // The library lists its fields when it meets one it does not know.
        let message = toml::from_str::<Config>("zzz = 1").unwrap_err().to_string();
        let listed: Vec<&str> = message.split('`').skip(3).step_by(2).collect();
        assert_eq!(listed, TABLES[0].1, "{message}");
    }

    #[test]
    fn a_misspelled_path_is_answered_with_the_nearest_key() {
        let message = |path: &str| check_path(path, "--set").unwrap_err().to_string();
        assert!(message("stages[0].rezolution").contains("the nearest known key is `resolution`"));
        assert!(message("losses.tv_densty").contains("`tv_density`"));
        assert!(message("zzzzzzzzzz").contains("one of seed, downscale"));
        assert!(message("seed.more").contains("which is no table"));
        assert!(message("stages.0.resolution").contains("stages[0] or stages[*]"));
        assert!(message("resolution").contains("stages[*].resolution, scout.stages[*].resolution, carve.resolution"));
        assert!(message("stages[0].dnsty_rate").contains("the nearest known key is `density_rate`"));
        assert!(message("lerning_rate").contains("stages[*].density_rate, stages[*].color_rate"));
        // However long: each part would take a table in a table.
        let deep = format!("losses.mse{}", ".weight".repeat(20_000));
        assert!(message(&deep).contains("the key `weight` below `losses.mse.weight`, which is no table"));
        assert!(check_path("losses.mse.from", "--set").is_ok());
        assert!(check_path("stages[*].sampling.step", "--set").is_ok());
    }
}
