//! The table as an HTML page with a picture in each cell.

use super::thumbnail::{self, Thumbnails};
use super::{Cell, Row, RunTable, Scores, beside, decibels};
use crate::html::{escaped, page, picture};

/// Largest size of a picture in pixels.
const LARGEST: [u32; 2] = [200, 200];

const STYLE: &str = "\
td { vertical-align: bottom; }
td img, th img { width: 200px; height: 200px; object-fit: contain; object-position: left bottom; margin-bottom: .4rem; }
.psnr { font-size: 1.5rem; line-height: 1.2; font-variant-numeric: tabular-nums; }
.best { font-weight: 700; color: light-dark(#06603a, #7fdca9); }
.published, .published .psnr { font-style: italic; }
.failed { color: light-dark(#a01818, #ff9a8f); max-width: 200px; overflow-wrap: anywhere; }
tr.mean > * { border-top: 2px solid #888; }
";

pub fn text(table: &RunTable) -> String {
    let mut body = "<div class=\"scroll\"><table>\n<tr><th>scene</th>".to_owned();
    table.methods.iter().for_each(|method| body += &format!("<th>{}</th>", escaped(method)));
    for published in &table.published {
        body +=
            &format!("<th class=\"published\">{}<div class=\"small\">published, not measured here</div></th>", escaped(&published.name));
    }
    body += "</tr>\n";
    for row in &table.rows {
        let pictures: Vec<Thumbnails> = row.cells.iter().map(|cell| cell.measured().map(thumbnail::of).unwrap_or_default()).collect();
        let target = pictures.iter().find_map(|pictures| pictures.target.as_ref());
        let target = target.map_or(String::new(), |of| picture(of, LARGEST, &format!("photograph of {}", row.scene)));
        body += &format!("<tr><th>{target}{}</th>", escaped(&row.scene));
        let best = highest(row.cells.iter().map(Cell::scores)).filter(|_| row.is_comparable());
        for ((method, cell), pictures) in table.methods.iter().zip(&row.cells).zip(&pictures) {
            let render = pictures.render.as_ref();
            let render = render.map_or(String::new(), |of| picture(of, LARGEST, &format!("{} by {method}", row.scene)));
            body += &match cell {
                Cell::Failed(failure) => format!(
                    "<td class=\"failed\">failed with exit code {}<div class=\"small\">{}</div></td>",
                    failure.code,
                    escaped(&failure.error)
                ),
                cell => format!("<td>{render}{}</td>", scores(&cell.scores(), best)),
            };
        }
        for published in &table.published {
            body += &format!("<td class=\"published\">{}</td>", scores(&published.scores(&row.scene), None));
        }
        body += "</tr>\n";
    }
    if table.rows.len() > 1 {
        body += "<tr class=\"mean\"><th>mean</th>";
        let means: Vec<Scores> = (0..table.methods.len()).map(|method| table.mean(method)).collect();
        let best = highest(means.iter().copied()).filter(|_| table.rows.iter().all(Row::is_comparable));
        means.iter().for_each(|mean| body += &format!("<td>{}</td>", scores(mean, best)));
        for published in &table.published {
            body += &format!("<td class=\"published\">{}</td>", scores(&table.published_mean(published), None));
        }
        body += "</tr>\n";
    }
    body += "</table></div>\n<ul class=\"small\">\n";
    table.notes().iter().for_each(|note| body += &format!("<li>{}</li>\n", escaped(note)));
    body += "</ul>\n";
    page(&table.title, STYLE, &body)
}

/// The highest PSNR, if there are several.
fn highest(scores: impl Iterator<Item = Scores>) -> Option<f64> {
    let psnr: Vec<f64> = scores.filter_map(|scores| scores.psnr).collect();
    psnr.iter().copied().reduce(f64::max).filter(|_| psnr.len() > 1)
}

/// Formats the results of a cell, with a large PSNR. `best` is the highest PSNR of the row.
fn scores(scores: &Scores, best: Option<f64>) -> String {
    if *scores == Scores::default() {
        return "–".to_owned();
    }
    let class = if scores.psnr.is_some() && scores.psnr == best { "psnr best" } else { "psnr" };
    format!("<div class=\"{class}\">{}</div><div class=\"small\">{}</div>", decibels(scores.psnr), beside(scores))
}
