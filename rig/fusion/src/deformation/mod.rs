//! Deformation tracking on the GPU: draws the Gaussians with the colours of the last instant into every input view and
//! passes the image residuals to the solver (FlyHuman Eq. 3).

mod area;
mod choose;
mod images;
mod motion;
mod options;

use std::time::{Duration, Instant};

use flyrig_body::{DeformationGraph, GpuSkinner, Part, Skeleton, SurfaceGaussians, Template, coarsen};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{BackwardRasterizer, ColorMeans, GaussianBuffers, GaussianGradients, ImageLoss};
use flyrig_tracker::{DeformReport, DeformTracker};
use flyrig_types::{Camera, Pose};
use glam::{DVec3, Vec3};

use self::area::Landmarks;
use self::choose::Chooser;
use self::images::{Images, Kernels, ViewBuffers};
use self::motion::MeshMotion;
pub use self::options::{DeformOptions, PAPER_COLOR_WEIGHT};
use crate::FusionError;

/// Share of the last instant's colours in those that are compared. Painting follows the surface wherever it slides; colours
/// that remember where cloth was hold it there.
const COLOR_RATE: f32 = 0.03;

/// The tracked deformation and the buffers it is solved with.
#[derive(Debug)]
pub struct Deformation {
    max_level: u32,
    color_weight: f32,
    most_views: usize,
    chooser: Chooser,
    tracker: DeformTracker,
    backward: BackwardRasterizer,
    loss: ImageLoss,
    /// Of the coarse Gaussians that are compared, and of all of them.
    coarse_displacement: StorageBuffer<[f32; 4]>,
    displacement: StorageBuffer<[f32; 4]>,
    skinner: GpuSkinner,
    colors: ColorMeans,
    /// The coarse Gaussians, one an instant.
    posed: Vec<GaussianBuffers>,
    spacing_m: f64,
    mesh: MeshMotion,
    /// One an instant.
    gradients: Vec<GaussianGradients>,
    views: Vec<ViewBuffers>,
    landmarks: Landmarks,
    report: Option<DeformReport>,
    /// Of the views of the last frame that were compared: how much of the person is where the image shows it, and whether
    /// it counted.
    judged: Vec<Option<(f64, bool)>>,
    /// Views of the last frame whose images were halved.
    halved: usize,
    /// Whether the Gaussians have colours yet.
    painted: bool,
    /// Whether the coarse ones had colours in the last frame.
    colored: bool,
}

/// One image that the person is compared with.
#[derive(Debug, Clone, Copy)]
pub struct TrackedView<'a> {
    pub camera: &'a Camera,
    /// Pixels, width and height.
    pub size: [u32; 2],
    /// sRGB bytes with mask coverage, row by row.
    pub rgba: &'a [u8],
    /// The same on the GPU, a pixel an element.
    pub words: &'a StorageBuffer<u32>,
    /// Whether pixels may be marked as unknown ([`flyrig_renderer::LossSettings::with_unknown`]).
    pub with_unknown: bool,
    /// Which of the [`Instants`] the image was taken at.
    pub instant: usize,
}

/// The person at the instants of one set.
pub struct Instants<'a> {
    pub gpu: &'a GpuContext,
    pub skeleton: &'a Skeleton,
    /// Poses of the instants that images were taken at.
    pub poses: &'a [&'a Pose],
    /// All Gaussians, as they were painted last.
    pub gaussians: &'a GaussianBuffers,
}

/// Run times of one frame's solve.
#[derive(Debug, Clone, Copy, Default)]
pub struct DeformTimes {
    /// Uploading and preparing the images.
    pub prepare: Duration,
    /// Skinning, drawing and comparing.
    pub draw: Duration,
    /// Backward rasteriser and reading its sums back.
    pub derivatives: Duration,
    /// The rest: gathering at the nodes and solving for the step.
    pub solve: Duration,
}

impl Deformation {
    /// At rest, for these Gaussians, before cameras whose finest pixel covers `pixel_m` of the person.
    pub fn new(
        gpu: &GpuContext,
        template: &Template,
        surface: &SurfaceGaussians,
        graph: &DeformationGraph,
        options: DeformOptions,
        pixel_m: f64,
    ) -> Result<Self, FusionError> {
        let coarse = coarsen(template, surface, graph, options.compared(template.area_m2(), pixel_m))?;
        let count = coarse.gaussians.len();
        let landmarks = Landmarks::new(surface, graph);
        let mut tracker = DeformTracker::new(&coarse.graph, &coarse.gaussians.skin, options.solver)?;
        let of_node = |&g: &u32| {
            let normal = surface.normals.get(g as usize)?.as_dvec3();
            Some((normal, *surface.parts.get(g as usize)?))
        };
        let (normals, parts): (Vec<DVec3>, Vec<Part>) = graph.node_gaussian.iter().filter_map(of_node).unzip();
        let stiffness: Vec<f64> = parts.iter().map(|&part| options.stiffness(part)).collect();
        tracker = tracker.with_stiffness(&stiffness)?;
        tracker = tracker.with_thickness(normals, parts.iter().map(|&part| part as usize).collect())?;
        Ok(Self {
            max_level: options.max_level,
            color_weight: options.color_weight,
            most_views: options.views,
            chooser: Chooser::default(),
            tracker,
            backward: BackwardRasterizer::new(gpu)?,
            loss: ImageLoss::new(gpu)?,
            coarse_displacement: StorageBuffer::zeroed(gpu, "displacements", count)?,
            displacement: StorageBuffer::zeroed(gpu, "displacements", surface.len())?,
            skinner: GpuSkinner::new(gpu, &coarse.gaussians.inset(), &template.skeleton)?,
            colors: ColorMeans::new(gpu, &coarse.first_child, &coarse.children)?,
            posed: vec![GaussianBuffers::zeroed(gpu, count)?],
            spacing_m: coarse.spacing_m,
            mesh: MeshMotion::new(template, surface, graph),
            gradients: Vec::new(),
            views: Vec::new(),
            landmarks,
            report: None,
            judged: Vec::new(),
            halved: 0,
            painted: false,
            colored: false,
        })
    }

