//! What pages and pictures that are text have in common.

/// Text as it is written in HTML and SVG, between tags and in attributes.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
