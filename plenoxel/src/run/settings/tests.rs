use super::*;
use std::collections::BTreeSet;

fn preset(name: &str) -> Layers {
    Layers::defaults().unwrap().with_preset(name).unwrap()
}

fn presets() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().chain([&CARVE]).map(|preset| preset.name)
}

/// Settings that no preset has, so that every key has a value.
const RARE: [&str; 11] = [
    "prune_from_stage = 1",
    "init_from = \"run\"",
    "stages = [{ resolution = 8, steps = 5, sampling = { step = 1.0 }, density_rate = 1.0, color_rate = 0.1 }]",
    "stages[0].harmonics_rate = 0.1",
    "stages[0].density_warm_up = 2",
    "stages[0].color_decay = 0.5",
    "carve.photo.noise = 0.1",
    "optimizer = { kind = \"momentum\", decay = 0.9 }",
    "losses.huber = 1",
    "losses.beta = { weight = 1e-3, until = 5 }",
    "losses.sparsity = { from = 1e-3, to = 1e-4, steps = 5 }",
];

/// The complete configuration of each preset, and one with the remaining keys, as layers.
fn complete() -> Vec<Layers> {
    let rare = |name| {
        let mut layers = preset(name);
        RARE.iter().try_for_each(|assignment| layers.assign(assignment)).unwrap();
        layers
    };
    let layers = presets().map(preset).chain([rare("voxels")]);
    layers.inspect(|layers| assert!(layers.clone().resolve().is_ok())).collect()
}

/// The path and the value of each leaf that no configuration before had: numbers of a list aside, each once.
fn all_leaves() -> Vec<(Layers, String, Value)> {
    let mut known = BTreeSet::new();
    let mut found = Vec::new();
    for layers in complete() {
        let table: Table = to_toml(&layers.clone().resolve().unwrap(), "").unwrap().parse().unwrap();
        leaves("", &Value::Table(table.clone()), &mut |path, _| {
            let general: String = path.chars().filter(|c| !c.is_ascii_digit() || !path.contains('[')).collect();
            let steps = path.split(['.', '[']).map(|step| step.trim_end_matches(']'));
            let value = steps.fold(Value::Table(table.clone()), |value, step| match step.parse::<usize>() {
                Ok(index) => value[index].clone(),
                Err(_) => value[step].clone(),
            });
            if known.insert((general, value.type_str())) {
                found.push((layers.clone(), path.to_owned(), value));
            }
        });
    }
    found
}

fn refusal(assignments: &[&str]) -> String {
    let mut layers = preset("paper");
    let set = assignments.iter().try_for_each(|a| layers.assign(a));
    set.and_then(|()| layers.resolve()).unwrap_err().to_string()
}

