//! Names of cameras from the topics of their images.

/// Last parts of topics that name the kind of image and not the camera.
const OF_IMAGES: [&str; 16] = [
    "compressed",
    "image",
    "images",
    "image_raw",
    "image_color",
    "image_mono",
    "image_rect",
    "image_rect_color",
    "image_rect_raw",
    "image_rect_mono",
    "image_compressed",
    "image_raw_color",
    "image_color_raw",
    "raw",
    "rect",
    "rectified",
];

/// Returns the parts of a topic between its slashes.
pub(super) fn parts(topic: &str) -> Vec<&str> {
    topic.split('/').filter(|part| !part.is_empty()).collect()
}

/// Returns the parts of a topic without those that name the kind of image: equal for all images of one camera.
pub(super) fn base(topic: &str) -> Vec<&str> {
    let mut parts = parts(topic);
    while parts.last().is_some_and(|last| OF_IMAGES.contains(last)) {
        parts.pop();
    }
    parts
}

/// Returns whether a topic holds rectified images.
pub(super) fn is_rectified(topic: &str) -> bool {
    parts(topic).iter().any(|part| *part == "rect" || *part == "rectified" || part.starts_with("image_rect"))
}

/// Returns the names of cameras: the parts that differ from topic to topic, joined by an underscore; of a single camera
/// the last part.
pub(super) fn names(bases: &[Vec<&str>]) -> Vec<String> {
    let shortest = bases.iter().map(Vec::len).min().unwrap_or(0);
    let agree = |at: &dyn Fn(&[&str]) -> Option<String>| {
        let first = bases.first().and_then(|base| at(base));
        first.is_some() && bases.iter().all(|base| at(base) == first)
    };
    // One part always remains.
    let most = shortest.saturating_sub(1);
    let prefix = (0..most).take_while(|&i| agree(&|base| base.get(i).map(|part| (*part).to_owned()))).count();
    let suffix = (0..most - prefix)
        .take_while(|&i| agree(&|base| base.iter().rev().nth(i).map(|part| (*part).to_owned())))
        .count();
    let suffix = if bases.len() < 2 { 0 } else { suffix };
    let name = |base: &Vec<&str>| match base.get(prefix..base.len().saturating_sub(suffix)) {
        Some(parts) if !parts.is_empty() => parts.join("_"),
        _ => "camera".to_owned(),
    };
    bases.iter().map(name).collect()
}

/// Finds the calibration of each camera, as a position in `lenses`: in the same namespace, with the same coordinate
/// frame, or of the same name. A calibration that would serve two cameras serves neither.
pub(super) fn pair(cameras: &[PairedTopic<'_>], lenses: &[PairedTopic<'_>]) -> Vec<Option<usize>> {
    let namespaces: Vec<Vec<&str>> = lenses.iter().map(|lens| namespace(lens.topic)).collect();
    let lens_names = names(&namespaces);
    let by_namespace = |camera: &PairedTopic<'_>| {
        let parts = parts(camera.topic);
        let is_inside = |(_, space): &(usize, &Vec<&str>)| !space.is_empty() && parts.starts_with(space);
        let found = namespaces.iter().enumerate().filter(is_inside).max_by_key(|(_, space)| space.len());
        found.map(|(i, _)| i).or_else(|| namespaces.iter().position(Vec::is_empty).filter(|_| cameras.len() == 1))
    };
    let only = |is_so: &dyn Fn(usize) -> bool| {
        let mut found = (0..lenses.len()).filter(|&i| is_so(i));
        found.next().filter(|_| found.next().is_none())
    };
    let by_frame =
        |camera: &PairedTopic<'_>| only(&|i| !camera.frame_id.is_empty() && lenses[i].frame_id == camera.frame_id);
    let by_name = |camera: &PairedTopic<'_>| only(&|i| lens_names[i] == camera.name);
    let proposals: [Vec<Option<usize>>; 3] = [
        cameras.iter().map(by_namespace).collect(),
        cameras.iter().map(by_frame).collect(),
        cameras.iter().map(by_name).collect(),
    ];
    let mut paired = vec![None; cameras.len()];
    for proposed in proposals {
        for (slot, found) in proposed.iter().enumerate() {
            let is_free = !paired.contains(found) && proposed.iter().filter(|other| *other == found).count() == 1;
            if paired[slot].is_none() && found.is_some() && is_free {
                paired[slot] = *found;
            }
        }
    }
    paired
}

