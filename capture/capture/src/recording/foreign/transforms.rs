//! Poses of cameras from the tree of coordinate frames (ROS tf, foxglove `FrameTransform`).

use std::collections::BTreeMap;

use flyrig_types::{Isometry, shortened};
use glam::DVec3;

use crate::recording::schemas::Link;

/// Most links from a camera to the root.
const MOST_DEPTH: usize = 64;
/// Motion of a frame below which it stands still: metres, radians.
const STILL_M: f64 = 1e-3;
const STILL_RAD: f64 = 1e-3;
/// Cosine of the angle to the vertical within which a camera looks straight up.
const STRAIGHT_UP: f64 = 0.8;

/// Coordinate frames, each with its parent.
#[derive(Debug, Default)]
pub(super) struct Frames {
    parents: BTreeMap<String, Parent>,
}

#[derive(Debug)]
struct Parent {
    name: String,
    parent_from_child: Isometry,
    /// Whether the frame moves in its parent, or changes it.
    moves: bool,
}

/// Cameras in a common world.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Poses {
    /// `frame_from_world` of each camera's coordinate frame.
    pub frame_from_world: Vec<Isometry>,
    /// Direction against gravity, where the world's name implies it.
    pub up: Option<DVec3>,
}

fn plain(name: &str) -> &str {
    name.trim_start_matches('/')
}

