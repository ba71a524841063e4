//! The table in long form as CSV: one line per run, with all results.

use super::figures::Figures;
use super::{Cell, RunTable};
use crate::commands::background_name;
use std::fmt::Display;

const HEADS: &str = "scene,method,state,psnr,ssim,ssim_same,seconds,rays,steps,peak_memory_bytes,voxels,resolution,background,views,\
                     width,height,exit_code,error,run\n";

pub fn text(table: &RunTable) -> String {
    let mut text = HEADS.to_owned();
    for row in &table.rows {
        for (method, cell) in table.methods.iter().zip(&row.cells) {
            let fields = fields(&row.scene, method, cell);
            text += &fields.iter().map(|field| quoted(field)).collect::<Vec<_>>().join(",");
            text += "\n";
        }
    }
    text
}

fn fields(scene: &str, method: &str, cell: &Cell) -> [String; 19] {
    let none = Figures::default();
    let measured = cell.measured();
    let f = measured.map_or(&none, |measured| &measured.figures);
    let (state, failure) = match cell {
        Cell::Measured(_) => ("finished", None),
        Cell::Failed(failure) => ("failed", Some(failure)),
        Cell::Missing => ("missing", None),
    };
    [
        scene.to_owned(),
        method.to_owned(),
        state.to_owned(),
        text_of(f.psnr),
        text_of(f.ssim),
        text_of(f.ssim_same),
        text_of(f.seconds),
        text_of(f.rays),
        text_of(f.steps),
        text_of(f.peak_memory_bytes),
        text_of(f.voxels),
        text_of(f.resolution),
        text_of(measured.map(|measured| background_name(measured.figures.background))),
        text_of(f.views),
        text_of(f.width),
        text_of(f.height),
        text_of(failure.map(|failure| failure.code)),
        text_of(failure.map(|failure| &failure.error)),
        text_of(measured.map(|measured| measured.folder.path().display())),
    ]
}

/// Formats a value; empty if it is missing.
fn text_of(value: Option<impl Display>) -> String {
    value.map_or(String::new(), |value| value.to_string())
}

/// Formats a field as in RFC 4180: in quotes if it has special characters.
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) { format!("\"{}\"", field.replace('"', "\"\"")) } else { field.to_owned() }
}