/// Topic to be paired.
#[derive(Debug, Clone, Copy)]
pub(super) struct PairedTopic<'a> {
    pub topic: &'a str,
    pub frame_id: &'a str,
    /// Name of the camera; unused for calibrations.
    pub name: &'a str,
}

/// Returns the namespace of a calibration: its topic without the last part if that names its kind.
fn namespace(topic: &str) -> Vec<&str> {
    let mut parts = parts(topic);
    let is_kind = |last: &&str| ["info", "calib", "intrinsics"].iter().any(|word| last.to_lowercase().contains(word));
    if parts.last().is_some_and(is_kind) {
        parts.pop();
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(topics: &[&str]) -> Vec<String> {
        names(&topics.iter().map(|topic| base(topic)).collect::<Vec<_>>())
    }

    #[test]
    fn the_part_that_differs_names_the_camera() {
        assert_eq!(named(&["/cam_a/image_raw/compressed", "/cam_b/image_raw/compressed"]), ["cam_a", "cam_b"]);
        assert_eq!(named(&["/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"]), ["infra1", "infra2"]);
        assert_eq!(named(&["/camera/color/image_raw", "/camera/infra1/image_rect_raw"]), ["color", "infra1"]);
        assert_eq!(named(&["/robot/left/cam/image", "/robot/right/cam/image"]), ["left", "right"]);
        assert_eq!(named(&["/a/x/image", "/b/image"]), ["a_x", "b"]);
        assert_eq!(named(&["/rig/image_left", "/rig/image_right"]), ["image_left", "image_right"]);
        assert_eq!(named(&["/cam/image", "/cam/left/image"]), ["cam", "cam_left"]);
        assert_eq!(named(&["/cam/front/image"]), ["front"]);
        assert_eq!(named(&["/image_raw"]), ["camera"]);
        assert_eq!(named(&["camera/left", "camera/right"]), ["left", "right"]);
        assert!(is_rectified("/a/image_rect_color/compressed") && is_rectified("/a/rect/image"));
        assert!(!is_rectified("/a/image_raw") && !is_rectified("/direct/image"));
    }

    fn topic<'a>(topic: &'a str, frame_id: &'a str, name: &'a str) -> PairedTopic<'a> {
        PairedTopic { topic, frame_id, name }
    }

    #[test]
    fn calibrations_are_found_by_namespace_then_frame_then_name() {
        let cameras = [topic("/a/image_raw/compressed", "shared", "a"), topic("/b/image_raw", "shared", "b")];
        let lenses = [topic("/b/camera_info", "shared", ""), topic("/a/camera_info", "shared", "")];
        assert_eq!(pair(&cameras, &lenses), [Some(1), Some(0)]);
        let cameras = [topic("/rig/left", "l", "left"), topic("/rig/right", "r", "right")];
        let lenses = [topic("/info/0", "r", ""), topic("/info/1", "l", "")];
        assert_eq!(pair(&cameras, &lenses), [Some(1), Some(0)]);
        let cameras = [topic("camera/left", "", "left"), topic("camera/right", "", "right")];
        let lenses = [topic("calibration/right", "", ""), topic("calibration/left", "", "")];
        assert_eq!(pair(&cameras, &lenses), [Some(1), Some(0)]);
        // One calibration for two cameras is that of neither.
        let lenses = [topic("/rig/camera_info", "x", "")];
        let cameras = [topic("/rig/left", "x", "left"), topic("/rig/right", "x", "right")];
        assert_eq!(pair(&cameras, &lenses), [None, None]);
        assert_eq!(pair(&[topic("/image_raw", "", "camera")], &[topic("/camera_info", "", "")]), [Some(0)]);
    }
}
