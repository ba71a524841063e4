//! The output of COLMAP 3.6 and newer, whose lines may begin with the time and place that glog adds.

/// Unit of a progress message of COLMAP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    Image,
    /// A block of the table of all pairs.
    Block,
}

impl Unit {
    pub fn name(self) -> &'static str {
        match self {
            Unit::Image => "image",
            Unit::Block => "block",
        }
    }
}

/// How far a command has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    pub unit: Unit,
    /// Number of the current one, from 1.
    pub at: u32,
    pub total: u32,
}

/// Lines about one image of all.
const IMAGES: [&str; 3] = ["Processed file [", "Matching image [", "Processing image ["];
/// Lines about a block of all pairs, by its row and column.
const BLOCKS: [&str; 2] = ["Matching block [", "Processing block ["];

/// Returns the position that a line states. The mapper does not know how many images it will place: the total is then that of all `photos`.
pub fn position(line: &str, photos: usize) -> Option<Position> {
    let after = |marks: &[&str]| marks.iter().find_map(|mark| Some(line.split_once(mark)?.1));
    if let Some(rest) = after(&IMAGES) {
        let (at, total) = fraction(rest)?;
        return place(Unit::Image, at, total);
    }
    if let Some(rest) = after(&BLOCKS) {
        let (row, column) = rest.split_once(", ")?;
        let ((row, rows), (column, columns)) = (fraction(row)?, fraction(column)?);
        return place(Unit::Block, row.checked_sub(1)? * columns + column, rows * columns);
    }
    // "Registering image #17 (5)" is the fifth image; "(num_reg_frames=4)" comes after four.
    let count = after(&["Registering image #"])?.split_once('(')?.1;
    let at = match count.strip_prefix("num_reg_frames=") {
        Some(before) => leading_number(before)? + 1,
        None => leading_number(count)?,
    };
    place(Unit::Image, at.min(photos as u64), photos as u64)
}

/// Returns the message of a line that is an error: `ERROR: MESSAGE`, or the form of glog, `E0703 12:00:00.123456 77 file.cc:33] MESSAGE`.
pub fn error(line: &str) -> Option<&str> {
    if let Some(message) = line.trim_start().strip_prefix("ERROR: ") {
        return Some(message);
    }
    let stamped = line.strip_prefix(['E', 'F']).is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()));
    line.split_once("] ").filter(|_| stamped).map(|(_, message)| message)
}

/// Returns true if the mapper says that no model came about, which is no failure of the program.
pub fn is_without_model(line: &str) -> bool {
    ["failed to create sparse model", "No images with matches found"].iter().any(|said| line.contains(said))
}

fn place(unit: Unit, at: u64, total: u64) -> Option<Position> {
    // More cannot be meant, and would overflow in products.
    let total = u32::try_from(total).ok()?;
    let at = u32::try_from(at).ok().filter(|at| (1..=total).contains(at))?;
    Some(Position { unit, at, total })
}

/// Parses the beginning of a text as `at/total`.
fn fraction(text: &str) -> Option<(u64, u64)> {
    let (at, total) = text.split_once('/')?;
    Some((leading_number(at)?, leading_number(total)?))
}

/// Parses the number at the beginning of a text. Products of two do not overflow.
fn leading_number(text: &str) -> Option<u64> {
    let digits = text.split(|c: char| !c.is_ascii_digit()).next().unwrap_or_default();
    digits.parse::<u32>().ok().map(u64::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_old_and_new_versions_state_the_same_positions() {
        let at = |unit, at, total| Some(Position { unit, at, total });
        for (line, expected) in [
            ("Processed file [3/50]", at(Unit::Image, 3, 50)),
            ("I20250102 03:04:05.678901 12 feature_extraction.cc:258] Processed file [50/50]", at(Unit::Image, 50, 50)),
            ("Matching block [2/8, 3/8] in 12.345s", at(Unit::Block, 11, 64)),
            ("I20250102 03:04:05.678901 12 pairing.cc:168] Processing block [8/8, 8/8]", at(Unit::Block, 64, 64)),
            ("Matching image [7/300] in 0.100s", at(Unit::Image, 7, 300)),
            ("I20250102 03:04:05.678901 12 pairing.cc:399] Processing image [7/300]", at(Unit::Image, 7, 300)),
            ("Registering image #17 (5)", at(Unit::Image, 5, 50)),
            ("I20250102 03:04:05.678901 12 incremental_pipeline.cc:486] Registering image #17 (num_reg_frames=4)", at(Unit::Image, 5, 50)),
            ("Registering image #17 (51)", at(Unit::Image, 50, 50)),
        ] {
            assert_eq!(position(line, 50), expected, "{line}");
        }
    }

    #[test]
    fn other_lines_and_damaged_ones_state_no_position() {
        let large = format!("Matching block [{0}/{0}, {0}/{0}]", u32::MAX);
        for line in [
            "",
            "  => Image sees 345 / 1234 points",
            "Processed file [",
            "Processed file [x/50]",
            "Processed file [3]",
            "Processed file [0/50]",
            "Processed file [51/50]",
            "Processed file [99999999999/99999999999]",
            "Matching block [1/8]",
            "Matching block [0/0, 0/0]",
            "Matching block [9/8, 9/8]",
            "Registering image #17",
            "Registering image #17 (",
            "Registering image #17 (0)",
            "Registering initial image pair #1 and #2",
        ] {
            assert_eq!(position(line, 50), None, "{line}");
        }
        assert_eq!(position("Registering image #17 (5)", 0), None);
        assert_eq!(position(&large, 50), None);
    }

    #[test]
    fn errors_are_told_from_what_is_only_reported() {
        assert_eq!(
            error("ERROR: Failed to parse options - unrecognised option '--x'."),
            Some("Failed to parse options - unrecognised option '--x'.")
        );
        assert_eq!(error("F0102 03:04:05.678901    12 sqlite3_utils.h:60] SQLite error: disk full"), Some("SQLite error: disk full"));
        assert_eq!(error("E20250102 03:04:05.678901 12 sfm.cc:311] failed to create sparse model"), Some("failed to create sparse model"));
        for line in ["I20250102 03:04:05.678901 12 sfm.cc:311] done", "Elapsed time: 4.479 [minutes]", "Export [1] done", ""] {
            assert_eq!(error(line), None, "{line}");
        }
        assert!(is_without_model("ERROR: failed to create sparse model") && !is_without_model("Elapsed time: 0.1 [minutes]"));
    }
}
