//! Limits at which a recording continues in a new file.

use std::{fmt, str::FromStr, time::Duration};

use serde::{Deserialize, Serialize};

/// Smallest file size, bytes; below it a file would hold a few frames.
const LEAST_BYTES: f64 = 1e6;
const LEAST_SECONDS: f64 = 1.0;
const MOST_BYTES: f64 = 1e18;
const MOST_SECONDS: f64 = 366.0 * 86_400.0;

/// Units of size with their bytes; a size is printed in the first that divides it.
const SIZES: [(&str, f64); 7] = [
    ("TB", 1e12),
    ("GB", 1e9),
    ("MB", 1e6),
    ("TiB", (1u64 << 40) as f64),
    ("GiB", (1u64 << 30) as f64),
    ("MiB", (1u64 << 20) as f64),
    ("B", 1.0),
];
/// Units of time with their seconds.
const TIMES: [(&str, f64); 3] = [("h", 3600.0), ("min", 60.0), ("s", 1.0)];

/// Limits of one file of a recording, which continues in a new file when either is reached. In settings a string:
/// `"off"`, `"4GB"`, `"30min"`, `"4GB 30min"`.
///
/// ```
/// use std::time::Duration;
///
/// use flyrig_capture::Rotation;
///
/// let rotation: Rotation = "4GB 30min".parse()?;
/// assert_eq!(rotation.max_bytes, Some(4_000_000_000));
/// assert_eq!(rotation.max_time, Some(Duration::from_secs(1800)));
/// # Ok::<(), flyrig_capture::RotationError>(())
/// ```
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Rotation {
    /// Bytes of a file without its index, which adds about a thousandth. A single message always fits.
    pub max_bytes: Option<u64>,
    /// Time from a file's first message to the first one of the next file.
    pub max_time: Option<Duration>,
}

/// Error of a string that is no [`Rotation`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}; expected a size such as \"4GB\", a time such as \"30min\", both (\"4GB 30min\"), or \"off\"")]
pub struct RotationError(String);

impl Rotation {
    /// Returns whether there is any limit.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.max_bytes.is_some() || self.max_time.is_some()
    }

    /// Returns whether a file of this age has to end before it grows to this size.
    pub(super) fn is_due(&self, bytes: u64, age: Duration) -> bool {
        self.max_bytes.is_some_and(|most| bytes > most) || self.max_time.is_some_and(|most| age >= most)
    }
}

impl FromStr for Rotation {
    type Err = RotationError;

    fn from_str(text: &str) -> Result<Self, RotationError> {
        let mut rotation = Self::default();
        if text.trim().eq_ignore_ascii_case("off") {
            return Ok(rotation);
        }
        let wrong = |why: &str| RotationError(format!("{text:?} {why}"));
        let mut rest = text.trim();
        if rest.is_empty() {
            return Err(wrong("is empty"));
        }
        while !rest.is_empty() {
            let (number, after) = split(rest, |c| !c.is_ascii_digit() && c != '.');
            let (unit, after) = split(after.trim_start(), |c| !c.is_ascii_alphabetic());
            rest = after.trim_start();
            let Some(number) = number.parse::<f64>().ok().filter(|number| number.is_finite()) else {
                return Err(wrong("holds no number where one is expected"));
            };
            let factor = |units: &[(&str, f64)]| {
                units.iter().find(|(name, _)| name.eq_ignore_ascii_case(unit)).map(|(_, factor)| number * factor)
            };
            if let Some(bytes) = factor(&SIZES) {
                if !(LEAST_BYTES..=MOST_BYTES).contains(&bytes) {
                    return Err(wrong("has a size that is not between 1 MB and 10^18 bytes"));
                }
                if rotation.max_bytes.replace(bytes as u64).is_some() {
                    return Err(wrong("has two sizes"));
                }
            } else if let Some(seconds) = factor(&TIMES) {
                if !(LEAST_SECONDS..=MOST_SECONDS).contains(&seconds) {
                    return Err(wrong("has a time that is not between 1 s and 366 days"));
                }
                if rotation.max_time.replace(Duration::from_secs(seconds.round() as u64)).is_some() {
                    return Err(wrong("has two times"));
                }
            } else if unit.is_empty() {
                return Err(wrong("has a number without a unit (MB, GB, TB, MiB, GiB, TiB, s, min, h)"));
            } else {
                return Err(wrong(&format!("has the unknown unit {unit:?} (MB, GB, TB, MiB, GiB, TiB, s, min, h)")));
            }
        }
        Ok(rotation)
    }
}

