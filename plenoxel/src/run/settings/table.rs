//! Merging tables and setting paths in them.

use crate::error::{Error, Result};
use toml::{Table, Value};

/// Mutually exclusive keys: setting the first removes the others. They are the two ways to place samples, the two ways to specify the length of
/// a stage, and the two schedules of a loss weight.
const ALTERNATIVES: [(&str, &[&str]); 9] = [
    ("step", &["samples", "far"]),
    ("samples", &["step"]),
    ("far", &["step"]),
    ("epochs", &["steps"]),
    ("steps", &["epochs", "weight", "until"]),
    ("weight", &["from", "to", "steps"]),
    ("until", &["from", "to", "steps"]),
    ("from", &["weight", "until"]),
    ("to", &["weight", "until"]),
];

/// Merges `over` into `base`, key by key: tables are merged, other values and lists are replaced. A table with another `kind` replaces the
/// old table, because the keys of the old kind do not apply to it.
pub fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(old)), Value::Table(new)) if !changes_kind(old, &new) => {
                merge(old, new);
            }
            (_, value) => insert(base, &key, value),
        }
    }
}

/// Sets the value at a path such as `stages[0].sampling.step`; `[*]` means every entry of a list. `None` removes the key.
///
/// Errors: an index is out of range; a list lacks an index, or a table has one. The message begins with `place`.
pub fn set(table: &mut Table, path: &str, value: Option<&Value>, place: &str) -> Result<()> {
    let (segment, rest) = match path.split_once('.') {
        Some((segment, rest)) => (segment, Some(rest)),
        None => (path, None),
    };
    let Some((name, index)) = segment.split_once('[') else {
        let Some(rest) = rest else {
            match value {
                Some(value) => {
                    // The other keys do not apply to another kind.
                    if segment == "kind" && table.get(segment) != Some(value) {
                        table.clear();
                    }
                    insert(table, segment, value.clone());
                }
                None => drop(table.remove(segment)),
            }
            return Ok(());
        };
        let inner = table.entry(segment).or_insert_with(|| Value::Table(Table::new()));
        // A table replaces a number: `losses.tv.from` where `losses.tv` was a constant weight.
        if !inner.is_table() && !inner.is_array() {
            *inner = Value::Table(Table::new());
        }
        let found = format!("`{segment}` is a list");
        return match inner.as_table_mut() {
            Some(inner) => set(inner, rest, value, place),
            None => Err(Error::usage(place, found, format!("add an index, as in {segment}[0].{rest} or {segment}[*].{rest}"))),
        };
    };
    let length = table.get(name).and_then(Value::as_array).map_or(0, Vec::len);
    let none = |found: String| match length {
        0 => Error::usage(
            place,
            format!("{found} has an index, but `{name}` is not a list with entries"),
            format!("set `{name}` without an index"),
        ),
        n => Error::usage(place, format!("{found} is out of range"), format!("expected {name}[0] to {name}[{}], or {name}[*]", n - 1)),
    };
    let index = index.trim_end_matches(']');
    let entries = match index {
        "*" => 0..length,
        index => {
            let index: Option<usize> = index.parse().ok().filter(|index| *index < length);
            index.map_or(0..0, |index| index..index + 1)
        }
    };
    if entries.is_empty() {
        return Err(none(format!("`{segment}`")));
    }
    let list = table.get_mut(name).and_then(Value::as_array_mut);
    for entry in list.into_iter().flat_map(|list| &mut list[entries.clone()]) {
        match (rest, entry, value) {
            (Some(rest), Value::Table(inner), value) => set(inner, rest, value, place)?,
            (None, entry, Some(value)) => *entry = value.clone(),
            _ => {
                return Err(Error::usage(
                    place,
                    format!("`{path}` has no such key, or no value"),
                    format!("set a key of a table, or a value for {name}[{index}]"),
                ));
            }
        }
    }
    Ok(())
}

fn insert(table: &mut Table, key: &str, value: Value) {
    for (_, others) in ALTERNATIVES.iter().filter(|(name, _)| *name == key) {
        others.iter().for_each(|other| drop(table.remove(*other)));
    }
    table.insert(key.to_owned(), value);
}

fn changes_kind(old: &Table, new: &Table) -> bool {
    new.get("kind").is_some_and(|kind| old.get("kind") != Some(kind))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> Table {
        text.parse().unwrap()
    }

    #[test]
    fn tables_are_merged_and_lists_are_replaced() {
        let mut base = table("a = 1\nb = [1, 2]\n[c]\nx = 1\ny = 2");
        merge(&mut base, table("b = [3]\n[c]\ny = 5"));
        assert_eq!(base, table("a = 1\nb = [3]\n[c]\nx = 1\ny = 5"));
    }

    #[test]
    fn another_kind_of_optimizer_takes_no_key_of_the_old_one() {
        let mut base = table("[o]\nkind = \"rms_prop\"\nbeta = 0.9");
        merge(&mut base, table("[o]\nkind = \"sgd\""));
        assert_eq!(base, table("[o]\nkind = \"sgd\""));
    }

    #[test]
    fn one_way_to_place_samples_takes_away_the_other() {
        let mut base = table("[e]\nstep = 0.5");
        merge(&mut base, table("[e]\nsamples = 5\nfar = 8.0"));
        assert_eq!(base, table("[e]\nsamples = 5\nfar = 8.0"));
        set(&mut base, "e.step", Some(&Value::Float(0.25)), "").unwrap();
        assert_eq!(base, table("[e]\nstep = 0.25"));
    }

    #[test]
    fn paths_reach_entries_of_lists_and_all_of_them() {
        let mut base = table("[[s]]\nn = 1\nepochs = 2\n[[s]]\nn = 2\nepochs = 2");
        set(&mut base, "s[1].n", Some(&Value::Integer(7)), "").unwrap();
        set(&mut base, "s[*].steps", Some(&Value::Integer(3)), "").unwrap();
        assert_eq!(base, table("[[s]]\nn = 1\nsteps = 3\n[[s]]\nn = 7\nsteps = 3"));
        set(&mut base, "s[0].steps", None, "").unwrap();
        assert_eq!(base, table("[[s]]\nn = 1\n[[s]]\nn = 7\nsteps = 3"));
        let message = |path: &str| {
            let mut base = base.clone();
            let set = set(&mut base, path, Some(&Value::Integer(1)), "--set");
            set.unwrap_err().to_string()
        };
        assert!(message("s[2].n").contains("s[0] to s[1]"), "{}", message("s[2].n"));
        assert!(message("s[18446744073709551615].n").contains("s[0] to s[1]"));
        assert!(message("s.n").contains("s[0].n"), "{}", message("s.n"));
        assert!(message("t[0].n").contains("`t` is not a list"), "{}", message("t[0].n"));
    }

    #[test]
    fn a_schedule_replaces_a_constant_weight() {
        let mut base = table("[losses]\nmse = 1.0");
        set(&mut base, "losses.mse.from", Some(&Value::Float(2.0)), "").unwrap();
        assert_eq!(base, table("[losses]\n[losses.mse]\nfrom = 2.0"));
    }
}
