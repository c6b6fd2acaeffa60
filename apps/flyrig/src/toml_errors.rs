//! Errors of TOML files, with the key that was probably meant.

use anyhow::anyhow;

/// Adds the known key that is nearest to an unknown one.
pub fn explain(error: &toml::de::Error) -> anyhow::Error {
    let hint = nearest_key(error.message()).map(|key| format!("did you mean `{key}`?")).unwrap_or_default();
    anyhow!("{}{hint}", error.to_string().trim_end_matches(' '))
}

/// Finds in a message "unknown field `x`, expected one of `a`, `b`" the listed key that is most similar to `x`.
fn nearest_key(message: &str) -> Option<String> {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let unknown = quoted.next().filter(|_| message.starts_with("unknown"))?;
    quoted
        .max_by(|a, b| strsim::jaro_winkler(unknown, a).total_cmp(&strsim::jaro_winkler(unknown, b)))
        .map(str::to_owned)
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
