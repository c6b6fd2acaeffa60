//! Key space: labels of topics, queries and liveliness tokens. A label is the part of a key behind `flyrig/v1/RIG/`.

use flyrig_types::CameraId;

use crate::{error::TransportError, schema::SCHEMA_VERSION};

/// Prefix of the names of views that belong to one subscriber.
pub(crate) const VIEWER_PREFIX: &str = "viewer-";

/// Largest number of people, besides the first, with topics at a time; beyond it the person published least recently loses its topics.
pub const MAX_PERSON_TOPICS: usize = 16;

/// Longest name in a key, bytes.
const MAX_NAME: usize = 64;

/// Checks that a name can be part of a key.
pub(crate) fn check_name(what: &str, name: &str) -> Result<(), TransportError> {
    let good = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'.' | b'-');
    if (1..=MAX_NAME).contains(&name.len()) && name.bytes().all(good) {
        return Ok(());
    }
    Err(TransportError::config(
        format!("{what} name {name:?}"),
        format!("use 1 to {MAX_NAME} of the characters A-Z a-z 0-9 _ . -"),
    ))
}

/// Returns the key `flyrig/v1/<rig>/<rest>`.
pub(crate) fn key(rig: &str, rest: &str) -> String {
    format!("flyrig/v{SCHEMA_VERSION}/{rig}/{rest}")
}

/// Returns the label of a view's images.
pub(crate) fn view_label(name: &str) -> String {
    match name.strip_prefix(VIEWER_PREFIX) {
        Some(subscriber) => format!("viewer/{subscriber}/view"),
        None => format!("view/{name}"),
    }
}

/// Prefix of the labels of splats of all people but the first.
pub(crate) const PERSON_SPLATS: &str = "splats/";

/// Returns the label of a person's splats; that of the first person is the label of a rig with one person.
pub(crate) fn splats_label(person: u32) -> String {
    if person == 0 { "splats".to_owned() } else { format!("{PERSON_SPLATS}{person}") }
}

/// Prefix of the labels of the person stream.
pub(crate) const PERSON: &str = "person/";

/// Returns the label of a person's motion.
pub(crate) fn motion_label(person: u32) -> String {
    format!("{PERSON}{person}/{MOTION}")
}

/// Last part of the labels of motion.
pub(crate) const MOTION: &str = "motion";

/// Last part of the labels of colour layers, before the number of the layer.
pub(crate) const COLOR: &str = "color-";

/// Returns the label of a layer of a person's colours.
pub(crate) fn color_label(person: u32, layer: usize) -> String {
    format!("{PERSON}{person}/{COLOR}{layer}")
}

/// Returns the person that a label of the person stream names, and the layer of a label of colours; `None` for any other label.
pub(crate) fn person_in(label: &str) -> Option<(u32, Option<usize>)> {
    let person: u32 = label.strip_prefix(PERSON)?.split('/').next()?.parse().ok()?;
    if label == motion_label(person) {
        return Some((person, None));
    }
    (0..flyrig_stream::LAYERS).find(|layer| label == color_label(person, *layer)).map(|layer| (person, Some(layer)))
}

/// Returns whether a label belongs, or claims to belong, to the person stream.
pub(crate) fn is_person(label: &str) -> bool {
    label.starts_with(PERSON)
}

/// Returns the label under which a chunk of a template is queried.
pub(crate) fn chunk_label(hash: u64, chunk: u32) -> String {
    format!("template/{hash:016x}-{chunk}")
}

/// Returns hash and chunk number of such a label.
pub(crate) fn chunk_in(label: &str) -> Option<(u64, u32)> {
    let (hash, chunk) = label.strip_prefix("template/")?.split_once('-')?;
    Some((u64::from_str_radix(hash, 16).ok()?, chunk.parse().ok()?))
}

/// Label under which the last motions of all people are queried.
pub(crate) const LAST_MOTIONS: &str = "present/motions";

/// Returns the label under which the hash of the present colours of a person is queried, from a layer on.
pub(crate) fn whole_colors_label(person: u32, first_layer: usize) -> String {
    format!("present/colors-{person}-{first_layer}")
}

/// Returns person and first layer of such a label.
pub(crate) fn whole_colors_in(label: &str) -> Option<(u32, usize)> {
    let (person, layer) = label.strip_prefix("present/colors-")?.split_once('-')?;
    let layer = layer.parse().ok().filter(|layer| *layer < flyrig_stream::LAYERS)?;
    Some((person.parse().ok()?, layer))
}

