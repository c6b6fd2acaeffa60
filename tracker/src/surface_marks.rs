//! Where BlazePose's landmarks lie on a template: joints, and places on the skin found by their geometry.

use flyrig_body::{SkinWeights, Template};
use glam::DVec3;

use crate::anatomy::Roles;
use crate::landmarks::{LEFT_ANKLE, LEFT_ELBOW, LEFT_HEEL, LEFT_HIP, LEFT_KNEE, LEFT_SHOULDER, LEFT_TOES, LEFT_WRIST, NOSE};
use crate::{LANDMARK_COUNT, TrackError, TrackErrorKind};

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
/// the surface: the network was taught on pictures, where people click the skin.
pub(crate) fn find_marks(
    template: &Template,
    roles: &Roles,
    origins: &[DVec3],
) -> Result<[Mark; LANDMARK_COUNT], TrackError> {
    let mut marks: [Mark; LANDMARK_COUNT] = [Mark::default(); LANDMARK_COUNT];
    for side in 0..2 {
        for (landmark, joint) in [
            (LEFT_SHOULDER, roles.upper_arm[side]),
            (LEFT_ELBOW, roles.forearm[side]),
            (LEFT_WRIST, roles.hand[side]),
            (LEFT_HIP, roles.thigh[side]),
            (LEFT_KNEE, roles.shank[side]),
            (LEFT_ANKLE, roles.foot[side]),
        ] {
            marks[landmark + side] = Mark::on_joint(joint, origins[joint]);
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
    let points: Vec<DVec3> = vertices_below(template, &[hand]).into_iter().map(|v| position(template, v)).collect();
    if points.is_empty() {
        return Err(missing(template, "hand"));
    }
    let center = points.iter().copied().sum::<DVec3>() / points.len() as f64;
    let along = (center - wrist).normalize_or(wrist - origins[roles.forearm[side]]).normalize_or(DVec3::X);
    let length = points.iter().map(|p| (*p - wrist).dot(along)).fold(0.0, f64::max);
    // The thumb points away from the row of fingers: toward the front and up in any usual bind pose.
    let thumb_joint = template.skeleton.joints().iter().position(|joint| {
        let name = joint.name.to_ascii_lowercase();
        name.contains("thumb") && below(template, &joint.name, hand)
    });
    let toward_thumb = thumb_joint.map_or(DVec3::Z, |joint| {
        // The thumb's vertices tell its direction better than its joint.
        let thumb = vertices_below(template, &[joint]);
        thumb.iter().map(|&v| position(template, v)).sum::<DVec3>() / thumb.len().max(1) as f64 - center
    });
    let across = (toward_thumb - along * toward_thumb.dot(along)).normalize_or(DVec3::Z);
    // Middle of the hand's flesh at a share of its length, at the thumb's (+) or little finger's (-) side.
    let at = |from: f64, to: f64, side: f64| {
        let slab: Vec<DVec3> = points
            .iter()
            .copied()
            .filter(|p| (from..to).contains(&((*p - wrist).dot(along) / length.max(1e-3))))
            .collect();
        let extent = |p: &DVec3| (*p - wrist).dot(across) * side;
        let edge = slab.iter().map(extent).fold(f64::NEG_INFINITY, f64::max);
        let rim: Vec<DVec3> = slab.into_iter().filter(|p| extent(p) > edge - 0.02).collect();
        (!rim.is_empty()).then(|| rim.iter().copied().sum::<DVec3>() / rim.len() as f64)
    };
    for (landmark, from, to, toward) in [(17, 0.45, 0.7, -1.0), (19, 0.55, 0.8, 1.0), (21, 0.3, 0.5, 1.0)] {
        let point = at(from, to, toward).unwrap_or(center);
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
