//! Errors of TOML files, with the key that was probably meant.

use anyhow::anyhow;

/// Adds the known key that is nearest to an unknown one. `all` holds every table with its default keys.
pub fn explain(error: &toml::de::Error, all: &toml::Table) -> anyhow::Error {
    let hint = nearest_key(error.message(), all).map(|key| format!("did you mean `{key}`?")).unwrap_or_default();
    anyhow!("{}{hint}", error.to_string().trim_end_matches(' '))
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
