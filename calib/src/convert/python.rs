//! Conversion of Python literals, as mrcal writes them, to JSON.

/// Returns a literal as JSON: without comments and trailing commas, with double quotes, tuples as lists, bytes as
/// strings. Anything else is left for the JSON parser to reject.
pub(super) fn to_json(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text.chars().peekable();
    while let Some(c) = rest.next() {
        match c {
            '#' => while rest.next_if(|c| *c != '\n').is_some() {},
            'b' if rest.peek().is_some_and(|c| matches!(c, '\'' | '"')) => {}
            '\'' | '"' => string(c, &mut rest, &mut out),
            '(' => out.push('['),
            ')' | ']' | '}' => {
                let end = out.trim_end().trim_end_matches(',').len();
                out.truncate(end);
                out.push(if c == ')' { ']' } else { c });
            }
            c if c.is_ascii_alphabetic() => {
                let mut word = String::from(c);
                while let Some(c) = rest.next_if(|c| c.is_ascii_alphanumeric() || *c == '_') {
                    word.push(c);
                }
                out.push_str(match word.as_str() {
                    "None" => "null",
                    "True" => "true",
                    "False" => "false",
                    other => other,
                });
            }
            // 1. and .5 are numbers of Python, not of JSON.
            '.' => {
                if !out.ends_with(|c: char| c.is_ascii_digit()) {
                    out.push('0');
                }
                out.push('.');
                if !rest.peek().is_some_and(char::is_ascii_digit) {
                    out.push('0');
                }
            }
            c if c.is_ascii_digit() => {
                out.push(c);
                // The exponent's letter belongs to the number.
                while let Some(c) = rest.next_if(char::is_ascii_digit) {
                    out.push(c);
                }
                if let Some(e) = rest.next_if(|c| matches!(c, 'e' | 'E')) {
                    out.push(e);
                }
            }
            c => out.push(c),
        }
    }
    out
}

fn string(quote: char, rest: &mut impl Iterator<Item = char>, out: &mut String) {
    out.push('"');
    while let Some(c) = rest.next() {
        match c {
            '\\' => match rest.next() {
                Some(next @ ('"' | '\\' | '/' | 'n' | 't' | 'r')) => out.extend(['\\', next]),
                Some(next) if next == quote => out.push(next),
                // Other escapes occur only in bytes that are not read.
                _ => {}
            },
            c if c == quote => break,
            '"' => out.push_str("\\\""),
            c if c.is_control() => {}
            c => out.push(c),
        }
    }
    out.push('"');
}
