//! Range check of numeric settings.

use crate::error::FusionError;

/// Checks that the value of a key lies in a range.
pub(crate) fn check(key: &str, value: f64, low: f64, high: f64) -> Result<(), FusionError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(FusionError::Setting(format!("{key} is {value}, it must lie between {low} and {high}")))
}
