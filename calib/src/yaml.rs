//! YAML files of other programs, read into a tree of bounded size; OpenCV's FileStorage in all three of its forms (YAML, XML and
//! JSON, which is YAML too), and a writer of the first.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    io::Write as _,
    path::{Path, PathBuf},
};

use flyrig_types::CameraId;
use saphyr_parser::{Event, Parser, ScalarStyle, ScanError, Span, Tag};

use crate::calibration_file;
use crate::error::CalibError;
use crate::storage_xml;
use crate::yaml_value::{MAX_DEPTH, Map, Value};

/// Most nodes of a file, copies by aliases included: a calibration with its corners has some ten thousand.
const MAX_NODES: usize = 500_000;

/// Matrix of a file, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Matrix {
    pub rows: usize,
    pub cols: usize,
    pub values: Vec<f64>,
}

/// Reads a YAML file, as Kalibr writes it.
pub(crate) fn parse_tree(path: &Path) -> Result<Map, CalibError> {
    parse(&calibration_file::read(path)?).map_err(|reason| CalibError::Format {
        path: path.to_owned(),
        problem: format!("is no YAML of a camera chain ({reason}); export it again"),
    })
}

/// Parses the maps of all documents of a file into one.
fn parse(text: &str) -> Result<Map, String> {
    // OpenCV's header is no directive of YAML.
    let is_header = text.trim_start().starts_with("%YAML");
    let body =
        if is_header { text.find('%').and_then(|from| text[from..].find('\n').map(|to| from + to)) } else { Some(0) };
    let body = body.map_or("", |from| &text[from..]);
    let skipped = text[..text.len() - body.len()].matches('\n').count();
    let mut tree = Tree::default();
    // The parser looks ahead to the end of a list in brackets: their entries are counted before.
    tree.count(body.bytes().filter(|byte| matches!(byte, b',' | b'[' | b'{')).count())?;
    tree.nodes = 0;
    for event in Parser::new_from_str(body) {
        let place = |line: usize, problem: &str| format!("line {}: {problem}", skipped + line);
        let (event, span): (Event<'_>, Span) =
            event.map_err(|error: ScanError| place(error.marker().line(), error.info()))?;
        tree.add(event).map_err(|problem| place(span.start.line(), &problem))?;
    }
    Ok(tree.root)
}

/// List or map whose end was not read yet.
struct Open {
    anchor: usize,
    nodes_before: usize,
    content: Content,
}

enum Content {
    List(Vec<Value>),
    /// Entries, the key that waits for its value, and the values of merge keys.
    Map(Map, Option<String>, Vec<Value>),
}

/// Tree under construction.
#[derive(Default)]
struct Tree {
    open: Vec<Open>,
    /// Values with an anchor, and their numbers of nodes.
    anchors: BTreeMap<usize, (Value, usize)>,
    nodes: usize,
    root: Map,
}

impl Tree {
    fn add(&mut self, event: Event<'_>) -> Result<(), String> {
        match event {
            Event::Scalar(text, style, anchor, tag) => {
                let before = self.count(1)?;
                let is_number = |tag: &Tag| tag.is_yaml_core_schema() && matches!(tag.suffix.as_str(), "float" | "int");
                let is_quoted = style != ScalarStyle::Plain && !tag.is_some_and(|tag| is_number(&tag));
                self.close(Value::Scalar(text.into_owned(), is_quoted), anchor, before)
            }
            Event::Alias(anchor) => {
                let (value, nodes) = self.anchors.get(&anchor).cloned().ok_or("an alias inside of its own anchor")?;
                let before = self.count(nodes)?;
                self.close(value, 0, before)
            }
            Event::SequenceStart(anchor, _) => self.open(anchor, Content::List(Vec::new())),
            Event::MappingStart(anchor, _) => self.open(anchor, Content::Map(Map::new(), None, Vec::new())),
            Event::SequenceEnd | Event::MappingEnd => {
                let Some(Open { anchor, nodes_before, content }) = self.open.pop() else { return Ok(()) };
                let value = match content {
                    Content::List(values) => Value::List(values),
                    Content::Map(mut entries, _, merged) => {
                        merged.into_iter().try_for_each(|value| merge(&mut entries, value))?;
                        Value::Map(entries)
                    }
                };
                self.close(value, anchor, nodes_before)
            }
            Event::Nothing | Event::StreamStart | Event::StreamEnd | Event::DocumentStart(_) | Event::DocumentEnd => {
                Ok(())
            }
        }
    }

    /// Counts nodes, and returns their number before.
    fn count(&mut self, nodes: usize) -> Result<usize, String> {
        let before = self.nodes;
        self.nodes = before.saturating_add(nodes);
        if self.nodes > MAX_NODES {
            return Err(format!("more than {MAX_NODES} values; this is no calibration"));
        }
        Ok(before)
    }

    fn open(&mut self, anchor: usize, content: Content) -> Result<(), String> {
        let nodes_before = self.count(1)?;
        if self.open.len() >= MAX_DEPTH {
            return Err(format!("nested more than {MAX_DEPTH} deep; this is no calibration"));
        }
        self.open.push(Open { anchor, nodes_before, content });
        Ok(())
    }

    /// Puts a complete value into the list or map around it.
    fn close(&mut self, value: Value, anchor: usize, nodes_before: usize) -> Result<(), String> {
        if anchor != 0 {
            let nodes = self.nodes - nodes_before;
            self.count(nodes)?;
            self.anchors.insert(anchor, (value.clone(), nodes));
        }
        let Some(around) = self.open.last_mut() else {
            return match value {
                Value::Map(entries) => entries.into_iter().try_for_each(|(key, value)| put(&mut self.root, key, value)),
                // An empty document is an empty scalar.
                Value::Scalar(text, false) if text.is_empty() => Ok(()),
                Value::Scalar(..) | Value::List(_) => Err("expected keys with values".to_owned()),
            };
        };
        match &mut around.content {
            Content::List(values) => values.push(value),
            Content::Map(entries, waiting, merged) => match (waiting.take(), value) {
                (None, Value::Scalar(key, _)) => *waiting = Some(key),
                (None, _) => return Err("a key that is a list or a map".to_owned()),
                (Some(key), value) if key == "<<" => merged.push(value),
                (Some(key), value) => put(entries, key, value)?,
            },
        }
        Ok(())
    }
}

fn put(entries: &mut Map, key: String, value: Value) -> Result<(), String> {
    if entries.contains_key(&key) {
        return Err(format!("key {:?} is there twice; take one out", shortened(&key)));
    }
    entries.insert(key, value);
    Ok(())
}

/// Adds the keys of the map, or maps, of a merge key; keys that stand in the map itself replace them.
fn merge(entries: &mut Map, value: Value) -> Result<(), String> {
    match value {
        Value::Map(others) => {
            for (key, value) in others {
                entries.entry(key).or_insert(value);
            }
            Ok(())
        }
        Value::List(maps) => maps.into_iter().try_for_each(|map| merge(entries, map)),
        Value::Scalar(..) => Err("<< without a map".to_owned()),
    }
}

fn shortened(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Parsed file.
pub(crate) struct YamlFile {
    path: PathBuf,
    root: Map,
}

impl YamlFile {
    pub fn open(path: PathBuf) -> Result<Self, CalibError> {
        let text = calibration_file::read(&path)?;
        match Self::parse(&text) {
            Ok(root) => Ok(Self { path, root }),
            Err(reason) => Err(CalibError::Parse { path, reason }),
        }
    }

    fn parse(text: &str) -> Result<Map, String> {
        let root = match text.trim_start().chars().next() {
            Some('<') => storage_xml::parse(text)?,
            // OpenCV puts comments into JSON, each on a line of its own.
            Some('{') => {
                let lines = text.lines().map(|line| if line.trim_start().starts_with("//") { "" } else { line });
                parse(&lines.collect::<Vec<_>>().join("\n"))?
            }
            _ => parse(text)?,
        };
        if root.is_empty() { Err("no keys in it".to_owned()) } else { Ok(root) }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns a value of the top level.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.root.get(key)
    }

    /// Returns the first of the keys that the file has; longer ones in any case, since OpenCV's sample changed it.
    pub fn key(&self, names: &[&str]) -> Option<&str> {
        let is_named =
            |key: &&str| names.iter().any(|name| name == key || name.len() > 1 && name.eq_ignore_ascii_case(key));
        let exact = names.iter().find_map(|name| self.root.get_key_value(*name)).map(|(key, _)| key.as_str());
        exact.or_else(|| self.keys().find(is_named))
    }

    /// Returns every key of the top level.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.root.keys().map(String::as_str)
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
        // ROS writes some vectors as plain lists.
        if let Some(values) = value.numbers() {
            return match values.iter().find(|value| !value.is_finite()) {
                Some(value) => Err(broken(format!("holds {value}, not a finite number"))),
                None => Ok(Some(Matrix { rows: 1, cols: values.len(), values })),
            };
        }
        if !matches!(value, Value::Map(_)) {
            return Err(broken("is not a matrix".to_owned()));
        }
        if value.get("data").and_then(Value::word).is_some_and(|text| !text.is_empty()) {
            return Err(broken("holds base64; write it without FileStorage's BASE64".to_owned()));
        }
        let size = |name: &str| {
            let number = value.get(name)?.number().filter(|n| n.fract() == 0.0 && (0.0..=1e6).contains(n))?;
            Some(number as usize)
        };
        let read = || -> Option<(usize, usize, Vec<f64>)> {
            Some((size("rows")?, size("cols")?, value.get("data")?.numbers()?))
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
