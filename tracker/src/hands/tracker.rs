//! Tracks fingers and head of one person through the frame sets of a rig.
//!
//! Per frame set: the networks run on the stalest crops within the budget, then each hand and the head are fitted to the
//! landmarks of all views. Views whose median residual is too large are dropped, and the fit is repeated without them.

use std::time::Instant;

use flyrig_body::Template;
use flyrig_solve::RigidMotion;
use flyrig_types::{Camera, FrameSet, Pose, Rig};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::error::{TrackError, TrackErrorKind};
use crate::hands::crop_schedule::{FORGET_SECS, FaceTarget, PartInference, hand_crop};
use crate::hands::face_net::{FACE_SIDE, FaceNet};
use crate::hands::face_points::FACE_POINTS;
use crate::hands::hand_fit::{HandPose, HandProblem, HandSight};
use crate::hands::hand_model::{Bends, HandModel, relaxed};
use crate::hands::hand_net::{HAND_LANDMARKS, HAND_SIDE, HandNet};
use crate::hands::head_fit::{FaceSight, HeadProblem};
use crate::hands::quality::{HandQuality, HandState, HandsQuality, HeadQuality};
use crate::hands::sight::Sight;
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::image::view::View;
use crate::landmarks::bias::template_scale;
use crate::pose::body_model::{BodyModel, PosedSkeleton};

/// Least presence of a usable inference.
const MIN_PRESENCE: f64 = 0.5;
/// Median residual above which a view shows something else, standard deviations.
const OFF_HAND: f64 = 3.0;
/// Standard deviation of an angle's change between frame sets at 30 frame sets per second, radians.
const SMOOTH_RAD: f64 = 0.3;
/// Limit of the speed of wrists and head, metres per second.
const MAX_SPEED: f64 = 12.0;
/// Number of parts: left hand, right hand, head.
const PARTS: usize = 3;
const HEAD: usize = 2;

/// Settings of [`HandTracker`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandConfig {
    /// Least length of a hand, wrist to fingertip, for the network to run, pixels.
    pub min_hand_px: f64,
    /// Least height of a face for the network to run, pixels.
    pub min_face_px: f64,
    /// Most crops per frame set, hands and faces together; 0 for all that are due.
    pub crops: usize,
    /// Motion of a hand or head, or of its flesh through rotation, until the network runs on a view of it again, metres.
    /// Inferences also become stale with age.
    pub look_after_m: f64,
    /// Whether fingers are estimated.
    pub fingers: bool,
    /// Whether the head's rotation is estimated.
    pub head: bool,
}

impl Default for HandConfig {
    fn default() -> Self {
        Self { min_hand_px: 20.0, min_face_px: 30.0, crops: 6, look_after_m: 0.005, fingers: true, head: true }
    }
}

/// Tracker of the fingers and the head of a body whose pose is estimated otherwise.
#[derive(Debug, Clone)]
pub struct HandTracker {
    hand_net: HandNet,
    face_net: FaceNet,
    config: HandConfig,
    rig: Rig,
    template: Template,
    body: BodyModel,
    hands: [HandModel; 2],
    scale: f64,
    /// Last inference of each part and slot.
    inferences: [Vec<Option<PartInference>>; PARTS],
    last: Option<Last>,
}

/// State after a frame set.
#[derive(Debug, Clone)]
struct Last {
    nanos: i64,
    frames: [RigidMotion; PARTS],
    velocity: [DVec3; PARTS],
    bends: [Bends; 2],
}

/// Crop that a network may run on.
struct Candidate {
    part: usize,
    slot: usize,
    crop: Crop,
    /// See [`PartInference::staleness_m`]; infinite without an inference.
    staleness_m: f64,
}

impl HandTracker {
    /// Creates a tracker for a body in the shape of `template`, which gets fingers if it has none, and the cameras of
    /// `rig`.
    ///
    /// # Errors
    /// Kind `Template` for a body that cannot have fingers, `Rig` for a rig without cameras, `Net` when a network does not
    /// load.
    pub fn new(template: &Template, rig: &Rig, config: HandConfig) -> Result<Self, TrackError> {
        Self::with_nets(HandNet::embedded()?, FaceNet::embedded()?, template, rig, config)
    }