/// Returns whether a label is that of splats.
pub(crate) fn is_splats(label: &str) -> bool {
    label == "splats" || label.starts_with(PERSON_SPLATS)
}

/// Returns the key expression of the liveliness of publishers of any schema version.
pub(crate) fn any_version_alive(rig: &str) -> String {
    format!("flyrig/*/{rig}/alive/*")
}

/// Prefix of the labels of camera status.
pub(crate) const STATUS: &str = "camera-status/";

/// Returns the label of a camera's images.
pub(crate) fn frames_label(camera: &CameraId) -> String {
    format!("camera/{camera}")
}

/// Returns the label of a camera's status.
pub(crate) fn status_label(camera: &CameraId) -> String {
    format!("{STATUS}{camera}")
}

/// Returns the label under which a holder of a key sends what a program without a key sends under `label`.
pub(crate) fn of_holder(label: &str, holder: &str) -> String {
    format!("{label}/{holder}")
}

/// Returns the name in topics of a session of a key's holder, whose rights its first part selects.
pub(crate) fn session_name(topic_name: &str, session: &str) -> String {
    format!("{topic_name}.{session}")
}

/// Returns the holder's part of the name of one of its sessions; `None` for a program without a key.
pub(crate) fn holder_in(name: &str) -> Option<&str> {
    name.split_once('.').map(|(holder, _)| holder)
}

/// Key expression of the liveliness of computers with cameras, of any rig and schema version.
pub(crate) const ANY_HOST: &str = "flyrig/*/*/host/*";

/// Returns the rig that a key names.
pub(crate) fn rig_in(key: &str) -> Option<&str> {
    key.strip_prefix("flyrig/")?.split('/').nth(1)
}

/// Returns the label of a key: the part behind version and rig.
pub(crate) fn label_in(key: &str) -> Option<&str> {
    key.strip_prefix("flyrig/")?.splitn(3, '/').nth(2)
}

/// Returns the part of a key that `*` matches in `<before>/*<after>`.
pub(crate) fn name_in<'a>(key: &'a str, before: &str, after: &str) -> Option<&'a str> {
    let name = label_in(key)?.strip_prefix(before)?.strip_prefix('/')?.strip_suffix(after)?;
    (!name.is_empty() && !name.contains('/')).then_some(name)
}

/// Returns the version that a key states, as written.
pub(crate) fn version_in(key: &str) -> Option<&str> {
    key.strip_prefix("flyrig/")?.split('/').next()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back_out_of_keys() {
        assert_eq!(key("studio", &view_label("front")), "flyrig/v1/studio/view/front");
        assert_eq!(key("studio", &view_label("viewer-ab12")), "flyrig/v1/studio/viewer/ab12/view");
        assert_eq!(name_in("flyrig/v1/studio/view/front", "view", ""), Some("front"));
        assert_eq!(name_in("flyrig/v1/studio/viewer/ab12/alive", "viewer", "/alive"), Some("ab12"));
        assert_eq!(name_in("flyrig/v1/studio/viewer/ab12/view", "viewer", "/alive"), None);
        assert_eq!(name_in("flyrig/v1", "view", ""), None);
        assert_eq!(version_in("flyrig/v7/studio/alive/x"), Some("v7"));
        assert_eq!(holder_in(&session_name("ab12-3", "7f")), Some("ab12-3"));
        assert_eq!(holder_in("7f"), None);
    }

    #[test]
    fn persons_come_back_out_of_labels() {
        assert_eq!(person_in(&motion_label(7)), Some((7, None)));
        assert_eq!(person_in(&color_label(0, 2)), Some((0, Some(2))));
        assert_eq!(chunk_in(&chunk_label(u64::MAX - 3, 12)), Some((u64::MAX - 3, 12)));
        assert_eq!(chunk_in("template/zz-1"), None);
        assert_eq!(whole_colors_in(&whole_colors_label(7, 2)), Some((7, 2)));
        assert_eq!((whole_colors_in("present/colors-7-3"), whole_colors_in("present/motions")), (None, None));
        for bad in
            ["person/07/motion", "person/x/motion", "person/1/color-3", "person/1", "person/1/motion/x", "splats"]
        {
            assert_eq!(person_in(bad), None, "{bad}");
        }
    }

    #[test]
    fn wild_or_endless_names_are_refused() {
        for bad in ["", "*", "a/b", "a$b", "é", "a b", &"x".repeat(65)] {
            assert!(check_name("view", bad).is_err(), "{bad}");
        }
        check_name("view", &"x".repeat(64)).unwrap();
    }
}
