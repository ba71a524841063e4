//! The keys of a configuration. A misspelled key is an error that suggests the correct one.

use crate::error::{Error, Result};
use crate::model::plenoxels::{LEARNED_LOSSES, LOSSES};
use crate::model::{dvgo, nerf, ngp, tensorf};
use serde::Serialize;
use std::sync::LazyLock;
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

/// The two encodings of directions.
const DIRECTIONS: &[&str] = &["frequency", "harmonics"];

/// The keys of a stage of a model whose resolution grows.
const GROWING: &[&str] = &["resolution", "steps", "rays"];

/// The tables of the run and of the voxel grid with their keys. In a path, `[]` stands for any index and `*` for any name.
const FIXED: &[(&str, &[&str])] = &[
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
            "group_in_pictures",
            "rays_per_step",
            "contrast_floor",
            "patch_size",
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
            "tensorf",
            "dvgo",
            "nerf",
            "ngp",
            "capture",
        ],
    ),
    ("capture", &["format", "space", "orient", "center", "scale", "test_every"]),
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
    ("tensorf.directions", DIRECTIONS),
    ("tensorf.short", &["below", "hidden", "group", "cost"]),
    ("tensorf.stages[]", GROWING),
    ("dvgo.directions", DIRECTIONS),
    ("dvgo.coarse", GROWING),
    ("dvgo.fine[]", GROWING),
    ("ngp.directions", DIRECTIONS),
    ("ngp.stages[]", &["steps", "rays"]),
];

/// Every table with its keys: [`FIXED`], and the settings of the other models, whose keys are those of their defaults.
static TABLES: LazyLock<Vec<(&str, Vec<String>)>> = LazyLock::new(|| {
    let fixed = FIXED.iter().map(|(table, keys)| (*table, keys.iter().map(|key| (*key).to_owned()).collect()));
    let of_models = [
        // The defaults lack `short` and `former_lengths`. `opaque_steps` is `frozen_steps` in the files of earlier runs.
        (
            tensorf::KIND,
            [keys_of(&tensorf::Config::default()), ["short", "former_lengths", "opaque_steps"].map(str::to_owned).to_vec()].concat(),
        ),
        (dvgo::KIND, keys_of(&dvgo::Config::default())),
        // The defaults lack `near_far`.
        (nerf::KIND, keys_of(&nerf::Config::authors())),
        (ngp::KIND, keys_of(&ngp::Config::default())),
    ];
    fixed.chain(of_models).collect()
});

/// Returns the keys of a settings structure.
fn keys_of(settings: &impl Serialize) -> Vec<String> {
    Table::try_from(settings).map(|table| table.keys().cloned().collect()).unwrap_or_default()
}

/// Checks every key of a table and of its nested tables. `place(path)` names the place where a path was set.
///
/// Errors: a key is unknown; the message names its place and similar known keys.
pub fn check_table(table: &Table, place: &dyn Fn(&str) -> String) -> Result<()> {
    walk("", "", &Value::Table(table.clone()), place)
}

/// Checks a path such as `stages[0].sampling.step`. `place` names the place where it was set.
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
        // Any name, without nested tables.
        (Some(start), _) => pattern.strip_prefix(start).is_some_and(|name| !name.contains(['.', '['])),
        (None, same) => same,
    };
    let known = TABLES.iter().find(|(table, _)| fits(table));
    // A damaged file may have keys of any length, which are neither printed nor compared completely.
    let key = key.char_indices().nth(60).map_or(key, |(end, _)| &key[..end]);
    let is_list = TABLES.iter().any(|(table, _)| table.strip_suffix("[]") == Some(pattern));
    let Some((_, known)) = known else {
        if is_list {
            let found = format!("`{pattern}` is a list, so the key `{key}` needs an index");
            return Err(Error::usage(place, found, format!("use {pattern}[0] or {pattern}[*] with --set, [[{pattern}]] in a file")));
        }
        let found = format!("`{pattern}` is not a table, so it has no key `{key}`");
        return Err(Error::usage(place, found, format!("set `{pattern}` itself")));
    };
    let known: Vec<&str> = known.iter().map(String::as_str).collect();
    if known.contains(&key) {
        return Ok(());
    }
    // Suggestions: the same key in other tables, a key of similar spelling, keys that end in the same word.
    let last_word = |key: &str| key.rsplit_once('_').map(|(_, word)| word.to_owned());
    let word = last_word(key).filter(|_| nearest(key, &known).is_none());
    let places = match places(&|other| other == key) {
        same if !same.is_empty() => same,
        _ => places(&|other| word.is_some() && last_word(other) == word),
    };
    match places.is_empty() {
        true => Err(unknown_name("key", key, &known, place)),
        false => Err(Error::usage(place, format!("unknown key `{key}`"), format!("similar keys elsewhere: {}", places.join(", ")))),
    }
}

/// The full paths of the known keys that `wanted` selects.
fn places(wanted: &dyn Fn(&str) -> bool) -> Vec<String> {
    let keys = TABLES.iter().flat_map(|(table, keys)| keys.iter().map(move |key| (table.replace("[]", "[*]"), key.as_str())));
    keys.filter(|(_, key)| wanted(key)).map(|(table, key)| joined(&table, key)).collect()
}

/// The known name with the most similar spelling, if one is similar enough.
fn nearest<'k>(name: &str, known: &[&'k str]) -> Option<&'k str> {
    let nearest = known.iter().min_by_key(|known| levenshtein(name, known));
    // In a short word, a few changed letters make another word.
    let most = |known: &str| (2 + known.len() / 4).min(known.len().min(name.len()).div_ceil(3));
    nearest.filter(|known| levenshtein(name, known) <= most(known)).copied()
}

/// The error for an unknown name. It suggests the known name of the most similar spelling, or lists all known names if none is similar.
pub fn unknown_name(what: &str, name: &str, known: &[&str], place: &str) -> Error {
    let remedy = match nearest(name, known) {
        Some(known) => format!("did you mean `{known}`?"),
        None => format!("expected one of {}", known.join(", ")),
    };
    Error::usage(place, format!("unknown {what} `{name}`"), remedy)
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
        assert!(message("stages[0].rezolution").contains("did you mean `resolution`?"));
        assert!(message("losses.tv_densty").contains("`tv_density`"));
        assert!(message("zzzzzzzzzz").contains("expected one of seed, downscale"));
        assert!(message("seed.more").contains("`seed` is not a table"));
        // A short word that resembles nothing gets the whole list.
        assert!(message("foo").contains("expected one of seed, downscale"));
        assert!(message("stages.0.resolution").contains("stages[0] or stages[*]"));
        assert!(message("resolution").contains("stages[*].resolution, scout.stages[*].resolution, carve.resolution"));
        assert!(message("stages[0].dnsty_rate").contains("did you mean `density_rate`?"));
        assert!(message("lerning_rate").contains("stages[*].density_rate, stages[*].color_rate"));
        // A path of any length: each part would need a nested table.
        let deep = format!("losses.mse{}", ".weight".repeat(20_000));
        assert!(message(&deep).contains("`losses.mse.weight` is not a table, so it has no key `weight`"));
        assert!(check_path("losses.mse.from", "--set").is_ok());
        assert!(check_path("stages[*].sampling.step", "--set").is_ok());
    }
}