    /// Creates a tracker with networks that are loaded already; see [`Self::new`].
    ///
    /// # Errors
    /// Kinds `Template` and `Rig` as those of [`Self::new`].
    pub fn with_nets(
        hand_net: HandNet,
        face_net: FaceNet,
        template: &Template,
        rig: &Rig,
        config: HandConfig,
    ) -> Result<Self, TrackError> {
        rig.validate().map_err(|error| TrackError::new(TrackErrorKind::Rig, error.to_string()))?;
        let template = fingered(template)?;
        let body = BodyModel::new(&template)?;
        let hands = HandModel::pair(&template)?;
        let slots = rig.cameras.len();
        Ok(Self {
            hand_net,
            face_net,
            config,
            rig: rig.clone(),
            scale: template_scale(&template),
            body,
            hands,
            template,
            inferences: std::array::from_fn(|_| vec![None; slots]),
            last: None,
        })
    }

    /// Returns the template with fingers that poses refer to.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Returns the world places of the hand landmarks in a pose of [`Self::template`], metres: left, right. `None` for a
    /// pose that does not fit.
    #[must_use]
    pub fn hand_landmarks(&self, pose: &Pose) -> Option<[[DVec3; HAND_LANDMARKS]; 2]> {
        self.template.skeleton.check_pose(pose).ok()?;
        let canonical = self.template.skeleton.world_from_canonical(pose);
        let of = |model: &HandModel| model.marks().map(|(joint, point)| canonical[joint].transform_point3(point));
        Some([of(&self.hands[0]), of(&self.hands[1])])
    }

    /// Returns the rotation of the head's flesh from canonical axes to the world in a pose of [`Self::template`]; `None`
    /// for a pose that does not fit.
    #[must_use]
    pub fn head_rotation(&self, pose: &Pose) -> Option<DQuat> {
        let turns = self.body.to_turns(pose)?;
        Some(self.body.pose(&turns).rotation[self.body.roles.head])
    }

    /// Replaces a camera that has moved, from the next frame set on. Slots that do not exist are ignored.
    pub fn move_camera(&mut self, slot: usize, camera: &Camera) {
        if let Some(known) = self.rig.cameras.get_mut(slot) {
            known.clone_from(camera);
            self.inferences
                .iter_mut()
                .filter_map(|inferences| inferences.get_mut(slot))
                .for_each(|inference| *inference = None);
        }
    }

    /// Replaces the template and forgets all inferences.
    ///
    /// # Errors
    /// Kind `Template` for a body that cannot have fingers.
    pub fn set_template(&mut self, template: &Template) -> Result<(), TrackError> {
        let rig = self.rig.clone();
        *self = Self::with_nets(self.hand_net.clone(), self.face_net.clone(), template, &rig, self.config)?;
        Ok(())
    }

    /// Forgets all inferences, as after the loss of the person.
    pub fn reset(&mut self) {
        self.inferences.iter_mut().flatten().for_each(|inference| *inference = None);
        self.last = None;
    }

