//! Geometry of one person: the deformation solved against the images, and the skinned Gaussians at each instant.
//!
//! The nodes of the deformation graph displace the canonical Gaussians, and `body::GpuSkinner` moves them to the world. Where nodes have
//! moved apart (skirts, coats), Gaussians are larger.

use std::{sync::Arc, time::Instant};

use flyrig_avatar::Avatar;
use flyrig_body::{DeformationGraph, GpuSkinner, Skeleton, SurfaceGaussians, Template, skin_mesh};
use flyrig_gpu::GpuContext;
use flyrig_renderer::{GaussianBuffers, Gaussians};
use flyrig_tracker::DeformReport;
use flyrig_types::{Camera, Pose, Rig};
use glam::{DVec3, Vec3};

use super::{
    figure::AvatarFigure,
    inputs::{InputView, Inputs},
    instants::Instants,
    stage_clock::{StageClock, TimedStage},
    surface::GraphedSurface,
};
use crate::{
    deformation::{
        DeformTimes, Deformation,
        scene::{TrackedPerson, TrackedView, ViewAgreement},
    },
    error::FusionError,
    health::{process::processor_time, stage_times::StageTimes},
    settings::session::SessionSettings,
};

/// Stage of the processor time that the deformation took, over all threads of the process.
pub const PROCESSOR_STAGE: &str = "  processor";
/// Linear RGB and opacity of a Gaussian before the first image.
pub(super) const UNPAINTED: [f32; 4] = [0.5, 0.5, 0.5, 1.0];

/// Gaussians of a person in the world, and the deformation that moves them beyond the pose.
#[derive(Debug)]
pub(super) struct Geometry {
    /// Skinner of the surface's own Gaussians.
    skinner: GpuSkinner,
    /// Gaussians of an avatar, in their place.
    figure: Option<Box<AvatarFigure>>,
    /// Gaussians at the frame set's time, with the colours that are shown.
    gaussians: GaussianBuffers,
    /// Gaussians at the second, third ... instant of a frame set.
    posed: Vec<GaussianBuffers>,
    deformation: Option<Deformation>,
    /// Whether the deformation is suspended.
    is_held: bool,
    /// Agreement of the deformation with the views that it was solved for last; see [`Self::agreement`].
    agreement: Vec<Option<ViewAgreement>>,
}

