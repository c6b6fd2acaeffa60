//! Corrections of a take's poses, learned with the Gaussians (LoGAvatar, section 4.3: "along with the learnable pose
//! parameters").
//!
//! Each frame has a small rotation of every joint in the joint's own frame, and a shift of the root in the root's: `R
//! exp(turn)`, `t + R_0 shift`. They serve the fit alone. Two terms keep them from absorbing the avatar's own shape:
//! they are pulled to zero and to the neighbouring frames, and their mean over the take is zero after every step, since
//! a correction common to all frames would be another rest pose.

use flyrig_body::Skeleton;
use flyrig_types::Pose;
use glam::{DMat3, DQuat, DVec3};

use crate::fit::skinning::BoneSlope;

/// Rates at the start and at the end: radians of turns, metres of shifts.
const TURN_RATE_RAD: [f32; 2] = [1.5e-3, 1.5e-4];
const SHIFT_RATE_M: [f32; 2] = [5e-4, 5e-5];
/// Corrections at which the pull to zero equals the usual derivative of the images.
const TURN_RAD: f32 = 0.1;
const SHIFT_M: f32 = 0.02;
/// Pull to the neighbouring frames relative to that to zero.
const SMOOTH: f32 = 1.0;
/// Decay of the mean squares of the derivatives.
const BETA: f32 = 0.99;
/// Share of the usual derivatives in the denominator: hardly visible joints move little.
const SHARE: f32 = 0.3;
/// Largest step, in rates.
const LARGEST: f32 = 5.0;
/// Bound on derivatives.
const LARGEST_SLOPE: f64 = 1e6;

/// Learned corrections of poses.
#[derive(Debug, Clone)]
pub(crate) struct PoseFit {
    /// Numbers per frame: shift of the root, rotation vectors of the joints.
    width: usize,
    /// Corrections, one row per frame.
    pub corrections: Vec<f32>,
    /// Mean squares of the derivatives over all frames, one row.
    pub squares: Vec<f32>,
}

impl PoseFit {
    /// Starts without corrections, for this many frames and joints.
    pub fn new(frames: usize, joints: usize) -> Self {
        let width = 3 + 3 * joints;
        Self { width, corrections: vec![0.0; frames * width], squares: vec![0.0; width] }
    }

    fn row(&self, frame: usize) -> &[f32] {
        self.corrections.get(frame * self.width..(frame + 1) * self.width).unwrap_or_default()
    }

    /// Returns the corrected pose of a frame.
    pub fn corrected(&self, frame: usize, pose: &Pose) -> Pose {
        let mut corrected = pose.clone();
        let mut vectors = self.row(frame).chunks_exact(3).map(vector);
        if let (Some(shift), Some(root)) = (vectors.next(), pose.joint_rotations.first()) {
            corrected.root_translation += *root * shift;
        }
        for (rotation, turn) in corrected.joint_rotations.iter_mut().zip(vectors) {
            *rotation = (*rotation * DQuat::from_scaled_axis(turn)).normalize();
        }
        corrected
    }

    /// Descends by one step, the `count`th from 1, along the derivatives of an image of `frame`, whose pose without
    /// correction is `pose`; `progress` in 0..=1 is the completed share of all steps.
    pub fn descend(
        &mut self,
        frame: usize,
        (skeleton, pose): (&Skeleton, &Pose),
        slopes: &[BoneSlope],
        count: u64,
        progress: f32,
    ) {
        let frames = self.corrections.len() / self.width;
        if frame >= frames {
            return;
        }
        let slopes = self.slopes(frame, skeleton, pose, slopes);
        let unbias = 1.0 - BETA.powi(count.min(1 << 20) as i32);
        for (square, slope) in self.squares.iter_mut().zip(&slopes) {
            *square = BETA * *square + (1.0 - BETA) * slope * slope;
        }
        let rate = |[from, to]: [f32; 2]| from * (to / from).powf(progress.clamp(0.0, 1.0));
        let floor = |squares: &[f32]| SHARE * (usual(squares) / unbias).sqrt() + 1e-12;
        let kinds = [
            (rate(SHIFT_RATE_M), SHIFT_M, floor(&self.squares[..3])),
            (rate(TURN_RATE_RAD), TURN_RAD, floor(&self.squares[3..])),
        ];
        let around = self.around(frame, frames);
        let row = self.corrections.chunks_exact_mut(self.width).nth(frame).unwrap_or_default();
        for (k, value) in row.iter_mut().enumerate() {
            let (rate, stiff_at, floor) = kinds[usize::from(k >= 3)];
            let image = slopes[k] / ((self.squares[k] / unbias).sqrt() + floor);
            let pull = (*value + SMOOTH * (*value - around[k])) / stiff_at;
            *value -= rate * (image + pull).clamp(-LARGEST, LARGEST);
        }
        self.center();
    }

