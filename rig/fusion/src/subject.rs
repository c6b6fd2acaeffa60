//! One person: the template, its Gaussians on the GPU, deformation, colours, and how well the person is tracked.

use std::{sync::Arc, time::Instant};

use flyrig_body::{
    BodyError, DEFAULT_SIGMA2_M2, DeformationGraph, GpuSkinner, Outfit, SurfaceGaussians, Template, build_graph,
    sample_surface, skin_mesh,
};
use flyrig_capture::to_rgb8;
use flyrig_gpu::{GpuContext, StageTimer, StorageBuffer};
use flyrig_renderer::{
    AppearanceSettings, ColorMatcher, DirectAppearance, GaussianBuffers, Observations, Outputs, RasterSettings,
    Rasterizer, RenderTarget, Splat, UNKNOWN_RGBA, ViewInput, read_splats,
};
use flyrig_stfa::{BodyGraph, LearnedAppearance, Parameters, ViewImage};
use flyrig_stream::EncodedTemplate;
use flyrig_tracker::{DeformReport, EdgeColor};
use flyrig_types::{Camera, Image, Mask, PersonId, Pose, Rig};

use crate::{
    BodySettings, Effort, FusionError, PersonMemory, SessionSettings, StageTimes, TrackWatch,
    deformation::{DeformTimes, Deformation, Instants, TrackedView},
    memory::NetworkMemory,
    person_stream::encode_template,
    pose_curve::PoseCurve,
    stage_times::processor_time,
};

/// Seed of the surface sampling: the same template gives the same Gaussians on every run.
const SURFACE_SEED: u64 = 1;
/// Stage of the processor time that the deformation took, over all threads of the process.
pub const PROCESSOR_STAGE: &str = "  processor";
/// Stages of an update that the adapter times.
const TIMED_STAGES: [&str; 3] = ["skinning", "visibility", "appearance"];
/// Updates of a person who was just met that get all the work.
const FULL_UPDATES: u32 = 10;
/// Coverage by other people from which a pixel says nothing about this person.
const OTHERS_COVER: u8 = 128;

/// One image of a set with one person's mask.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputView<'a> {
    pub camera: &'a Camera,
    pub image: &'a Image,
    pub mask: &'a Mask,
    /// Colours of the mask's outline without the background's share.
    pub edge_colors: &'a [EdgeColor],
    /// Coverage by other people.
    pub others: Option<&'a Mask>,
    /// Pose at the image's own time, where that is not the set's.
    pub pose: Option<&'a Pose>,
}

/// An image as the kernels read it.
#[derive(Debug)]
struct InputImage {
    size: [u32; 2],
    /// sRGB with the person's coverage, row by row.
    rgba: Vec<u8>,
    /// The same on the GPU, a pixel an element.
    words: StorageBuffer<u32>,
    /// Of the camera that took it; `None` where its colours stay as they are.
    matcher: Option<ColorMatcher>,
}

/// The inputs and results of a person's last update, read back: the raw material of training samples.
#[derive(Debug)]
pub struct Observed {
    /// Of direct appearance, by observing view.
    pub observations: Observations,
    /// Slots of the observing views' cameras.
    pub slots: Vec<usize>,
    /// The observing views: width, height, and pixels with the mask as alpha.
    pub pictures: Vec<(u32, u32, Vec<u8>)>,
    /// World centre, metres; w: scale.
    pub center_scale: Vec<[f32; 4]>,
    /// World normal; w: depth below the drawn surface, metres.
    pub normal: Vec<[f32; 4]>,
}

