//! Writes the valid inputs that fuzzing begins from into `corpus/`.

use plenoxel_fuzz::parsers::PARSERS;
use std::fs;
use std::path::Path;

/// The target of each parser.
const TARGETS: [&str; PARSERS.len()] = ["transforms", "png", "ply", "checkpoint", "state", "config", "assignments", "metrics", "record"];

fn main() -> std::io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    for (parser, target) in PARSERS.iter().zip(TARGETS) {
        let folder = corpus.join(target);
        fs::create_dir_all(&folder)?;
        for (i, bytes) in (parser.valid)().iter().enumerate() {
            fs::write(folder.join(format!("valid-{i}")), bytes)?;
        }
    }
    let folder = corpus.join("arguments");
    fs::create_dir_all(&folder)?;
    for (i, line) in
        ["train data --time 5m --max-memory 8GiB", "filter a --out b --bbox 0,0,0,1,1,1", "train --scene-size 32x24"].iter().enumerate()
    {
        fs::write(folder.join(format!("valid-{i}")), line.replace(' ', "\n"))?;
    }
    Ok(())
}
