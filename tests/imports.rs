//! Who imports whom: no circle between the modules of a crate, and training and rendering know no field.
//!
//! The listing: `cargo test --test programs imports -- --nocapture`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The source of the modules at the top of a crate, each with the files in its folder; comments and tests are left out.
fn modules(source: &Path) -> BTreeMap<String, String> {
    let mut modules: BTreeMap<String, String> = BTreeMap::new();
    let mut folders = vec![source.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).expect("a folder of the crate").map(|entry| entry.expect("an entry").path()) {
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") && path.file_stem().is_some_and(|stem| stem != "tests") {
                let inside = path.strip_prefix(source).expect("a path below the source");
                let first = inside.components().next().expect("a name").as_os_str().to_string_lossy();
                let name = first.trim_end_matches(".rs").to_owned();
                let text = std::fs::read_to_string(&path).expect("a source file");
                let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
                let code: String = code.lines().filter(|line| !line.trim_start().starts_with("//")).flat_map(|line| [line, "\n"]).collect();
                modules.entry(name).or_default().push_str(&code);
            }
        }
    }
    modules
}

/// The modules at the top of the crate that a source names as `crate::…`.
fn imports(source: &str, all: &BTreeSet<&String>) -> BTreeSet<String> {
    let names = source.split("crate::").skip(1).flat_map(|rest| {
        let list = match rest.strip_prefix('{') {
            Some(list) => list.split('}').next().unwrap_or_default(),
            None => rest,
        };
        let parts = if rest.starts_with('{') { list.split(',').collect() } else { vec![list] };
        parts.into_iter().map(|part| part.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>())
    });
    names.filter(|name| all.contains(name)).collect()
}

fn graph(source: &str) -> BTreeMap<String, BTreeSet<String>> {
    let modules = modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join(source));
    let all: BTreeSet<&String> = modules.keys().collect();
    let edges = modules.iter().map(|(name, source)| {
        let imports = imports(source, &all).into_iter().filter(|import| import != name);
        (name.clone(), imports.collect())
    });
    edges.collect()
}

#[test]
fn no_circle_of_imports_crosses_the_folders_of_the_library() {
    let graph = graph("plenoxel/src");
    for (name, imports) in &graph {
        println!("{name:12} {}", imports.iter().map(String::as_str).collect::<Vec<_>>().join(" "));
    }
    // A module goes when everything that it imports has gone; what is left at the end is in circles.
    let mut left: BTreeMap<&String, BTreeSet<&String>> = graph
        .iter()
        .filter(|(name, _)| *name != "lib")
        .map(|(name, imports)| (name, imports.iter().filter(|i| *i != "lib").collect()))
        .collect();
    loop {
        let free: Vec<&String> = left.iter().filter(|(_, imports)| imports.is_empty()).map(|(name, _)| *name).collect();
        if free.is_empty() {
            break;
        }
        left.retain(|name, _| !free.contains(name));
        left.values_mut().for_each(|imports| imports.retain(|import| !free.contains(import)));
    }
    assert!(left.is_empty(), "circles among {left:?}");
}

#[test]
fn training_and_rendering_know_no_field_and_the_library_no_command_line() {
    let graph = graph("plenoxel/src");
    for (module, strangers) in [
        ("render", ["field", "model", "train", "run", "loss"]),
        ("train", ["field", "model", "carve", "run", "checkpoint"]),
        ("sampling", ["field", "model", "train", "run", "render"]),
    ] {
        let known: Vec<&&str> = strangers.iter().filter(|stranger| graph[module].contains(**stranger)).collect();
        assert!(known.is_empty(), "`{module}` imports {known:?}");
    }
    for (name, source) in modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join("plenoxel/src")) {
        assert!(!source.contains("plenoxel_cli"), "`{name}` imports the command line");
        assert!(!["println!", "eprintln!"].iter().any(|print| source.contains(print)), "`{name}` prints");
    }
    let manifest = include_str!("../plenoxel/Cargo.toml");
    assert!(!manifest.contains("plenoxel-cli"));
}
