//! Deformation tracking on the GPU (FlyHuman, Eq. 3), unless `tracking.solver` is "off".
//!
//! 30,000 of the Gaussians, moved inside of the surface that they draw ([`SurfaceGaussians::inset`]), are drawn into every input view in
//! the pose of that image's own time, with the sharpened colours of earlier instants, and compared with halved images ([`images`]).
//! `tracker::DeformTracker` turns the image residuals into steps of the deformation graph's nodes; it knows no GPU and sees the images
//! only through its data term. The nodes then move all Gaussians and the template's vertices ([`motion`]).
//!
//! Where no camera looks, clothes are as thick as on the seen part of the same limb; head, hands and feet are stiffer than clothes.
//!
//! Resolution ([`area`]) and number of Gaussians ([`options`]) are bounded by what is informative, and of many views those from the most
//! different directions are compared ([`view_choice`]). `stability_tests.rs` runs the chain beside a plain f64 copy of itself: a change to
//! the loss, the solver or the choice of images changes that copy too.

mod area;
mod images;
mod motion;
pub(crate) mod options;
pub(crate) mod scene;
mod view_choice;

use std::time::Instant;

use flyrig_body::{
    DeformationGraph, GpuSkinner, Part, SkinWeights, SurfaceGaussians, Template, coarsen, hangs_from_hips,
};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{BackwardRasterizer, ColorMeans, GaussianBuffers, GaussianGradients, ImageLoss};
use flyrig_tracker::{DeformReport, DeformTracker, OutlineTerm, OutlineView};
use flyrig_types::Camera;
use glam::{DVec3, Vec3};

use crate::error::FusionError;

pub use options::{DeformOptions, PAPER_COLOR_WEIGHT};
pub(crate) use scene::DeformTimes;

use area::{Landmarks, ViewPlan};
use images::{DeformKernels, Images, ViewBuffers};
use motion::MeshMotion;
use scene::{TrackedPerson, TrackedView, ViewAgreement};
use view_choice::ViewChooser;

/// Share of the last painting's colours in those that are compared. Painting follows the surface wherever it slides; colours that
/// remember where cloth was hold it there.
const COLOR_RATE: f32 = 0.03;

/// Tracked deformation of one person, and the buffers that it is solved with.
#[derive(Debug)]
pub struct Deformation {
    max_level: u32,
    color_weight: f32,
    most_views: usize,
    outline_steps: usize,
    /// Coarse Gaussians on the surface, canonical metres, and their skin weights.
    points: (Vec<Vec3>, Vec<SkinWeights>),
    /// Whether each of them may follow an outline.
    is_loose: Vec<bool>,
    chooser: ViewChooser,
    tracker: DeformTracker,
    backward: BackwardRasterizer,
    loss: ImageLoss,
    /// Canonical displacement of the coarse Gaussians, which are compared.
    coarse_displacement: StorageBuffer<[f32; 4]>,
    /// Canonical displacement of all Gaussians.
    displacement: StorageBuffer<[f32; 4]>,
    skinner: GpuSkinner,
    colors: ColorMeans,
    /// Coarse Gaussians, one element per instant.
    posed: Vec<GaussianBuffers>,
    spacing_m: f64,
    mesh: MeshMotion,
    /// Derivatives with respect to the coarse Gaussians, one element per instant.
    gradients: Vec<GaussianGradients>,
    views: Vec<ViewBuffers>,
    landmarks: Landmarks,
    report: Option<DeformReport>,
    /// Agreement of each view of the last frame set; `None` for one that was not compared.
    agreement: Vec<Option<ViewAgreement>>,
    /// Views of the last frame set whose images were halved.
    halved: usize,
    /// Whether the Gaussians have been painted.
    has_colors: bool,
    /// Whether the coarse Gaussians had colours in the last frame set.
    had_colors: bool,
}

