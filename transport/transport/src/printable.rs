//! Escaping of text from other programs for terminals and logs.

use std::borrow::Cow;

/// Longest text that [`printable`] returns, characters.
pub const MAX_PRINTABLE: usize = 500;

/// Ending of a text that was cut.
const CUT: &str = "...";

/// Escapes characters that a terminal would obey instead of showing, and cuts the text at [`MAX_PRINTABLE`] characters.
///
/// Control characters (C0, delete, C1, and with them all ANSI escape sequences), line separators, and the marks that
/// reorder text (U+061C, U+200E, U+200F, U+202A to U+202E, U+2066 to U+2069) become `\n`, `\u{1b}` and the like. Other
/// text is returned unchanged; escaping twice changes nothing.
///
/// ```
/// use flyrig_transport::printable;
///
/// assert_eq!(printable("left\x1b[2J"), "left\\u{1b}[2J");
/// assert_eq!(printable("camera 'left'"), "camera 'left'");
/// ```
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    let is_short = text.len() <= MAX_PRINTABLE || text.chars().nth(MAX_PRINTABLE).is_none();
    if is_short && !text.chars().any(is_obeyed) {
        return Cow::Borrowed(text);
    }
    let (mut shown, mut length, mut whole) = (String::new(), 0, 0);
    for char in text.chars() {
        let start = shown.len();
        if is_obeyed(char) {
            shown.extend(char.escape_default());
        } else {
            shown.push(char);
        }
        length += shown[start..].chars().count();
        if length > MAX_PRINTABLE {
            shown.truncate(whole);
            shown.push_str(CUT);
            return Cow::Owned(shown);
        }
        if length <= MAX_PRINTABLE - CUT.len() {
            whole = shown.len();
        }
    }
    Cow::Owned(shown)
}

/// Applies [`printable`] in place.
pub(crate) fn clean(text: &mut String) {
    if let Cow::Owned(safe) = printable(text) {
        *text = safe;
    }
}

fn is_obeyed(char: char) -> bool {
    char.is_control()
        || matches!(char, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_escaped() {
        for (text, shown) in [
            ("\u{1b}[2Jgone", "\\u{1b}[2Jgone"),
            ("\u{9b}31mred\u{9c}", "\\u{9b}31mred\\u{9c}"),
            ("a\0b\u{7}\u{7f}", "a\\u{0}b\\u{7}\\u{7f}"),
            ("line\r\n\tnext", "line\\r\\n\\tnext"),
            ("\u{202e}txt.exe\u{2066}\u{2069}", "\\u{202e}txt.exe\\u{2066}\\u{2069}"),
            ("a\u{2028}b\u{200f}", "a\\u{2028}b\\u{200f}"),
        ] {
            assert_eq!(printable(text), shown);
            assert_eq!(printable(shown), shown);
        }
        for code in (0..0x20).chain(0x7f..0xa0).chain(0x202a..0x202f).chain(0x2066..0x206a) {
            let text = char::from_u32(code).unwrap().to_string();
            assert!(!printable(&text).contains(&text), "U+{code:04x}");
        }
        for plain in ["", "camera 'left' 640x480", "Körper, 体, 👩‍🚀, C:\\path"] {
            assert!(matches!(printable(plain), Cow::Borrowed(same) if same == plain));
        }
    }

    #[test]
    fn long_texts_are_cut_at_a_whole_escape() {
        let most = "ä".repeat(MAX_PRINTABLE);
        assert_eq!(printable(&most), most);
        let cut = printable(&format!("{most}x")).into_owned();
        assert_eq!(cut, format!("{}...", "ä".repeat(MAX_PRINTABLE - 3)));
        let escaped = printable(&"\u{1b}".repeat(100_000)).into_owned();
        assert!(escaped.chars().count() <= MAX_PRINTABLE && escaped.ends_with("\\u{1b}..."), "{escaped}");
        assert_eq!(printable(&escaped), escaped);
    }
}