    /// Estimates fingers and head, from the body's pose at the frame set's time, which may lack rotations of the finger
    /// joints. Returns a pose of [`Self::template`].
    ///
    /// # Errors
    /// Kind `Template` for a pose that does not fit, `Frames` and `Image` for a frame set that does not fit the rig, `Net`
    /// when a network fails. The state stays valid.
    pub fn estimate(&mut self, set: &FrameSet, pose: &Pose) -> Result<(Pose, HandsQuality), TrackError> {
        if set.frames.len() != self.rig.cameras.len() {
            return Err(TrackError::new(
                TrackErrorKind::Frames,
                format!("a frame set of {} slots for a rig of {} cameras", set.frames.len(), self.rig.cameras.len()),
            ));
        }
        let mut turns = self.body.to_turns(&self.extended(pose)).ok_or_else(|| {
            TrackError::new(
                TrackErrorKind::Template,
                format!(
                    "a pose of {} joints that is not for template '{}'",
                    pose.joint_rotations.len(),
                    self.template.name
                ),
            )
        })?;
        for hand in &self.hands {
            for joint in 0..turns.turns.len() {
                if joint != hand.hand && self.body.hangs_below(joint, hand.hand) {
                    turns.turns[joint] = DQuat::IDENTITY;
                }
            }
        }
        let posed = self.body.pose(&turns);
        let nanos = set.master_nanos;
        let frames = self.frames(&posed);
        let last = self
            .last
            .take()
            .filter(|last| (0.0..FORGET_SECS).contains(&(1e-9 * nanos.saturating_sub(last.nanos) as f64)));
        if last.is_none() {
            self.inferences.iter_mut().flatten().for_each(|inference| *inference = None);
        }
        let velocity = velocities(last.as_ref(), &frames, nanos);

        let start = Instant::now();
        let (candidates, largest_px) = self.candidates(set, &posed, &frames, last.as_ref());
        let crops = self.infer(set, candidates, &frames, &velocity)?;
        let net_secs = start.elapsed().as_secs_f64();

        let start = Instant::now();
        let mut bends = [relaxed(); 2];
        let mut hands = [HandQuality { state: HandState::TooSmall, largest_px: 0.0, views: 0, residual_px: None }; 2];
        for side in 0..2 {
            hands[side].largest_px = largest_px[side];
            let before = last.as_ref().map(|last| (last.bends[side], 1e-9 * nanos.saturating_sub(last.nanos) as f64));
            let fitted = self.fit_hand(side, &frames[side], nanos, before, &mut hands[side]);
            match fitted {
                Some(found) => {
                    bends[side] = found.bends;
                    let hand = self.hands[side].hand;
                    let parent = self.body.parents[hand].map_or(DQuat::IDENTITY, |parent| posed.rotation[parent]);
                    turns.turns[hand] = (parent.inverse() * found.turn * posed.rotation[hand]).normalize();
                }
                None => bends[side] = before.map_or_else(relaxed, |(before, secs)| calmed(&before, secs)),
            }
            let model = &self.hands[side];
            for (finger, bend) in bends[side].into_iter().enumerate() {
                for (joint, turn) in model.joints[finger].into_iter().zip(model.turns(finger, bend)) {
                    turns.turns[joint] = turn;
                }
            }
        }
        let head_joint = self.body.roles.head;
        let mut head = HeadQuality::default();
        if let Some(turn) = self.fit_head(&frames[HEAD], nanos, &mut head) {
            let parent = self.body.parents[head_joint].map_or(DQuat::IDENTITY, |parent| posed.rotation[parent]);
            turns.turns[head_joint] = (parent.inverse() * turn * posed.rotation[head_joint]).normalize();
        }
        self.last = Some(Last { nanos, frames, velocity, bends });
        let seconds = [net_secs, start.elapsed().as_secs_f64()];
        Ok((self.body.to_pose(&turns), HandsQuality { hands, head, crops, seconds }))
    }

    /// Returns the pose with rotations at rest for joints that it lacks.
    fn extended(&self, pose: &Pose) -> Pose {
        let mut pose = pose.clone();
        let rest = self.template.skeleton.joints().iter().map(|joint| joint.rest_rotation);
        pose.joint_rotations.extend(rest.skip(pose.joint_rotations.len()));
        pose
    }

    /// Returns rotation and place of each part in the world.
    fn frames(&self, posed: &PosedSkeleton) -> [RigidMotion; PARTS] {
        [self.hands[0].hand, self.hands[1].hand, self.body.roles.head]
            .map(|joint| RigidMotion { rotation: posed.rotation[joint], translation: posed.origin[joint] })
    }

    /// Returns the crops of hands and faces that are large enough, and the largest length of each hand, pixels.
    fn candidates(
        &self,
        set: &FrameSet,
        posed: &PosedSkeleton,
        frames: &[RigidMotion; PARTS],
        last: Option<&Last>,
    ) -> (Vec<Candidate>, [f64; 2]) {
        let mut found = Vec::new();
        let mut largest_px = [0.0f64; 2];
        for (slot, _) in set.present() {
            let camera = &self.rig.cameras[slot];
            let view = View::new(camera);
            let mut offer = |part: usize, crop: Crop, reach_m: f64| {
                let inference = self.inferences[part][slot].as_ref();
                let staleness_m = inference
                    .map_or(f64::INFINITY, |inference| inference.staleness_m(&frames[part], reach_m, set.master_nanos));
                found.push(Candidate { part, slot, crop, staleness_m });
            };
            for (side, model) in self.hands.iter().enumerate().filter(|_| self.config.fingers) {
                let Some(px_per_m) = view.px_per_m(frames[side].translation) else { continue };
                let pose =
                    HandPose { bends: last.map_or_else(relaxed, |last| last.bends[side]), ..HandPose::relaxed() };
                let problem = HandProblem { model, sights: &[], wrist: frames[side], before: None };
                let length_px = model.length_m * px_per_m;
                let Some(crop) = hand_crop(camera, &problem.points(&pose).0, length_px) else { continue };
                largest_px[side] = largest_px[side].max(length_px);
                if length_px >= self.config.min_hand_px {
                    offer(side, crop, 0.5 * model.length_m);
                }
            }
            if self.config.head
                && !FACE_POINTS.is_empty()
                && let Some(face) = FaceTarget::new(camera, &self.body, posed, self.scale)
                && face.height_px >= self.config.min_face_px
            {
                offer(HEAD, face.crop, 0.1 * self.scale);
            }
        }
        (found, largest_px)
    }

