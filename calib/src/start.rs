//! Initial values: focal lengths, board poses, and camera poses by the vote of the shots, joined along the strongest
//! pairs.

use std::collections::BTreeMap;

use flyrig_solve::{RigidMotion, log_rotation};
use flyrig_types::{CameraId, Intrinsics};
use glam::{DVec2, DVec3};

use crate::adjust::adjust;
use crate::board::Board;
use crate::bundle::{BoardShot, BoardView, Estimate, Free, SolvedCamera};
use crate::error::CalibError;
use crate::homography::{homography, plane_poses, spread_out};

/// Largest angle, radians, and relative distance by which two estimates of a camera's pose agree.
const AGREE_RAD: f64 = 0.05;
const AGREE_SHARE: f64 = 0.05;
/// Multiple of the best pose's error up to which the other pose of a flat board is kept.
const RIVAL: f64 = 3.0;
/// Error of the best board pose above which a view is rejected, relative to the image's width.
const MOST_ERROR: f64 = 0.01;

/// Estimates the board poses that explain a view, best first: one, or two where the view is too flat to distinguish
/// them.
pub(crate) fn board_poses(board: &Board, intrinsics: &Intrinsics, view: &BoardView) -> Vec<RigidMotion> {
    let ideal: Vec<(DVec2, DVec2)> = view
        .corners
        .iter()
        .filter_map(|corner| {
            let ideal = intrinsics.lens.undistort((corner.pixel - intrinsics.center_px) / intrinsics.focal_px)?;
            Some((board.corner(corner.index).truncate(), ideal))
        })
        .collect();
    let on_board: Vec<DVec2> = ideal.iter().map(|pair| pair.0).collect();
    if !spread_out(&on_board) {
        return Vec::new();
    }
    let Some(starts) = homography(&ideal).and_then(|h| plane_poses(&h)) else { return Vec::new() };
    let points: Vec<DVec3> = (0..board.corner_count()).map(|index| board.corner(index)).collect();
    let shots = [BoardShot { nanos: view.nanos, views: vec![BoardView { camera: 0, ..view.clone() }] }];
    let mut found: Vec<(f64, RigidMotion)> = Vec::new();
    for start in starts {
        let camera = SolvedCamera { camera_from_rig: RigidMotion::IDENTITY, intrinsics: *intrinsics, lag_s: 0.0 };
        let start = Estimate { cameras: vec![camera], boards: vec![start], bend_m: [0.0; 3] };
        let Some(adjusted) = adjust(&points, &shots, start, Free::default()) else { continue };
        let error = rms(adjusted.errors_px());
        if error < MOST_ERROR * f64::from(intrinsics.width) {
            found.push((error, adjusted.estimate.boards[0]));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let limit = found.first().map_or(0.0, |(best, _)| RIVAL * best.max(0.05));
    let first = found.first().map(|(_, pose)| *pose);
    let is_rival = |(k, (error, pose)): (usize, &(f64, RigidMotion))| {
        k == 0 || (*error <= limit && !first.is_some_and(|first| agree(&first, pose)))
    };
    found.iter().enumerate().filter(|&item| is_rival(item)).map(|(_, (_, pose))| *pose).collect()
}

/// Returns the root mean square.
pub(crate) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), value| (sum + value * value, count + 1));
    if count == 0 { 0.0 } else { (sum / count as f64).sqrt() }
}

fn agree(a: &RigidMotion, b: &RigidMotion) -> bool {
    let turn = log_rotation(a.rotation * b.rotation.inverse()).length();
    let far = a.translation.length().max(b.translation.length());
    turn < AGREE_RAD && a.translation.distance(b.translation) < AGREE_SHARE * far
}

/// Pair of cameras that saw the board together.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Pair {
    /// Slots of the cameras, ascending.
    pub cameras: (usize, usize),
    /// Shots that both saw.
    pub shots: usize,
    /// Shots that agree on the cameras' relative pose.
    pub agreeing: usize,
}