    /// Returns the mean corrections of the neighbouring frames, the frame's own where there are none.
    fn around(&self, frame: usize, frames: usize) -> Vec<f32> {
        let beside = [frame.checked_sub(1), Some(frame + 1).filter(|next| *next < frames)];
        let rows: Vec<&[f32]> = beside.into_iter().flatten().map(|other| self.row(other)).collect();
        match rows.as_slice() {
            [] => self.row(frame).to_vec(),
            [one] => one.to_vec(),
            [one, other, ..] => one.iter().zip(*other).map(|(one, other)| (one + other) / 2.0).collect(),
        }
    }

    /// Subtracts the mean over all frames.
    fn center(&mut self) {
        let frames = (self.corrections.len() / self.width).max(1);
        let mut mean = vec![0.0f64; self.width];
        for row in self.corrections.chunks_exact(self.width) {
            mean.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value) / frames as f64);
        }
        for row in self.corrections.chunks_exact_mut(self.width) {
            row.iter_mut().zip(&mean).for_each(|(value, mean)| *value -= *mean as f32);
        }
    }

    /// Returns dL/d corrections of a frame from dL/d motions of the bones. Non-finite ones count as zero.
    fn slopes(&self, frame: usize, skeleton: &Skeleton, pose: &Pose, bones: &[BoneSlope]) -> Vec<f32> {
        let joints = skeleton.joints();
        // A joint moves itself and all that hang on it, parents come first.
        let mut sums = bones.to_vec();
        sums.resize(joints.len(), BoneSlope::default());
        for (joint, parent) in joints.iter().enumerate().rev().filter_map(|(i, joint)| Some((i, joint.parent?))) {
            let own = sums[joint];
            sums[parent] += own;
        }
        let world = skeleton.world_from_joint(&self.corrected(frame, pose));
        let mut all = Vec::with_capacity(self.width);
        let root = pose.joint_rotations.first().copied().unwrap_or_default();
        all.push(root.inverse() * sums[0].shift);
        let turns = self.row(frame).chunks_exact(3).skip(1).map(vector);
        all.extend(world.iter().zip(&sums).zip(turns).map(|((world, slope), turn)| {
            let around_joint = slope.turn - world.w_axis.truncate().cross(slope.shift);
            right_jacobian(turn).transpose() * (DMat3::from_mat4(*world).transpose() * around_joint)
        }));
        let mut flat: Vec<f32> = all
            .iter()
            .flat_map(DVec3::to_array)
            .map(|value| if value.is_finite() { value.clamp(-LARGEST_SLOPE, LARGEST_SLOPE) as f32 } else { 0.0 })
            .collect();
        flat.resize(self.width, 0.0);
        flat
    }
}

/// Returns the mean square over the numbers that ever had a derivative.
pub(crate) fn usual(squares: &[f32]) -> f32 {
    let (sum, count) =
        squares.iter().filter(|v| **v > 0.0).fold((0.0f64, 0u32), |(sum, n), v| (sum + f64::from(*v), n + 1));
    (sum / f64::from(count.max(1))) as f32
}

fn vector(row: &[f32]) -> DVec3 {
    DVec3::new(f64::from(row[0]), f64::from(row[1]), f64::from(row[2]))
}