/// One person as Gaussians on the GPU, with everything that belongs to the person: shape, pose track, deformation, colour
/// memory and tracking quality.
#[derive(Debug)]
pub struct Subject {
    id: PersonId,
    /// Number of the shape, see [`crate::KnownPerson`].
    pub(crate) shape: u32,
    /// As it is drawn: with its clothes.
    template: Template,
    /// The body below the clothes, and these; `None` without any.
    undressed: Option<(Template, Outfit)>,
    /// The same for those who draw the person themselves.
    stream_template: Arc<EncodedTemplate>,
    skinner: GpuSkinner,
    gaussians: GaussianBuffers,
    /// The Gaussians as they stood at the second, third ... instant of a set.
    posed: Vec<GaussianBuffers>,
    appearance: DirectAppearance,
    settings: AppearanceSettings,
    body: BodyGraph,
    networks: Option<Box<LearnedAppearance>>,
    /// Of [`TIMED_STAGES`].
    timer: StageTimer,
    /// Views that painted in the last update.
    painted: Vec<usize>,
    /// A target an input view; grows with the rig, remade when an image's size changes.
    visibility: Vec<RenderTarget>,
    inputs: Vec<InputImage>,
    deformation: Option<Deformation>,
    /// Whether the deformation is suspended.
    pub(crate) shape_held: bool,
    /// Colours of direct appearance, while the Gaussians show those of the networks.
    direct_colors: Option<StorageBuffer<[f32; 4]>>,
    /// Agreement of the deformation with the views that it was solved for last.
    judged: Vec<Option<(f64, bool)>>,
    /// Updates since the person was met.
    updates: u32,
    /// Shape and colours that the person starts with, where they are known before the first image.
    start: Option<Arc<PersonMemory>>,
    /// Times of the last poses that were used, for what lies between and beyond them.
    pub(crate) curve: PoseCurve,
    pub(crate) watch: TrackWatch,
    pub(crate) last_pose: Option<Pose>,
    /// Confidence in the last pose, 0..=1.
    pub(crate) confidence: f64,
    /// Slots of the views that the last update took in.
    pub(crate) viewed: Vec<usize>,
}

/// Samples a template's Gaussians as a [`Subject`] does, on the surface.
///
/// # Errors
/// [`BodyError`] for a template that is not valid.
pub fn person_gaussians(template: &Template, body: &BodySettings) -> Result<SurfaceGaussians, BodyError> {
    sample_surface(template, body.gaussians, SURFACE_SEED)
}

/// Samples a template's Gaussians as a [`Subject`] does, and the graph that deforms them. Where it is deformed, they are drawn
/// [inset](SurfaceGaussians::inset).
///
/// # Errors
/// [`BodyError`] for a template that is not valid.
pub fn person_surface(
    template: &Template,
    body: &BodySettings,
) -> Result<(SurfaceGaussians, DeformationGraph), BodyError> {
    let surface = person_gaussians(template, body)?;
    let graph = build_graph(template, &surface, body.nodes, DEFAULT_SIGMA2_M2)?;
    Ok((surface, graph))
}

impl Subject {
    /// Samples the template's surface and prepares the GPU for the input cameras of `rig`. Takes a few seconds.
    pub(crate) fn new(
        gpu: &GpuContext,
        id: PersonId,
        (shape, outfit): (Template, Outfit),
        rig: &Rig,
        settings: &SessionSettings,
    ) -> Result<Self, FusionError> {
        let body = &settings.body;
        let template = outfit.on(&shape)?;
        let (surface, graph) = person_surface(&template, body)?;
        let mut subject = Self::from_parts(gpu, id, template, &surface, &graph, rig, settings)?;
        subject.undressed = (!outfit.is_bare()).then_some((shape, outfit));
        if let Some(networks) = settings.appearance.load_networks()? {
            subject.use_networks(gpu, &networks)?;
        }
        Ok(subject)
    }

