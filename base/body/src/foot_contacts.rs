//! Foot contacts of a recorded motion, and their transfer to the template's feet.

use flyrig_types::Pose;
use glam::{DMat4, DQuat, DVec2, DVec3};

use crate::Skeleton;

/// Largest height of a standing joint of the source above its lowest positions, metres.
const LOW_M: f64 = 0.050;
/// Largest speed of a standing joint, metres per second.
const SLOW_M_A_SEC: f64 = 0.35;
/// Time over which speed is measured, nanoseconds.
const SPEED_NANOS: i64 = 50_000_000;
/// Shortest contact, and shortest interruption of one, nanoseconds.
const SHORTEST_NANOS: i64 = 70_000_000;
/// Approximate time in which the hips are lowered and raised around frames whose legs need it, nanoseconds.
const SOFT_NANOS: i64 = 120_000_000;
/// Largest angle by which a foot is levelled, radians: beyond it a dancer stands on the toes.
const TILT: f64 = 35.0 * std::f64::consts::PI / 180.0;
/// Largest extension of a leg, as a fraction of its length.
const STRETCH: f64 = 0.999;

/// Positions of a foot of the source, one per frame, y up, metres.
pub(crate) struct FootSource {
    pub ankle: Vec<DVec3>,
    pub toe: Option<Vec<DVec3>>,
}

/// Part of a foot that is in contact with the floor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stand {
    Nothing,
    Heel,
    Ball,
}

/// Sole of a foot in the bind pose, relative to the ankle joint, canonical axes: heel, ball and tip of the toes, with the distance
/// of both edges from them.
struct Sole {
    canonical: [DVec3; 3],
    half_width: f64,
}

/// Holds both feet of z-up poses in place where the source stands, soles on z = 0. `legs` are hip, knee, ankle and toe joints;
/// `floor_y` is the floor of the bind pose, canonical metres, `sole_m` the thickness of soles below it.
pub(crate) fn plant_feet(
    skeleton: &Skeleton,
    legs: &[[usize; 4]; 2],
    (floor_y, sole_m): (f64, f64),
    nanos: &[i64],
    source: &[FootSource; 2],
    poses: &mut [Pose],
) {
    let origins = skeleton.canonical_origins();
    let moves: Vec<Vec<DVec3>> = legs
        .iter()
        .zip(source)
        .map(|(leg, foot)| {
            let sole = Sole::new(&origins, leg, floor_y, sole_m);
            foot_moves(skeleton, &sole, leg, &stands(nanos, foot), poses)
        })
        .collect();
    // Lowers the hips where a leg would be too short.
    let mut too_high = vec![0.0f64; poses.len()];
    for (leg, moves) in legs.iter().zip(&moves) {
        let length: f64 = (0..2).map(|bone| origins[leg[bone]].distance(origins[leg[bone + 1]])).sum();
        for ((high, pose), moved) in too_high.iter_mut().zip(poses.iter()).zip(moves) {
            if *moved == DVec3::ZERO {
                continue;
            }
            let world = skeleton.world_from_joint(pose);
            let away = at(&world, leg[2]) + *moved - at(&world, leg[0]);
            let reach = STRETCH * length;
            let above = (reach * reach - away.truncate().length_squared()).max(0.04 * reach * reach).sqrt();
            *high = high.max(-above - away.z).min(0.5 * length);
        }
    }
    let lower = smooth_above(&too_high.iter().map(|high| high.max(0.0)).collect::<Vec<_>>(), radius(nanos, SOFT_NANOS));
    for (frame, pose) in poses.iter_mut().enumerate() {
        for (leg, moves) in legs.iter().zip(&moves) {
            // The feet stay while the hips go down.
            let moved = moves[frame] + DVec3::Z * lower[frame];
            if moved != DVec3::ZERO {
                move_ankle(skeleton, leg, moved, pose);
            }
        }
        pose.root_translation.z -= lower[frame];
    }
}

