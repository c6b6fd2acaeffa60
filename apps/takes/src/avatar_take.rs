//! Tracking of a take's person, with the images that an avatar is fitted to.

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_avatar::{Avatar, KnownPoses, TrainingFrame};
use flyrig_fit::TrainingView;
use flyrig_fusion::{BodySettings, Outcome, PersonId, person_surface};
use flyrig_renderer::HarmonicOrder;
use flyrig_report::{progress_bar, stop};
use flyrig_types::{Camera, FrameSet};
use glam::Vec2;
use rayon::prelude::*;

use crate::depth_images::DepthFolder;
use crate::outline_memory::{NodeSurface, remember_outlines};
use crate::replay::{Replay, frame_number};

/// Tracked take.
#[derive(Debug, Clone)]
pub struct AvatarTake {
    /// Frames in which the person was found.
    pub frames: Vec<TrainingFrame>,
    /// Input images, cropped to the person.
    pub views: Vec<TrainingView>,
    /// Initial avatar, which looks like the live rendering.
    pub avatar: Avatar,
    /// Texture coordinates of its Gaussians; empty if the template has none.
    pub uvs: Vec<Vec2>,
    /// Number of each of these frames, ascending; at least one.
    pub numbers: Vec<u64>,
    /// First camera.
    pub camera: Camera,
    /// Nodes of the deformation graph; `None` without a deformation.
    nodes: Option<NodeSurface>,
}

impl AvatarTake {
    /// Tracks the person of a replay until the end or Ctrl-C. `body` are the session's settings; `each` is called after every frame set in
    /// which the person was found.
    ///
    /// # Errors
    /// No person was found; errors of the session, the data set and `each`.
    pub fn track(
        replay: &mut Replay,
        body: &BodySettings,
        order: HarmonicOrder,
        mut each: impl FnMut(&mut Replay, &FrameSet) -> Result<()>,
    ) -> Result<Self> {
        let person = PersonId::default();
        let (mut frames, mut views, mut numbers, mut poses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let bar = progress_bar(replay.count as u64, "track");
        while let Some(set) = replay.next_set()?.filter(|_| !stop::requested()) {
            bar.inc(1);
            if let Outcome::Held(reason) = replay.session.process(&set)? {
                tracing::warn!(frame = frame_number(&set), %reason, "frame not used");
                continue;
            }
            let subject = replay.session.subject(person);
            let Some((subject, pose)) = subject.and_then(|subject| Some((subject, subject.pose()?))) else { continue };
            let cameras = replay.session.viewed(person);
            let cut = |(k, camera)| TrainingView::cut(frames.len(), camera, subject.input(k));
            views.extend(cameras.iter().enumerate().filter_map(cut));
            frames.push(TrainingFrame { pose: pose.clone(), translations: subject.node_translations().to_vec() });
            poses.push(pose.clone());
            numbers.push(frame_number(&set));
            each(replay, &set)?;
        }
        bar.finish_and_clear();
        let subject = replay.session.subject(person);
        let Some(subject) = subject.filter(|_| !numbers.is_empty()) else {
            bail!("no person was found in the take; run with -v to see why");
        };
        let (surface, graph) = person_surface(subject.template(), body)?;
        let deforms = frames.iter().any(|frame| !frame.translations.is_empty());
        let surface = if deforms { surface.inset() } else { surface };
        let colors: Vec<[f32; 3]> = replay.session.splats(person)?.iter().map(|splat| splat.color).collect();
        let mut avatar = Avatar::new(subject.template(), &surface, deforms.then_some(&graph), &colors, order)?;
        avatar.set_mean(frames.iter().map(|frame: &TrainingFrame| frame.translations.as_slice()));
        avatar.known_poses = KnownPoses::new(&poses);
        avatar.undressed = subject.undressed().cloned();
        let camera = replay.session.rig().cameras.first().cloned().context("no camera")?;
        let normals = graph.node_gaussian.iter().map(|&at| surface.normals[at as usize]).collect();
        let nodes =
            deforms.then_some(NodeSurface { gaussians: graph.node_gaussian, neighbors: graph.neighbors, normals });
        Ok(Self { frames, views, avatar, uvs: surface.uvs, numbers, camera, nodes })
    }

    /// Uses in all frames what outlines show of clothes and hair in some; the mean of the frames becomes the
    /// avatar's.
    #[must_use]
    pub fn with_outlines(mut self) -> Self {
        if let Some(nodes) = &self.nodes {
            let moved_m = remember_outlines(&mut self.frames, &self.views, &self.avatar, nodes);
            tracing::debug!(mm = 1e3 * moved_m, "nodes moved to where outlines of other frames show them");
            self.avatar.set_mean(self.frames.iter().map(|frame| frame.translations.as_slice()));
        }
        self
    }

    /// Adds the surfaces that depth images show to the views, and returns the number of views that have one. `cameras` are those of the
    /// take.
    ///
    /// # Errors
    /// Those of [`DepthFolder::read`]; no depth image shows the person.
    pub fn with_depths(mut self, folder: &DepthFolder, cameras: &[Camera]) -> Result<(Self, usize)> {
        let numbers = &self.numbers;
        let with = |view: TrainingView| {
            let camera = cameras.iter().find(|camera| camera.id == view.camera().id);
            let (Some(camera), Some(number)) = (camera, numbers.get(view.frame())) else { return Ok(view) };
            Ok(match folder.read(camera, *number)? {
                Some(depths) => view.with_depths(&depths),
                None => view,
            })
        };
        self.views = self.views.into_par_iter().map(with).collect::<Result<_>>()?;
        let count = self.views.iter().filter(|view| view.has_surface()).count();
        ensure!(count > 0, "no depth image shows the person; check that their numbers are those of the frames");
        Ok((self, count))
    }

    /// Returns the frame of this number alone, whose shape of clothes and hair becomes the avatar's mean.
    ///
    /// # Errors
    /// The person was not found in this frame.
    pub fn only(mut self, number: u64) -> Result<Self> {
        let Ok(at) = self.numbers.binary_search(&number) else {
            bail!(
                "the person was not found in frame {number}; it was found in {} frames from {} to {}",
                self.numbers.len(),
                self.numbers.first().copied().unwrap_or_default(),
                self.numbers.last().copied().unwrap_or_default()
            );
        };
        self.avatar.set_mean(self.frames[at..=at].iter().map(|frame| frame.translations.as_slice()));
        self.frames = self.frames.split_off(at);
        self.frames.truncate(1);
        self.views = self.views.into_iter().filter(|view| view.frame() == at).map(|view| view.of_frame(0)).collect();
        self.numbers = vec![number];
        let poses: Vec<_> = self.frames.iter().map(|frame| frame.pose.clone()).collect();
        self.avatar.known_poses = KnownPoses::new(&poses);
        Ok(self)
    }
}