/// Estimates initial poses in the axes of the first camera, with the pairs that they rest on.
///
/// # Errors
/// [`CalibError::NotLinked`] lists the groups of cameras that never saw the board together.
pub(crate) fn rig_start(
    board: &Board,
    shots: &[BoardShot],
    ids: &[CameraId],
    intrinsics: &[Intrinsics],
) -> Result<(Estimate, Vec<Pair>, Vec<BoardShot>), CalibError> {
    // By shot and camera: the poses of the board, camera axes.
    let poses: Vec<BTreeMap<usize, Vec<RigidMotion>>> = shots
        .iter()
        .map(|shot| {
            let of_view = |view: &BoardView| {
                let poses = board_poses(board, &intrinsics[view.camera], view);
                (!poses.is_empty()).then_some((view.camera, poses))
            };
            shot.views.iter().filter_map(of_view).collect()
        })
        .collect();
    let mut pairs = Vec::new();
    let mut links = Vec::new();
    for a in 0..ids.len() {
        for b in a + 1..ids.len() {
            // By shot: every way in which the two cameras may stand to each other.
            let ways: Vec<Vec<RigidMotion>> = poses
                .iter()
                .filter_map(|seen| Some((seen.get(&a)?, seen.get(&b)?)))
                .map(|(pa, pb)| pa.iter().flat_map(|pa| pb.iter().map(|pb| *pb * pa.inverse())).collect())
                .collect();
            let votes = |way: &RigidMotion| ways.iter().filter(|others| others.iter().any(|o| agree(o, way))).count();
            let best = ways.iter().flatten().map(|way| (votes(way), way)).max_by_key(|(votes, _)| *votes);
            if let Some((agreeing, b_from_a)) = best {
                pairs.push(Pair { cameras: (a, b), shots: ways.len(), agreeing });
                links.push((agreeing, a, b, *b_from_a));
            }
        }
    }
    // Strongest links first, from the first camera on.
    let mut placed: BTreeMap<usize, RigidMotion> = BTreeMap::from([(0, RigidMotion::IDENTITY)]);
    while let Some(&(_, a, b, b_from_a)) = links
        .iter()
        .filter(|(_, a, b, _)| placed.contains_key(a) != placed.contains_key(b))
        .max_by_key(|(agreeing, ..)| *agreeing)
    {
        if let Some(a_from_rig) = placed.get(&a).copied() {
            placed.insert(b, b_from_a * a_from_rig);
        } else if let Some(b_from_rig) = placed.get(&b).copied() {
            placed.insert(a, b_from_a.inverse() * b_from_rig);
        }
    }
    if placed.len() < ids.len() {
        return Err(CalibError::NotLinked { groups: groups(ids, &links) });
    }
    let cameras: Vec<SolvedCamera> = intrinsics
        .iter()
        .enumerate()
        .map(|(slot, intrinsics)| SolvedCamera { camera_from_rig: placed[&slot], intrinsics: *intrinsics, lag_s: 0.0 })
        .collect();
    let (mut boards, mut kept) = (Vec::new(), Vec::new());
    for (shot, seen) in shots.iter().zip(&poses) {
        let ways = seen.iter().flat_map(|(camera, poses)| {
            let rig_from_camera = cameras[*camera].camera_from_rig.inverse();
            poses.iter().map(move |pose| rig_from_camera * *pose)
        });
        // The pose that most views agree with; a camera that saw the board wrongly is left to the robust solve.
        let error = |pose: &RigidMotion| -> f64 {
            let of_view = |view: &BoardView| {
                let camera = &cameras[view.camera];
                let errors = view.corners.iter().map(|corner| {
                    let place = camera.camera_from_rig.apply(pose.apply(board.corner(corner.index)));
                    let drawn = crate::projection::project(&camera.intrinsics, place);
                    drawn.map_or(1e3, |drawn| drawn.distance(corner.pixel).min(1e3))
                });
                rms(errors).min(100.0)
            };
            shot.views.iter().map(of_view).sum()
        };
        let best = ways.map(|pose| (error(&pose), pose)).min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, pose)) = best else { continue };
        // Every corner must be before its camera to begin with.
        let visible = |view: &&BoardView| {
            let camera = &cameras[view.camera];
            let drawn = |corner: &crate::SeenCorner| {
                let place = camera.camera_from_rig.apply(pose.apply(board.corner(corner.index)));
                crate::projection::project(&camera.intrinsics, place).is_some()
            };
            seen.contains_key(&view.camera) && view.corners.iter().all(drawn)
        };
        let views: Vec<BoardView> = shot.views.iter().filter(visible).cloned().collect();
        if !views.is_empty() {
            boards.push(pose);
            kept.push(BoardShot { nanos: shot.nanos, views });
        }
    }
    Ok((Estimate { cameras, boards, bend_m: [0.0; 3] }, pairs, kept))
}

/// Returns the groups of linked cameras, by name.
fn groups(ids: &[CameraId], links: &[(usize, usize, usize, RigidMotion)]) -> String {
    let mut group: Vec<usize> = (0..ids.len()).collect();
    for &(_, a, b, _) in links {
        let (from, to) = (group[b].max(group[a]), group[b].min(group[a]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    }
    let mut names: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
    for (id, group) in ids.iter().zip(&group) {
        names.entry(*group).or_default().push(id.as_str());
    }
    names.values().map(|names| format!("[{}]", names.join(" "))).collect::<Vec<_>>().join(" and ")
}
