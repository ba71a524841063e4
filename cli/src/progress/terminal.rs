//! Line wrapping for terminals.

use indicatif::ProgressDrawTarget;
#[cfg(unix)]
use indicatif::TermLike;
#[cfg(unix)]
use std::io::{self, Write};
use std::path::Path;

/// Free columns at the end of the line of a bar, for the `^C` that a terminal prints at the cursor. A line longer than the terminal could not be
/// cleared.
const FREE: usize = 4;
/// Default number of columns.
const USUAL: usize = 80;

/// Returns the number of columns of the terminal.
pub fn columns() -> usize {
    terminal_size::terminal_size().map_or(USUAL, |(width, _)| usize::from(width.0).max(20))
}

/// Returns the draw target of progress bars: stderr, without the last [`FREE`] columns.
#[cfg(unix)]
pub fn bar_target() -> ProgressDrawTarget {
    ProgressDrawTarget::term_like(Box::new(Narrow))
}

#[cfg(not(unix))]
pub fn bar_target() -> ProgressDrawTarget {
    ProgressDrawTarget::stderr()
}

/// The terminal of stderr, with a reduced width, because a bar pads its line with spaces.
#[cfg(unix)]
#[derive(Debug)]
struct Narrow;

#[cfg(unix)]
impl Narrow {
    fn control(count: usize, code: char) -> io::Result<()> {
        if count == 0 { Ok(()) } else { write!(io::stderr(), "\x1b[{count}{code}") }
    }
}

#[cfg(unix)]
impl TermLike for Narrow {
    fn width(&self) -> u16 {
        columns().saturating_sub(FREE).try_into().unwrap_or(u16::MAX)
    }

    fn move_cursor_up(&self, n: usize) -> io::Result<()> {
        Self::control(n, 'A')
    }

    fn move_cursor_down(&self, n: usize) -> io::Result<()> {
        Self::control(n, 'B')
    }

    fn move_cursor_right(&self, n: usize) -> io::Result<()> {
        Self::control(n, 'C')
    }

    fn move_cursor_left(&self, n: usize) -> io::Result<()> {
        Self::control(n, 'D')
    }

    fn write_line(&self, line: &str) -> io::Result<()> {
        writeln!(io::stderr(), "{line}")
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        write!(io::stderr(), "{text}")
    }

    fn clear_line(&self) -> io::Result<()> {
        write!(io::stderr(), "\r\x1b[2K")
    }

    fn flush(&self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// Truncates a line to the space beside a bar of `taken` columns.
pub fn fitted(line: &str, taken: usize, columns: usize) -> String {
    line.chars().take(columns.saturating_sub(taken + FREE)).collect()
}

/// Wraps a line at spaces and indents the following lines. Numbers are kept together with their neighboring words, which may be units, unless two spaces
/// separate them. A word longer than a line is not broken, because it may be a path.
pub fn wrapped(line: &str, columns: usize) -> String {
    const BOUND: &str = "\u{a0}";
    let mut words: Vec<String> = Vec::new();
    for field in line.split("  ") {
        let mut bound = false;
        for (i, word) in field.split(' ').enumerate() {
            let is_number = |c: char| c.is_ascii_digit() || c == '³';
            match words.last_mut().filter(|last| i > 0 && (last.ends_with(is_number) || word.starts_with(is_number)) && !bound) {
                Some(last) => *last += &format!("{BOUND}{word}"),
                None => words.push(word.to_owned()),
            }
            bound = word.ends_with([',', ';', ':']);
        }
        // The second of two spaces, which is dropped at a line break.
        if let Some(last) = words.last_mut() {
            last.push(' ');
        }
    }
    let options = textwrap::Options::new(columns)
        .subsequent_indent("  ")
        .break_words(false)
        .word_separator(textwrap::WordSeparator::AsciiSpace)
        .word_splitter(textwrap::WordSplitter::NoHyphenation)
        .wrap_algorithm(textwrap::WrapAlgorithm::FirstFit);
    textwrap::fill(words.join(" ").trim_end(), options).replace(BOUND, " ")
}

/// Returns the `file://` address of a file, which many terminals open at a click.
pub fn file_address(path: &Path) -> String {
    let absolute = path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned());
    let text = absolute.to_string_lossy().replace('\\', "/");
    let text = text.strip_prefix("//?/").unwrap_or(&text);
    let mut address = String::from(if text.starts_with('/') { "file://" } else { "file:///" });
    for byte in text.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'/' | b':' | b'-' | b'_' | b'.' | b'~' => address.push(byte.into()),
            _ => address += &format!("%{byte:02X}"),
        }
    }
    address
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_broken_between_words_and_not_within_numbers() {
        let line = "memory: about 458 MB (images 32 MB, grid 37 MB, optimizer 59 MB, step 270 MB), for a scene of usual surfaces";
        let broken = "memory: about 458 MB (images 32 MB, grid 37 MB, optimizer 59 MB,\n  step 270 MB), for a scene of usual surfaces";
        assert_eq!(wrapped(line, 70), broken);
        assert_eq!(wrapped(line, 200), line);
        let progress = "stage 1/4 (16³)  step 60/240  ETA 0:14  train 17.42 val 18.82 dB  loss 0.02146  294 krays/s  2379 voxels";
        for columns in [40, 60, 80] {
            let lines = wrapped(progress, columns);
            assert!(lines.lines().all(|line| line.chars().count() <= columns), "{lines}");
            assert_eq!(lines.split_whitespace().collect::<Vec<_>>(), progress.split_whitespace().collect::<Vec<_>>());
            assert!(
                lines.lines().any(|line| line.contains("294 krays/s")) && lines.lines().any(|line| line.contains("18.82 dB")),
                "{lines}"
            );
        }
        let path = format!("go on with: plenoxel train --resume /{}", "x".repeat(90));
        assert!(wrapped(&path, 80).contains(&"x".repeat(90)));
    }

    #[test]
    fn there_is_room_beside_a_bar_for_what_a_terminal_adds() {
        assert_eq!(fitted("0123456789", 4, 12), "0123");
        assert_eq!(fitted("0123456789", 14, 12), "");
    }

    #[test]
    fn addresses_have_no_character_that_means_something_else() {
        assert_eq!(file_address(Path::new("/no such/ä#?%.html")), "file:///no%20such/%C3%A4%23%3F%25.html");
    }
}