/// Returns the matrix `J` of `exp(v + d) = exp(v) exp(J d)` for small `d`: the right Jacobian of rotations.
fn right_jacobian(v: DVec3) -> DMat3 {
    let angle2 = v.length_squared();
    let cross = DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0));
    let (a, b) = if angle2 < 1e-8 {
        (0.5, 1.0 / 6.0)
    } else {
        let angle = angle2.sqrt();
        ((1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
    };
    DMat3::IDENTITY - cross * a + cross * cross * b
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::fit::skinning::reference::loss;
    use crate::model::avatar::Avatar;
    use crate::model::avatar::tests::{random_pose, small};
    use crate::model::posing::{Bones, PosedAvatar};
    use flyrig_fit::Element;

    /// Returns random corrections of three frames.
    fn random_fit(avatar: &Avatar) -> PoseFit {
        let mut random = StdRng::seed_from_u64(7);
        let mut fit = PoseFit::new(3, avatar.template.skeleton.joints().len());
        fit.corrections.iter_mut().for_each(|value| *value = random.random_range(-0.2..0.2));
        fit
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let avatar = small(400, 7);
        let skeleton = &avatar.template.skeleton;
        let (pose, translations) = random_pose(&avatar, 3);
        let mut fit = random_fit(&avatar);
        // One joint without a correction.
        fit.corrections[fit.width + 9..fit.width + 12].fill(0.0);
        let weights: Vec<[Element; 2]> = (0..avatar.places.len())
            .map(|i| [0, 1].map(|list| [0, 1, 2, 3].map(|k| ((i * 8 + list * 4 + k) as f32 * 1.7).sin())))
            .collect();
        let bones = Bones::new(skeleton, &fit.corrected(1, &pose));
        let mut posed = PosedAvatar::default();
        avatar.pose(&bones, Some(&translations), &mut posed);
        let [centers, rotations]: [Vec<Element>; 2] = [0, 1].map(|list| weights.iter().map(|row| row[list]).collect());
        let slopes = avatar.bone_slopes(&bones, &posed, &centers, &rotations);
        let found = fit.slopes(1, skeleton, &pose, &slopes);
        assert_eq!(found.len(), fit.width);
        let canonical: Vec<_> = posed.canonical().collect();
        let mut moving = 0;
        for (k, found) in found.iter().enumerate() {
            let step = 1e-3;
            let at = |by: f32| {
                let mut moved = fit.clone();
                moved.corrections[fit.width + k] += by;
                loss(&avatar, &avatar.skin, &moved.corrected(1, &pose), (0, &canonical), &weights)
            };
            let expected = (at(step) - at(-step)) / f64::from(2.0 * step);
            let error = (expected - f64::from(*found)).abs();
            assert!(error < 1e-3 * (expected.abs() + 0.1), "{k}: {expected} {found}");
            moving += u32::from(expected.abs() > 0.1);
        }
        assert!(moving > 60, "{moving}");
    }

    #[test]
    fn without_corrections_poses_stay_and_frames_that_are_missing_have_none() {
        let avatar = small(40, 7);
        let (pose, _) = random_pose(&avatar, 3);
        let fit = PoseFit::new(2, avatar.template.skeleton.joints().len());
        for frame in [0, 1, 9] {
            let corrected = fit.corrected(frame, &pose);
            assert!(corrected.root_translation.distance(pose.root_translation) < 1e-12);
            assert!(
                corrected.joint_rotations.iter().zip(&pose.joint_rotations).all(|(a, b)| a.angle_between(*b) < 1e-6)
            );
        }
        // A pose without rotations has nothing to correct.
        let empty = Pose { root_translation: DVec3::X, joint_rotations: Vec::new() };
        assert_eq!(random_fit(&avatar).corrected(1, &empty), empty);
    }

    #[test]
    fn the_mean_over_the_take_is_zero_and_poison_is_left_out() {
        let avatar = small(40, 7);
        let skeleton = &avatar.template.skeleton;
        let joints = skeleton.joints().len();
        let (pose, _) = random_pose(&avatar, 3);
        let mut random = StdRng::seed_from_u64(2);
        let mut draw = || DVec3::new(random.random(), random.random(), random.random()) - 0.3;
        let mut fit = PoseFit::new(3, joints);
        for count in 1..=60 {
            let mut slopes: Vec<BoneSlope> = (0..joints).map(|_| BoneSlope { shift: draw(), turn: draw() }).collect();
            slopes[5] = BoneSlope { shift: DVec3::NAN, turn: DVec3::INFINITY };
            fit.descend(count as usize % 3, (skeleton, &pose), &slopes, count, count as f32 / 60.0);
        }
        assert!(fit.corrections.iter().chain(&fit.squares).all(|value| value.is_finite()));
        assert!(fit.corrections.iter().any(|value| value.abs() > 1e-3));
        for k in 0..fit.width {
            let mean: f32 = (0..3).map(|frame| fit.corrections[frame * fit.width + k]).sum();
            assert!(mean.abs() < 1e-5, "{k}: {mean}");
        }
        let huge = vec![BoneSlope { shift: DVec3::X, turn: DVec3::splat(1e300) }; joints];
        fit.descend(1, (skeleton, &pose), &huge, 61, 1.0);
        assert!(fit.corrections.iter().chain(&fit.squares).all(|value| value.is_finite()));
        // Of one frame alone nothing is corrected, and of none either.
        for frames in [1, 0] {
            let mut fit = PoseFit::new(frames, joints);
            fit.descend(0, (skeleton, &pose), &vec![BoneSlope { shift: DVec3::X, turn: DVec3::Y }; joints], 1, 0.0);
            assert!(fit.corrections.iter().all(|value| value.abs() <= 0.0));
        }
    }

    /// Checks the pull alone: neighbouring frames become more alike and all corrections return to zero.
    #[test]
    fn without_images_corrections_vanish() {
        let avatar = small(40, 7);
        let skeleton = &avatar.template.skeleton;
        let (pose, _) = random_pose(&avatar, 3);
        let mut fit = random_fit(&avatar);
        let most = |fit: &PoseFit| fit.corrections.iter().fold(0.0f32, |most, value| most.max(value.abs()));
        let before = most(&fit);
        for count in 1..=300 {
            fit.descend(count as usize % 3, (skeleton, &pose), &[], count, 0.0);
        }
        assert!(most(&fit) < 0.2 * before, "{before} {}", most(&fit));
    }
}
