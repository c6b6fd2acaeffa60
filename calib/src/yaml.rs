//! Reader and writer of the YAML subset of OpenCV's FileStorage: keys, scalars, lists, matrices.
//!
//! OpenCV's own reader hangs on some damaged files; hence this one.

use std::{
    fmt::Write as _,
    io::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::CameraId;

use crate::error::CalibError;

/// Maximum file size: calibrations are small, larger files are something else.
const MAX_BYTES: usize = 16 << 20;

/// Matrix of a file, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Matrix {
    pub rows: usize,
    pub cols: usize,
    pub values: Vec<f64>,
}

/// Value of a file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    /// Scalar text, and whether it was quoted.
    Scalar(String, bool),
    List(Vec<Value>),
    Map(Vec<(String, Value)>),
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
        entries.iter().find(|(name, _)| name == key).map(|(_, value)| value)
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

/// Reads a plain YAML file of nested maps and lists, as Kalibr writes them.
pub(crate) fn parse_tree(path: &Path) -> Result<Value, CalibError> {
    let bytes = std::fs::read(path).map_err(|source| CalibError::Read { path: path.to_owned(), source })?;
    let parsed = text_of(&bytes).and_then(|text| Lines::new(text).map());
    parsed.map(Value::Map).map_err(|reason| CalibError::Format {
        path: path.to_owned(),
        problem: format!("is no YAML of a camera chain ({reason}); export it again"),
    })
}

/// Checks that bytes are UTF-8 text of an acceptable length.
fn text_of(bytes: &[u8]) -> Result<&str, String> {
    if bytes.len() > MAX_BYTES {
        return Err(format!("it has {} bytes, at most {MAX_BYTES}", bytes.len()));
    }
    let text = std::str::from_utf8(bytes).ok().filter(|text| !text.contains('\0')).ok_or("it is not text")?;
    Ok(text.trim_start_matches('\u{feff}'))
}

/// Parsed file.
pub(crate) struct YamlFile {
    path: PathBuf,
    entries: Vec<(String, Value)>,
}

impl YamlFile {
    pub fn open(path: PathBuf) -> Result<Self, CalibError> {
        let bytes = match std::fs::read(&path) {
            Ok(bytes) => bytes,
            Err(source) => return Err(CalibError::Read { path, source }),
        };
        match Self::parse(&bytes) {
            Ok(entries) => Ok(Self { path, entries }),
            Err(reason) => Err(CalibError::Parse { path, reason }),
        }
    }

