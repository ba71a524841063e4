//! Text for terminals: untrusted text escaped to one line, and durations.

/// Escapes untrusted text, such as a file name, so that it is one line and cannot control a terminal. Control characters, line breaks and
/// bidirectional formatting characters become Rust escapes such as `\n` and `\u{1b}`. All other characters are unchanged.
pub fn one_line(text: &str) -> String {
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if is_unprintable(c) { line.extend(c.escape_default()) } else { line.push(c) }
    }
    line
}

/// True for characters that a terminal or a text renderer interprets instead of displaying.
pub(crate) fn is_unprintable(c: char) -> bool {
    let separator = matches!(c, '\u{2028}' | '\u{2029}');
    let direction = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || separator || direction
}

/// Formats a duration in seconds as `m:ss`, or as `h:mm:ss` from one hour on, such as `1:02:05`.
pub fn clock(seconds: f64) -> String {
    let s = seconds.max(0.0).round() as u64;
    match s / 3600 {
        0 => format!("{}:{:02}", s / 60, s % 60),
        h => format!("{h}:{:02}:{:02}", s / 60 % 60, s % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_read_well() {
        assert_eq!([3.4, 59.6, 3725.0].map(clock), ["0:03", "1:00", "1:02:05"]);
    }

    #[test]
    fn what_moves_something_is_escaped_and_the_rest_stays() {
        assert_eq!(one_line("a\x1b[2J\nb\u{9b}c\u{7f}\u{202e}d"), "a\\u{1b}[2J\\nb\\u{9b}c\\u{7f}\\u{202e}d");
        let harmless = "Größe 1\u{202f}000 ³ – \"x\" \\ 日本";
        assert_eq!(one_line(harmless), harmless);
        assert_eq!(one_line(&one_line("\t")), one_line("\t"));
    }
}