    /// Runs the networks on the stalest crops within the budget. Returns the numbers of hands and faces.
    fn infer(
        &mut self,
        set: &FrameSet,
        mut candidates: Vec<Candidate>,
        frames: &[RigidMotion; PARTS],
        velocity: &[DVec3; PARTS],
    ) -> Result<[usize; 2], TrackError> {
        candidates.retain(|candidate| candidate.staleness_m > self.config.look_after_m);
        candidates.sort_by(|a, b| b.staleness_m.total_cmp(&a.staleness_m));
        if self.config.crops > 0 {
            candidates.truncate(self.config.crops);
        }
        let seen: Vec<(usize, usize, PartInference)> = candidates
            .par_iter()
            .map(|&Candidate { part, slot, crop, .. }| {
                let camera = &self.rig.cameras[slot];
                let frame = set.frames[slot].as_ref().ok_or_else(|| {
                    TrackError::new(TrackErrorKind::Frames, format!("camera {} has no frame", camera.id))
                })?;
                let picture = Rgb::of_camera(&frame.image, camera)?;
                let view = View::new(camera);
                let (seen, presence) = if part == HEAD {
                    let output = self.face_net.run(&crop.sample_square(&picture, FACE_SIDE))?;
                    let of_point = |landmark: usize| crop.to_image_from(output.landmarks[landmark], FACE_SIDE);
                    let seen = FACE_POINTS.iter().map(|point| view.undistorted(camera, of_point(point.landmark)));
                    (seen.collect(), output.presence)
                } else {
                    let output = self.hand_net.run(&crop.sample_square(&picture, HAND_SIDE))?;
                    let seen = output.landmarks.iter();
                    let seen = seen.map(|&at| view.undistorted(camera, crop.to_image_from(at, HAND_SIDE)));
                    (seen.collect(), output.presence)
                };
                let delay_secs = 1e-9 * frame.capture_nanos.saturating_sub(set.master_nanos) as f64;
                let translation = frames[part].translation + velocity[part] * delay_secs.clamp(-0.1, 0.1);
                let frame = RigidMotion { translation, ..frames[part] };
                Ok((part, slot, PartInference { nanos: set.master_nanos, seen, presence, frame }))
            })
            .collect::<Result<_, TrackError>>()?;
        let mut crops = [0; 2];
        for (part, slot, inference) in seen {
            crops[usize::from(part == HEAD)] += 1;
            self.inferences[part][slot] = Some(inference);
        }
        Ok(crops)
    }

    /// Iterates over the usable inferences of a part at a time.
    fn usable(&self, part: usize, nanos: i64) -> impl Iterator<Item = (&Camera, &PartInference)> {
        let inferences = self.inferences[part].iter().zip(&self.rig.cameras);
        inferences.filter_map(move |(inference, camera)| {
            let inference = inference.as_ref()?;
            (inference.presence >= MIN_PRESENCE && inference.age_secs(nanos) < FORGET_SECS)
                .then_some((camera, inference))
        })
    }

