//! Escaping of text for HTML.

/// Escapes a text for an HTML or SVG element, or for an attribute in double quotes.
///
/// ```
/// assert_eq!(flyrig_types::escape_html("a <b> & \"c\""), "a &lt;b&gt; &amp; &quot;c&quot;");
/// ```
#[must_use]
pub fn escape_html(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
