//! Errors of TOML files, with the key that is wrong and the one that was probably meant.

use anyhow::anyhow;
use flyrig_types::shortened;
use serde::de::DeserializeOwned;

/// Explains why `text` is no `T`: names the line and the key, and the known key nearest to an unknown one. `all` holds every table with
/// its default keys.
///
/// Tables with flattened settings of another crate (`serde(flatten)`) report the line of their header alone; the key is found by reading
/// the table's keys one at a time.
pub fn explain<T: DeserializeOwned>(text: &str, error: &toml::de::Error, all: &toml::Table) -> anyhow::Error {
    let found = error.span().and_then(|span| key_of_table::<T>(text, span.start, all));
    let (place, error) = match &found {
        Some((place, error)) => (place.as_str(), error),
        None => ("", error),
    };
    let hint = nearest_key(error.message(), all).map(|key| format!("did you mean `{key}`?")).unwrap_or_default();
    match place {
        "" => anyhow!("{}{hint}", short_lines(error.to_string().trim_end_matches(' '))),
        place => anyhow!("{place}: {}\n{hint}", error.message()),
    }
}

/// Shortens the lines that an error repeats from the file, which it marks with a bar.
fn short_lines(text: &str) -> String {
    let is_repeated = |line: &str| line.trim_start_matches(|c: char| c.is_ascii_digit() || c == ' ').starts_with('|');
    let short = |line| if is_repeated(line) { shortened(line) } else { line.into() };
    text.split('\n').map(short).collect::<Vec<_>>().join("\n")
}

/// Returns the line and name of the key that makes the table whose header is at `start` invalid, and its error.
fn key_of_table<T: DeserializeOwned>(text: &str, start: usize, all: &toml::Table) -> Option<(String, toml::de::Error)> {
    let header = text.get(start..)?.lines().next()?;
    let name = header.trim().strip_prefix('[')?.strip_suffix(']').filter(|name| all.contains_key(*name))?;
    let tables: toml::Table = text.parse().ok()?;
    let line_of = |key: &str| {
        let is_key = |line: &str| line.split_once('=').is_some_and(|(before, _)| before.trim() == key);
        let at = text[start..].lines().position(is_key)?;
        Some(text[..start].matches('\n').count() + at + 1)
    };
    tables.get(name)?.as_table()?.iter().find_map(|(key, value)| {
        let alone = toml::Table::from_iter([(key.clone(), value.clone())]);
        let alone = toml::Table::from_iter([(name.to_owned(), toml::Value::Table(alone))]);
        let error = toml::from_str::<T>(&alone.to_string()).err()?;
        Some((format!("line {}: {name}.{key}", line_of(key)?), error))
    })
}

/// Finds the key most similar to `x` in a message "unknown field `x`, expected one of `a`, `b`": among the listed keys, else in `all`.
fn nearest_key(message: &str, all: &toml::Table) -> Option<String> {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let unknown = quoted.next().filter(|_| message.starts_with("unknown"))?;
    let likeness = |key: &str| strsim::jaro_winkler(unknown, key);
    if let Some(listed) = quoted.max_by(|a, b| likeness(a).total_cmp(&likeness(b))) {
        return Some(listed.to_owned());
    }
    // Tables that contain the settings of another crate list no keys.
    let keys = all.values().filter_map(toml::Value::as_table).flat_map(toml::Table::keys);
    keys.max_by(|a, b| likeness(a).total_cmp(&likeness(b))).cloned()
}

/// Returns the keys of a configuration that a printed one lacks.
#[cfg(test)]
pub fn missing_keys(all: &toml::Table, printed: &toml::Table, path: &str) -> Vec<String> {
    let of = |(key, value): (&String, &toml::Value)| match (value, printed.get(key)) {
        // Lists are empty at first: tables to copy stand there as comments.
        (toml::Value::Array(list), None) if list.is_empty() => Vec::new(),
        (_, None) => vec![format!("{path}{key}")],
        (toml::Value::Table(all), Some(toml::Value::Table(printed))) => {
            missing_keys(all, printed, &format!("{path}{key}."))
        }
        _ => Vec::new(),
    };
    all.iter().flat_map(of).collect()
}
