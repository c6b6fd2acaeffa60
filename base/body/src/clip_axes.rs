//! Axes of motion clips whose format states none, read off the recorded person.

use glam::{DQuat, DVec3};

use crate::motion_clip::{MotionClip, Moved};

/// Frames that are looked at, spread over the clip.
const FRAMES: usize = 200;

/// Least part of the distance from feet to head along an axis for the axis to count as up.
const UPRIGHT: f64 = 0.8;

/// Least part of a foot's or thigh's length by which it points backwards, on average, in mirrored axes.
const BACKWARDS: f64 = 0.25;

/// Joints of a clip that show its axes: top of the spine, and hip, knee, ankle and toe of the left and right leg.
pub(crate) struct Landmarks {
    pub top: Option<usize>,
    pub legs: [([usize; 3], Option<usize>); 2],
}

/// Axes x, y, z and their opposites.
const AXES: [DVec3; 6] = [DVec3::Y, DVec3::Z, DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z, DVec3::NEG_X];
const NAMES: [&str; 6] = ["y", "z", "x", "-y", "-z", "-x"];

impl MotionClip {
    /// Returns the clip in right-handed axes with y up where the person shows that the file has others: feet are below the head,
    /// toes and knees in front. Logs each change; `None` without a change.
    pub(crate) fn with_usual_axes(&self, landmarks: &Landmarks) -> Option<Self> {
        if self.axes_are_stated {
            return None;
        }
        let up = self.up_axis(landmarks);
        let turned = (up != 0).then(|| {
            tracing::warn!(
                "{}: the person's head is along {} of the feet; turned so that y is up",
                self.what,
                NAMES[up]
            );
            let turn = match AXES[up] {
                // Half a turn from side to side, so that a person who faces -z in axes of a camera faces +z.
                DVec3::NEG_Y => DQuat::from_rotation_x(std::f64::consts::PI),
                axis => DQuat::from_rotation_arc(axis, DVec3::Y),
            };
            self.mapped(|place| turn * place, |rotation| (turn * rotation * turn.inverse()).normalize())
        });
        let clip = turned.as_ref().unwrap_or(self);
        if !clip.is_mirrored(landmarks) {
            return turned;
        }
        tracing::warn!(
            "{}: toes and knees point backwards between the left and the right leg; mirrored, as from left-handed axes",
            self.what
        );
        let flip = |place: DVec3| DVec3::new(-place.x, place.y, place.z);
        Some(clip.mapped(flip, |q| DQuat::from_xyzw(q.x, -q.y, -q.z, q.w)))
    }

    fn mapped(&self, place: impl Fn(DVec3) -> DVec3, turn: impl Fn(DQuat) -> DQuat) -> Self {
        let moved = |joint: &Moved| Moved { position: place(joint.position), turned: turn(joint.turned) };
        Self {
            origins: self.origins.iter().map(|&origin| place(origin)).collect(),
            frames: self.frames.iter().map(|(at, joints)| (*at, joints.iter().map(moved).collect())).collect(),
            ..self.clone()
        }
    }

    /// Returns frames spread over the clip.
    pub(crate) fn spread_frames(&self, count: usize) -> impl Iterator<Item = &Vec<Moved>> {
        self.frames.iter().step_by(self.frames.len().div_ceil(count).max(1)).map(|(_, joints)| joints)
    }

    /// Returns the index of the axis along which head and feet lie apart; 0, y, where nothing speaks against it.
    fn up_axis(&self, Landmarks { top, legs }: &Landmarks) -> usize {
        let Some(top) = *top else { return 0 };
        let axis = |at: &dyn Fn(usize) -> DVec3| {
            let up = (at(top) - (at(legs[0].0[2]) + at(legs[1].0[2])) * 0.5).try_normalize()?;
            AXES.iter().position(|axis| axis.dot(up) > UPRIGHT)
        };
        let mut votes = [0usize; 6];
        let mut frames = 0;
        for joints in self.spread_frames(FRAMES) {
            frames += 1;
            if let Some(axis) = axis(&|joint| joints[joint].position) {
                votes[axis] += 1;
            }
        }
        let Some((up, &most)) = votes.iter().enumerate().rev().max_by_key(|(_, votes)| **votes) else { return 0 };
        // A rest pose shows the axes too, where it is one: the legs lead away from the trunk.
        let leads_away = legs.iter().all(|([hip, _, ankle], _)| {
            let hip = self.origins[*hip];
            (self.origins[*ankle] - hip).dot(self.origins[top] - hip) < 0.0
        });
        let rest = axis(&|joint| self.origins[joint]).filter(|_| leads_away);
        match rest {
            _ if up == 0 || most == 0 => 0,
            Some(0) => {
                tracing::warn!(
                    "{}: the person lies in most frames (head along {} of the feet), but rests with y up; y is taken as up",
                    self.what,
                    NAMES[up]
                );
                0
            }
            Some(rest) if rest == up => up,
            _ if most * 2 > frames => up,
            _ => 0,
        }
    }

    /// Returns whether toes, or else knees, point backwards seen from the order of the legs.
    fn is_mirrored(&self, Landmarks { top, legs }: &Landmarks) -> bool {
        let (mut sum, mut count) = (0.0, 0.0f64);
        for joints in self.spread_frames(FRAMES) {
            let at = |joint: usize| joints[joint].position;
            let hips = (at(legs[0].0[0]) + at(legs[1].0[0])) * 0.5;
            let up = top.map_or(DVec3::Y, |top| at(top) - hips);
            let Some(front) = (at(legs[0].0[0]) - at(legs[1].0[0])).cross(up).try_normalize() else { continue };
            for ([hip, knee, ankle], toe) in legs {
                let pointing = match toe {
                    Some(toe) => at(*toe) - at(*ankle),
                    None => at(*knee) - (at(*hip) + at(*ankle)) * 0.5,
                };
                let length = toe.map_or(at(*hip).distance(at(*knee)), |toe| at(toe).distance(at(*ankle)));
                sum += pointing.dot(front) / length.max(1e-9);
                count += 1.0;
            }
        }
        sum / count.max(1.0) < -BACKWARDS
    }
}