    fn parse(bytes: &[u8]) -> Result<Vec<(String, Value)>, String> {
        let text = text_of(bytes)?;
        if !text.trim_start().starts_with("%YAML") {
            return Err("it does not begin with %YAML".to_owned());
        }
        Lines::new(text).map()
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    fn get(&self, key: &str) -> Option<&Value> {
        self.entries.iter().find(|(name, _)| name == key).map(|(_, value)| value)
    }

    /// Returns every key of the top level.
    pub fn keys(&self) -> Result<Vec<String>, CalibError> {
        if self.entries.is_empty() {
            return Err(CalibError::Parse { path: self.path.clone(), reason: "no keys in it".to_owned() });
        }
        Ok(self.entries.iter().map(|(key, _)| key.clone()).collect())
    }

    /// Returns a list of strings; `None` when it is missing or holds anything else (YAML reads a bare 00 as the number
    /// 0).
    pub fn strings(&self, key: &str) -> Option<Vec<String>> {
        let Some(Value::List(values)) = self.get(key) else { return None };
        values
            .iter()
            .map(|value| match value {
                Value::Scalar(text, quoted) if *quoted || value.number().is_none() => Some(text.clone()),
                _ => None,
            })
            .collect()
    }

    /// Returns a number; `None` when it is missing or no number.
    pub fn number(&self, key: &str) -> Option<f64> {
        self.get(key)?.number()
    }

    /// Returns a matrix of finite numbers, `None` when the key is missing.
    pub fn matrix(&self, camera: &CameraId, key: &str) -> Result<Option<Matrix>, CalibError> {
        let broken = |problem: String| CalibError::Value {
            path: self.path.clone(),
            camera: camera.clone(),
            key: key.to_owned(),
            problem,
            mend: "export or redo the calibration of this camera",
        };
        let Some(value) = self.get(key) else { return Ok(None) };
        if !matches!(value, Value::Map(_)) {
            return Err(broken("is not a matrix".to_owned()));
        }
        let size = |name: &str| {
            let number = value.get(name)?.number().filter(|n| n.fract() == 0.0 && (0.0..=1e6).contains(n))?;
            Some(number as usize)
        };
        let read = || -> Option<(usize, usize, Vec<f64>)> {
            let Some(Value::List(data)) = value.get("data") else { return None };
            Some((size("rows")?, size("cols")?, data.iter().map(Value::number).collect::<Option<_>>()?))
        };
        let (rows, cols, values) =
            read().ok_or_else(|| broken("cannot be read as a matrix (rows, cols or data is no number)".to_owned()))?;
        if rows.checked_mul(cols) != Some(values.len()) {
            let count = values.len();
            return Err(broken(format!("cannot be read as a matrix ({count} numbers for {rows}x{cols})")));
        }
        match values.iter().find(|value| !value.is_finite()) {
            Some(value) => Err(broken(format!("holds {value}, not a finite number"))),
            None => Ok(Some(Matrix { rows, cols, values })),
        }
    }
}

/// Non-empty lines, with number and indentation.
struct Lines<'a> {
    lines: Vec<(usize, usize, &'a str)>,
    at: usize,
}

impl<'a> Lines<'a> {
    fn new(text: &'a str) -> Self {
        let line = |(number, line): (usize, &'a str)| {
            let body = line.trim();
            let is_content = !body.is_empty() && !body.starts_with(['%', '#']) && body != "---" && body != "...";
            is_content.then_some((number + 1, line.len() - line.trim_start().len(), body))
        };
        Self { lines: text.lines().enumerate().filter_map(line).collect(), at: 0 }
    }

    /// Parses the top level.
    fn map(mut self) -> Result<Vec<(String, Value)>, String> {
        let entries = self.entries(0, true)?;
        match self.lines.get(self.at) {
            Some((number, ..)) => Err(format!("line {number} is indented without a key above it")),
            None => Ok(entries),
        }
    }

    /// Parses the keys at one indentation. Only those of the top level may hold keys themselves: these files nest no
    /// deeper.
    fn entries(&mut self, indent: usize, is_top: bool) -> Result<Vec<(String, Value)>, String> {
        let mut entries: Vec<(String, Value)> = Vec::new();
        while let Some(&(number, found, body)) = self.lines.get(self.at).filter(|line| line.1 == indent) {
            let Some((key, rest)) = key(body) else {
                return Err(format!("line {number}: expected a key, found {:?}", shortened(body)));
            };
            self.at += 1;
            // A tag says what the keys below are; they say it themselves.
            let rest = match rest.strip_prefix("!!") {
                Some(tag) => tag.split_once(char::is_whitespace).map_or("", |(_, rest)| rest).trim(),
                None => rest,
            };
            let value = if rest.is_empty() {
                self.below(found, is_top)?
            } else if rest.starts_with('[') {
                self.flow(number, rest)?
            } else {
                scalar(rest)
            };
            entries.push((key, value));
        }
        Ok(entries)
    }

    /// Parses the value below a key.
    fn below(&mut self, indent: usize, is_top: bool) -> Result<Value, String> {
        let Some(&(number, inner, body)) = self.lines.get(self.at) else {
            return Ok(Value::Scalar(String::new(), false));
        };
        let is_item = |body: &str| body == "-" || body.starts_with("- ");
        if is_item(body) && inner >= indent {
            let mut items = Vec::new();
            while let Some(&(number, _, body)) =
                self.lines.get(self.at).filter(|line| line.1 == inner && is_item(line.2))
            {
                self.at += 1;
                let item = body[1..].trim();
                items.push(if item.starts_with('[') { self.flow(number, item)? } else { scalar(item) });
            }
            return Ok(Value::List(items));
        }
        if inner <= indent {
            return Ok(Value::Scalar(String::new(), false));
        }
        if !is_top {
            return Err(format!("line {number} is nested deeper than a calibration"));
        }
        Ok(Value::Map(self.entries(inner, false)?))
    }

