//! One person: template, Gaussians on the GPU, deformation, colours and tracking quality.
//!
//! [`Subject::update`] reconstructs the person in one frame set:
//!
//! 1. [`Inputs`] converts and uploads the images with the person's masks.
//! 2. [`Instants`] collects the poses at which the images were taken.
//! 3. [`Geometry`] solves the deformation against the images and skins the Gaussians at every instant.
//! 4. [`GaussianPainter`] renders canonical positions and the last colours into every view, and updates the colours from the pixels at the
//!    surface; in the learned modes networks then correct them.
//!
//! Nothing waits between skinning and painting where the adapter has timestamps: [`StageClock`] collects their times with the next
//! wait. [`PersonMemory`] outlives the subject, and a [`PersonFrame`] is what viewers get of it.

use std::sync::Arc;

use flyrig_avatar::Avatar;
use flyrig_body::{DEFAULT_SIGMA2_M2, DeformationGraph, Outfit, SurfaceGaussians, Template, build_graph};
use flyrig_gpu::GpuContext;
use flyrig_renderer::{GaussianBuffers, Gaussians, Observations, Rasterizer, Splat, read_splats};
use flyrig_stfa::BodyGraph;
use flyrig_stream::{EncodedTemplate, Motion, Stamp};
use flyrig_tracker::DeformReport;
use flyrig_types::{PersonId, Pose, Rig};
use glam::{DVec3, Vec3};

use super::{
    avatar_stream::encode_tracked_avatar,
    geometry::Geometry,
    inputs::{InputImage, InputView, Inputs},
    instants::Instants,
    memory::PersonMemory,
    painter::{GaussianPainter, PaintInputs, PaintTools},
    pose_curve::PoseCurve,
    schedule::Schedule,
    stage_clock::StageClock,
    stream_frame::{PersonFrame, encode_template, motion},
    surface::{GraphedSurface, person_surface},
    track_watch::TrackWatch,
    upright::Upright,
};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    settings::{effort::Effort, session::SessionSettings},
};

/// Number of updates after which the up direction is checked against the person.
const UPRIGHT_SETS: u32 = 10;

/// Inputs and results of a person's last update, read back: the raw material of training samples.
#[derive(Debug)]
pub struct Observed {
    /// Observations of direct appearance, one element per observing view.
    pub observations: Observations,
    /// Slots of the observing views' cameras.
    pub slots: Vec<usize>,
    /// Images of the observing views: width, height, and sRGB pixels with the mask as alpha.
    pub pictures: Vec<(u32, u32, Vec<u8>)>,
    /// World centre of each Gaussian, metres; w: scale.
    pub center_scale: Vec<[f32; 4]>,
    /// World normal of each Gaussian; w: depth below the rendered surface, metres.
    pub normal: Vec<[f32; 4]>,
}

/// Shape of a person, with and without clothes.
#[derive(Debug)]
pub(super) struct PersonShape {
    /// Template that is posed and drawn: dressed.
    pub template: Template,
    /// Body below the clothes, and the clothes; `None` without any.
    undressed: Option<(Template, Outfit)>,
    /// Template of the person stream, for viewers that draw the person themselves; `None` until it is encoded.
    pub stream: Option<Arc<EncodedTemplate>>,
}

/// Pose and tracking quality over the frame sets.
#[derive(Debug, Default)]
pub(crate) struct PersonTrack {
    /// Last poses, for the times between and shortly after them.
    pub curve: PoseCurve,
    pub watch: TrackWatch,
    pub upright: Upright,
    pub last_pose: Option<Pose>,
    /// Confidence in the last pose, 0..=1.
    pub confidence: f64,
    /// Slots of the views that the last update used.
    pub viewed: Vec<usize>,
}

/// Returns whether this body is an avatar's; it may have more joints: fingers.
fn is_of(avatar: &Avatar, template: &Template) -> bool {
    let names = |template: &Template| -> Vec<String> {
        template.skeleton.joints().iter().map(|joint| joint.name.clone()).collect()
    };
    avatar.template.positions == template.positions && names(template).starts_with(&names(&avatar.template))
}

