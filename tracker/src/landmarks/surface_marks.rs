//! Places of BlazePose's landmarks on a template: joints, and places on the skin found by their geometry.

use flyrig_body::Template;
use glam::DVec3;

use crate::error::{TrackError, TrackErrorKind};
use crate::landmarks::keypoints::{
    LANDMARK_COUNT, LEFT_ANKLE, LEFT_ELBOW, LEFT_HEEL, LEFT_HIP, LEFT_INDEX, LEFT_KNEE, LEFT_LITTLE, LEFT_SHOULDER,
    LEFT_THUMB, LEFT_TOES, LEFT_WRIST, NOSE,
};
use crate::pose::anatomy::Roles;

/// Point of a template that moves with one joint; canonical space, metres.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct BodyMark {
    pub joint: usize,
    pub point: DVec3,
}

impl BodyMark {
    /// Returns a point that moves with a joint.
    fn on_joint(joint: usize, point: DVec3) -> Self {
        Self { joint, point }
    }
}

/// Returns the landmarks' places on a template.
///
/// Shoulders, elbows, wrists, hips, knees and ankles are joints; landmarks of face, hands and feet are places on the
/// surface, since the network was trained on images that people annotated on the skin.
///
/// # Errors
/// Kind `Template` when head, feet or hands have no vertices.
pub(crate) fn find_marks(
    template: &Template,
    roles: &Roles,
    origins: &[DVec3],
) -> Result<[BodyMark; LANDMARK_COUNT], TrackError> {
    let body = Body { template, roles, origins };
    let mut marks: [BodyMark; LANDMARK_COUNT] = [BodyMark::default(); LANDMARK_COUNT];
    for side in 0..2 {
        // A joint's centre lies on both bones; it moves with the one in whose axes its habit was measured.
        let parent = |joint: usize| template.skeleton.joints()[joint].parent.unwrap_or(joint);
        for (landmark, mover, center) in [
            (LEFT_SHOULDER, parent(roles.upper_arm[side]), roles.upper_arm[side]),
            (LEFT_ELBOW, roles.upper_arm[side], roles.forearm[side]),
            (LEFT_WRIST, roles.hand[side], roles.hand[side]),
            (LEFT_HIP, parent(roles.thigh[side]), roles.thigh[side]),
            (LEFT_KNEE, roles.thigh[side], roles.shank[side]),
            (LEFT_ANKLE, roles.foot[side], roles.foot[side]),
        ] {
            marks[landmark + side] = BodyMark::on_joint(mover, origins[center]);
        }
    }
    body.mark_face(&mut marks)?;
    for side in 0..2 {
        body.mark_foot(side, &mut marks)?;
        body.mark_hand(side, &mut marks)?;
    }
    Ok(marks)
}

/// Template whose landmarks are placed.
struct Body<'a> {
    template: &'a Template,
    roles: &'a Roles,
    /// Joint origins in canonical space, metres.
    origins: &'a [DVec3],
}