#[test]
fn every_preset_is_a_valid_configuration_that_survives_its_file() {
    let path = std::env::temp_dir().join(format!("plenoxel-config-{}", std::process::id()));
    for name in presets() {
        let config = preset(name).resolve().unwrap();
        write(&path, &config, name).unwrap();
        assert_eq!(ConfigFile::read(&path).unwrap().complete().unwrap(), config, "{name}");
        assert_eq!((Config::read(&path).unwrap(), Config::preset(name).unwrap()), (config.clone(), config.clone()), "{name}");
        let (again, from) = layered(None, "demo", Some(&path), |_| Ok(())).unwrap();
        assert!(again == config && from.is_none(), "{name}");
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
    assert_eq!(ConfigFile::read(&path).unwrap().complete().unwrap(), config);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_text_that_is_not_complete_is_a_layer_over_the_defaults() {
    assert_eq!(Config::from_toml("").unwrap(), Config::default());
    assert_eq!(Config::from_toml("seed = 7").unwrap(), Config { seed: 7, ..Config::default() });
    let mut layers = preset("voxels");
    ["losses.mse=", "losses.huber=1"].iter().try_for_each(|assignment| layers.assign(assignment)).unwrap();
    let complete = layers.resolve().unwrap();
    assert_eq!(Config::from_toml(&text_of(&complete)).unwrap(), complete, "nothing of the defaults is under a complete text");
    let message = Config::from_toml("seed = 1\nsede = 2").unwrap_err().to_string();
    assert!(message.starts_with("the settings, line 2: unknown key `sede`"), "{message}");
    let message = Config::from_toml("preset = \"fast\"").unwrap_err().to_string();
    assert!(message.contains("unknown key `preset`"), "{message}");
    assert!(Config::preset("fats").unwrap_err().to_string().contains("fast, quality"));
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
    assert!(message.starts_with("--set stages[1].density_rate: invalid value -1; expected "), "{message}");
    let message = refusal(&["stages[*].density_rate=-1"]);
    assert!(message.starts_with("stages[0].density_rate (--set stages[*].density_rate): invalid value -1"), "{message}");
    let message = refusal(&["half_width=wide"]);
    assert!(message.starts_with("--set half_width") && message.contains("invalid value \"wide\"; expected a number"), "{message}");
    let message = refusal(&["evaluation={samples=5}"]);
    assert!(message.starts_with("--set evaluation") && message.contains("far ="), "{message}");
    let message = refusal(&["losses.mse=often"]);
    assert!(message.contains("a number, { weight = ") && message.contains("{ from = "), "{message}");
    // An entry of a list is named by its number.
    let message = refusal(&["stages[2].color_rate=fast", "stages[3].color_rate=0.1"]);
    assert!(message.starts_with("--set stages[2].color_rate: invalid value \"fast\"; expected a number"), "{message}");
    let message = refusal(&["optimizer.kind=momentum"]);
    assert!(message.contains("the key `decay` is missing") && message.contains("--set optimizer.kind"), "{message}");
    assert!(refusal(&["stages"]).contains("key=value"));
}

#[test]
fn an_unknown_key_in_a_file_is_reported_with_its_line() {
    let path = std::env::temp_dir().join(format!("plenoxel-unknown-{}.toml", std::process::id()));
    std::fs::write(&path, "seed = 1\n\n[initial]\ndensitty = 1\n").unwrap();
    let message = preset("paper").file(&ConfigFile::read(&path).unwrap()).unwrap_err().to_string();
    assert!(message.contains(", line 4: unknown key `densitty`"), "{message}");
    assert!(message.contains("did you mean `density`?"), "{message}");
    std::fs::write(&path, "seed = 1\nhalf_width = = 2\n").unwrap();
    let error = ConfigFile::read(&path).unwrap_err();
    assert!(error.exit_code() == 3 && error.to_string().contains("line 2 is not valid TOML"), "{error}");
    std::fs::write(&path, "seed = 1\nhalf_width = -2\n").unwrap();
    let mut layers = preset("paper");
    layers.file(&ConfigFile::read(&path).unwrap()).unwrap();
    let message = layers.resolve().unwrap_err().to_string();
    assert!(message.starts_with("half_width (") && message.contains("line 2): invalid value -2"), "{message}");
    std::fs::remove_file(path).unwrap();
}

#[test]
fn nothing_shines_through_a_complete_file() {
    let path = std::env::temp_dir().join(format!("plenoxel-complete-{}", std::process::id()));
    let mut layers = preset("voxels");
    // The defaults have this loss, and the preset a scout.
    ["losses.mse=", "losses.huber=1", "scout="].iter().try_for_each(|assignment| layers.assign(assignment)).unwrap();
    let config = layers.resolve().unwrap();
    write(&path, &config, "two\nlines").unwrap();
    assert_eq!(layered(None, "demo", Some(&path), |_| Ok(())).unwrap().0, config);
    std::fs::remove_file(path).unwrap();
}

#[test]
fn each_key_of_each_preset_misspelled_is_refused_with_the_right_one() {
    for mut layers in complete() {
        let table: Table = to_toml(&layers.clone().resolve().unwrap(), "").unwrap().parse().unwrap();
        let mut paths = BTreeSet::new();
        leaves("", &Value::Table(table), &mut |path, _| {
            paths.insert(path.to_owned());
        });
        assert!(paths.len() > 30, "{paths:?}");
        for path in paths {
            let steps: Vec<&str> = path.split('.').collect();
            for at in 0..steps.len() {
                let (name, index) = steps[at].split_at(steps[at].find('[').unwrap_or(steps[at].len()));
                let capital = name[..1].to_uppercase() + &name[1..];
                for wrong in [format!("{}{name}", &name[..1]), capital, name.replacen('_', "-", 1)] {
                    if wrong == name {
                        continue;
                    }
                    let misspelled = format!("{wrong}{index}");
                    let path = [&steps[..at], &[&misspelled], &steps[at + 1..]].concat().join(".");
                    let parts = [format!("unknown key `{wrong}`"), format!("did you mean `{name}`?")];
                    let refused = |error: Error, place: &str| {
                        let message = error.to_string();
                        assert!(message.starts_with(place) && parts.iter().all(|part| message.contains(part)), "{path}: {message}");
                        assert_eq!(error.exit_code(), 2, "{message}");
                    };
                    refused(layers.assign(&format!("{path}=1")).unwrap_err(), &format!("--set {path}: "));
                    let file = ConfigFile::parse(Path::new("my.toml"), in_a_file(&path).as_bytes()).unwrap();
                    refused(layers.file(&file).unwrap_err(), "my.toml, line 3: ");
                }
            }
        }
    }
}

/// A text that sets a path to 1 on its third line.
fn in_a_file(path: &str) -> String {
    let nested = path.rsplit('.').fold("1".to_owned(), |inner, step| {
        let value = if inner == "1" { inner } else { format!("{{ {inner} }}") };
        match step.split_once('[') {
            Some((name, index)) => {
                let before = "{}, ".repeat(index.trim_end_matches(']').parse().unwrap());
                format!("{name} = [{before}{value}]")
            }
            None => format!("{step} = {value}"),
        }
    });
    format!("# a remark\nseed = 1\n{nested}\n")
}

#[test]
fn a_flag_without_effect_on_the_model_is_refused_even_with_the_default_value() {
    let ngp = || Layers::defaults().unwrap().with_preset("ngp").unwrap();
    for (assignment, key) in [("sh_degree=2", "sh_degree"), ("optimizer.beta1=0.9", "optimizer")] {
        let mut layers = ngp();
        layers.assign(assignment).unwrap();
        let message = layers.resolve().unwrap_err().to_string();
        assert!(message.contains(key) && message.contains("no effect on the model `ngp`"), "{message}");
    }
    // The complete file of a run has every key.
    let mut layers = Layers::default();
    layers.file(&ConfigFile::parse(Path::new("my.toml"), text_of(&ngp().resolve().unwrap()).as_bytes()).unwrap()).unwrap();
    assert!(layers.resolve().is_ok());
}

#[test]
fn each_value_out_of_range_or_of_another_type_is_refused_by_the_name_of_its_key() {
    const NUMBERS: [&str; 16] = [
        "-1",
        "0",
        "1",
        "-0.5",
        "1.5",
        "1e300",
        "-1e300",
        "1e-300",
        "nan",
        "-nan",
        "inf",
        "-inf",
        "1000000000",
        "9223372036854775807",
        "9223372036854775808",
        "340282366920938463463374607431768211456",
    ];
    const OTHERS: [&str; 10] = ["wide", "\"\"", "\"1\"", "true", "[]", "[1, 2]", "{}", "{ seed = 1 }", "1979-05-27", "[[[[]]]]"];
    let (mut accepted, mut refused) = (0, 0);
    for (layers, path, value) in all_leaves() {
        for text in NUMBERS.iter().chain(&OTHERS) {
            let mut layers = layers.clone();
            let resolved = layers.assign(&format!("{path} = {text}")).and_then(|()| layers.resolve());
            let is_number = value.is_integer() || value.is_float();
            match resolved {
                // Another kind of value is one that the key takes: a weight may be a table, a number where a number was.
                Ok(config) => {
                    assert!(is_number && NUMBERS.contains(text) || is_another_form(&path, text), "{path} = {text} was accepted");
                    let again = text_of(&config);
                    assert_eq!(toml::from_str::<Config>(&again).unwrap(), config, "{path} = {text} does not survive its file");
                    accepted += 1;
                }
                Err(error) => {
                    let message = error.to_string();
                    assert!(error.exit_code() == 2 && message.contains(&path), "{path} = {text}: {message}");
                    assert!(message.len() < 500, "{path} = {text}: {message}");
                    refused += 1;
                }
            }
        }
        let mut layers = layers;
        // Without it, it is optional, or missed by name.
        let removed = layers.assign(&format!("{path}=")).and_then(|()| layers.resolve());
        let last = path.rsplit('.').next().unwrap();
        removed.err().into_iter().for_each(|e| assert!(e.to_string().contains(last), "{path}: {e}"));
    }
    assert!(accepted > 200 && refused > 1000, "{accepted} {refused}");
}

fn text_of(config: &Config) -> String {
    to_toml(config, "").unwrap()
}

/// True for values of another type that a key also accepts.
fn is_another_form(path: &str, text: &str) -> bool {
    let flags = ["aim", "jitter", "project", "initial.random", "tensorf.lazy", "tensorf.compact_groups"];
    text == "true" && (flags.contains(&path) || path.ends_with(".mixed_precision"))
        || path == "stages" && text == "[]"
        || path == "capture.scale" && text.parse::<f64>().is_ok()
        || path == "init_from" && text != "\"\""
}