impl Deformation {
    /// Creates the undeformed state of these Gaussians. The finest pixel of the cameras covers `pixel_m` metres of the person.
    pub fn new(
        gpu: &GpuContext,
        template: &Template,
        surface: &SurfaceGaussians,
        (graph, mean): (&DeformationGraph, Option<&[DVec3]>),
        options: DeformOptions,
        pixel_m: f64,
    ) -> Result<Self, FusionError> {
        let coarse = coarsen(template, surface, graph, options.compared(template.area_m2(), pixel_m))?;
        let count = coarse.gaussians.len();
        let landmarks = Landmarks::new(surface, graph);
        let mut tracker = DeformTracker::new(&coarse.graph, &coarse.gaussians.skin, options.solver)?;
        let hangs = hangs_from_hips(&template.skeleton);
        let of_node = |&g: &u32| {
            let g = g as usize;
            let is_loose = hangs(*surface.positions.get(g)?, surface.skin.get(g)?);
            Some((surface.normals.get(g)?.as_dvec3(), (*surface.parts.get(g)?, is_loose)))
        };
        let (normals, parts): (Vec<DVec3>, Vec<(Part, bool)>) = graph.node_gaussian.iter().filter_map(of_node).unzip();
        let stiffness: Vec<f64> = parts.iter().map(|&(part, _)| options.stiffness(part)).collect();
        tracker = tracker.with_stiffness(&stiffness)?;
        let clothes: Vec<(usize, bool)> = parts.iter().map(|&(part, is_loose)| (part as usize, is_loose)).collect();
        tracker = tracker.with_thickness(normals, &clothes)?;
        if let Some(mean) = mean {
            tracker = tracker.with_mean(mean)?;
        }
        // Elsewhere images are finer than outlines, and hats and ponytails, which the body lacks, pull head and shoulders outwards.
        let hung = coarse.gaussians.positions.iter().zip(&coarse.gaussians.skin);
        let is_loose: Vec<bool> = hung.map(|(point, skin)| hangs(*point, skin)).collect();
        let outline_steps = if is_loose.contains(&true) { options.outline_steps } else { 0 };
        let mut deformation = Self {
            max_level: options.max_level,
            color_weight: options.color_weight,
            most_views: options.views,
            outline_steps,
            chooser: ViewChooser::default(),
            tracker,
            backward: BackwardRasterizer::new(gpu)?,
            loss: ImageLoss::new(gpu)?,
            coarse_displacement: StorageBuffer::zeroed(gpu, "displacements", count)?,
            displacement: StorageBuffer::zeroed(gpu, "displacements", surface.len())?,
            skinner: GpuSkinner::new(gpu, &coarse.gaussians.inset(), &template.skeleton)?,
            colors: ColorMeans::new(gpu, &coarse.first_child, &coarse.children)?,
            posed: vec![GaussianBuffers::zeroed(gpu, count)?],
            spacing_m: coarse.spacing_m,
            is_loose,
            points: (coarse.gaussians.positions, coarse.gaussians.skin),
            mesh: MeshMotion::new(template, surface, graph),
            gradients: Vec::new(),
            views: Vec::new(),
            landmarks,
            report: None,
            agreement: Vec::new(),
            halved: 0,
            has_colors: mean.is_some(),
            had_colors: false,
        };
        deformation.show(gpu);
        Ok(deformation)
    }

    /// Uploads the displacement that the nodes' translations give.
    fn show(&mut self, gpu: &GpuContext) {
        self.displacement.write(gpu, self.mesh.follow(self.tracker.translations()));
    }

    /// Solves the deformation for one frame set. Afterwards [`Self::displacement`] holds its result.
    ///
    /// # Errors
    /// [`FusionError::Gpu`] and errors of the solver.
    pub fn track(
        &mut self,
        person: TrackedPerson<'_>,
        all_views: &[TrackedView<'_>],
    ) -> Result<DeformTimes, FusionError> {
        let (start, gpu) = (Instant::now(), person.gpu);
        let chosen = self.choose(&person, all_views);
        let views: &[TrackedView<'_>] = &chosen.iter().map(|&i| all_views[i]).collect::<Vec<_>>();
        let plans = self.landmarks.plans(person.skeleton, person.poses, views, self.spacing_m, self.max_level);
        self.halved = plans.iter().filter(|plan| plan.level > 0).count();
        self.reserve(gpu, person.poses.len(), views, &plans)?;
        if self.views.is_empty() {
            return Ok(Default::default());
        }
        self.update_colors(&person);
        self.align(&person, views);
        let mut images = Images::new(
            person,
            views,
            &plans,
            &mut self.views,
            DeformKernels {
                skinner: &self.skinner,
                posed: &self.posed,
                loss: &self.loss,
                backward: &mut self.backward,
                displacement: &self.coarse_displacement,
                gradients: &self.gradients,
            },
            if self.has_colors { self.color_weight } else { 0.0 },
        );
        let prepare = start.elapsed();
        images.distrust(self.tracker.displacement())?;
        let report = self.tracker.track(&mut images)?;
        let agreement = images.agreement(self.tracker.displacement());
        let (draw, derivatives) = images.times();
        self.keep_agreement(all_views, &chosen, &agreement);
        self.show(gpu);
        self.has_colors |= !views.is_empty();
        let solve = start.elapsed().saturating_sub(prepare + draw + derivatives);
        tracing::debug!(?report, "deformation");
        self.report = Some(report);
        Ok(DeformTimes { prepare, draw, derivatives, solve })
    }

    /// Moves a skirt towards the outlines of the masks, out of reach of the images' derivatives.
    fn align(&mut self, person: &TrackedPerson<'_>, views: &[TrackedView<'_>]) {
        if self.outline_steps == 0 {
            return;
        }
        let started = Instant::now();
        let outlines: Vec<OutlineView<'_>> = views.iter().map(TrackedView::outline).collect();
        let bones = person.poses.iter().map(|pose| person.skeleton.world_from_canonical(pose)).collect();
        let (points, skin) = &self.points;
        let mut term = OutlineTerm::new((points, skin, self.spacing_m), &self.is_loose, &outlines, bones);
        let Ok(report) = self.tracker.align(&mut term, self.outline_steps);
        tracing::debug!(?report, took = ?started.elapsed(), "outlines");
    }

    /// Chooses the views that are compared, as ascending indices.
    fn choose(&mut self, person: &TrackedPerson<'_>, all_views: &[TrackedView<'_>]) -> Vec<usize> {
        let cameras: Vec<&Camera> = all_views.iter().map(|view| view.camera).collect();
        let center = person.poses.first().map_or(DVec3::ZERO, |pose| self.landmarks.center(person.skeleton, pose));
        self.chooser.choose(&cameras, center, self.most_views)
    }