fn split(text: &str, at: impl Fn(char) -> bool) -> (&str, &str) {
    text.split_at(text.find(at).unwrap_or(text.len()))
}

/// Formats a number in the first unit of which it is a multiple, otherwise in the last.
fn in_unit(number: f64, units: &[(&str, f64)]) -> String {
    let whole = units.iter().find(|(_, factor)| number >= *factor && number % factor < 0.5);
    let (name, factor) = whole.or(units.last()).copied().unwrap_or(("", 1.0));
    format!("{}{name}", number / factor)
}

impl fmt::Display for Rotation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = self.max_bytes.map(|bytes| in_unit(bytes as f64, &SIZES));
        let time = self.max_time.map(|time| in_unit(time.as_secs_f64(), &TIMES));
        match (size, time) {
            (Some(size), Some(time)) => write!(f, "{size} {time}"),
            (Some(one), None) | (None, Some(one)) => f.write_str(&one),
            (None, None) => f.write_str("off"),
        }
    }
}

impl TryFrom<String> for Rotation {
    type Error = RotationError;

    fn try_from(text: String) -> Result<Self, RotationError> {
        text.parse()
    }
}

impl From<Rotation> for String {
    fn from(rotation: Rotation) -> Self {
        rotation.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> (Option<u64>, Option<u64>) {
        let rotation: Rotation = text.parse().unwrap();
        assert_eq!(rotation.to_string().parse(), Ok(rotation), "{text}");
        (rotation.max_bytes, rotation.max_time.map(|time| time.as_secs()))
    }

    #[test]
    fn sizes_and_times_are_read_and_printed() {
        assert_eq!(parsed("off"), (None, None));
        assert_eq!(parsed("4GB"), (Some(4_000_000_000), None));
        assert_eq!(parsed(" 1.5 gib "), (Some(3 << 29), None));
        assert_eq!(parsed("30min"), (None, Some(1800)));
        assert_eq!(parsed("4GB 30min"), (Some(4_000_000_000), Some(1800)));
        assert_eq!(parsed("90s 250MB"), (Some(250_000_000), Some(90)));
        assert_eq!(parsed("123456789B2h"), (Some(123_456_789), Some(7200)));
        let texts = ["4GB 30min", "90s 250MB", "60 min", "1536MiB", "1.5GB"];
        let printed = texts.map(|text| text.parse::<Rotation>().unwrap().to_string());
        assert_eq!(printed, ["4GB 30min", "250MB 90s", "1h", "1536MiB", "1500MB"]);
    }

    #[test]
    fn what_is_no_limit_is_refused_with_its_reason() {
        for (text, why) in [
            ("", "is empty"),
            ("GB", "no number"),
            ("4", "without a unit"),
            ("4 5GB", "without a unit"),
            ("4XB", "the unknown unit \"XB\""),
            ("0GB", "not between 1 MB"),
            ("1kB", "the unknown unit \"kB\""),
            ("1B", "not between 1 MB"),
            ("0.1s", "not between 1 s"),
            ("999999999h", "not between 1 s"),
            ("1GB 2GB", "two sizes"),
            ("1min 2min", "two times"),
            ("-4GB", "no number"),
            ("1.2.3GB", "no number"),
            ("4GB off", "no number"),
            ("infGB", "no number"),
        ] {
            let error = text.parse::<Rotation>().unwrap_err().to_string();
            assert!(error.contains(why) && error.contains("expected a size such as \"4GB\""), "{text}: {error}");
        }
    }

    #[test]
    fn settings_hold_a_string() {
        let rotation: Rotation = serde_json::from_str("\"2GB 10min\"").unwrap();
        assert_eq!(serde_json::to_string(&rotation).unwrap(), "\"2GB 10min\"");
        let error = serde_json::from_str::<Rotation>("\"2\"").unwrap_err().to_string();
        assert!(error.contains("without a unit"), "{error}");
    }
}