    /// Fits a hand to its inferences; `None` leaves it relaxed.
    fn fit_hand(
        &self,
        side: usize,
        frame: &RigidMotion,
        nanos: i64,
        before: Option<(Bends, f64)>,
        quality: &mut HandQuality,
    ) -> Option<HandPose> {
        if quality.largest_px < self.config.min_hand_px {
            return None;
        }
        quality.state = HandState::NotSeen;
        let sight = |(camera, inference): (&Camera, &PartInference)| {
            let seen = std::array::from_fn(|i| inference.seen.get(i).copied().flatten());
            HandSight { sight: sight_of(camera, inference, frame, nanos), seen }
        };
        let mut sights: Vec<HandSight> = self.usable(side, nanos).map(sight).collect();
        if sights.is_empty() {
            return None;
        }
        quality.state = HandState::Disagrees;
        let sigma = |secs: f64| SMOOTH_RAD * (secs * 30.0).clamp(0.1, 30.0).sqrt();
        let prior = before.map(|(bends, secs)| (bends, sigma(secs)));
        let solve = |sights: &[HandSight]| {
            let problem = HandProblem { model: &self.hands[side], sights, wrist: *frame, before: prior };
            let relaxed = problem.solve(&HandPose::relaxed());
            let last = before.and_then(|(bends, _)| problem.solve(&HandPose { bends, ..HandPose::relaxed() }));
            relaxed.into_iter().chain(last).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(pose, _)| pose)
        };
        let off = |pose: &HandPose, sights: &[HandSight]| -> Vec<Option<(f64, f64)>> {
            let problem = HandProblem { model: &self.hands[side], sights, wrist: *frame, before: None };
            sights.iter().map(|sight| problem.residual(pose, sight)).collect()
        };
        let mut pose = solve(&sights)?;
        let first = off(&pose, &sights);
        let mut good = first.iter().map(|off| off.is_some_and(|(sigmas, _)| sigmas < OFF_HAND));
        sights.retain(|_| good.next().unwrap_or(false));
        if sights.is_empty() {
            return None;
        }
        if sights.len() < first.len() {
            pose = solve(&sights)?;
        }
        let mut pixels: Vec<f64> = off(&pose, &sights).into_iter().flatten().map(|(_, pixels)| pixels).collect();
        quality.residual_px = flyrig_solve::median(&mut pixels);
        quality.views = sights.len();
        quality.state = HandState::Fitted;
        Some(pose)
    }

    /// Fits the head to the inferences of the face; `None` leaves it in the body's pose.
    fn fit_head(&self, frame: &RigidMotion, nanos: i64, quality: &mut HeadQuality) -> Option<DQuat> {
        let sight = |(camera, inference): (&Camera, &PartInference)| {
            let points = FACE_POINTS.iter().map(|point| point.place_m(self.scale));
            let seen = inference.seen.iter().zip(points).filter_map(|(seen, point)| Some(((*seen)?, point))).collect();
            FaceSight { sight: sight_of(camera, inference, frame, nanos), seen }
        };
        let mut sights: Vec<FaceSight> =
            self.usable(HEAD, nanos).map(sight).filter(|sight| !sight.seen.is_empty()).collect();
        if sights.is_empty() {
            return None;
        }
        let mut pose = HeadProblem { sights: &sights, head: *frame }.solve()?;
        let count = sights.len();
        let problem = HeadProblem { sights: &[], head: *frame };
        sights.retain(|sight| problem.residual(&pose, sight).is_some_and(|(sigmas, _)| sigmas < OFF_HAND));
        if sights.is_empty() {
            return None;
        }
        if sights.len() < count {
            pose = HeadProblem { sights: &sights, head: *frame }.solve()?;
        }
        let mut pixels: Vec<f64> =
            sights.iter().filter_map(|sight| problem.residual(&pose, sight)).map(|(_, pixels)| pixels).collect();
        quality.residual_px = flyrig_solve::median(&mut pixels);
        quality.views = sights.len();
        quality.turned_rad = pose.turn.angle_between(DQuat::IDENTITY);
        Some(pose.turn)
    }
}

/// Returns the view of a part in the image of an inference.
fn sight_of(camera: &Camera, inference: &PartInference, frame: &RigidMotion, nanos: i64) -> Sight {
    Sight { view: View::new(camera), trust: inference.trust(nanos), carry: inference.carry(frame) }
}

/// Returns the template with fingers.
fn fingered(template: &Template) -> Result<Template, TrackError> {
    template.with_fingers().map_err(|error| TrackError::new(TrackErrorKind::Template, error.to_string()))
}

/// Returns the velocities of wrists and head since the last frame set, metres per second.
fn velocities(last: Option<&Last>, frames: &[RigidMotion; PARTS], nanos: i64) -> [DVec3; PARTS] {
    let Some(last) = last else { return [DVec3::ZERO; PARTS] };
    let secs = 1e-9 * nanos.saturating_sub(last.nanos) as f64;
    if secs < 1e-3 {
        return last.velocity;
    }
    std::array::from_fn(|part| {
        let moved = frames[part].translation - last.frames[part].translation;
        (moved / secs).clamp_length_max(MAX_SPEED)
    })
}