impl Sole {
    /// Estimates a sole from the distance of ankle and toe joints, on the bind pose's floor or `sole_m` below it.
    fn new(origins: &[DVec3], leg: &[usize; 4], floor_y: f64, sole_m: f64) -> Self {
        let (ankle, toe) = (origins[leg[2]], origins[leg[3]]);
        let long = if leg[2] == leg[3] { 0.13 } else { (toe.z - ankle.z).abs().max(0.05) };
        // Shoes are longer by about half the sole's thickness.
        let below = floor_y - sole_m - ankle.y;
        let point = |x: f64, along: f64, longer: f64| DVec3::new(x, below, along * long + longer * sole_m);
        let across = if leg[2] == leg[3] { 0.0 } else { toe.x - ankle.x };
        // The ball stays below the joint of the toes, about which the foot turns.
        let canonical = [point(0.0, -0.55, -0.5), point(across, 1.0, 0.0), point(across, 1.55, 0.5)];
        Self { canonical, half_width: 0.28 * long + 0.25 * sole_m }
    }

    /// Returns the sole in the world.
    fn at(&self, skeleton: &Skeleton, leg: &[usize; 4], world: &[DMat4]) -> Standing {
        let joints = skeleton.joints();
        let ankle = joints[leg[2]].joint_from_canonical.inverse().w_axis.truncate();
        let place = |index: usize, aside: f64| {
            let joint = [leg[2], leg[2], leg[3]][index];
            let point = ankle + self.canonical[index] + DVec3::X * aside;
            (world[joint] * joints[joint].joint_from_canonical).transform_point3(point)
        };
        let edges = [self.half_width, -self.half_width];
        let heights = (0..3).flat_map(|index| edges.map(|aside| place(index, aside).z));
        Standing { points: [place(0, 0.0), place(1, 0.0)], lowest: heights.fold(f64::INFINITY, f64::min) }
    }
}

/// Sole in the world: heel and ball, and the height of its lowest point, metres.
struct Standing {
    points: [DVec3; 2],
    lowest: f64,
}

fn at(world: &[DMat4], joint: usize) -> DVec3 {
    world[joint].w_axis.truncate()
}

/// Returns the number of frames within `time` on either side.
fn radius(nanos: &[i64], time: i64) -> usize {
    let (Some(first), Some(last)) = (nanos.first(), nanos.last()) else { return 1 };
    let frame = ((last - first) / (nanos.len().max(2) as i64 - 1)).max(1);
    (time / frame).clamp(1, 60) as usize
}

/// Turns each foot of y-up poses by one rotation, so that its sole is level on average while the source stands on heel and ball: rigs
/// differ in the slope from ankle to toe. Toes keep their direction. A foot that never stands is turned as the other one.
pub(crate) fn level_feet(
    skeleton: &Skeleton,
    legs: &[[usize; 4]; 2],
    nanos: &[i64],
    source: &[FootSource; 2],
    poses: &mut [Pose],
) {
    let bind = |ankle: usize| skeleton.joints()[ankle].bind_rotation();
    let found = [0, 1].map(|side| {
        let ([_, _, ankle, _], foot) = (legs[side], &source[side]);
        let toes = foot.toe.as_ref()?;
        let is_flat = still(nanos, &foot.ankle).into_iter().zip(still(nanos, toes)).map(|(heel, ball)| heel && ball);
        let ups = poses.iter().zip(is_flat).filter(|(_, is_flat)| *is_flat).map(|(pose, _)| {
            let world = DQuat::from_mat4(&skeleton.world_from_joint(pose)[ankle]);
            bind(ankle) * world.inverse() * DVec3::Y
        });
        ups.sum::<DVec3>().try_normalize().filter(|up| up.angle_between(DVec3::Y) < TILT)
    });
    for (side, [_, _, ankle, toe]) in legs.iter().enumerate() {
        let mirrored = found[1 - side].map(|up| DVec3::new(-up.x, up.y, up.z));
        let Some(up) = found[side].or(mirrored).filter(|_| source[side].toe.is_some()) else { continue };
        let level = bind(*ankle).inverse() * DQuat::from_rotation_arc(DVec3::Y, up) * bind(*ankle);
        for pose in &mut *poses {
            pose.joint_rotations[*ankle] = (pose.joint_rotations[*ankle] * level).normalize();
            if toe != ankle {
                pose.joint_rotations[*toe] = (level.inverse() * pose.joint_rotations[*toe]).normalize();
            }
        }
    }
}

