//! Comparison of versions of a person on views that they were not made from.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use flyrig_avatar::Avatar;
use flyrig_body::Template;
use flyrig_fit::{ErrorWeights, ImageDifference};
use flyrig_gpu::GpuContext;
use flyrig_renderer::{HarmonicOrder, Outputs, RasterSettings, Rasterizer, RenderTarget};
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

    /// Returns whether a camera shows the person in the key sets that were held back.
    pub fn is_compared_in(&self, camera: &CameraId) -> bool {
        shows(&self.held, camera)
    }

    /// Returns whether a camera shows the person in the key sets that a version may be made from.
    pub fn is_seen_in(&self, camera: &CameraId) -> bool {
        shows(&self.seen, camera)
    }
}

fn shows(sets: &[&KeySet], camera: &CameraId) -> bool {
    sets.iter().any(|set| set.views.iter().any(|view| view.crop.camera().id == *camera))
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
        let base = Arc::clone(&self.base);
        let rasterizer = Rasterizer::new(&self.gpu, base.surface.len())?;
        let with = (&self.rig, &self.settings);
        let subject = Subject::of_surface(&self.gpu, PersonId::default(), self.template.clone(), base, with)?;
        Ok(StandIn { subject, rasterizer, target: None })
    }

    /// Returns the surface of the person, painted from key sets without one of the cameras. Painting ends early when it is stopped.
    pub fn surface(
        &mut self,
        Compared { seen, .. }: &Compared<'_>,
        without: Option<&CameraId>,
    ) -> Result<Avatar, FusionError> {
        let mut stand_in = self.stand_in()?;
        for set in seen {
            if self.stopped.load(Ordering::Relaxed) {
                break;
            }
            let views = set.views.iter().filter(|view| Some(&view.crop.camera().id) != without);
            stand_in.paint(&self.gpu, set, &set.pose, views)?;
        }
        let colors: Vec<[f32; 3]> = stand_in.subject.splats(&self.gpu)?.iter().map(|splat| splat.color).collect();
        let surface = self.base.surface.inset();
        Ok(Avatar::new(&self.template, &surface, Some(&self.base.graph), &colors, HarmonicOrder::Zero)?)
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
        if self.stopped.load(Ordering::Relaxed) {
            return Ok(None);
        }
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

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use flyrig_fit::TrainingView;
    use flyrig_gpu::AdapterChoice;
    use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
    use glam::{DVec2, DVec3};

    use super::*;
    use crate::{
        learner::key_sets::Choice, person_surface, settings::body::BodySettings, settings::session::SessionSettings,
    };

    const SIZE: u32 = 96;

    /// Camera in front of the person (1) or behind it (-1), whose image has one colour.
    fn view(id: &str, side: f64, rgb: [u8; 3]) -> KeyView {
        let middle = DVec3::new(0.0, 0.85, 0.0);
        let intrinsics = Intrinsics {
            width: SIZE,
            height: SIZE,
            focal_px: DVec2::splat(1.2 * f64::from(SIZE)),
            center_px: DVec2::splat(0.5 * f64::from(SIZE) - 0.5),
            lens: Lens::PINHOLE,
        };
        let camera = Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: id.into(),
            intrinsics,
            camera_from_world: Isometry::look_at(middle + DVec3::Z * (3.4 * side), middle, DVec3::Y),
        };
        let rgba = [rgb[0], rgb[1], rgb[2], 255].repeat((SIZE * SIZE) as usize);
        KeyView { crop: TrainingView::cut(0, &camera, &rgba).unwrap(), pose: None }
    }

    /// A trial that began with the colours of the camera that it leaves out would be compared with what it knows.
    #[test]
    fn a_camera_that_is_left_out_paints_nothing() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let template = default_template(&ShapeParams::default()).unwrap();
        let settings = SessionSettings { body: BodySettings::with_gaussians(2000), ..SessionSettings::default() };
        let (surface, graph) = person_surface(&template, &settings.body).unwrap();
        let views = vec![view("front", 1.0, [250, 0, 0]), view("back", -1.0, [0, 250, 0])];
        let cameras = views.iter().map(|view| view.crop.camera().clone()).collect();
        let rig = Rig { cameras, world_up: DVec3::Y };
        let set = KeySet {
            choice: Choice { slot: 0, is_new: true },
            pose: template.skeleton.rest_pose(),
            translations: vec![DVec3::ZERO; graph.nodes.len()],
            views,
        };
        let base = Arc::new(GraphedSurface { surface, graph });
        let mut judge = Judge::new(&gpu, (template, base), (&rig, &settings), Arc::default());
        let sets = BTreeMap::from([(0, (1, set))]);
        let mut red = |without: Option<&CameraId>| {
            let colors = judge.surface(&Compared::of(&sets), without).unwrap().parameters.harmonics;
            colors.iter().filter(|color| color[0] > color[1] + 0.1).count()
        };
        assert!(red(None) > 200, "the front is red");
        assert_eq!(red(Some(&"front".into())), 0);
        assert!(red(Some(&"back".into())) > 200);
    }
}
