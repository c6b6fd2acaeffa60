//! OpenCV's FileStorage as XML, read into the tree of its YAML form.

use roxmltree::{Document, Node};

use crate::yaml_value::{MAX_DEPTH, Map, Value};

/// Parses a file `<opencv_storage>`.
pub(crate) fn parse(text: &str) -> Result<Map, String> {
    let document = Document::parse(text).map_err(|error| error.to_string())?;
    let root = document.root_element();
    if !root.has_tag_name("opencv_storage") {
        return Err(format!("XML of <{}>, expected <opencv_storage>", root.tag_name().name()));
    }
    map(root, 0)
}

fn map(node: Node<'_, '_>, depth: usize) -> Result<Map, String> {
    let mut entries = Map::new();
    for child in node.children().filter(Node::is_element) {
        let key = child.tag_name().name();
        // OpenCV puts an underscore before names that begin with a digit.
        if entries.insert(key.to_owned(), value(child, depth + 1)?).is_some() {
            return Err(format!("key {key:?} is there twice; take one out"));
        }
    }
    Ok(entries)
}

fn value(node: Node<'_, '_>, depth: usize) -> Result<Value, String> {
    if depth > MAX_DEPTH {
        return Err(format!("nested more than {MAX_DEPTH} deep; this is no calibration"));
    }
    let items: Vec<Node<'_, '_>> = node.children().filter(Node::is_element).collect();
    if !items.is_empty() {
        let is_list = items.iter().all(|item| item.has_tag_name("_"));
        return if is_list {
            items.into_iter().map(|item| value(item, depth + 1)).collect::<Result<_, _>>().map(Value::List)
        } else {
            map(node, depth).map(Value::Map)
        };
    }
    let mut words = words(node.text().unwrap_or_default());
    Ok(match words.pop() {
        Some(word) if words.is_empty() && node.tag_name().name() != "data" => word,
        last => Value::List(words.into_iter().chain(last).collect()),
    })
}

/// Splits text at blanks; words in quotes may hold some.
fn words(text: &str) -> Vec<Value> {
    let mut words = Vec::new();
    let mut rest = text.trim_start();
    while !rest.is_empty() {
        let quoted = rest.strip_prefix('"').and_then(|rest| rest.split_once('"'));
        let (word, after) = quoted.or_else(|| rest.split_once(char::is_whitespace)).unwrap_or((rest, ""));
        words.push(Value::Scalar(word.to_owned(), quoted.is_some()));
        rest = after.trim_start();
    }
    words
}