    /// Parses `[ a, b, c ]`, over any number of lines.
    fn flow(&mut self, number: usize, first: &str) -> Result<Value, String> {
        let mut items = Vec::new();
        let mut rest = &first[1..];
        loop {
            let (inside, is_end) = rest.split_once(']').map_or((rest, false), |(inside, _)| (inside, true));
            if inside.contains(['[', '{']) {
                return Err(format!("line {number}: a list inside of a list"));
            }
            items.extend(inside.split(',').map(str::trim).filter(|item| !item.is_empty()).map(scalar));
            if is_end {
                return Ok(Value::List(items));
            }
            let Some((_, _, body)) = self.lines.get(self.at) else {
                return Err(format!("line {number}: a list without its end"));
            };
            rest = body;
            self.at += 1;
        }
    }
}

/// Splits `key: rest`; the key may be quoted.
fn key(body: &str) -> Option<(String, &str)> {
    let (key, rest) = match body.strip_prefix('"') {
        Some(quoted) => {
            let (key, rest) = quoted.split_once('"')?;
            (key, rest.trim_start().strip_prefix(':')?)
        }
        None => body.split_once(": ").or_else(|| Some((body.strip_suffix(':')?, "")))?,
    };
    let key = key.trim();
    (!key.is_empty()).then(|| (key.to_owned(), rest.trim()))
}

fn scalar(text: &str) -> Value {
    for quote in ['"', '\''] {
        if let Some(inner) = text.strip_prefix(quote).and_then(|text| text.split_once(quote)) {
            return Value::Scalar(inner.0.to_owned(), true);
        }
    }
    let text = text.split(" #").next().unwrap_or_default().trim();
    Value::Scalar(text.to_owned(), false)
}

fn shortened(text: &str) -> String {
    text.chars().take(40).collect()
}

/// File under construction.
pub(crate) struct YamlWriter {
    path: PathBuf,
    text: String,
}

impl YamlWriter {
    pub fn new(path: PathBuf) -> Self {
        Self { path, text: "%YAML:1.0\n---\n".to_owned() }
    }

    pub fn strings<'a>(&mut self, key: &str, values: impl Iterator<Item = &'a str>) -> Result<(), CalibError> {
        let _ = writeln!(self.text, "{key}:");
        for value in values {
            if value.contains('"') || value.contains(char::is_control) {
                let reason = format!("the name {value:?} cannot stand in it");
                return Err(CalibError::Write { path: self.path.clone(), reason });
            }
            let _ = writeln!(self.text, "   - \"{value}\"");
        }
        Ok(())
    }

    pub fn integer(&mut self, key: &str, value: u32) {
        let _ = writeln!(self.text, "{key}: {value}");
    }

    pub fn matrix(&mut self, key: &str, cols: usize, values: &[f64]) {
        let rows = values.len() / cols.max(1);
        // The shortest digits that read back as the same number.
        let data: Vec<String> = values.iter().map(|value| format!("{value:?}")).collect();
        let data = data.join(", ");
        let _ = writeln!(
            self.text,
            "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]"
        );
    }

    /// Returns the text without writing it.
    pub fn into_text(self) -> String {
        self.text
    }

    pub fn finish(self) -> Result<(), CalibError> {
        flyrig_types::write_whole(&self.path, |out| out.write_all(self.text.as_bytes()))
            .map_err(|error| CalibError::Write { path: self.path, reason: error.to_string() })
    }
}

#[cfg(test)]
#[path = "yaml_tests.rs"]
mod tests;