    /// Solves one instant. Afterwards [`Self::displacement`] holds its result.
    pub fn track(&mut self, scene: Instants<'_>, all_views: &[TrackedView<'_>]) -> Result<DeformTimes, FusionError> {
        let start = Instant::now();
        let gpu = scene.gpu;
        let cameras: Vec<&Camera> = all_views.iter().map(|view| view.camera).collect();
        let center = scene.poses.first().map_or(DVec3::ZERO, |pose| self.landmarks.center(scene.skeleton, pose));
        let chosen = self.chooser.choose(&cameras, center, self.most_views);
        let views: &[TrackedView<'_>] = &chosen.iter().map(|&i| all_views[i]).collect::<Vec<_>>();
        let count = self.posed[0].count();
        let plans = self.landmarks.plans(scene.skeleton, scene.poses, views, self.spacing_m, self.max_level);
        self.halved = plans.iter().filter(|plan| plan.level > 0).count();
        for (i, (view, plan)) in views.iter().zip(&plans).enumerate() {
            let fits = self.views.get(i).is_some_and(|v| v.fits(view.size, plan.level));
            if !fits {
                let buffers = ViewBuffers::new(gpu, count, view.size, plan.level)?;
                if i < self.views.len() {
                    self.views[i] = buffers;
                } else {
                    self.views.push(buffers);
                }
            }
        }
        while self.posed.len() < scene.poses.len() {
            self.posed.push(self.posed[0].posed_again(gpu)?);
        }
        while self.gradients.len() < scene.poses.len() {
            self.gradients.push(GaussianGradients::zeroed(gpu, count)?);
        }
        self.loss.reserve(gpu, views.len())?;
        if self.views.is_empty() {
            return Ok(Default::default());
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let rate = if self.colored { COLOR_RATE } else { 1.0 };
        self.colored = self.painted;
        self.colors.encode(gpu, &mut encoder, &scene.gaussians.color, &self.posed[0].color, rate);
        gpu.queue.submit([encoder.finish()]);
        let mut pictures = Images::new(
            scene,
            views,
            &plans,
            &mut self.views,
            Kernels {
                skinner: &self.skinner,
                posed: &self.posed,
                loss: &self.loss,
                backward: &mut self.backward,
                displacement: &self.coarse_displacement,
                gradients: &self.gradients,
            },
            if self.painted { self.color_weight } else { 0.0 },
        );
        let prepare = start.elapsed();
        pictures.distrust(self.tracker.displacement())?;
        let report = self.tracker.track(&mut pictures)?;
        let judged = pictures.judged(self.tracker.displacement());
        let (draw, derivatives) = pictures.times();
        self.judged.clear();
        self.judged.resize(all_views.len(), None);
        for (&i, judged) in chosen.iter().zip(judged) {
            self.judged[i] = Some(judged);
            if !judged.1 {
                self.chooser.doubt(&all_views[i].camera.id);
            }
        }
        self.displacement.write(gpu, self.mesh.follow(self.tracker.translations()));
        self.painted |= !views.is_empty();
        let solve = start.elapsed().saturating_sub(prepare + draw + derivatives);
        tracing::debug!(?report, "deformation");
        self.report = Some(report);
        Ok(DeformTimes { prepare, draw, derivatives, solve })
    }

    /// Back to rest, for a person who was not there before.
    pub fn reset(&mut self) {
        self.tracker.reset();
        self.painted = false;
    }

    /// Canonical translations of the graph's nodes, metres.
    pub fn translations(&self) -> &[DVec3] {
        self.tracker.translations()
    }

    /// Resumes from the translations of an earlier deformation of the same body; the Gaussians have colours already.
    pub fn resume(&mut self, gpu: &GpuContext, translations: &[DVec3]) -> Result<(), FusionError> {
        self.tracker.resume(translations)?;
        self.displacement.write(gpu, self.mesh.follow(self.tracker.translations()));
        (self.painted, self.colored) = (true, false);
        Ok(())
    }

    /// The next frames get the iterations of a start.
    pub fn restart(&mut self) {
        self.tracker.restart();
    }

    /// By view of the last frame: how much of the person is where the image shows it (1: all; 0: as much is wrong as there
    /// is), and whether the view counted: one that disagrees with all others does not. None for one that was not compared.
    pub fn judged(&self) -> &[Option<(f64, bool)>] {
        &self.judged
    }

    /// How many Gaussians are compared with the images.
    pub fn compared(&self) -> usize {
        self.posed[0].count()
    }

    /// Views of the last frame whose images were compared at a half of their size or less.
    pub fn halved_images(&self) -> usize {
        self.halved
    }

    /// What the last solve did.
    pub fn report(&self) -> Option<&DeformReport> {
        self.report.as_ref()
    }

    /// Canonical displacement of every Gaussian.
    pub fn displacement(&self) -> &StorageBuffer<[f32; 4]> {
        &self.displacement
    }

    /// Canonical displacement of every vertex of the template, metres.
    pub fn vertex_displacement(&self) -> Vec<Vec3> {
        self.mesh.of_vertices()
    }
}
#[cfg(test)]
mod stability_tests;