/// Returns the frames in which a joint is low and slow.
fn still(nanos: &[i64], places: &[DVec3]) -> Vec<bool> {
    let mut heights: Vec<f64> = places.iter().map(|place| place.y).collect();
    heights.sort_by(f64::total_cmp);
    let floor = heights.get(heights.len() / 20).copied().unwrap_or(0.0);
    let around = radius(nanos, SPEED_NANOS / 2);
    let quiet = |i: usize| {
        let (before, after) = (i.saturating_sub(around), (i + around).min(places.len() - 1));
        let secs = (nanos[after] - nanos[before]) as f64 * 1e-9;
        let speed = places[after].distance(places[before]) / secs.max(1e-9);
        after > before && places[i].y - floor < LOW_M && speed < SLOW_M_A_SEC
    };
    let mut still: Vec<bool> = (0..places.len()).map(quiet).collect();
    fill_short(&mut still, nanos, false);
    fill_short(&mut still, nanos, true);
    still
}

/// Classifies the contact in each frame.
fn stands(nanos: &[i64], foot: &FootSource) -> Vec<Stand> {
    let heel = still(nanos, &foot.ankle);
    let ball = foot.toe.as_ref().map_or_else(|| heel.clone(), |toe| still(nanos, toe));
    let stand = |(heel, ball): (&bool, &bool)| match (heel, ball) {
        (_, true) => Stand::Ball,
        (true, false) => Stand::Heel,
        _ => Stand::Nothing,
    };
    heel.iter().zip(&ball).map(stand).collect()
}

/// Inverts runs of `what` that are shorter than [`SHORTEST_NANOS`].
fn fill_short(still: &mut [bool], nanos: &[i64], what: bool) {
    let mut start = 0;
    while start < still.len() {
        let end = (start..still.len()).find(|&i| still[i] != still[start]).unwrap_or(still.len());
        let inside = start > 0 && end < still.len();
        if still[start] == what && (inside || what) && nanos[end - 1] - nanos[start] < SHORTEST_NANOS {
            still[start..end].fill(!what);
        }
        start = end;
    }
}

/// Returns the displacement of the ankle in each frame that keeps a standing foot in place, z up, metres.
fn foot_moves(skeleton: &Skeleton, sole: &Sole, leg: &[usize; 4], stands: &[Stand], poses: &[Pose]) -> Vec<DVec3> {
    let points: Vec<Standing> =
        poses.iter().map(|pose| sole.at(skeleton, leg, &skeleton.world_from_joint(pose))).collect();
    let lowest = |frame: usize| points[frame].lowest;
    let mut flat: Vec<Option<DVec2>> = vec![None; poses.len()];
    for (start, end) in runs(stands, |stand| *stand != Stand::Nothing) {
        let pieces: Vec<(usize, usize)> = {
            let mut pieces = Vec::new();
            let mut from = start;
            for i in start + 1..=end {
                if i == end || stands[i] != stands[from] {
                    pieces.push((from, i));
                    from = i;
                }
            }
            pieces
        };
        let point = |frame: usize| points[frame].points[usize::from(stands[frame] == Stand::Ball)].truncate();
        // The longest piece on the ball, or else the longest, is fixed at its mean position.
        let key = |piece: &(usize, usize)| (stands[piece.0] == Stand::Ball, piece.1 - piece.0);
        let Some(anchor) = (0..pieces.len()).max_by_key(|&i| key(&pieces[i])) else { continue };
        let (from, to) = pieces[anchor];
        let place = (from..to).map(point).sum::<DVec2>() / (to - from) as f64;
        (from..to).for_each(|i| flat[i] = Some(place - point(i)));
        // Its neighbours are fixed at their position at the transition.
        for &(from, to) in &pieces[anchor + 1..] {
            let place = point(from) + flat[from - 1].unwrap_or_default();
            (from..to).for_each(|i| flat[i] = Some(place - point(i)));
        }
        for &(from, to) in pieces[..anchor].iter().rev() {
            let place = point(to - 1) + flat[to].unwrap_or_default();
            (from..to).for_each(|i| flat[i] = Some(place - point(i)));
        }
    }
    // Between contacts the correction is interpolated, never through the floor.
    let known: Vec<(usize, DVec3)> =
        flat.iter().enumerate().filter_map(|(i, flat)| Some((i, flat.as_ref()?.extend(-lowest(i))))).collect();
    (0..poses.len())
        .map(|frame| {
            let next = known.partition_point(|(i, _)| *i < frame);
            let moved = match (next.checked_sub(1).map(|i| known[i]), known.get(next)) {
                (_, Some((i, moved))) if *i == frame => return *moved,
                (Some((a, from)), Some((b, to))) => {
                    let t = (frame - a) as f64 / (b - a) as f64;
                    from.lerp(*to, t * t * (3.0 - 2.0 * t))
                }
                (Some((_, moved)), None) | (None, Some(&(_, moved))) => moved,
                (None, None) => DVec3::ZERO,
            };
            DVec3::new(moved.x, moved.y, moved.z.max(-lowest(frame)))
        })
        .map(|moved| if moved.length() < 1e-9 { DVec3::ZERO } else { moved })
        .collect()
}