/// Returns unseen fingers on their way to the relaxed hand, `secs` after `before`.
fn calmed(before: &Bends, secs: f64) -> Bends {
    let share = (secs / FORGET_SECS).clamp(0.0, 1.0);
    let calm = relaxed();
    std::array::from_fn(|finger| {
        std::array::from_fn(|k| before[finger][k] + (calm[finger][k] - before[finger][k]) * share)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{body, random_turns, ring};
    use flyrig_types::{Frame, Image, PixelFormat};
    use std::sync::Arc;

    fn grey_set(rig: &Rig, nanos: i64) -> FrameSet {
        let frame = |camera: &Camera| {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let bytes = vec![90; (width * height * 3) as usize];
            let image = Image::new(width, height, PixelFormat::Rgb8, bytes).unwrap();
            let camera = camera.id.clone();
            Some(Arc::new(Frame { camera, sequence: 0, capture_nanos: nanos, exposure_nanos: None, image, mask: None }))
        };
        FrameSet { index: 0, master_nanos: nanos, frames: rig.cameras.iter().map(frame).collect() }
    }

    #[test]
    fn hands_that_nobody_sees_are_relaxed_and_reported() {
        let (rig, template) = (ring(2), body());
        let mut tracker = HandTracker::new(&template, &rig, HandConfig::default()).unwrap();
        let model = BodyModel::new(&template).unwrap();
        let pose = model.to_pose(&random_turns(&model, 1));
        let (found, quality) = tracker.estimate(&grey_set(&rig, 0), &pose).unwrap();
        assert_eq!(found.joint_rotations.len(), 59);
        assert!(found.is_valid());
        assert_eq!(quality.fitted(), 0);
        assert!(quality.hands.iter().all(|hand| hand.state == HandState::NotSeen && hand.views == 0));
        assert!(quality.crops[0] > 0);
        // The body is as it was, but for the thumbs, whose first joints the body has without fingers as well.
        let joints = template.skeleton.joints().iter();
        for ((a, b), joint) in found.joint_rotations.iter().zip(&pose.joint_rotations).zip(joints) {
            assert!(joint.name.contains("Thumb") || a.dot(*b).abs() > 1.0 - 1e-9, "{a} {b}");
        }
        let small = HandConfig { min_hand_px: 5000.0, min_face_px: 5000.0, ..HandConfig::default() };
        let mut tracker = HandTracker::new(&template, &rig, small).unwrap();
        let (_, quality) = tracker.estimate(&grey_set(&rig, 0), &pose).unwrap();
        assert!(quality.hands.iter().all(|hand| hand.state == HandState::TooSmall && hand.largest_px > 30.0));
        assert_eq!(quality.crops, [0, 0]);
    }

    #[test]
    fn the_budget_bounds_the_crops_of_a_set_and_all_views_have_their_turn() {
        let (rig, template) = (ring(3), body());
        let config = HandConfig { crops: 2, head: false, ..HandConfig::default() };
        let mut tracker = HandTracker::new(&template, &rig, config).unwrap();
        let model = BodyModel::new(&template).unwrap();
        let pose = model.to_pose(&random_turns(&model, 1));
        for k in 0..3 {
            let (_, quality) = tracker.estimate(&grey_set(&rig, k * 1_000_000), &pose).unwrap();
            assert_eq!(quality.crops, [2, 0]);
        }
        assert!(tracker.inferences[..2].iter().flatten().all(Option::is_some));
        // No part has moved, and no inference is old.
        let (_, quality) = tracker.estimate(&grey_set(&rig, 4_000_000), &pose).unwrap();
        assert_eq!(quality.crops, [0, 0]);
    }

    #[test]
    fn poses_and_sets_that_do_not_fit_are_refused() {
        let (rig, template) = (ring(2), body());
        let mut tracker = HandTracker::new(&template, &rig, HandConfig::default()).unwrap();
        let pose = template.skeleton.rest_pose();
        let mut long = pose.clone();
        long.joint_rotations.extend([DQuat::IDENTITY; 40]);
        let set = grey_set(&rig, 0);
        assert_eq!(tracker.estimate(&set, &long).unwrap_err().kind, TrackErrorKind::Template);
        let mut nan = pose.clone();
        nan.root_translation = DVec3::NAN;
        assert_eq!(tracker.estimate(&set, &nan).unwrap_err().kind, TrackErrorKind::Template);
        let short = FrameSet { frames: set.frames[..1].to_vec(), ..set };
        assert_eq!(tracker.estimate(&short, &pose).unwrap_err().kind, TrackErrorKind::Frames);
        let mut statue = template;
        statue.name = "statue".to_owned();
        let error = HandTracker::new(&statue, &rig, HandConfig::default()).unwrap_err();
        assert_eq!(error.kind, TrackErrorKind::Template);
    }
}
