//! Where BlazePose's landmarks lie on a template: joints, and places on the skin found by their geometry.

use flyrig_body::{SkinWeights, Template};
use glam::DVec3;

use crate::error::{TrackError, TrackErrorKind};
use crate::landmarks::keypoints::{
    LANDMARK_COUNT, LEFT_ANKLE, LEFT_ELBOW, LEFT_HEEL, LEFT_HIP, LEFT_INDEX, LEFT_KNEE, LEFT_LITTLE, LEFT_SHOULDER,
    LEFT_THUMB, LEFT_TOES, LEFT_WRIST, NOSE,
};
use crate::pose::anatomy::Roles;

/// A canonical point of the template that moves with one joint.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Mark {
    pub joint: usize,
    pub point: DVec3,
}

impl Mark {
    fn on_joint(joint: usize, point: DVec3) -> Self {
        Self { joint, point }
    }
}

/// Vertices whose strongest joint is one of `joints` or hangs below it.
fn vertices_below(template: &Template, joints: &[usize]) -> Vec<usize> {
    let parents: Vec<Option<usize>> = template.skeleton.joints().iter().map(|joint| joint.parent).collect();
    let below = |mut joint: usize| loop {
        if joints.contains(&joint) {
            return true;
        }
        match parents.get(joint).copied().flatten() {
            Some(parent) => joint = parent,
            None => return false,
        }
    };
    let strongest = |skin: &SkinWeights| usize::from(skin.joints[0]);
    (0..template.positions.len()).filter(|&v| below(strongest(&template.skin[v]))).collect()
}

/// The landmarks' places on the template.
///
/// Joints for shoulders, elbows, wrists, hips, knees, ankles; for the face, the hands and the feet places on
/// the surface: the network was taught on images, where people click the skin.
pub(crate) fn find_marks(
    template: &Template,
    roles: &Roles,
    origins: &[DVec3],
) -> Result<[Mark; LANDMARK_COUNT], TrackError> {
    let mut marks: [Mark; LANDMARK_COUNT] = [Mark::default(); LANDMARK_COUNT];
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
            marks[landmark + side] = Mark::on_joint(mover, origins[center]);
        }
    }
    face_marks(template, roles, &mut marks)?;
    for side in 0..2 {
        foot_marks(template, roles, origins, side, &mut marks)?;
        hand_marks(template, roles, origins, side, &mut marks)?;
    }
    Ok(marks)
}

fn position(template: &Template, vertex: usize) -> DVec3 {
    template.positions[vertex].as_dvec3()
}

fn missing(template: &Template, what: &str) -> TrackError {
    TrackError::new(
        TrackErrorKind::Template,
        format!("template '{}' has no vertices on the {what}; give it skin weights there", template.name),
    )
}

fn face_marks(template: &Template, roles: &Roles, marks: &mut [Mark; LANDMARK_COUNT]) -> Result<(), TrackError> {
    let head = vertices_below(template, &[roles.head]);
    let all = || head.iter().map(|&v| position(template, v));
    let top = all().map(|p| p.y).fold(f64::NEG_INFINITY, f64::max);
    let middle_x = all().map(|p| p.x).sum::<f64>() / head.len().max(1) as f64;
    // The nose is the foremost point near the plane of symmetry, at least 8 cm under the crown.
    let scale = (top / 1.7).clamp(0.3, 2.0);
    let nose = all()
        .filter(|p| (p.x - middle_x).abs() < 0.015 * scale && p.y < top - 0.08 * scale)
        .max_by(|a, b| a.z.total_cmp(&b.z))
        .ok_or_else(|| missing(template, "head"))?;
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
    let mut put = |landmark: usize, point: DVec3| marks[landmark] = Mark::on_joint(roles.head, point);
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
            .ok_or_else(|| missing(template, "head"))?;
        put(7 + side, ear + DVec3::new(-sign * 0.005, 0.0, 0.01) * unit);
    }
    Ok(())
}

