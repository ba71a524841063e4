//! The table as Markdown.

use super::{Cell, RunTable, Scores, beside, decibels};
use plenoxel::text::one_line;

pub fn text(table: &RunTable) -> String {
    let mut text = format!("# {}\n\n", as_text(&table.title));
    let published = table.published.iter().map(|p| format!("{} (published)", p.name));
    let heads: Vec<String> = ["scene".to_owned()].into_iter().chain(table.methods.iter().cloned()).chain(published).collect();
    text += &line(heads.iter().map(|head| as_text(head)));
    text += &line(heads.iter().map(|_| "---".to_owned()));
    for row in &table.rows {
        let measured = row.cells.iter().map(cell);
        let published = table.published.iter().map(|p| scores(&p.scores(&row.scene)));
        text += &line([as_text(&row.scene)].into_iter().chain(measured).chain(published));
    }
    for (name, measured, published) in table.summaries() {
        text += &line([name.to_owned()].into_iter().chain(measured.iter().chain(&published).map(scores)));
    }
    text += "\n";
    table.notes().iter().for_each(|note| text += &format!("- {}\n", as_text(note)));
    text
}

fn line(cells: impl Iterator<Item = String>) -> String {
    format!("| {} |\n", cells.collect::<Vec<_>>().join(" | "))
}

fn cell(cell: &Cell) -> String {
    match cell {
        Cell::Failed(failure) => format!("failed ({})", failure.code),
        cell => scores(&cell.scores()),
    }
}

fn scores(scores: &Scores) -> String {
    if *scores == Scores::default() {
        return "–".to_owned();
    }
    format!("**{}** · {}", decibels(scores.psnr), beside(scores))
}

/// Escapes text for a line of Markdown, so that it has no markup, HTML, cell borders or characters that control a terminal.
pub fn as_text(text: &str) -> String {
    let text = one_line(&text.split_whitespace().collect::<Vec<_>>().join(" "));
    let mut shown = String::with_capacity(text.len());
    let mut before = None;
    let mut all = text.chars().peekable();
    while let Some(c) = all.next() {
        let of_word = |other: Option<char>| other.is_some_and(char::is_alphanumeric);
        let next = all.peek().copied();
        let markup = match c {
            '_' => !(of_word(before) && of_word(next)),
            '&' => next == Some('#') || of_word(next),
            c => "\\|<>`*[]~".contains(c),
        };
        if markup {
            shown.push('\\');
        }
        shown.push(c);
        before = Some(c);
    }
    shown
}
