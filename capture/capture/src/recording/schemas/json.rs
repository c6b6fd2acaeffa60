//! Messages of foxglove's schemas as JSON.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use flyrig_types::Isometry;
use glam::{DQuat, DVec3};
use serde_json::Value;

use super::content::{ImageMessage, Kind, LensMessage, Link, Pixels};

pub(super) fn parse(payload: &[u8]) -> Result<Value, String> {
    serde_json::from_slice(payload).map_err(|error| format!("is no JSON: {error}"))
}

fn text(message: &Value, key: &str) -> Result<String, String> {
    match message.get(key) {
        None | Some(Value::Null) => Ok(String::new()),
        Some(Value::String(text)) => Ok(text.clone()),
        Some(_) => Err(format!("{key} is no text")),
    }
}

fn count(message: &Value, key: &str) -> Result<u32, String> {
    let value = message.get(key).and_then(Value::as_u64).and_then(|value| u32::try_from(value).ok());
    value.ok_or_else(|| format!("{key} is no count"))
}

fn numbers(message: &Value, key: &str) -> Result<Vec<f64>, String> {
    // The schema has capitals, its types in some languages have not.
    let list = match message.get(key).or_else(|| message.get(key.to_lowercase())) {
        None | Some(Value::Null) => return Ok(Vec::new()),
        Some(list) => list.as_array().ok_or_else(|| format!("{key} is no list"))?,
    };
    list.iter().map(|value| value.as_f64().ok_or_else(|| format!("{key} holds what is no number"))).collect()
}

/// Returns a time, nanoseconds; 0 for none.
fn stamp(message: &Value) -> i64 {
    let time = message.get("timestamp");
    let part = |keys: [&str; 3]| keys.iter().find_map(|key| time?.get(key)?.as_i64()).unwrap_or(0);
    let (seconds, nanos) = (part(["sec", "seconds", "secs"]), part(["nsec", "nanos", "nanosec"]));
    seconds.saturating_mul(1_000_000_000).saturating_add(nanos)
}

pub(super) fn image(message: &Value, kind: Kind) -> Result<ImageMessage, String> {
    let data = STANDARD.decode(text(message, "data")?).map_err(|error| format!("data is no base64: {error}"))?.into();
    let pixels = if kind == Kind::RawImage {
        let (width, height, step) = (count(message, "width")?, count(message, "height")?, count(message, "step")?);
        Pixels::Raw { width, height, encoding: text(message, "encoding")?, step, data }
    } else {
        Pixels::Compressed { format: text(message, "format")?, data }
    };
    Ok(ImageMessage { stamp_nanos: stamp(message), frame_id: text(message, "frame_id")?, pixels })
}

pub(super) fn lens(message: &Value) -> Result<LensMessage, String> {
    Ok(LensMessage {
        frame_id: text(message, "frame_id")?,
        width: count(message, "width")?,
        height: count(message, "height")?,
        model: text(message, "distortion_model")?,
        d: numbers(message, "D")?,
        k: numbers(message, "K")?,
        r: numbers(message, "R")?,
        p: numbers(message, "P")?,
        ..LensMessage::default()
    })
}

pub(super) fn links(message: &Value, kind: Kind) -> Result<Vec<Link>, String> {
    if kind == Kind::Link {
        return Ok(vec![link(message)?]);
    }
    let list = message.get("transforms").and_then(Value::as_array).ok_or("transforms is no list")?;
    list.iter().map(link).collect()
}

fn link(message: &Value) -> Result<Link, String> {
    let number = |of: &str, key: &str| {
        let value = message.get(of).and_then(|value| value.get(key)?.as_f64());
        value.ok_or_else(|| format!("{of} has no number {key}"))
    };
    let t = |key| number("translation", key);
    let r = |key| number("rotation", key);
    let translation = DVec3::new(t("x")?, t("y")?, t("z")?);
    let rotation = DQuat::from_xyzw(r("x")?, r("y")?, r("z")?, r("w")?);
    Ok(Link {
        parent: text(message, "parent_frame_id")?,
        child: text(message, "child_frame_id")?,
        parent_from_child: Isometry { rotation, translation },
    })
}