/// One person as Gaussians on the GPU, with shape, deformation, colour memory and tracking quality.
#[derive(Debug)]
pub struct Subject {
    pub(super) id: PersonId,
    /// Number of the shape, see [`crate::KnownPerson`].
    pub(crate) shape_number: u32,
    pub(super) shape: PersonShape,
    /// Surface of the body with its graph, where the person is learnt.
    pub(super) base: Option<Arc<GraphedSurface>>,
    /// Deformation graph as the networks see it.
    body_graph: BodyGraph,
    pub(super) inputs: Inputs,
    pub(super) geometry: Geometry,
    pub(super) painter: GaussianPainter,
    pub(super) schedule: Schedule,
    pub(super) clock: StageClock,
    /// Shape and colours that the person starts with, where they are known before the first image.
    pub(super) start: Option<Arc<PersonMemory>>,
    pub(crate) track: PersonTrack,
}

impl Subject {
    /// Samples the template's surface and prepares the GPU for the input cameras of `rig`. Takes a few seconds.
    pub(crate) fn new(
        gpu: &GpuContext,
        id: PersonId,
        (body, outfit): (Template, Outfit),
        avatar: Option<&Arc<Avatar>>,
        (rig, settings): (&Rig, &SessionSettings),
    ) -> Result<Self, FusionError> {
        let template = outfit.on(&body)?;
        let avatar = avatar.filter(|avatar| is_of(avatar, &template));
        let base = match avatar {
            Some(avatar) => {
                let surface = avatar.attached_surface()?;
                let nodes = avatar.hanging.as_ref().map_or(settings.body.nodes, |hanging| hanging.nodes.len());
                let graph = build_graph(&template, &surface, nodes, DEFAULT_SIGMA2_M2)?;
                GraphedSurface { surface, graph }
            }
            None => {
                let (surface, graph) = person_surface(&template, &settings.body)?;
                GraphedSurface { surface, graph }
            }
        };
        let undressed = (!outfit.is_bare()).then_some((body, outfit));
        let drawn = base.drawn(settings.tracking.options().is_some());
        let mut subject = Self::drawn_as(gpu, id, (template, undressed), (&base, &drawn, avatar), (rig, settings))?;
        if subject.geometry.hung_avatar().is_some() {
            subject.prepare_stream()?;
        } else {
            subject.encode_stream(&drawn, &base.graph)?;
        }
        if settings.body.learn {
            drop(drawn);
            subject.base = Some(Arc::new(base));
        }
        Ok(subject)
    }

    /// Creates a person of this template and its surface, without a template of the person stream.
    pub(crate) fn of_surface(
        gpu: &GpuContext,
        id: PersonId,
        template: Template,
        base: Arc<GraphedSurface>,
        (rig, settings): (&Rig, &SessionSettings),
    ) -> Result<Self, FusionError> {
        let drawn = base.drawn(settings.tracking.options().is_some());
        let subject = Self::drawn_as(gpu, id, (template, None), (&base, &drawn, None), (rig, settings))?;
        drop(drawn);
        Ok(Self { base: Some(base), ..subject })
    }

    /// Creates a person with this surface, which is that of the template, drawn as `drawn`.
    fn drawn_as(
        gpu: &GpuContext,
        id: PersonId,
        (template, undressed): (Template, Option<(Template, Outfit)>),
        (GraphedSurface { surface, graph }, drawn, avatar): (&GraphedSurface, &SurfaceGaussians, Option<&Arc<Avatar>>),
        (rig, settings): (&Rig, &SessionSettings),
    ) -> Result<Self, FusionError> {
        let body_graph = BodyGraph::new(surface, graph)?;
        Ok(Self {
            id,
            shape_number: 0,
            geometry: Geometry::new(gpu, &template, (surface, drawn), graph, avatar, (rig, settings))?,
            painter: GaussianPainter::new(
                gpu,
                surface,
                graph,
                &body_graph,
                (rig.cameras.len(), avatar.is_some()),
                settings,
            )?,
            shape: PersonShape { template, undressed, stream: None },
            base: None,
            body_graph,
            inputs: Inputs::default(),
            schedule: Schedule::default(),
            clock: StageClock::new(gpu),
            start: None,
            track: PersonTrack::default(),
        })
    }

