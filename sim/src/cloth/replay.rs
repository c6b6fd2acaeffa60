//! Random access to the particles' motion.
//!
//! Time (one cycle of the motion) is divided into windows. Each has a run of its own that starts at rest some time
//! before it, so that an instant costs at most a window's steps and depends on its time alone; runs are blended from
//! window to window. The cloth of a closed motion is closed.

use std::collections::VecDeque;

use flyrig_body::{Skeleton, SkinWeights};
use flyrig_types::PoseTrack;
use glam::{Mat3, Mat4, Vec3};

use super::colliders::{Capsule, Colliders};
use super::pieces::Rigging;
use super::solver::{STEPS_A_SECOND, SkinnedParticle, State, step};

const STEP_NANOS: i64 = 1_000_000_000 / STEPS_A_SECOND;
/// Steps of a window, of the lead-in before it, and of blending with the previous window.
const WINDOW: i64 = 2 * STEPS_A_SECOND;
const LEAD_IN: i64 = 3 * STEPS_A_SECOND / 2;
const BLEND: i64 = STEPS_A_SECOND / 4;
/// Cached windows: a minute of motion, about 100 MB for the loosest clothes.
const KEPT: usize = 30;

/// Run of a window: offsets of all particles from their skinned positions per step.
struct Run {
    window: i64,
    state: State,
    /// Completed steps since the start of the lead-in.
    done: i64,
    offsets: Vec<Vec<Vec3>>,
}

/// Cache of simulated runs.
pub(crate) struct Replay {
    skeleton: Skeleton,
    rigging: Rigging,
    colliders: Colliders,
    /// Runs, newest last.
    runs: VecDeque<Run>,
}

impl Replay {
    pub(crate) fn new(skeleton: Skeleton, rigging: Rigging, colliders: Colliders) -> Self {
        Self { skeleton, rigging, colliders, runs: VecDeque::new() }
    }

    /// Returns the particles' offsets from their skinned positions at a time of the repeated track, world metres.
    pub(crate) fn at(&mut self, track: &PoseTrack, nanos: i64) -> Vec<Vec3> {
        let (first, last) = track.span_nanos();
        let round = i128::from(last) - i128::from(first);
        let into = if round > 0 { (i128::from(nanos) - i128::from(first)).rem_euclid(round) } else { 0 };
        // A round has a whole number of windows of about the same length, or fewer steps than one.
        let round_steps = (round / i128::from(STEP_NANOS)).max(1);
        let windows = i64::try_from((round_steps / i128::from(WINDOW)).max(1)).unwrap_or(i64::MAX);
        let window_nanos = round / i128::from(windows);
        let index = if window_nanos > 0 { (into / window_nanos).min(i128::from(windows) - 1) } else { 0 };
        let since = i64::try_from(into - index * window_nanos).unwrap_or(0);
        let start = i64::try_from(i128::from(first) + index * window_nanos).unwrap_or(first);
        let index = i64::try_from(index).unwrap_or(0);
        let here = self.in_window(track, index, start, since);
        let blend = i128::from(BLEND * STEP_NANOS);
        if round == 0 || i128::from(since) >= blend || window_nanos < blend {
            return here;
        }
        let earlier = (index + windows - 1).rem_euclid(windows);
        let window_nanos = i64::try_from(window_nanos).unwrap_or(i64::MAX);
        let earlier_start = match index {
            0 => first.saturating_add(window_nanos.saturating_mul(windows - 1)),
            _ => start.saturating_sub(window_nanos),
        };
        let there = self.in_window(track, earlier, earlier_start, since.saturating_add(window_nanos));
        let t = since as f32 / blend as f32;
        let t = t * t * (3.0 - 2.0 * t);
        there.iter().zip(&here).map(|(a, b)| a.lerp(*b, t)).collect()
    }

    /// Returns the body's capsules at a time of the repeated track.
    pub(crate) fn capsules(&self, track: &PoseTrack, nanos: i64) -> Vec<Capsule> {
        self.colliders.placed(&self.skeleton.world_from_canonical(&track.at_repeated(nanos)))
    }

    /// Returns the offsets `since` nanoseconds after a window's start, from the run of that window.
    fn in_window(&mut self, track: &PoseTrack, window: i64, start: i64, since: i64) -> Vec<Vec3> {
        let place = self.runs.iter().position(|run| run.window == window);
        let run = place.and_then(|place| self.runs.remove(place));
        let mut run = run.unwrap_or_else(|| {
            let carried = self.carried(track, start.saturating_sub(LEAD_IN * STEP_NANOS)).0;
            Run { window, state: State::at_rest(&carried), done: 0, offsets: Vec::new() }
        });
        let step_index = (since / STEP_NANOS) as usize;
        while run.offsets.len() < step_index + 2 {
            let at = start.saturating_add((run.done - LEAD_IN) * STEP_NANOS);
            let (carried, matrices) = self.carried(track, at);
            if run.done > 0 {
                step(&self.rigging.particles, &carried, &self.colliders.placed(&matrices), &mut run.state);
            }
            if run.done >= LEAD_IN {
                run.offsets.push(run.state.places.iter().zip(&carried).map(|(p, c)| *p - c.place).collect());
            }
            run.done += 1;
        }
        let t = (since - step_index as i64 * STEP_NANOS) as f32 / STEP_NANOS as f32;
        let offsets = run.offsets[step_index].iter().zip(&run.offsets[step_index + 1]).map(|(a, b)| a.lerp(*b, t));
        let offsets = offsets.map(|offset| if offset.is_finite() { offset } else { Vec3::ZERO }).collect();
        self.runs.push_back(run);
        if self.runs.len() > KEPT {
            self.runs.pop_front();
        }
        offsets
    }

    /// Returns the skinned positions of the particles, and the skinning matrices.
    fn carried(&self, track: &PoseTrack, nanos: i64) -> (Vec<SkinnedParticle>, Vec<glam::DMat4>) {
        let matrices = self.skeleton.world_from_canonical(&track.at_repeated(nanos));
        let small: Vec<Mat4> = matrices.iter().map(glam::DMat4::as_mat4).collect();
        let carried = self
            .rigging
            .canonical
            .iter()
            .zip(&self.rigging.normals)
            .zip(&self.rigging.skin)
            .map(|((&position, &normal), skin)| {
                let blend = blended(&small, skin);
                let linear = Mat3::from_mat4(blend);
                SkinnedParticle {
                    place: blend.transform_point3(position),
                    // Canonical space is y up.
                    up: (linear * Vec3::Y).normalize_or(Vec3::Z),
                    normal: (linear * normal).normalize_or(Vec3::Z),
                }
            })
            .collect();
        (carried, matrices)
    }
}

/// Blends matrices as [`flyrig_body::skin_mesh`] does.
fn blended(matrices: &[Mat4], skin: &SkinWeights) -> Mat4 {
    let mut sum = Mat4::ZERO;
    for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
        if let (Some(matrix), true) = (matrices.get(usize::from(joint)), weight > 0.0) {
            sum += *matrix * weight;
        }
    }
    if sum.w_axis.w > 0.0 { sum * (1.0 / sum.w_axis.w) } else { Mat4::IDENTITY }
}
