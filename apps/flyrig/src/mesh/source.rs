//! Avatar that is meshed: one from a file, or that of a take's person, tracked and fitted.

use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use flyrig_avatar::{Avatar, AvatarFitSettings, AvatarModel, TrainingFrame};
use flyrig_fit::{Fit, FitSettings, TrainingView};
use flyrig_fusion::BodySettings;
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{progress_bar, stop};
use flyrig_takes::{AvatarTake, DepthFolder, frame_number};
use flyrig_types::PoseTrack;
use glam::{DQuat, DVec3};

use super::{arguments::MeshArgs, held_out::HeldOut};
use crate::avatar::{DrivenMotion, load, open_replay};

/// Avatar, and the frames of its take.
pub(super) struct Source {
    pub avatar: Avatar,
    /// Frames in which the person was found; none for an avatar from a file.
    pub frames: Vec<TrainingFrame>,
    /// Number of each of these frames in the take, ascending.
    pub numbers: Vec<u64>,
    /// Frames per second of the take.
    pub fps: f64,
    /// Motion of an avatar, z up.
    pub motion: Option<PoseTrack>,
    /// Upward direction of the take's or the motion's world.
    pub up: DVec3,
    /// Images of the inputs, cropped to the person; none for an avatar from a file.
    pub photos: Vec<TrainingView>,
    /// Cameras of the take that are left out.
    pub held_out: Option<HeldOut>,
    /// Seconds of tracking and of the fit.
    pub tracked_s: f64,
    pub fitted_s: f64,
    /// Mean distance of the drawn planes from the depth images in the first images of the fit and in the last ones, millimetres; `None` without
    /// depth images.
    pub depth_mm: Option<[f64; 2]>,
}

impl Source {
    /// Opens the avatar or tracks the take.
    pub fn open(args: &MeshArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Self> {
        let path = &args.take.dataset;
        if path.extension().is_some_and(|extension| extension == "flyavatar" || extension == "person") {
            args.check_no_take("an avatar")?;
            let avatar = load(path)?;
            let motion =
                args.motion.as_deref().map(|motion| DrivenMotion::load(&avatar.surface(), motion)).transpose()?;
            return Ok(Self {
                avatar,
                motion: motion.map(|motion| motion.track().clone()),
                frames: Vec::new(),
                numbers: Vec::new(),
                fps: 30.0,
                up: DVec3::Z,
                photos: Vec::new(),
                held_out: None,
                tracked_s: 0.0,
                fitted_s: 0.0,
                depth_mm: None,
            });
        }
        ensure!(
            args.motion.is_none(),
            "--motion moves an avatar, and {} is a take, whose mesh moves as the person did: leave out --motion, or build an avatar first",
            path.display()
        );
        Self::track(args, &gpu()?.fastest())
    }

    /// Returns the rotation of the take's world to y up.
    pub fn y_up(&self) -> DQuat {
        DQuat::from_rotation_arc(self.up.normalize_or(DVec3::Z), DVec3::Y)
    }

    /// Returns the time of each frame, seconds from the first one.
    pub fn seconds(&self) -> impl Iterator<Item = f64> + '_ {
        seconds_of(&self.numbers, self.fps)
    }