    fn from_parts(
        gpu: &GpuContext,
        id: PersonId,
        template: Template,
        surface: &SurfaceGaussians,
        graph: &DeformationGraph,
        rig: &Rig,
        settings: &SessionSettings,
    ) -> Result<Self, FusionError> {
        let count = surface.positions.len();
        let gaussians = GaussianBuffers::zeroed(gpu, count)?;
        let center_scale: Vec<[f32; 4]> =
            surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| p.extend(*s).to_array()).collect();
        gaussians.center_scale.write(gpu, &center_scale);
        let canonical: Vec<[f32; 4]> = surface.positions.iter().map(|p| p.extend(1.0).to_array()).collect();
        gaussians.canonical.write(gpu, &canonical);
        gaussians.color.write(gpu, &vec![[0.5, 0.5, 0.5, 1.0]; count]);
        let deform = settings.tracking.options();
        let inset = deform.as_ref().map(|_| surface.inset());
        let drawn = inset.as_ref().unwrap_or(surface);
        let stream_template = encode_template(drawn, deform.as_ref().map(|_| graph), &template.skeleton)?;
        Ok(Self {
            id,
            shape: 0,
            stream_template: Arc::new(stream_template),
            skinner: GpuSkinner::new(gpu, drawn, &template.skeleton)?,
            shape_held: false,
            direct_colors: None,
            deformation: deform
                .map(|options| Deformation::new(gpu, &template, surface, graph, options, finest_pixel_m(rig)))
                .transpose()?,
            appearance: DirectAppearance::new(gpu, surface, graph, rig.cameras.len())?,
            body: BodyGraph::new(surface, graph)?,
            networks: None,
            timer: StageTimer::new(gpu, TIMED_STAGES.len() as u32),
            painted: Vec::new(),
            template,
            undressed: None,
            gaussians,
            settings: settings.appearance.mode.settings(),
            posed: Vec::new(),
            judged: Vec::new(),
            updates: 0,
            start: None,
            visibility: Vec::new(),
            inputs: Vec::new(),
            curve: PoseCurve::default(),
            watch: TrackWatch::default(),
            last_pose: None,
            confidence: 0.0,
            viewed: Vec::new(),
        })
    }

    /// Which person this is.
    #[must_use]
    pub fn id(&self) -> PersonId {
        self.id
    }

    /// The template that is posed.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// The body's shape without its clothes.
    #[must_use]
    pub fn body(&self) -> &Template {
        self.undressed.as_ref().map_or(&self.template, |(shape, _)| shape)
    }

    /// The body's shape without clothes, and these.
    pub(crate) fn shape_and_outfit(&self) -> (Template, Outfit) {
        match &self.undressed {
            Some((shape, outfit)) => (shape.clone(), *outfit),
            None => (self.template.clone(), Outfit::default()),
        }
    }

    /// How well the person is tracked.
    #[must_use]
    pub fn watch(&self) -> &TrackWatch {
        &self.watch
    }

    /// Pose of the last update.
    #[must_use]
    pub fn pose(&self) -> Option<&Pose> {
        self.last_pose.as_ref()
    }

    /// Confidence in the last observed pose, 0..=1.
    #[must_use]
    pub fn confidence(&self) -> f64 {
        self.confidence
    }

    /// The template for the person stream.
    pub(crate) fn stream_template(&self) -> Arc<EncodedTemplate> {
        Arc::clone(&self.stream_template)
    }

    /// Canonical translations of the deformation graph's nodes, metres; empty without a deformation.
    #[must_use]
    pub fn node_translations(&self) -> &[glam::DVec3] {
        self.deformation.as_ref().map_or(&[], Deformation::translations)
    }

    /// The Gaussians as they are drawn.
    pub(crate) fn gaussians(&self) -> &GaussianBuffers {
        &self.gaussians
    }

    fn use_networks(&mut self, gpu: &GpuContext, parameters: &Parameters) -> Result<(), FusionError> {
        self.appearance.keep_observations(gpu)?;
        self.networks = Some(Box::new(LearnedAppearance::new(parameters, self.body.clone())));
        let direct = StorageBuffer::zeroed(gpu, "direct colours", self.gaussians.count())?;
        self.gaussians.color.copy_to(gpu, &direct);
        self.direct_colors = Some(direct);
        Ok(())
    }

    /// Keeps what each view saw from the next update on, for [`Self::observed`].
    pub(crate) fn keep_observations(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        Ok(self.appearance.keep_observations(gpu)?)
    }

    /// The deformation graph as the networks see it.
    #[must_use]
    pub fn body_graph(&self) -> &BodyGraph {
        &self.body
    }

    /// sRGB of an input view of the last update with the person's mask as alpha, in the order of
    /// [`crate::Session::viewed`].
    #[must_use]
    pub fn input(&self, view: usize) -> &[u8] {
        self.inputs.get(view).map_or(&[], |input| &input.rgba)
    }

    pub(crate) fn observed(&self, gpu: &GpuContext) -> Result<Observed, FusionError> {
        let picture = |&i: &usize| {
            let InputImage { size: [width, height], rgba, .. } = &self.inputs[i];
            (*width, *height, rgba.clone())
        };
        Ok(Observed {
            observations: self.appearance.observations(gpu, self.painted.len())?,
            slots: self.painted.iter().filter_map(|&i| self.viewed.get(i).copied()).collect(),
            pictures: self.painted.iter().map(picture).collect(),
            center_scale: self.gaussians.center_scale.read(gpu)?,
            normal: self.gaussians.normal.read(gpu)?,
        })
    }

    /// Whether the person was just met, and gets all the work at whatever level of effort.
    pub(crate) fn is_new(&self) -> bool {
        (1..=FULL_UPDATES).contains(&self.updates)
    }

    /// Other cameras give images now than in the last update.
    pub(crate) fn views_changed(&mut self) {
        self.judged.clear();
    }

    /// Takes in one instant: pose, then colours from the views. A view whose mask is empty adds nothing.
    pub(crate) fn update(
        &mut self,
        gpu: &GpuContext,
        rasterizer: &mut Rasterizer,
        pose: &Pose,
        views: &[InputView<'_>],
        effort: Effort,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        // Somebody who was just met needs all the work: whatever comes later builds on it.
        let turn = self.updates.saturating_sub(FULL_UPDATES);
        self.updates = self.updates.saturating_add(1);
        let solves = turn.is_multiple_of(effort.solve_every);
        // Half a cycle later, so that neighbouring sets cost about the same.
        let paints = turn == 0 || (turn + effort.paint_every / 2).is_multiple_of(effort.paint_every);
        stages.time("convert images", || self.take_images(gpu, views))?;
        // One update at a time is under way, and none while the processor's time is measured.
        gpu.wait()?;
        self.collect_times(stages);

        // The instant itself, and each other one that an image was taken at.
        let mut instants = vec![pose];
        let instant_of: Vec<usize> = views
            .iter()
            .map(|view| {
                let Some(own) = view.pose else { return 0 };
                instants.iter().position(|known| *known == own).unwrap_or_else(|| {
                    instants.push(own);
                    instants.len() - 1
                })
            })
            .collect();
        while self.posed.len() + 1 < instants.len() {
            self.posed.push(self.gaussians.posed_again(gpu)?);
        }
        let poses = instants;
        let instants: Vec<(&Pose, &GaussianBuffers)> =
            poses.iter().copied().zip(std::iter::once(&self.gaussians).chain(&self.posed)).collect();

        let solves = solves && !views.is_empty() && !self.shape_held;
        if solves || self.shape_held {
            self.judged.clear();
        }
        if let Some(deformation) = self.deformation.as_mut().filter(|_| solves) {
            let (start, processor) = (Instant::now(), processor_time());
            let tracked: Vec<TrackedView<'_>> = views
                .iter()
                .zip(&self.inputs)
                .zip(&instant_of)
                .map(|((view, input), &instant)| TrackedView {
                    camera: view.camera,
                    size: input.size,
                    rgba: &input.rgba,
                    words: &input.words,
                    with_unknown: view.others.is_some(),
                    instant,
                })
                .collect();
            let scene = Instants { gpu, skeleton: &self.template.skeleton, poses: &poses, gaussians: &self.gaussians };
            let DeformTimes { prepare, draw, derivatives, solve } = deformation.track(scene, &tracked)?;
            self.judged.extend_from_slice(deformation.judged());
            stages.add("deformation", start.elapsed());
            stages.add("  prepare", prepare);
            stages.add("  draw and compare", draw);
            stages.add("  derivatives", derivatives);
            stages.add("  solve", solve);
            stages.add_processor_time(PROCESSOR_STAGE, processor_time().saturating_sub(processor));
            let at_rest = deformation.report().is_some_and(|report| report.at_rest);
            stages.count("frames at rest, not solved", u64::from(at_rest));
            let left_out = deformation.judged().iter().filter(|judged| judged.is_none()).count();
            stages.count("views not compared", left_out as u64);
            let distrusted = deformation.judged().iter().flatten().filter(|(_, trusted)| !trusted).count();
            stages.count("views not believed", distrusted as u64);
            stages.count("images halved", deformation.halved_images() as u64);
        }

        let start = Instant::now();
        let displacement = self.deformation.as_ref().map(Deformation::displacement);
        for (i, (pose, gaussians)) in instants.iter().enumerate() {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if i == 0 {
                self.timer.begin(&mut encoder);
            }
            let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
            let skeleton = &self.template.skeleton;
            self.skinner.encode(gpu, &mut encoder, skeleton, pose, displacement, centers, normals)?;
            if i + 1 == instants.len() {
                self.timer.mark(&mut encoder, TIMED_STAGES[0]);
            }
            gpu.queue.submit([encoder.finish()]);
        }
        // Waits that only a clock on this side needs.
        let has_timer = self.timer.is_supported();
        if !has_timer {
            gpu.wait()?;
            stages.add(TIMED_STAGES[0], start.elapsed());
        }

        self.painted.clear();
        if !paints {
            stages.count("sets not painted", 1);
            return Ok(());
        }
        if let Some(direct) = &self.direct_colors {
            // Direct appearance goes on from its own colours.
            direct.copy_to(gpu, &self.gaussians.color);
        }
        let start = Instant::now();
        for (i, view) in views.iter().enumerate() {
            let (width, height) = (view.image.width(), view.image.height());
            let fits = self.visibility.get(i).is_some_and(|t| (t.width, t.height) == (width, height));
            if !fits {
                let target = RenderTarget::new(gpu, width, height)?;
                if i < self.visibility.len() {
                    self.visibility[i] = target;
                } else {
                    self.visibility.push(target);
                }
            }
            let settings = RasterSettings {
                outputs: Outputs { color: true, depth: false, canonical: true },
                ..RasterSettings::default()
            };
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            rasterizer.encode(
                gpu,
                &mut encoder,
                instants[instant_of[i]].1,
                view.camera,
                &settings,
                &self.visibility[i],
            )?;
            if i + 1 == views.len() {
                self.timer.mark(&mut encoder, TIMED_STAGES[1]);
            }
            gpu.queue.submit([encoder.finish()]);
        }
        if !has_timer {
            gpu.wait()?;
            stages.add(TIMED_STAGES[1], start.elapsed());
        }

        let start = Instant::now();
        // A view that is not believed paints nothing.
        let believed = |i: usize| self.judged.get(i).copied().flatten().is_none_or(|(_, trusted)| trusted);
        self.painted = (0..views.len()).filter(|&i| believed(i)).collect();
        let inputs: Vec<ViewInput<'_>> = self
            .painted
            .iter()
            .map(|&i| ViewInput {
                camera: views[i].camera,
                picture: &self.inputs[i].words,
                canonical: &self.visibility[i].canonical,
                rendered: &self.visibility[i].color,
                gaussians: (instant_of[i] > 0).then(|| instants[instant_of[i]].1),
            })
            .collect();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        if views.is_empty() {
            self.timer.mark(&mut encoder, TIMED_STAGES[1]);
        }
        self.appearance.update(gpu, &mut encoder, &self.gaussians, &inputs, &self.settings)?;
        self.timer.mark(&mut encoder, TIMED_STAGES[2]);
        self.timer.finish(&mut encoder);
        gpu.queue.submit([encoder.finish()]);
        if !has_timer || self.networks.is_some() {
            gpu.wait()?;
        }
        if !has_timer {
            stages.add(TIMED_STAGES[2], start.elapsed());
        }
        self.paint_learned(gpu, stages)
    }

    /// Adds the adapter's times of updates that were waited for.
    pub(crate) fn collect_times(&mut self, stages: &mut StageTimes) {
        for stage in self.timer.collect() {
            stages.add_of_adapter(stage.name, stage.time);
        }
    }

    /// Lets the networks add to what direct appearance painted.
    fn paint_learned(&mut self, gpu: &GpuContext, stages: &mut StageTimes) -> Result<(), FusionError> {
        let Some(learned) = &mut self.networks else { return Ok(()) };
        let start = Instant::now();
        if let Some(direct) = &self.direct_colors {
            self.gaussians.color.copy_to(gpu, direct);
        }
        let picture = |&i: &usize| {
            let InputImage { size: [width, height], rgba, .. } = &self.inputs[i];
            ViewImage { width: *width, height: *height, rgba }
        };
        let pictures: Vec<_> = self.painted.iter().map(picture).collect();
        let observed = self.appearance.observations(gpu, self.painted.len())?;
        let before = learned.counts;
        let colors = learned.paint(&observed, &pictures, &self.settings)?;
        self.gaussians.color.write(gpu, &colors);
        stages.add("networks", start.elapsed());
        let counts = learned.counts;
        stages.count("corrections that were no numbers", counts.poisoned - before.poisoned);
        Ok(())
    }

    /// Forgets clothes and colours: another person may come. Returns to those known before the first image, where there are any.
    pub(crate) fn forget(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        self.updates = 0;
        if let Some(deformation) = &mut self.deformation {
            deformation.reset();
        }
        self.appearance.reset();
        if let Some(learned) = &mut self.networks {
            learned.reset();
        }
        match self.start.clone() {
            Some(start) => self.show(gpu, &start),
            None => Ok(()),
        }
    }

    /// Reads back what was learnt about the person.
    pub(crate) fn memory(&self, gpu: &GpuContext) -> Result<PersonMemory, FusionError> {
        let translations = self.deformation.as_ref().map_or_else(Vec::new, |known| known.translations().to_vec());
        let colors = self.direct_colors.as_ref().unwrap_or(&self.gaussians.color);
        let networks = match &self.networks {
            Some(learned) if !learned.memory().weights().is_empty() => {
                Some(NetworkMemory { digest: learned.digest(), memory: learned.memory().clone() })
            }
            _ => None,
        };
        let (memory, colors) = (self.appearance.memory(gpu)?, colors.read(gpu)?);
        let bare = (&self.template, Outfit::default());
        let (shape, outfit) = self.undressed.as_ref().map_or(bare, |(shape, outfit)| (shape, *outfit));
        Ok(PersonMemory::new((shape, outfit), translations, memory, colors, networks))
    }

    /// Resumes from what an earlier session has learnt about the same person.
    pub(crate) fn restore(&mut self, gpu: &GpuContext, memory: &PersonMemory) -> Result<(), FusionError> {
        let count = self.gaussians.count();
        if memory.colors.len() != count {
            return Err(FusionError::SavedPerson {
                name: self.id.to_string(),
                problem: format!(
                    "it has {} Gaussians, the session {count}; set body.gaussians to {0}, or delete it",
                    memory.colors.len()
                ),
            });
        }
        self.show(gpu, memory)?;
        if memory.is_start {
            self.start_from(Arc::new(memory.clone()));
        }
        if let (Some(learned), Some(of)) = (&mut self.networks, &memory.networks)
            && learned.digest() == of.digest
        {
            learned.restore(of.memory.clone());
        }
        self.watch.resume();
        Ok(())
    }

    /// Keeps what is known before the first image.
    fn start_from(&mut self, start: Arc<PersonMemory>) {
        if let Some(avatar) = &start.stream {
            if avatar.template.joints().len() == self.template.skeleton.joints().len() {
                self.stream_template = Arc::clone(avatar);
            } else {
                tracing::warn!("person {} has other joints than the avatar: viewers get surface and colours", self.id);
            }
        }
        self.start = Some(start);
    }

    /// Takes deformation and colours from a memory of as many Gaussians.
    fn show(&mut self, gpu: &GpuContext, memory: &PersonMemory) -> Result<(), FusionError> {
        if let Some(deformation) = &mut self.deformation {
            // A memory without deformation is of a body at rest.
            let rest = vec![glam::DVec3::ZERO; deformation.translations().len()];
            let known = if memory.translations.is_empty() { &rest } else { &memory.translations };
            deformation.resume(gpu, known)?;
        }
        self.appearance.resume(gpu, &memory.memory)?;
        self.gaussians.color.write(gpu, &memory.colors);
        if let Some(direct) = &self.direct_colors {
            direct.write(gpu, &memory.colors);
        }
        Ok(())
    }

    /// Takes over what belongs to no device: poses, tracking quality, and the memory of networks. For the same person on another device.
    pub(crate) fn take_over(&mut self, old: &Self) {
        let resumed = self.watch.is_resumed();
        self.curve.clone_from(&old.curve);
        self.last_pose.clone_from(&old.last_pose);
        self.viewed.clone_from(&old.viewed);
        if let Some(start) = &old.start {
            self.start_from(Arc::clone(start));
        }
        (self.confidence, self.shape_held, self.shape) = (old.confidence, old.shape_held, old.shape);
        if resumed {
            self.watch.clone_from(&old.watch);
            if let (Some(networks), Some(old)) = (&mut self.networks, &old.networks) {
                networks.restore(old.memory().clone());
            }
        }
    }

    /// The next frames get the iterations of a start.
    pub(crate) fn restart(&mut self) {
        if let Some(deformation) = &mut self.deformation {
            deformation.restart();
        }
    }

    /// By view of the last update: how much of the person is where the image shows it, 0 to 1. Empty when the body was not
    /// compared with the images, None for a view that was not.
    pub(crate) fn agreement(&self) -> Vec<Option<f64>> {
        self.judged.iter().map(|judged| judged.map(|(quality, _)| quality)).collect()
    }

    /// How many Gaussians are compared with the images; 0 where the body is only skinned.
    pub fn compared_gaussians(&self) -> usize {
        self.deformation.as_ref().map_or(0, Deformation::compared)
    }

    /// Report of the deformation's last solve.
    pub fn deform_report(&self) -> Option<&DeformReport> {
        self.deformation.as_ref().and_then(Deformation::report)
    }

    /// The Gaussians of this instant.
    pub(crate) fn splats(&self, gpu: &GpuContext) -> Result<Vec<Splat>, FusionError> {
        Ok(read_splats(gpu, &self.gaussians)?)
    }

    /// The tracked surface: world positions and normals of the template's vertices.
    pub fn surface(&self, pose: &Pose) -> (Vec<glam::Vec3>, Vec<glam::Vec3>) {
        let Some(deformation) = &self.deformation else { return skin_mesh(&self.template, pose) };
        let mut moved = self.template.clone();
        for (position, by) in moved.positions.iter_mut().zip(deformation.vertex_displacement()) {
            *position += by;
        }
        skin_mesh(&moved, pose)
    }

    /// Converts the images to RGB with the mask as alpha and without the background along its outline, and uploads each once.
    fn take_images(&mut self, gpu: &GpuContext, views: &[InputView<'_>]) -> Result<(), FusionError> {
        for (i, view) in views.iter().enumerate() {
            let (image, mask) = (view.image, view.mask);
            let size = [image.width(), image.height()];
            for mask in std::iter::once(mask).chain(view.others) {
                if [mask.width(), mask.height()] != size {
                    return Err(FusionError::MaskSize {
                        camera: view.camera.id.clone(),
                        mask: (mask.width(), mask.height()),
                        image: (image.width(), image.height()),
                    });
                }
            }
            if self.inputs.get(i).is_none_or(|input| input.size != size) {
                let words = StorageBuffer::zeroed(
                    gpu,
                    &format!("the image of camera {}", view.camera.id),
                    size[0] as usize * size[1] as usize,
                )?;
                let input = InputImage { size, rgba: Vec::new(), words, matcher: None };
                if i < self.inputs.len() {
                    self.inputs[i] = input;
                } else {
                    self.inputs.push(input);
                }
            }
            let converted;
            let rgb = if image.format() == flyrig_types::PixelFormat::Rgb8 {
                image.bytes()
            } else {
                converted = to_rgb8(image)?;
                &converted
            };
            let InputImage { rgba, words, matcher, .. } = &mut self.inputs[i];
            rgba.clear();
            rgba.extend(rgb.chunks_exact(3).zip(mask.coverage()).flat_map(|(c, &a)| [c[0], c[1], c[2], a]));
            for EdgeColor { pixel, rgb } in view.edge_colors {
                if let Some(pixel) = rgba.get_mut(4 * *pixel as usize..).and_then(<[u8]>::first_chunk_mut::<3>) {
                    *pixel = *rgb;
                }
            }
            if matcher.as_ref().is_none_or(|matcher| !matcher.is_of(view.camera)) {
                *matcher = ColorMatcher::new(view.camera);
            }
            if let Some(matcher) = matcher {
                matcher.correct(rgba, 4, size[0] as usize, |pixel| pixel[3] == 0);
            }
            if let Some(others) = view.others {
                for (pixel, others) in rgba.chunks_exact_mut(4).zip(others.coverage()) {
                    if *others >= OTHERS_COVER {
                        pixel.copy_from_slice(&UNKNOWN_RGBA);
                    }
                }
            }
            words.write_bytes(gpu, rgba);
        }
        Ok(())
    }
}

/// Width on the person of a pixel of the finest camera, at the point that all cameras look at, metres.
fn finest_pixel_m(rig: &Rig) -> f64 {
    let center = rig.center_of_attention();
    let pixel = |camera: &Camera| camera.position().distance(center) / (0.5 * camera.intrinsics.focal_px.element_sum());
    rig.cameras.iter().map(pixel).fold(f64::INFINITY, f64::min)
}
