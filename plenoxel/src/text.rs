//! Text for people: untrusted text, such as file names and file content, made safe to print; and times.

use std::borrow::Cow;

/// Returns the text on one line without characters that control a terminal: control characters, line breaks, and marks that change the
/// direction of writing are escaped as in Rust, `\n` and `\u{1b}`. Everything else is unchanged.
pub fn one_line(text: &str) -> String {
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if is_unprintable(c) { line.extend(c.escape_default()) } else { line.push(c) }
    }
    line
}

/// Returns a part of a message on [`one_line`] and with bounded length. The middle of words longer than 200 characters and of texts longer than 1200 characters is
/// replaced by …; numbers with many zeros are written with an exponent.
pub fn brief(text: &str) -> String {
    const WORD: usize = 200;
    const ALL: usize = 1200;
    let mut words = String::new();
    for word in text.split_inclusive(char::is_whitespace) {
        words += &shortened(&with_exponents(word), WORD);
    }
    one_line(&shortened(&words, ALL))
}

/// Returns names as a list with commas, with at most five of them.
pub fn listed(names: &[String]) -> String {
    const NAMED: usize = 5;
    match names.len() {
        n if n <= NAMED => names.join(", "),
        n => format!("{} and {} more", names[..NAMED].join(", "), n - NAMED),
    }
}

/// Formats a number with the fewest digits that read back as the same number, with an exponent if it is very large or small.
pub fn number(value: f64) -> String {
    let text = format!("{value:?}");
    text.strip_suffix(".0").unwrap_or(&text).to_owned()
}

/// Returns the beginning and the end of a text of more than `most` characters.
fn shortened(text: &str, most: usize) -> Cow<'_, str> {
    // No character has more bytes than 4.
    if text.len() <= most || text.chars().nth(most).is_none() {
        return text.into();
    }
    let begin = text.char_indices().nth(most / 2).map_or(text.len(), |(end, _)| end);
    let end = text.char_indices().rev().nth(most - most / 2 - 1).map_or(0, |(start, _)| start);
    format!("{}…{}", &text[..begin], &text[end..]).into()
}

/// Returns the word with very long numbers in their shortest form, if Rust formatted them. Other digits are unchanged.
fn with_exponents(word: &str) -> Cow<'_, str> {
    const DIGITS: usize = 24;
    // Length of the longest number.
    const MOST: usize = 1100;
    let is_part = |c: char| c.is_ascii_digit() || c == '.';
    if word.len() <= DIGITS {
        return word.into();
    }
    let mut text = String::new();
    let mut rest = word;
    while let Some(start) = rest.find(is_part) {
        let (before, from) = rest.split_at(start);
        let (digits, after) = from.split_at(from.find(|c| !is_part(c)).unwrap_or(from.len()));
        let value = Some(digits).filter(|digits| (DIGITS..MOST).contains(&digits.len())).and_then(|digits| digits.parse::<f64>().ok());
        text += before;
        match value.filter(|value| value.to_string() == digits) {
            Some(value) => text += &number(value),
            None => text += digits,
        }
        rest = after;
    }
    text += rest;
    text.into()
}

/// Returns true for characters that control a terminal instead of being displayed.
pub(crate) fn is_unprintable(c: char) -> bool {
    let separator = matches!(c, '\u{2028}' | '\u{2029}');
    let direction = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || separator || direction
}

/// Formats a time as minutes and seconds, with hours where there are any: `1:02:05`.
pub fn clock(seconds: f64) -> String {
    let s = seconds.max(0.0).round() as u64;
    match s / 3600 {
        0 => format!("{}:{:02}", s / 60, s % 60),
        h => format!("{h}:{:02}:{:02}", s / 60 % 60, s % 60),
    }
}

/// Parses a duration such as `90`, `90s`, `1.5m` or `1h` to seconds.
///
/// Errors with the expected form.
pub fn duration(text: &str) -> Result<f64, String> {
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[number.len()..] {
        "" | "s" => Some(1.0),
        "m" | "min" => Some(60.0),
        "h" => Some(3600.0),
        _ => None,
    };
    let seconds = unit.and_then(|unit| Some(number.parse::<f64>().ok()? * unit));
    seconds
        .filter(|s| *s > 0.0 && *s <= 1e6)
        .ok_or_else(|| "expected a duration above 0 and up to 1e6 seconds, such as 90s, 5m or 1h".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_read_well() {
        assert_eq!([3.4, 59.6, 3725.0].map(clock), ["0:03", "1:00", "1:02:05"]);
    }

    #[test]
    fn what_is_long_loses_its_middle_and_the_rest_stays() {
        let text = brief(&format!("engine: \"{}b\" cannot be used", "a".repeat(900_000)));
        assert!(text.starts_with("engine: \"aaa") && text.ends_with("aaab\" cannot be used") && text.chars().count() < 240, "{text}");
        let names = brief(&format!("[{}]; the end", vec!["name"; 100_000].join(", ")));
        assert!(names.contains('…') && names.ends_with("the end") && names.chars().count() == 1201, "{names}");
        let umlauts = brief(&"ä".repeat(201));
        assert_eq!(umlauts, format!("{0}…{0}", "ä".repeat(100)));
        for text in [&"ä".repeat(200), "a sentence\nof some words,  or none", &vec!["word"; 200].join(" ")] {
            assert_eq!(brief(text), one_line(text));
        }
        assert_eq!(brief(&"\u{1b}".repeat(300)).chars().count(), 1201);
    }

    #[test]
    fn numbers_are_as_short_as_they_can_be() {
        assert_eq!([1e300, 800.0, 0.1, -2.5, 5e-324, 1e15].map(number), ["1e300", "800", "0.1", "-2.5", "5e-324", "1000000000000000"]);
        assert_eq!(brief(&format!("fl_x is {}, or [{},{}]", 1e300, -1e25, 5e-324)), "fl_x is 1e300, or [-1e25,5e-324]");
        let others = "1234567890123456789012345678901234567890 0.30000000000000004";
        assert_eq!(brief(others), others);
    }

    #[test]
    fn what_moves_something_is_escaped_and_the_rest_stays() {
        assert_eq!(one_line("a\x1b[2J\nb\u{9b}c\u{7f}\u{202e}d"), "a\\u{1b}[2J\\nb\\u{9b}c\\u{7f}\\u{202e}d");
        let harmless = "Größe 1\u{202f}000 ³ – \"x\" \\ 日本";
        assert_eq!(one_line(harmless), harmless);
        assert_eq!(one_line(&one_line("\t")), one_line("\t"));
    }
}