impl Geometry {
    /// Uploads the canonical Gaussians of `surface`, grey. `rendered` are those that are drawn: `surface`, or its inset where it is
    /// deformed.
    pub fn new(
        gpu: &GpuContext,
        template: &Template,
        (surface, rendered): (&SurfaceGaussians, &SurfaceGaussians),
        graph: &DeformationGraph,
        avatar: Option<&Arc<Avatar>>,
        (rig, settings): (&Rig, &SessionSettings),
    ) -> Result<Self, FusionError> {
        let count = surface.positions.len();
        let gaussians = GaussianBuffers::zeroed(gpu, count)?;
        let center_scale: Vec<[f32; 4]> =
            surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| p.extend(*s).to_array()).collect();
        gaussians.center_scale.write(gpu, &center_scale);
        let canonical: Vec<[f32; 4]> = surface.positions.iter().map(|p| p.extend(1.0).to_array()).collect();
        gaussians.canonical.write(gpu, &canonical);
        gaussians.color.write(gpu, &vec![UNPAINTED; count]);
        let skinner = GpuSkinner::new(gpu, rendered, &template.skeleton)?;
        let figure = avatar.map(|avatar| AvatarFigure::new(gpu, avatar, (surface, graph), &gaussians)).transpose()?;
        let figure = figure.map(Box::new);
        let mean = figure.as_ref().map(|figure| figure.mean());
        let deformation = (settings.tracking.options())
            .map(|options| Deformation::new(gpu, template, surface, (graph, mean), options, finest_pixel_m(rig)))
            .transpose()?;
        Ok(Self { skinner, figure, gaussians, posed: Vec::new(), deformation, is_held: false, agreement: Vec::new() })
    }

    /// Returns the Gaussians at the frame set's time.
    pub fn gaussians(&self) -> &GaussianBuffers {
        &self.gaussians
    }

    /// Returns the Gaussians at an instant of the last update.
    pub fn at(&self, instant: usize) -> &GaussianBuffers {
        if instant == 0 { &self.gaussians } else { &self.posed[instant - 1] }
    }

    /// Returns the avatar whose Gaussians follow the surface; `None` for those of the surface itself.
    pub fn avatar(&self) -> Option<&Arc<Avatar>> {
        self.figure.as_ref().map(|figure| figure.source())
    }

    /// Returns that avatar, hung on the session's graph.
    pub fn hung_avatar(&self) -> Option<&Avatar> {
        self.figure.as_ref().map(|figure| figure.hung())
    }

    /// Reads back linear RGB and opacity of each Gaussian as it is drawn.
    pub fn shown_colors(&self, gpu: &GpuContext) -> Result<Vec<[f32; 4]>, FusionError> {
        match &self.figure {
            Some(figure) => figure.shown_colors(gpu),
            None => Ok(self.gaussians.color.read(gpu)?),
        }
    }

    /// Makes the person of an avatar that hangs on this surface's graph. Another avatar before it changes into it over `sets` updates.
    pub fn set_avatar(
        &mut self,
        gpu: &GpuContext,
        avatar: &Arc<Avatar>,
        base: &GraphedSurface,
        sets: u32,
    ) -> Result<(), FusionError> {
        let GraphedSurface { surface, graph } = base;
        match &mut self.figure {
            Some(figure) => figure.change_to(gpu, avatar, (surface, graph), &self.gaussians, sets),
            none => {
                *none = Some(Box::new(AvatarFigure::new(gpu, avatar, (surface, graph), &self.gaussians)?));
            }
        }
        match (&mut self.deformation, &self.figure) {
            (Some(deformation), Some(figure)) => deformation.set_mean(figure.mean()),
            _ => Ok(()),
        }
    }

    /// Returns to the Gaussians of the surface. They keep the colours that were seen last.
    pub fn drop_avatar(&mut self, gpu: &GpuContext, base: &GraphedSurface) -> Result<(), FusionError> {
        if self.figure.take().is_none() {
            return Ok(());
        }
        let canonical: Vec<[f32; 4]> = base.surface.positions.iter().map(|p| p.extend(1.0).to_array()).collect();
        self.gaussians.canonical.write(gpu, &canonical);
        match &mut self.deformation {
            Some(deformation) => deformation.set_mean(&vec![DVec3::ZERO; base.graph.nodes.len()]),
            None => Ok(()),
        }
    }

    /// Returns the Gaussians that are drawn at an instant of the last update.
    pub fn drawn(&self, instant: usize) -> Gaussians<'_> {
        let avatar = self.figure.as_ref().and_then(|figure| figure.drawn(instant));
        avatar.map_or(self.at(instant).into(), Gaussians::Anisotropic)
    }

    /// Returns the Gaussians at the frame set's time with the colours that images paint: those of the surface, or corrections of an
    /// avatar's.
    pub fn painted(&self) -> &GaussianBuffers {
        self.figure.as_ref().map_or(&self.gaussians, |figure| figure.painted())
    }

    /// Shows what was painted.
    pub fn encode_colors(&self, gpu: &GpuContext, encoder: &mut wgpu::CommandEncoder) {
        if let Some(figure) = &self.figure {
            figure.recolor(gpu, encoder, 0, &self.gaussians);
        }
    }

    /// Creates the Gaussians of further instants, sharing colours and canonical positions with the first.
    pub fn reserve(&mut self, gpu: &GpuContext, instants: usize) -> Result<(), FusionError> {
        while self.posed.len() + 1 < instants {
            self.posed.push(self.gaussians.posed_again(gpu)?);
        }
        Ok(())
    }

    /// Returns the agreement of each view of the last update, in 0..=1. Empty when the body was not compared with the images, `None`
    /// for a view that was not compared.
    pub fn agreement(&self) -> &[Option<ViewAgreement>] {
        &self.agreement
    }

    /// Forgets the agreement: other cameras give images now.
    pub fn views_changed(&mut self) {
        self.agreement.clear();
    }

    /// Returns whether a view's image is used for painting: not where it disagrees with all others.
    pub fn is_trusted(&self, view: usize) -> bool {
        self.agreement.get(view).copied().flatten().is_none_or(|view| view.is_trusted)
    }

    /// Suspends the deformation, or lets it go on.
    pub fn hold(&mut self, hold: bool) {
        self.is_held = hold;
        if hold {
            self.agreement.clear();
        }
    }

    /// Returns whether the deformation is suspended.
    pub fn is_held(&self) -> bool {
        self.is_held
    }

    /// Solves the deformation against the views, unless it is held or there is none.
    pub fn deform(
        &mut self,
        gpu: &GpuContext,
        skeleton: &Skeleton,
        instants: &Instants<'_>,
        views: &[InputView<'_>],
        inputs: &Inputs,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        if views.is_empty() || self.is_held {
            return Ok(());
        }
        self.agreement.clear();
        let Some(deformation) = &mut self.deformation else { return Ok(()) };
        let (start, processor) = (Instant::now(), processor_time());
        let tracked: Vec<TrackedView<'_>> = (views.iter().zip(inputs.images()).enumerate())
            .map(|(i, (view, input))| TrackedView {
                camera: view.camera,
                size: input.size,
                rgba: &input.rgba,
                words: &input.words,
                with_unknown: view.others.is_some(),
                instant: instants.of_view(i),
            })
            .collect();
        let colors = self.figure.as_ref().map_or(&self.gaussians.color, |figure| figure.looks());
        let person = TrackedPerson { gpu, skeleton, poses: instants.poses(), colors };
        let times = deformation.track(person, &tracked)?;
        self.agreement.extend_from_slice(deformation.agreement());
        stages.add("deformation", start.elapsed());
        add_parts(stages, times);
        stages.add_processor_time(PROCESSOR_STAGE, processor_time().saturating_sub(processor));
        count_results(stages, deformation);
        Ok(())
    }

    /// Skins the Gaussians in the pose of each instant.
    pub fn skin(
        &mut self,
        gpu: &GpuContext,
        skeleton: &Skeleton,
        instants: &Instants<'_>,
        clock: &mut StageClock,
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        let start = Instant::now();
        for (i, pose) in instants.poses().iter().enumerate() {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if i == 0 {
                clock.begin(&mut encoder);
            }
            let gaussians = if i == 0 { &self.gaussians } else { &self.posed[i - 1] };
            let deformation = self.deformation.as_ref();
            if let Some(figure) = &mut self.figure {
                let translations = deformation.map(Deformation::translations);
                figure.pose(gpu, &mut encoder, i, (skeleton, pose), translations, gaussians)?;
            } else {
                let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
                let displacement = deformation.map(Deformation::displacement);
                self.skinner.encode(gpu, &mut encoder, skeleton, pose, displacement, centers, normals)?;
            }
            if i + 1 == instants.poses().len() {
                clock.mark(&mut encoder, TimedStage::Skinning);
            }
            gpu.queue.submit([encoder.finish()]);
        }
        clock.wait(gpu, TimedStage::Skinning, start, stages)
    }

    /// Returns the canonical translations of the graph's nodes, metres; empty without a deformation.
    pub fn node_translations(&self) -> &[DVec3] {
        self.deformation.as_ref().map_or(&[], Deformation::translations)
    }

    /// Returns the number of Gaussians that are compared with the images; 0 without a deformation.
    pub fn compared_gaussians(&self) -> usize {
        self.deformation.as_ref().map_or(0, Deformation::compared)
    }

    /// Returns the report of the last solve.
    pub fn report(&self) -> Option<&DeformReport> {
        self.deformation.as_ref().and_then(Deformation::report)
    }

    /// Poses the deformed template: world positions, metres, and normals of its vertices.
    pub fn surface(&self, template: &Template, pose: &Pose) -> (Vec<Vec3>, Vec<Vec3>) {
        let Some(deformation) = &self.deformation else { return skin_mesh(template, pose) };
        let mut moved = template.clone();
        for (position, by) in moved.positions.iter_mut().zip(deformation.vertex_displacement()) {
            *position += by;
        }
        skin_mesh(&moved, pose)
    }

    /// Returns to the undeformed body.
    pub fn reset(&mut self) {
        if let Some(deformation) = &mut self.deformation {
            deformation.reset();
        }
    }

    /// Gives the next solves the iterations of a start.
    pub fn restart(&mut self) {
        if let Some(deformation) = &mut self.deformation {
            deformation.restart();
        }
    }

    /// Resumes from canonical translations of the nodes, metres; from the mean shape without any.
    pub fn resume(&mut self, gpu: &GpuContext, translations: &[DVec3]) -> Result<(), FusionError> {
        let Some(deformation) = &mut self.deformation else { return Ok(()) };
        deformation.resume(gpu, translations)
    }
}