impl Frames {
    /// Adds a link; what is no rigid motion is left out.
    pub fn add(&mut self, link: Link) {
        let Link { parent, child, parent_from_child } = link;
        let length = parent_from_child.rotation.length();
        if !parent_from_child.is_finite() || (length - 1.0).abs() > 1e-3 {
            return;
        }
        let parent_from_child = Isometry::new(parent_from_child.rotation.normalize(), parent_from_child.translation);
        let name = plain(&parent).to_owned();
        match self.parents.get_mut(plain(&child)) {
            None => {
                self.parents.insert(plain(&child).to_owned(), Parent { name, parent_from_child, moves: false });
            }
            Some(known) => {
                let first = known.parent_from_child;
                let shift = first.translation.distance(parent_from_child.translation);
                let turn = first.rotation.angle_between(parent_from_child.rotation);
                known.moves |= known.name != name || shift > STILL_M || turn > STILL_RAD;
            }
        }
    }

    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }

    /// Returns the frames from a camera's own outwards, up to the first that moves in its parent, with
    /// `ancestor_from_camera`.
    fn chain(&self, frame: &str) -> Vec<(&str, Isometry)> {
        let Some((frame, _)) = self.parents.get_key_value(frame) else { return Vec::new() };
        let (mut at, mut from_camera) = (frame.as_str(), Isometry::IDENTITY);
        let mut chain = vec![(at, from_camera)];
        while let Some(parent) = self.parents.get(at).filter(|parent| !parent.moves) {
            at = parent.name.as_str();
            if chain.len() > MOST_DEPTH || chain.iter().any(|(known, _)| *known == at) {
                break;
            }
            from_camera = parent.parent_from_child * from_camera;
            chain.push((at, from_camera));
        }
        chain
    }

    /// Returns the poses of the cameras with these coordinate frames.
    ///
    /// # Errors
    /// Explains which frame has no place in a common world.
    pub fn poses(&self, frames: &[&str]) -> Result<Poses, String> {
        for (i, frame) in frames.iter().enumerate() {
            if frame.is_empty() {
                return Err("the images name no coordinate frame".to_owned());
            }
            if frames[..i].contains(frame) {
                return Err(format!("two cameras have the coordinate frame '{}'", shortened(frame)));
            }
        }
        let named: Vec<&str> = frames.iter().map(|frame| plain(frame)).collect();
        let chains: Vec<Vec<(&str, Isometry)>> = named.iter().map(|frame| self.chain(frame)).collect();
        for (frame, chain) in named.iter().zip(&chains) {
            match self.parents.get(*frame) {
                None => return Err(format!("no transform leads from the coordinate frame '{}'", shortened(frame))),
                Some(parent) if chain.len() < 2 && parent.moves => {
                    return Err(format!("the coordinate frame '{}' moves", shortened(frame)));
                }
                Some(_) => {}
            }
        }
        let place = |chain: &[(&str, Isometry)], name: &str| {
            chain.iter().find(|(known, _)| *known == name).map(|(_, from_camera)| from_camera.inverse())
        };
        let (first, others) = chains.split_first().ok_or("there is no camera")?;
        let world = first.iter().rev().map(|(name, _)| *name);
        let world = world.into_iter().find(|name| others.iter().all(|chain| place(chain, name).is_some()));
        let world =
            world.ok_or_else(|| "the transforms do not join the cameras, or those between them move".to_owned())?;
        let frame_from_world: Vec<Isometry> = chains.iter().filter_map(|chain| place(chain, world)).collect();
        // Axes of cameras do not say where up is; those of all other frames have z up (REP 103).
        let is_optical = named.contains(&world) || world.ends_with("optical_frame") || world.ends_with("optical");
        let up = (!is_optical).then_some(DVec3::Z);
        let looks_up = |pose: &Isometry| (pose.rotation.inverse() * DVec3::Z).z > STRAIGHT_UP;
        if up.is_some() && frame_from_world.iter().all(looks_up) {
            let text = "has z up: it is the camera's body, not its optical frame (x right, y down, z forward)";
            return Err(format!("the coordinate frame '{}' {text}", shortened(named[0])));
        }
        Ok(Poses { frame_from_world, up })
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    fn add(frames: &mut Frames, parent: &str, child: &str, rotation: DQuat, translation: DVec3) {
        let parent_from_child = Isometry { rotation, translation };
        frames.add(Link { parent: parent.to_owned(), child: child.to_owned(), parent_from_child });
    }

    /// Camera that looks along x of its parent, which has z up.
    fn optical() -> DQuat {
        DQuat::from_mat3(&glam::DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X))
    }

    #[test]
    fn cameras_are_placed_in_the_outermost_frame_that_they_share_at_rest() {
        let mut frames = Frames::default();
        // The rig drives about; its cameras do not move in it.
        for step in 0..3 {
            add(&mut frames, "map", "base", DQuat::IDENTITY, DVec3::X * f64::from(step));
        }
        add(&mut frames, "base", "/left_link", DQuat::from_rotation_z(1.0), DVec3::new(1.0, 2.0, 3.0));
        add(&mut frames, "left_link", "left", optical(), DVec3::ZERO);
        add(&mut frames, "base", "right", optical(), DVec3::new(0.0, -1.0, 1.5));
        let Poses { frame_from_world, up } = frames.poses(&["left", "/right"]).unwrap();
        assert_eq!(up, Some(DVec3::Z));
        let eyes = frame_from_world.iter().map(|pose| pose.inverse().translation).collect::<Vec<_>>();
        assert!(eyes[0].distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-12, "{eyes:?}");
        assert!(eyes[1].distance(DVec3::new(0.0, -1.0, 1.5)) < 1e-12, "{eyes:?}");
        let forward = frame_from_world[0].rotation.inverse() * DVec3::Z;
        assert!(forward.distance(DQuat::from_rotation_z(1.0) * DVec3::X) < 1e-12, "{forward}");
        let up_in_image = frame_from_world[1].rotation * DVec3::Z;
        assert!(up_in_image.distance(DVec3::NEG_Y) < 1e-12);
    }

    #[test]
    fn frames_without_a_common_place_are_named() {
        let mut frames = Frames::default();
        add(&mut frames, "left", "right", DQuat::IDENTITY, DVec3::X);
        let error = |frames: &Frames, of: &[&str]| frames.poses(of).unwrap_err();
        assert!(error(&frames, &["right", "other"]).contains("leads from the coordinate frame 'other'"));
        assert!(error(&frames, &["right", ""]).contains("name no coordinate frame"));
        assert!(error(&frames, &["right", "right"]).contains("two cameras have the coordinate frame 'right'"));
        add(&mut frames, "elsewhere", "third", optical(), DVec3::ZERO);
        assert!(error(&frames, &["right", "third"]).contains("do not join the cameras"));
        add(&mut frames, "elsewhere", "third", optical(), DVec3::X);
        assert!(error(&frames, &["third", "right"]).contains("'third' moves"));
        // x forward, z up: the camera's body.
        add(&mut frames, "world", "a", DQuat::from_rotation_z(1.0), DVec3::X);
        add(&mut frames, "world", "b", DQuat::from_rotation_z(2.0), DVec3::Y);
        assert!(error(&frames, &["a", "b"]).contains("not its optical frame"));
        // A circle, and numbers that are no motion.
        add(&mut frames, "p", "q", optical(), DVec3::X);
        add(&mut frames, "q", "p", optical(), DVec3::X);
        add(&mut frames, "world", "c", DQuat::from_xyzw(0.0, 0.0, 0.0, 5.0), DVec3::X);
        assert!(frames.poses(&["p", "q"]).is_ok());
        assert!(error(&frames, &["c"]).contains("leads from"));
    }

    #[test]
    fn the_frame_of_a_camera_says_nothing_about_up() {
        let mut frames = Frames::default();
        add(&mut frames, "left", "right", DQuat::IDENTITY, DVec3::X);
        add(&mut frames, "rig_optical_frame", "left", DQuat::IDENTITY, DVec3::X);
        let poses = frames.poses(&["left", "right"]).unwrap();
        assert_eq!((poses.up, poses.frame_from_world.len()), (None, 2));
    }
}