    /// Reconstructs the person in one frame set: deformation, Gaussians, then colours from the views. A view whose mask is empty adds
    /// nothing.
    pub(crate) fn update(
        &mut self,
        gpu: &GpuContext,
        rasterizer: &mut Rasterizer,
        pose: &Pose,
        views: &[InputView<'_>],
        effort: Effort,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let work = self.schedule.next(effort);
        stages.time("convert images", || self.inputs.upload(gpu, views))?;
        // One update at a time is under way, and none while the processor's time is measured.
        gpu.wait()?;
        self.clock.collect(stages);

        let skeleton = &self.shape.template.skeleton;
        let instants = Instants::new(pose, views);
        self.geometry.reserve(gpu, instants.poses().len())?;
        if work.solves {
            self.geometry.deform(gpu, skeleton, &instants, views, &self.inputs, stages)?;
        }
        self.geometry.skin(gpu, skeleton, &instants, &mut self.clock, stages)?;
        if !work.paints {
            self.painter.skip();
            stages.count("sets not painted", 1);
            return Ok(());
        }
        let (geometry, instants, images) = (&self.geometry, &instants, &self.inputs);
        let inputs = PaintInputs { gpu, geometry, instants, views, images };
        self.painter.paint(inputs, &mut PaintTools { rasterizer, clock: &mut self.clock, stages })
    }

    /// Adds the adapter's times of updates that were waited for.
    pub(crate) fn collect_times(&mut self, stages: &mut StageTimes) {
        self.clock.collect(stages);
    }

    /// Returns the person's id.
    #[must_use]
    pub fn id(&self) -> PersonId {
        self.id
    }

    /// Returns the template that is posed: dressed.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.shape.template
    }

    /// Returns the surface with its graph; `None` where the person is not learnt.
    pub(crate) fn base(&self) -> Option<&Arc<GraphedSurface>> {
        self.base.as_ref()
    }

    /// Returns the body without its clothes.
    #[must_use]
    pub fn body(&self) -> &Template {
        self.shape.undressed.as_ref().map_or(&self.shape.template, |(body, _)| body)
    }

    /// Returns the body of a person in a skirt or coat; `None` without one.
    #[must_use]
    pub fn undressed(&self) -> Option<&Template> {
        let (body, _) = self.shape.undressed.as_ref().filter(|(_, outfit)| outfit.skirt.is_some())?;
        Some(body)
    }

    /// Returns the person's clothes.
    pub(crate) fn outfit(&self) -> Outfit {
        self.shape.undressed.as_ref().map_or_else(Outfit::default, |(_, outfit)| *outfit)
    }

    /// Returns the tracking quality.
    #[must_use]
    pub fn watch(&self) -> &TrackWatch {
        &self.track.watch
    }

    /// Notes how the person stands, and warns once where that contradicts the world's up direction.
    pub(crate) fn check_up(&mut self, pose: &Pose, world_up: DVec3) {
        if self.track.upright.count() >= UPRIGHT_SETS {
            return;
        }
        if let Some(direction) = self.template().skeleton.standing(pose) {
            self.track.upright.add(direction);
        }
        if self.track.upright.count() == UPRIGHT_SETS
            && let Some(fault) = self.track.upright.fault(world_up)
        {
            tracing::warn!(person = %self.id, "{fault}");
        }
    }

    /// Returns the person's mean direction from the feet to the head.
    #[must_use]
    pub fn upright(&self) -> &Upright {
        &self.track.upright
    }

    /// Returns the pose of the last update.
    #[must_use]
    pub fn pose(&self) -> Option<&Pose> {
        self.track.last_pose.as_ref()
    }

    /// Returns the confidence in the last observed pose, 0..=1.
    #[must_use]
    pub fn confidence(&self) -> f64 {
        self.track.confidence
    }

    /// Returns the canonical translations of the deformation graph's nodes, metres; empty without a deformation.
    #[must_use]
    pub fn node_translations(&self) -> &[DVec3] {
        self.geometry.node_translations()
    }

