//! Comparison of versions of a person on views that they were not made from.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use flyrig_avatar::Avatar;
use flyrig_body::{Outfit, Template};
use flyrig_fit::{ErrorWeights, ImageDifference};
use flyrig_gpu::GpuContext;
use flyrig_renderer::{Outputs, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::{CameraId, Image, Mask, PersonId, PixelFormat, Pose, Rig};

use super::key_sets::{KeySet, KeyView, is_held_back};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    settings::session::SessionSettings,
    subject::{inputs::InputView, person::Subject, surface::GraphedSurface},
};

/// Most key sets whose colours a version remembers.
const REMEMBERED: usize = 8;
/// Most held-back key sets of a comparison: the newest.
const COMPARED: usize = 4;

/// Key sets of a comparison, by age.
#[derive(Debug)]
pub(super) struct Compared<'a> {
    /// Those that the version may be made from.
    pub seen: Vec<&'a KeySet>,
    /// Newest of those that were held back.
    held: Vec<&'a KeySet>,
}

impl<'a> Compared<'a> {
    /// Sorts key sets by their number, the first of each pair.
    pub fn of(sets: &'a BTreeMap<usize, (u64, KeySet)>) -> Self {
        let mut newest: Vec<&(u64, KeySet)> = sets.values().collect();
        newest.sort_by_key(|(came, _)| *came);
        let (mut held, seen): (Vec<&KeySet>, Vec<&KeySet>) =
            newest.into_iter().map(|(_, set)| set).partition(|set| is_held_back(set.choice.slot));
        held.drain(..held.len().saturating_sub(COMPARED));
        Self { seen, held }
    }
}

/// Comparison of versions.
#[derive(Debug)]
pub(super) struct Judge {
    gpu: GpuContext,
    template: Template,
    base: Arc<GraphedSurface>,
    rig: Rig,
    settings: SessionSettings,
    /// Held during a comparison: it takes as much memory as the person of a session.
    stand_in: Option<StandIn>,
    /// Set when comparisons are to end early.
    stopped: Arc<AtomicBool>,
}

/// Person that is made of one version after the other.
#[derive(Debug)]
struct StandIn {
    subject: Subject,
    rasterizer: Rasterizer,
    target: Option<RenderTarget>,
}

impl Judge {
    /// Compares versions of a person with this surface.
    pub fn new(
        gpu: &GpuContext,
        (template, base): (Template, Arc<GraphedSurface>),
        (rig, settings): (&Rig, &SessionSettings),
        stopped: Arc<AtomicBool>,
    ) -> Self {
        let (rig, settings) = (rig.clone(), settings.clone());
        Self { gpu: gpu.clone(), template, base, rig, settings, stand_in: None, stopped }
    }

    /// Frees the memory of comparisons until the next one.
    pub fn rest(&mut self) {
        self.stand_in = None;
    }

    fn stand_in(&self) -> Result<StandIn, FusionError> {
        let (worn, base) = ((self.template.clone(), Outfit::default()), Arc::clone(&self.base));
        let rasterizer = Rasterizer::new(&self.gpu, base.surface.len())?;
        let with = (&self.rig, &self.settings);
        let subject = Subject::of_surface(&self.gpu, PersonId::default(), worn, (base, None), with)?;
        Ok(StandIn { subject, rasterizer, target: None })
    }

    /// Returns the mean error of a version in one camera's views that were held back, weighted as [`ErrorWeights`] say. The last of those
    /// seen are painted before, and each that was held back from the other cameras alone. Without an avatar, the version is the surface.
    /// `None` where the camera has no view, and for a comparison that was stopped.
    pub fn error(
        &mut self,
        avatar: Option<&Arc<Avatar>>,
        Compared { seen, held }: &Compared<'_>,
        camera: &CameraId,
    ) -> Result<Option<f64>, FusionError> {
        let mut stand_in = match self.stand_in.take() {
            Some(known) => known,
            None => self.stand_in()?,
        };
        let StandIn { subject, .. } = &mut stand_in;
        match avatar {
            Some(avatar) => subject.become_avatar(&self.gpu, avatar, 1)?,
            None => subject.return_to_surface(&self.gpu)?,
        }
        subject.forget_colors(&self.gpu);
        let is_other = |view: &&KeyView| view.crop.camera().id != *camera;
        for set in &seen[seen.len().saturating_sub(REMEMBERED)..] {
            if self.stopped.load(Ordering::Relaxed) {
                return Ok(None);
            }
            stand_in.paint(&self.gpu, set, &set.pose, set.views.iter())?;
        }
        let memory = stand_in.subject.memory(&self.gpu)?;
        let (mut sum, mut count) = (0.0, 0);
        for set in held {
            let Some(view) = set.views.iter().find(|view| !is_other(view)) else { continue };
            stand_in.subject.show_colors(&self.gpu, &memory)?;
            let pose = view.pose.as_ref().unwrap_or(&set.pose);
            stand_in.paint(&self.gpu, set, pose, set.views.iter().filter(is_other))?;
            sum += stand_in.difference(&self.gpu, view)?;
            count += 1;
        }
        self.stand_in = Some(stand_in);
        Ok((count > 0).then(|| sum / f64::from(count)))
    }
}

impl StandIn {
    /// Poses the person as in a key set, and paints it from views of it.
    fn paint<'a>(
        &mut self,
        gpu: &GpuContext,
        set: &KeySet,
        pose: &Pose,
        views: impl Iterator<Item = &'a KeyView>,
    ) -> Result<(), FusionError> {
        let images = views.map(|view| Ok((view, picture(view)?))).collect::<Result<Vec<_>, FusionError>>()?;
        let views: Vec<InputView<'_>> = images
            .iter()
            .map(|(view, (image, mask))| InputView {
                camera: view.crop.camera(),
                image,
                mask,
                edge_colors: &[],
                others: None,
                pose: view.pose.as_ref(),
            })
            .collect();
        // Times of comparisons are not those of the session's stages.
        let mut stages = StageTimes::default();
        self.subject.paint_tracked(gpu, &mut self.rasterizer, (pose, &set.translations), &views, &mut stages)
    }

    /// Renders the person as a view shows it and returns the error.
    fn difference(&mut self, gpu: &GpuContext, view: &KeyView) -> Result<f64, FusionError> {
        let (camera, [width, height]) = (view.crop.camera(), view.crop.size());
        if self.target.as_ref().is_none_or(|target| (target.width, target.height) != (width, height)) {
            self.target = Some(RenderTarget::new(gpu, width, height)?);
        }
        let Some(target) = &self.target else { return Ok(0.0) };
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(gpu, &mut encoder, self.subject.drawn(), camera, &settings, target)?;
        gpu.queue.submit([encoder.finish()]);
        let pixels = target.color.read(gpu)?;
        let weights = ErrorWeights::default();
        Ok(ImageDifference::of(&pixels, view.crop.photograph(), width as usize, &weights).loss)
    }
}

/// Returns image and mask of a crop.
fn picture(view: &KeyView) -> Result<(Image, Mask), FusionError> {
    let ([width, height], rgba) = (view.crop.size(), view.crop.rgba());
    let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let mask = rgba.iter().skip(3).step_by(4).copied().collect();
    Ok((Image::new(width, height, PixelFormat::Rgb8, rgb)?, Mask::new(width, height, mask)?))
}
