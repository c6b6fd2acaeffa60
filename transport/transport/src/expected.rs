//! Expected form of received messages, by the label of their key.

use flyrig_stream::{MAX_MESSAGE_BYTES, MAX_SPLAT_BYTES};

use crate::{
    cameras::calibration, error::TransportError, header::MessageKind, json::MAX_JSON_BYTES, keys, views::view,
};

/// Checks the names in a label: they reach the reader, and a slot keeps its name.
pub(crate) fn check_label(key: &str, label: &str) -> Result<(), TransportError> {
    let malformed = |message: String| TransportError::malformed(key, message);
    for (prefix, what) in [("view/", "view"), ("calibration/", "camera")] {
        if let Some(name) = label.strip_prefix(prefix) {
            keys::check_name(what, name).map_err(|error| malformed(error.to_string()))?;
        }
    }
    if let Some(person) = label.strip_prefix(keys::PERSON_SPLATS)
        && person.parse().map(keys::splats_label).as_deref() != Ok(label)
    {
        return Err(malformed("names no person; expected a number".to_owned()));
    }
    if keys::is_person(label) && keys::person_in(label).is_none() {
        return Err(malformed("names no part of the person stream".to_owned()));
    }
    Ok(())
}

/// Returns kind and largest length, bytes, of a topic's payload.
pub(crate) fn expected_payload(label: &str) -> (MessageKind, usize) {
    match label {
        "stats" => (MessageKind::Stats, MAX_JSON_BYTES),
        "transforms" => (MessageKind::Transforms, calibration::MAX_BYTES),
        _ if keys::is_splats(label) => (MessageKind::Splats, MAX_SPLAT_BYTES),
        _ if keys::is_person(label) && label.ends_with("/motion") => (MessageKind::Motion, MAX_MESSAGE_BYTES),
        _ if keys::is_person(label) => (MessageKind::Colors, MAX_MESSAGE_BYTES),
        _ if label.starts_with("calibration/") => (MessageKind::Calibration, calibration::MAX_BYTES),
        _ => (MessageKind::View, view::MAX_MESSAGE_BYTES),
    }
}
