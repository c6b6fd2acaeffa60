//! Tree of a YAML file.

use std::collections::BTreeMap;

/// Most levels of nested lists and maps.
pub(crate) const MAX_DEPTH: usize = 32;

/// Keys and values of a map.
pub(crate) type Map = BTreeMap<String, Value>;

/// Value of a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    /// Scalar text, and whether it was quoted.
    Scalar(String, bool),
    List(Vec<Value>),
    Map(Map),
}

impl Value {
    /// Returns a number; `None` for anything else.
    pub fn number(&self) -> Option<f64> {
        let Self::Scalar(text, false) = self else { return None };
        match text.as_str() {
            ".Inf" | ".inf" | "+.Inf" => Some(f64::INFINITY),
            "-.Inf" | "-.inf" => Some(f64::NEG_INFINITY),
            ".NaN" | ".Nan" | ".nan" => Some(f64::NAN),
            // Rust reads words like "inf" and "nan" too, YAML does not.
            text if text.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c)) => text.parse().ok(),
            _ => None,
        }
    }

    /// Returns a value of a map.
    pub fn get(&self, key: &str) -> Option<&Self> {
        let Self::Map(entries) = self else { return None };
        entries.get(key)
    }

    /// Returns a scalar as text, quoted or not.
    pub fn word(&self) -> Option<&str> {
        let Self::Scalar(text, _) = self else { return None };
        Some(text)
    }

    /// Returns a list of numbers.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        let Self::List(values) = self else { return None };
        values.iter().map(Self::number).collect()
    }

    /// Returns a list of lists of numbers.
    pub fn rows(&self) -> Option<Vec<Vec<f64>>> {
        let Self::List(values) = self else { return None };
        values.iter().map(Self::numbers).collect()
    }
}