    fn track(args: &MeshArgs, gpu: &GpuContext) -> Result<Self> {
        ensure!(
            args.depth.is_none() || args.steps > 0,
            "--steps 0 fits nothing, and --depth is for the fit: leave out one of them"
        );
        let started = Instant::now();
        let mut take_args = args.take.resolve("mesh", &args.holdout, gpu)?;
        if let Some(frame) = args.frame {
            // What comes after it changes nothing.
            let range = take_args.range.frames.clone().unwrap_or(0..u64::MAX);
            ensure!(range.contains(&frame), "--frame {frame} is not among --frames {}..{}", range.start, range.end);
            take_args.range.frames = Some(range.start..frame + 1);
        }
        let body = BodySettings { gaussians: args.gaussians as usize, ..BodySettings::default() };
        let mut replay = open_replay(&take_args, &args.holdout, (&body, None), gpu)?;
        // A folder that cannot be used is found before anything is tracked.
        let depths =
            args.depth.as_deref().map(|depth| DepthFolder::open(depth, &replay.session.rig().cameras)).transpose()?;
        let mut found = Vec::new();
        let take = AvatarTake::track(&mut replay, &body, HarmonicOrder::Zero, |_, set| {
            found.push((frame_number(set), set.master_nanos));
            Ok(())
        })
        .with_context(|| format!("no mesh of {}", take_args.dataset.display()))?;
        ensure!(!stop::requested(), "stopped; nothing was written");
        let mut take = match args.frame {
            Some(frame) => {
                found.retain(|(number, _)| *number == frame);
                take.only(frame)?
            }
            None => take.with_outlines(),
        };
        if let Some(depths) = &depths {
            let (with_depths, count) = take.with_depths(depths, &replay.session.rig().cameras)?;
            println!("depth images show the person in {count} of {} images", with_depths.views.len());
            take = with_depths;
        }
        let photos = take.views.clone();
        let AvatarTake { frames, views, avatar, numbers, .. } = take;
        let tracked_s = started.elapsed().as_secs_f64();
        println!("tracked {} frames in {tracked_s:.0} s", frames.len());
        let up = replay.session.rig().world_up;
        let held_out = HeldOut::of(replay, &found);
        let started = Instant::now();
        let Fitted { avatar, frames, depth_mm } = if args.steps == 0 {
            Fitted { avatar, frames, depth_mm: None }
        } else {
            fit(args, (avatar, frames), views, gpu)?
        };
        let fitted_s = started.elapsed().as_secs_f64();
        Ok(Self {
            avatar,
            frames,
            motion: None,
            numbers,
            fps: take_args.rate.fps,
            up,
            photos,
            held_out,
            tracked_s,
            fitted_s,
            depth_mm,
        })
    }
}

/// Avatar and frames of a take, fitted to its images.
struct Fitted {
    avatar: Avatar,
    frames: Vec<TrainingFrame>,
    /// As [`Source::depth_mm`].
    depth_mm: Option<[f64; 2]>,
}

/// Fits an avatar and the node translations of its frames to the images of the take.
fn fit(
    args: &MeshArgs,
    (avatar, frames): (Avatar, Vec<TrainingFrame>),
    views: Vec<TrainingView>,
    gpu: &GpuContext,
) -> Result<Fitted> {
    let settings = AvatarFitSettings { refine_nodes: true, ..AvatarFitSettings::default() };
    let model = AvatarModel::new(avatar, frames, settings);
    let mut fit = Fit::new(gpu, model, views, FitSettings::default())?;
    let bar = progress_bar(args.steps, "fit");
    let mut depths_mm = Vec::new();
    for step in 0..args.steps {
        ensure!(!stop::requested(), "stopped; nothing was written");
        depths_mm.extend(fit.step(step as f32 / args.steps as f32)?.depth_m.map(|metres| 1e3 * metres));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let count = fit.images().min(depths_mm.len());
    let mean = |some: &[f64]| some.iter().sum::<f64>() / some.len() as f64;
    let ends = || [mean(&depths_mm[..count]), mean(&depths_mm[depths_mm.len() - count..])];
    let depth_mm = (count > 0).then(ends);
    let (avatar, frames) = fit.into_model().into_parts();
    Ok(Fitted { avatar, frames, depth_mm })
}

/// Returns the times of frames by their ascending numbers, seconds from the first one.
fn seconds_of(numbers: &[u64], fps: f64) -> impl Iterator<Item = f64> + '_ {
    let first = numbers.first().copied().unwrap_or_default();
    numbers.iter().map(move |number| number.saturating_sub(first) as f64 / fps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_without_a_person_leave_gaps_in_time() {
        let close =
            |found: Vec<f64>, expected: [f64; 3]| found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(close(seconds_of(&[3, 4, 7], 10.0).collect(), [0.0, 0.1, 0.4]));
        assert_eq!(seconds_of(&[], 10.0).count(), 0);
    }
}
