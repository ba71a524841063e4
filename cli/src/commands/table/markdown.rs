//! The table as Markdown, which also reads well as it is.

use super::{Cell, RunTable, Scores, beside, decibels};

pub fn text(table: &RunTable) -> String {
    let mut text = format!("# {}\n\n", plain(&table.title));
    let published = table.published.iter().map(|p| format!("{} (published)", p.name));
    let heads: Vec<String> = ["scene".to_owned()].into_iter().chain(table.methods.iter().cloned()).chain(published).collect();
    text += &line(&heads);
    text += &line(&vec!["---".to_owned(); heads.len()]);
    for row in &table.rows {
        let measured = row.cells.iter().map(cell);
        let published = table.published.iter().map(|p| scores(&p.scores(&row.scene)));
        text += &line(&[row.scene.clone()].into_iter().chain(measured).chain(published).collect::<Vec<_>>());
    }
    if table.rows.len() > 1 {
        let measured = (0..table.methods.len()).map(|method| scores(&table.mean(method)));
        let published = table.published.iter().map(|p| scores(&table.published_mean(p)));
        text += &line(&["mean".to_owned()].into_iter().chain(measured).chain(published).collect::<Vec<_>>());
    }
    text += "\n";
    table.notes().iter().for_each(|note| text += &format!("- {}\n", plain(note)));
    text
}

fn line(cells: &[String]) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| plain(cell)).collect();
    format!("| {} |\n", cells.join(" | "))
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

/// Text on one line that ends no cell.
pub fn plain(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").replace('\\', "\\\\").replace('|', "\\|")
}