fn add_parts(stages: &mut StageTimes, times: DeformTimes) {
    let DeformTimes { prepare, draw, derivatives, solve } = times;
    stages.add("  prepare", prepare);
    stages.add("  draw and compare", draw);
    stages.add("  derivatives", derivatives);
    stages.add("  solve", solve);
}

fn count_results(stages: &mut StageTimes, deformation: &Deformation) {
    let at_rest = deformation.report().is_some_and(|report| report.at_rest);
    stages.count("frames at rest, not solved", u64::from(at_rest));
    let left_out = deformation.agreement().iter().filter(|view| view.is_none()).count();
    stages.count("views not compared", left_out as u64);
    let distrusted = deformation.agreement().iter().flatten().filter(|view| !view.is_trusted).count();
    stages.count("views not believed", distrusted as u64);
    stages.count("images halved", deformation.halved_images() as u64);
}

/// Returns the width on the person that one pixel of the finest camera covers, metres, at the point that all cameras look at.
fn finest_pixel_m(rig: &Rig) -> f64 {
    let center = rig.center_of_attention();
    let pixel = |camera: &Camera| camera.position().distance(center) / (0.5 * camera.intrinsics.focal_px.element_sum());
    rig.cameras.iter().map(pixel).fold(f64::INFINITY, f64::min)
}