impl Body<'_> {
    /// Whether a joint hangs below another or is it.
    fn is_below(&self, mut joint: usize, ancestor: usize) -> bool {
        let joints = self.template.skeleton.joints();
        loop {
            if joint == ancestor {
                return true;
            }
            match joints.get(joint).and_then(|joint| joint.parent) {
                Some(parent) => joint = parent,
                None => return false,
            }
        }
    }

    /// Returns the vertices whose strongest joint is `joint` or hangs below it, ascending.
    fn vertices_below(&self, joint: usize) -> Vec<usize> {
        let joints = 0..self.template.skeleton.joints().len();
        let below: Vec<bool> = joints.map(|other| self.is_below(other, joint)).collect();
        let strongest = |vertex: usize| usize::from(self.template.skin[vertex].joints[0]);
        (0..self.template.positions.len()).filter(|&vertex| below.get(strongest(vertex)) == Some(&true)).collect()
    }

    /// Returns the canonical position of a vertex, metres.
    fn position(&self, vertex: usize) -> DVec3 {
        self.template.positions[vertex].as_dvec3()
    }

    /// Returns the error of a part without vertices.
    fn missing(&self, part: &str) -> TrackError {
        let name = &self.template.name;
        TrackError::new(
            TrackErrorKind::Template,
            format!("template '{name}' has no vertices on the {part}; give it skin weights there"),
        )
    }

    /// Places nose, eyes, mouth and ears.
    fn mark_face(&self, marks: &mut [BodyMark; LANDMARK_COUNT]) -> Result<(), TrackError> {
        let roles = self.roles;
        let head = self.vertices_below(roles.head);
        let all = || head.iter().map(|&v| self.position(v));
        let top = all().map(|p| p.y).fold(f64::NEG_INFINITY, f64::max);
        let middle_x = all().map(|p| p.x).sum::<f64>() / head.len().max(1) as f64;
        // The nose is the foremost point near the plane of symmetry, at least 8 cm under the crown.
        let scale = (top / 1.7).clamp(0.3, 2.0);
        let nose = all()
            .filter(|p| (p.x - middle_x).abs() < 0.015 * scale && p.y < top - 0.08 * scale)
            .max_by(|a, b| a.z.total_cmp(&b.z))
            .ok_or_else(|| self.missing("head"))?;
        // Proportions of an adult face; the distance crown to nose is about 15 cm.
        let unit = (top - nose.y).max(0.05) / 0.15;
        let skin_at = |x: f64, y: f64, z_back: f64| {
            let (x, y) = (nose.x + x * unit, nose.y + y * unit);
            let near = |p: &DVec3| (p.x - x).powi(2) + (p.y - y).powi(2) < (0.008 * unit).powi(2);
            let z = all().filter(near).map(|p| p.z).fold(f64::NEG_INFINITY, f64::max);
            // Holes in the mesh (eyes, mouth) leave no vertex: fall back to a set-back plane.
            let z = if z.is_finite() { z } else { nose.z - z_back * unit };
            DVec3::new(x, y, z)
        };
        let mut put = |landmark: usize, point: DVec3| marks[landmark] = BodyMark::on_joint(roles.head, point);
        put(NOSE, nose);
        for (side, sign) in [(0, 1.0), (3, -1.0)] {
            put(1 + side, skin_at(sign * 0.018, 0.036, 0.025));
            put(2 + side, skin_at(sign * 0.032, 0.036, 0.03));
            put(3 + side, skin_at(sign * 0.046, 0.036, 0.04));
        }
        for (side, sign) in [(0, 1.0), (1, -1.0)] {
            put(9 + side, skin_at(sign * 0.025, -0.035, 0.025));
            // The outermost point between eye and mouth height is the ear.
            let ear = all()
                .filter(|p| (nose.y - 0.03 * unit..nose.y + 0.045 * unit).contains(&p.y))
                .max_by(|a, b| (a.x * sign).total_cmp(&(b.x * sign)))
                .ok_or_else(|| self.missing("head"))?;
            put(7 + side, ear + DVec3::new(-sign * 0.005, 0.0, 0.01) * unit);
        }
        Ok(())
    }

    /// Places heel and toes of a side.
    fn mark_foot(&self, side: usize, marks: &mut [BodyMark; LANDMARK_COUNT]) -> Result<(), TrackError> {
        let Body { roles, origins, .. } = *self;
        let foot = roles.foot[side];
        let vertices = self.vertices_below(foot);
        let lowest = vertices.iter().map(|&v| self.position(v).y).fold(f64::INFINITY, f64::min);
        let low = |p: &DVec3| p.y < lowest + 0.06;
        let points: Vec<DVec3> = vertices.iter().map(|&v| self.position(v)).filter(low).collect();
        if points.is_empty() {
            return Err(self.missing("foot"));
        }
        let back = points.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
        let front = points.iter().map(|p| p.z).fold(f64::NEG_INFINITY, f64::max);
        let mean = |keep: &dyn Fn(&DVec3) -> bool| {
            let kept: Vec<&DVec3> = points.iter().filter(|p| keep(p)).collect();
            kept.iter().copied().sum::<DVec3>() / kept.len().max(1) as f64
        };
        let ankle = origins[foot];
        marks[LEFT_HEEL + side] = BodyMark::on_joint(foot, mean(&|p| p.z < back + 0.02));
        let toes = mean(&|p| p.z > front - 0.03);
        // Toward the big toe: the side of the body's middle plane.
        let inner = -ankle.x.signum() * 0.01;
        marks[LEFT_TOES + side] = BodyMark::on_joint(foot, toes + DVec3::new(inner, 0.0, 0.0));
        Ok(())
    }

    /// Places little finger, index finger and thumb of a side.
    fn mark_hand(&self, side: usize, marks: &mut [BodyMark; LANDMARK_COUNT]) -> Result<(), TrackError> {
        let Body { roles, origins, template } = *self;
        let hand = roles.hand[side];
        let wrist = origins[hand];
        let joints = template.skeleton.joints();
        let thumb_joint = (0..joints.len())
            .find(|&j| joints[j].name.to_ascii_lowercase().contains("thumb") && self.is_below(j, hand));
        let thumb: Vec<usize> = thumb_joint.map_or(Vec::new(), |joint| self.vertices_below(joint));
        // The thumb stands off the row of fingers: without it the mean of the flesh gives the fingers' direction.
        let points: Vec<DVec3> = self
            .vertices_below(hand)
            .into_iter()
            .filter(|v| thumb.binary_search(v).is_err())
            .map(|v| self.position(v))
            .collect();
        if points.is_empty() {
            return Err(self.missing("hand"));
        }
        let center = points.iter().copied().sum::<DVec3>() / points.len() as f64;
        let along = (center - wrist).normalize_or(wrist - origins[roles.forearm[side]]).normalize_or(DVec3::X);
        let length = points.iter().map(|p| (*p - wrist).dot(along)).fold(0.0, f64::max);
        let thumb_center =
            (!thumb.is_empty()).then(|| thumb.iter().map(|&v| self.position(v)).sum::<DVec3>() / thumb.len() as f64);
        // A skeleton without a thumb: it points to the front in any usual bind pose.
        let toward_thumb = thumb_center.map_or(DVec3::Z, |thumb| thumb - wrist);
        let across = (toward_thumb - along * toward_thumb.dot(along)).normalize_or(DVec3::Z);
        // The row of knuckles, at half the hand's length; its ends are those of the index and little fingers.
        let row: Vec<DVec3> = points
            .iter()
            .copied()
            .filter(|p| (0.4..0.6).contains(&((*p - wrist).dot(along) / length.max(1e-3))))
            .collect();
        let end = |side: f64| {
            let extent = |p: &DVec3| (*p - wrist).dot(across) * side;
            let edge = row.iter().map(extent).fold(f64::NEG_INFINITY, f64::max);
            let rim: Vec<DVec3> = row.iter().copied().filter(|p| extent(p) > edge - 0.02).collect();
            if rim.is_empty() { center } else { rim.iter().copied().sum::<DVec3>() / rim.len() as f64 }
        };
        let (index, little) = (end(1.0), end(-1.0));
        // Its middle joint: between the thumb's base and the middle of its flesh.
        let thumb = match (thumb_joint, thumb_center) {
            (Some(joint), Some(flesh)) => 0.5 * (origins[joint] + flesh),
            _ => 0.5 * (wrist + index),
        };
        for (landmark, point) in [(LEFT_LITTLE, little), (LEFT_INDEX, index), (LEFT_THUMB, thumb)] {
            marks[landmark + side] = BodyMark::on_joint(hand, point);
        }
        Ok(())
    }
}
