//! What HTML pages share: text made harmless, pictures that travel with the page, and the frame with its style sheet.
//!
//! A page is one file that reads nothing else, so that it can be kept, moved and sent.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

/// Looks of all pages; they follow the reader's choice of light or dark.
const STYLE: &str = "\
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 80rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; }
table { border-collapse: collapse; }
th, td { padding: .6rem .8rem; border-bottom: 1px solid #8886; text-align: left; vertical-align: top; }
img { display: block; max-width: 100%; border-radius: 4px; }
.small { font-size: .85rem; opacity: .75; }
.scroll { overflow-x: auto; }
";

/// Text as it may stand in an element or in a quoted attribute.
pub fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            c => safe.push(c),
        }
    }
    safe
}

/// A picture within the page, from the bytes of a PNG file.
pub fn picture(png: &[u8], description: &str) -> String {
    format!("<img src=\"data:image/png;base64,{}\" alt=\"{}\">", STANDARD.encode(png), escaped(description))
}

/// A whole page: a title as text, styles of its own, and the HTML below its heading.
pub fn page(title: &str, style: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" content=\"width=device-width\">\n\
         <title>{title}</title>\n<style>\n{STYLE}{style}</style>\n<h1>{title}</h1>\n{body}</html>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_becomes_markup() {
        assert_eq!(escaped("a<b> & \"c\" 'd'"), "a&lt;b&gt; &amp; &quot;c&quot; &#39;d&#39;");
        let page = page("<script>", "", "<p>text</p>\n");
        assert!(!page.contains("<script>") && page.contains("<p>text</p>"), "{page}");
        assert_eq!(picture(b"abc", "\"x"), "<img src=\"data:image/png;base64,YWJj\" alt=\"&quot;x\">");
    }
}