    /// Returns the Gaussians that are drawn.
    pub(crate) fn drawn(&self) -> Gaussians<'_> {
        self.geometry.drawn(0)
    }

    /// Returns one Gaussian of the surface for each that is drawn.
    pub(crate) fn gaussians(&self) -> &GaussianBuffers {
        self.geometry.gaussians()
    }

    /// Keeps what each view observes from the next update on, for [`Self::observed`].
    pub(crate) fn keep_observations(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        self.painter.keep_observations(gpu)
    }

    /// Returns the deformation graph as the networks see it.
    #[must_use]
    pub fn body_graph(&self) -> &BodyGraph {
        &self.body_graph
    }

    /// Returns an input view of the last update, sRGB with the person's mask as alpha, in the order of [`crate::Session::viewed`].
    #[must_use]
    pub fn input(&self, view: usize) -> &[u8] {
        self.inputs.images().get(view).map_or(&[], |input| &input.rgba)
    }

    /// Reads back what the last update observed. Needs [`Self::keep_observations`].
    pub(crate) fn observed(&self, gpu: &GpuContext) -> Result<Observed, FusionError> {
        let picture = |&i: &usize| {
            let InputImage { size: [width, height], rgba, .. } = &self.inputs.images()[i];
            (*width, *height, rgba.clone())
        };
        let (painted, gaussians) = (self.painter.painted(), self.geometry.gaussians());
        Ok(Observed {
            observations: self.painter.observations(gpu)?,
            slots: painted.iter().filter_map(|&i| self.track.viewed.get(i).copied()).collect(),
            pictures: painted.iter().map(picture).collect(),
            center_scale: gaussians.center_scale.read(gpu)?,
            normal: gaussians.normal.read(gpu)?,
        })
    }

    /// Returns whether the person was met within the last updates and gets all the work at whatever level of effort.
    pub(crate) fn is_new(&self) -> bool {
        self.schedule.is_new()
    }

    /// Prepares for an update with images of other cameras than the last.
    pub(crate) fn views_changed(&mut self) {
        self.geometry.views_changed();
    }

    /// Suspends the deformation, or lets it go on.
    pub(crate) fn hold_shape(&mut self, hold: bool) {
        self.geometry.hold(hold);
    }

    /// Gives the next frame sets the iterations of a start.
    pub(crate) fn restart(&mut self) {
        self.geometry.restart();
    }

    /// Returns the fraction of the person that each view of the last update confirms, 0..=1. Empty when the body was not compared
    /// with the images, `None` for a view that was not compared.
    pub(crate) fn agreement(&self) -> Vec<Option<f64>> {
        self.geometry.agreement().iter().map(|view| view.map(|view| view.fraction)).collect()
    }

    /// Returns the number of Gaussians that are compared with the images; 0 where the body is only skinned.
    pub fn compared_gaussians(&self) -> usize {
        self.geometry.compared_gaussians()
    }

    /// Returns the report of the deformation's last solve.
    pub fn deform_report(&self) -> Option<&DeformReport> {
        self.geometry.report()
    }

    /// Reads back the colours for the person stream; `None` before the first pose, and without a template.
    pub(crate) fn person_frame(
        &self,
        gpu: &GpuContext,
        frame: u64,
        capture_nanos: i64,
    ) -> Result<Option<PersonFrame>, FusionError> {
        let Some(pose) = self.pose() else { return Ok(None) };
        let stamp = Stamp { person: self.id.0, frame, capture_nanos, ..Stamp::default() };
        let motion = Motion { stamp, ..motion(pose, self.node_translations()) };
        let Some(template) = self.shape.stream.clone() else { return Ok(None) };
        if template.template.has_colors() {
            return Ok(Some(PersonFrame::of_pose(template, &motion)));
        }
        Ok(Some(PersonFrame { template, motion, colors: self.geometry.shown_colors(gpu)? }))
    }

    /// Encodes the template of the person stream, unless it is known. Takes some tenths of a second.
    pub(crate) fn prepare_stream(&mut self) -> Result<(), FusionError> {
        if self.shape.stream.is_some() {
            return Ok(());
        }
        match (self.geometry.hung_avatar(), &self.base) {
            (Some(avatar), _) => {
                let encoded = encode_tracked_avatar(avatar, &self.shape.template.skeleton, self.is_deformed())?;
                self.shape.stream = Some(Arc::new(encoded));
                Ok(())
            }
            (None, Some(base)) => {
                let base = Arc::clone(base);
                self.encode_stream(&base.drawn(self.is_deformed()), &base.graph)
            }
            (None, None) => Ok(()),
        }
    }

    /// Encodes the template of the person stream from the Gaussians as they are drawn.
    fn encode_stream(&mut self, drawn: &SurfaceGaussians, graph: &DeformationGraph) -> Result<(), FusionError> {
        let graph = self.is_deformed().then_some(graph);
        self.shape.stream = Some(Arc::new(encode_template(drawn, graph, &self.shape.template.skeleton)?));
        Ok(())
    }

    fn is_deformed(&self) -> bool {
        self.geometry.compared_gaussians() > 0
    }

    /// Reads back the Gaussians at the last update's time.
    pub(crate) fn splats(&self, gpu: &GpuContext) -> Result<Vec<Splat>, FusionError> {
        Ok(read_splats(gpu, self.geometry.gaussians())?)
    }

    /// Returns the tracked surface: world positions, metres, and normals of the template's vertices.
    pub fn surface(&self, pose: &Pose) -> (Vec<Vec3>, Vec<Vec3>) {
        self.geometry.surface(&self.shape.template, pose)
    }
}