    /// Creates the buffers that these views and instants need and that do not exist yet.
    fn reserve(
        &mut self,
        gpu: &GpuContext,
        instants: usize,
        views: &[TrackedView<'_>],
        plans: &[ViewPlan],
    ) -> Result<(), FusionError> {
        let count = self.posed[0].count();
        for (i, (view, plan)) in views.iter().zip(plans).enumerate() {
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
        while self.posed.len() < instants {
            self.posed.push(self.posed[0].posed_again(gpu)?);
        }
        while self.gradients.len() < instants {
            self.gradients.push(GaussianGradients::zeroed(gpu, count)?);
        }
        Ok(self.loss.reserve(gpu, views.len())?)
    }

    /// Moves the colours of the coarse Gaussians towards those of the last painting.
    fn update_colors(&mut self, person: &TrackedPerson<'_>) {
        let gpu = person.gpu;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let rate = if self.had_colors { COLOR_RATE } else { 1.0 };
        self.had_colors = self.has_colors;
        self.colors.encode(gpu, &mut encoder, person.colors, &self.posed[0].color, rate);
        gpu.queue.submit([encoder.finish()]);
    }

    /// Stores the agreement of the compared views, and chooses distrusted ones less often.
    fn keep_agreement(&mut self, all_views: &[TrackedView<'_>], chosen: &[usize], agreement: &[ViewAgreement]) {
        self.agreement.clear();
        self.agreement.resize(all_views.len(), None);
        for (&i, &agreement) in chosen.iter().zip(agreement) {
            self.agreement[i] = Some(agreement);
            if !agreement.is_trusted {
                self.chooser.distrust(&all_views[i].camera.id);
            }
        }
    }

    /// Replaces the mean shape, canonical metres per node, from the next frame set on.
    pub fn set_mean(&mut self, mean: &[DVec3]) -> Result<(), FusionError> {
        Ok(self.tracker.set_mean(mean)?)
    }

    /// Returns to the undeformed body, for another person.
    pub fn reset(&mut self) {
        self.tracker.reset();
        self.has_colors = false;
    }

    /// Returns the canonical translations of the graph's nodes, metres.
    pub fn translations(&self) -> &[DVec3] {
        self.tracker.translations()
    }

    /// Resumes from the node translations, metres, of an earlier deformation of the same body, whose Gaussians have colours already;
    /// from the mean shape without any.
    pub fn resume(&mut self, gpu: &GpuContext, translations: &[DVec3]) -> Result<(), FusionError> {
        if translations.is_empty() {
            self.tracker.reset();
        } else {
            self.tracker.resume(translations)?;
        }
        self.show(gpu);
        (self.has_colors, self.had_colors) = (true, false);
        Ok(())
    }

    /// Gives the next frame sets the iterations of a start.
    pub fn restart(&mut self) {
        self.tracker.restart();
    }

    /// Returns the agreement of each view of the last frame set; `None` for one that was not compared.
    pub fn agreement(&self) -> &[Option<ViewAgreement>] {
        &self.agreement
    }

    /// Returns the number of Gaussians that are compared with the images.
    pub fn compared(&self) -> usize {
        self.posed[0].count()
    }

    /// Returns the number of views of the last frame set whose images were compared at half of their size or less.
    pub fn halved_images(&self) -> usize {
        self.halved
    }

    /// Returns the report of the last solve.
    pub fn report(&self) -> Option<&DeformReport> {
        self.report.as_ref()
    }

    /// Returns the canonical displacement of every Gaussian, metres.
    pub fn displacement(&self) -> &StorageBuffer<[f32; 4]> {
        &self.displacement
    }

    /// Returns the canonical displacement of every vertex of the template, metres.
    pub fn vertex_displacement(&self) -> Vec<Vec3> {
        self.mesh.of_vertices()
    }
}

#[cfg(test)]
mod stability_tests;
