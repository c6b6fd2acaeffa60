//! Escaping of text from other programs for terminals and logs.

use std::borrow::Cow;

/// Longest text that [`printable`] returns, characters.
pub const MAX_PRINTABLE: usize = 500;

/// Longest value that [`shortened`] repeats, characters.
const MAX_VALUE: usize = 100;

/// Ending of a text that was cut.
const CUT: &str = "...";

/// Escapes characters that a terminal would obey instead of showing, and cuts the text at [`MAX_PRINTABLE`] characters.
///
/// Control characters (C0, delete, C1, and with them all ANSI escape sequences), line separators, and the marks that
/// reorder text (U+061C, U+200E, U+200F, U+202A to U+202E, U+2066 to U+2069) become `\n`, `\u{1b}` and the like. Other
/// text is returned unchanged; escaping twice changes nothing.
///
/// ```
/// use flyrig_types::printable;
///
/// assert_eq!(printable("left\x1b[2J"), "left\\u{1b}[2J");
/// assert_eq!(printable("camera 'left'"), "camera 'left'");
/// ```
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    escape(text, MAX_PRINTABLE)
}

/// Returns a value of a file or a command line as errors repeat it: escaped like [`printable`], and cut at 100 characters.
///
/// ```
/// use flyrig_types::shortened;
///
/// assert_eq!(shortened("left"), "left");
/// assert_eq!(shortened(&"a".repeat(300)), "a".repeat(97) + "...");
/// ```
#[must_use]
pub fn shortened(value: &str) -> Cow<'_, str> {
    escape(value, MAX_VALUE)
}

/// Applies [`shortened`] to every value that a text has in double quotes or backticks, as errors of parsers have, and to
/// every long word that is no path.
///
/// ```
/// use flyrig_types::shorten_values;
///
/// let text = format!("invalid type: string \"{}\", expected u8", "a".repeat(300));
/// assert_eq!(shorten_values(&text), format!("invalid type: string \"{}...\", expected u8", "a".repeat(97)));
/// ```
#[must_use]
pub fn shorten_values(text: &str) -> Cow<'_, str> {
    if text.len() <= MAX_VALUE {
        return Cow::Borrowed(text);
    }
    let (mut short, mut rest) = (String::new(), text);
    while let Some((begin, quote)) = rest.char_indices().find(|(_, char)| matches!(char, '"' | '`')) {
        let (before, after) = rest.split_at(begin + 1);
        // A quote without an end quotes nothing.
        let Some(end) = closing(after, quote) else { break };
        short.push_str(before);
        short.push_str(&shortened(&after[..end]));
        short.push(quote);
        rest = &after[end + 1..];
    }
    short.push_str(rest);
    // A cut value has its quotes and a comma.
    let most = MAX_VALUE + 4;
    let is_long = |word: &str| word.chars().nth(most).is_some() && !word.contains('/') && !word.contains(":\\");
    let words = short.split_inclusive(char::is_whitespace).map(|word| match word.trim_end() {
        long if is_long(long) => shortened(long) + &word[long.len()..],
        _ => Cow::Borrowed(word),
    });
    Cow::Owned(words.collect())
}

/// Returns the position of the quote that ends a value; a backslash hides the character after it.
fn closing(text: &str, quote: char) -> Option<usize> {
    let mut is_hidden = false;
    text.char_indices()
        .find(|(_, char)| {
            let is_end = *char == quote && !is_hidden;
            is_hidden = *char == '\\' && !is_hidden;
            is_end
        })
        .map(|(at, _)| at)
}

/// Escapes a whole text like [`printable`], at any length.
#[must_use]
pub fn escape_controls(text: &str) -> Cow<'_, str> {
    escape(text, usize::MAX)
}

fn escape(text: &str, most: usize) -> Cow<'_, str> {
    let is_short = text.len() <= most || text.chars().nth(most).is_none();
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
        if length > most {
            shown.truncate(whole);
            shown.push_str(CUT);
            return Cow::Owned(shown);
        }
        if length <= most - CUT.len() {
            whole = shown.len();
        }
    }
    Cow::Owned(shown)
}

/// Returns whether a terminal would obey a character instead of showing it.
pub(crate) fn is_obeyed(char: char) -> bool {
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
    fn repeated_values_are_short_and_whole_texts_are_not() {
        assert_eq!(shortened("\u{1b}[2J"), "\\u{1b}[2J");
        assert_eq!(shortened(&"\n".repeat(1000)), "\\n".repeat(48) + "...");
        let (long, cut) = ("x".repeat(5000), "x".repeat(97) + "...");
        let of = |value: &str| format!("`{value}` and \"a\\\"{value}\" of x's \" {}", "y ".repeat(200));
        let shown = format!("it is '{}... at\nmost", &long[..96]);
        assert_eq!(shorten_values(&format!("it is '{long}', at\nmost")), shown);
        let path = format!("/tmp/{long}: no such file");
        assert_eq!(shorten_values(&path), path);
        assert_eq!(shorten_values(&of(&long)), of(&cut).replace("a\\\"xxx", "a\\\""));
        let long = "a".repeat(10_000);
        assert_eq!(escape_controls(&format!("{long}\u{7}")), format!("{long}\\u{{7}}"));
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