fn foot_marks(
    template: &Template,
    roles: &Roles,
    origins: &[DVec3],
    side: usize,
    marks: &mut [Mark; LANDMARK_COUNT],
) -> Result<(), TrackError> {
    let foot = roles.foot[side];
    let vertices = vertices_below(template, &[foot]);
    let lowest = vertices.iter().map(|&v| position(template, v).y).fold(f64::INFINITY, f64::min);
    let low = |p: &DVec3| p.y < lowest + 0.06;
    let points: Vec<DVec3> = vertices.iter().map(|&v| position(template, v)).filter(low).collect();
    if points.is_empty() {
        return Err(missing(template, "foot"));
    }
    let back = points.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
    let front = points.iter().map(|p| p.z).fold(f64::NEG_INFINITY, f64::max);
    let mean = |keep: &dyn Fn(&DVec3) -> bool| {
        let kept: Vec<&DVec3> = points.iter().filter(|p| keep(p)).collect();
        kept.iter().copied().sum::<DVec3>() / kept.len().max(1) as f64
    };
    let ankle = origins[foot];
    marks[LEFT_HEEL + side] = Mark::on_joint(foot, mean(&|p| p.z < back + 0.02));
    let toes = mean(&|p| p.z > front - 0.03);
    // Toward the big toe: the side of the body's middle plane.
    let inner = -ankle.x.signum() * 0.01;
    marks[LEFT_TOES + side] = Mark::on_joint(foot, toes + DVec3::new(inner, 0.0, 0.0));
    Ok(())
}

fn hand_marks(
    template: &Template,
    roles: &Roles,
    origins: &[DVec3],
    side: usize,
    marks: &mut [Mark; LANDMARK_COUNT],
) -> Result<(), TrackError> {
    let hand = roles.hand[side];
    let wrist = origins[hand];
    let joints = template.skeleton.joints();
    let thumb_joint =
        joints.iter().position(|j| j.name.to_ascii_lowercase().contains("thumb") && below(template, &j.name, hand));
    let thumb: Vec<usize> = thumb_joint.map_or(Vec::new(), |joint| vertices_below(template, &[joint]));
    // The thumb stands off the row of fingers: without it the flesh tells the fingers' direction.
    let points: Vec<DVec3> = vertices_below(template, &[hand])
        .into_iter()
        .filter(|v| !thumb.contains(v))
        .map(|v| position(template, v))
        .collect();
    if points.is_empty() {
        return Err(missing(template, "hand"));
    }
    let center = points.iter().copied().sum::<DVec3>() / points.len() as f64;
    let along = (center - wrist).normalize_or(wrist - origins[roles.forearm[side]]).normalize_or(DVec3::X);
    let length = points.iter().map(|p| (*p - wrist).dot(along)).fold(0.0, f64::max);
    let thumb_center =
        (!thumb.is_empty()).then(|| thumb.iter().map(|&v| position(template, v)).sum::<DVec3>() / thumb.len() as f64);
    // A skeleton without a thumb: it points to the front in any usual bind pose.
    let toward_thumb = thumb_center.map_or(DVec3::Z, |thumb| thumb - wrist);
    let across = (toward_thumb - along * toward_thumb.dot(along)).normalize_or(DVec3::Z);
    // The row of knuckles, at half the hand's length; its ends are those of the index and little fingers.
    let row: Vec<DVec3> =
        points.iter().copied().filter(|p| (0.4..0.6).contains(&((*p - wrist).dot(along) / length.max(1e-3)))).collect();
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
        marks[landmark + side] = Mark::on_joint(hand, point);
    }
    Ok(())
}

fn below(template: &Template, name: &str, ancestor: usize) -> bool {
    let joints = template.skeleton.joints();
    let mut joint = template.skeleton.joint(name);
    while let Some(index) = joint {
        if index == ancestor {
            return true;
        }
        joint = joints[index].parent;
    }
    false
}