/// Returns the ranges of neighbouring items for which `inside` holds.
fn runs<T>(items: &[T], inside: impl Fn(&T) -> bool) -> Vec<(usize, usize)> {
    let mut found = Vec::new();
    let mut start = None;
    for i in 0..=items.len() {
        match (items.get(i).is_some_and(&inside), start) {
            (true, None) => start = Some(i),
            (false, Some(from)) => {
                found.push((from, i));
                start = None;
            }
            _ => {}
        }
    }
    found
}

/// Moves the ankle by two-bone inverse kinematics; the knee keeps its side, the foot its direction.
fn move_ankle(skeleton: &Skeleton, leg: &[usize; 4], moved: DVec3, pose: &mut Pose) {
    let world = skeleton.world_from_joint(pose);
    let [hip, knee, ankle] = [leg[0], leg[1], leg[2]].map(|joint| at(&world, joint));
    let rotations = [leg[0], leg[1], leg[2]].map(|joint| DQuat::from_mat4(&world[joint]).normalize());
    let (thigh, shank) = (hip.distance(knee), knee.distance(ankle));
    let target = ankle + moved - hip;
    let distance = target.length().clamp((thigh - shank).abs() + 1e-4, (thigh + shank) * 0.9999);
    let along = target.normalize_or(DVec3::NEG_Z);
    // A straight leg bends in the direction of its foot.
    let toes = at(&world, leg[3]) - ankle;
    let pole = (knee - hip) * 4.0 + toes.normalize_or(DVec3::NEG_Y) * 0.02;
    let bend = (pole - along * pole.dot(along)).normalize_or(along.any_orthonormal_vector());
    let cos = ((thigh * thigh + distance * distance - shank * shank) / (2.0 * thigh * distance)).clamp(-1.0, 1.0);
    let new_knee = hip + thigh * (along * cos + bend * (1.0 - cos * cos).sqrt());
    let new_ankle = hip + along * distance;
    let arc = |from: DVec3, to: DVec3| {
        DQuat::from_rotation_arc(from.normalize_or(DVec3::NEG_Z), to.normalize_or(DVec3::NEG_Z))
    };
    let turned = [
        arc(knee - hip, new_knee - hip) * rotations[0],
        arc(ankle - knee, new_ankle - new_knee) * rotations[1],
        rotations[2],
    ];
    for (i, joint) in [leg[0], leg[1], leg[2]].into_iter().enumerate() {
        // Between hip, knee and ankle there are no other joints in any rig that `match_joints` knows.
        let parent = match i {
            0 => skeleton.joints()[joint].parent.map_or(DQuat::IDENTITY, |parent| DQuat::from_mat4(&world[parent])),
            _ => turned[i - 1],
        };
        if let Some(rotation) = pose.joint_rotations.get_mut(joint) {
            *rotation = (parent.inverse() * turned[i]).normalize();
        }
    }
}

/// Returns a smooth sequence that is nowhere below `values`: the maximum within `radius`, averaged over as many neighbours.
fn smooth_above(values: &[f64], radius: usize) -> Vec<f64> {
    let around = |i: usize| i.saturating_sub(radius)..(i + radius + 1).min(values.len());
    let largest: Vec<f64> = (0..values.len()).map(|i| values[around(i)].iter().copied().fold(0.0, f64::max)).collect();
    let weight =
        |i: usize, k: usize| (std::f64::consts::FRAC_PI_2 * i.abs_diff(k) as f64 / (radius + 1) as f64).cos().powi(2);
    let mean = |i: usize| {
        let total: f64 = around(i).map(|k| weight(i, k)).sum();
        around(i).map(|k| largest[k] * weight(i, k)).sum::<f64>() / total
    };
    (0..values.len()).map(mean).collect()
}
