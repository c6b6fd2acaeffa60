//! The method on one GPU: pose the Gaussians, see which camera sees what, colour them, draw them.

use std::time::Instant;

use anyhow::{Context, Result, ensure};
use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, GpuSkinner, SurfaceGaussians, Template, build_graph, sample_surface, skin_mesh,
};
use flyrig_capture::to_rgb8;
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{
    AppearanceSettings, DirectAppearance, GaussianBuffers, Observations, Outputs, RasterSettings, Rasterizer,
    RenderTarget, Splat, ViewInput, read_splats, rgba8_from_target,
};
use flyrig_stfa::{BodyGraph, LearnedAppearance, Parameters, SharedAppearance, ViewPicture};
use flyrig_tracker::DeformReport;
use flyrig_types::{Camera, Image, Mask, Pose, Rig};

use crate::cli::NetworkUse;
use crate::config::NetworksOn;
use crate::deformation::{DeformOptions, DeformTimes, Deformation, Scene, TrackedView};
use crate::stats::{StageTimes, processor_time};
use crate::viewpoints::center_of_attention;

/// Seed of the surface sampling: the same template gives the same Gaussians on every run.
const SURFACE_SEED: u64 = 1;

/// Stage that tells how much of the deformation's time the processor worked for this program.
pub const PROCESSOR_STAGE: &str = "  processor";

/// One input picture with its person mask.
#[derive(Debug, Clone, Copy)]
pub struct InputView<'a> {
    pub camera: &'a Camera,
    pub image: &'a Image,
    pub mask: &'a Mask,
    /// Pose at the picture's own time, where that is not the instant's.
    pub pose: Option<&'a Pose>,
}

/// A rendered view: straight-alpha sRGB.
#[derive(Debug, Clone)]
pub struct RenderedView {
    pub width: u32,
    pub height: u32,
    pub rgba: Vec<u8>,
}

/// What the last update saw, and where the Gaussians stood.
#[derive(Debug)]
pub struct Observed {
    pub observations: Observations,
    /// The observing views: size and pixels with mask.
    pub pictures: Vec<(u32, u32, Vec<u8>)>,
    pub center_scale: Vec<[f32; 4]>,
    pub normal: Vec<[f32; 4]>,
}

/// Networks, where they run.
#[derive(Debug)]
enum Learned {
    Processor(Box<LearnedAppearance>),
    Adapter(SharedAppearance),
}

/// The person as Gaussians on the GPU, and everything that keeps them up to date.
#[derive(Debug)]
pub struct Engine {
    gpu: GpuContext,
    template: Template,
    skinner: GpuSkinner,
    gaussians: GaussianBuffers,
    /// The Gaussians as they stood when the second, third ... instant of a set was taken.
    posed: Vec<GaussianBuffers>,
    rasterizer: Rasterizer,
    appearance: DirectAppearance,
    settings: AppearanceSettings,
    body: BodyGraph,
    /// What adds to direct appearance.
    learned: Option<Learned>,
    /// Views that painted in the last update.
    painted: Vec<usize>,
    /// A target an input view; grows with the rig, remade when a picture's size changes.
    visibility: Vec<RenderTarget>,
    rgba: Vec<Vec<u8>>,
    output: Option<RenderTarget>,
    deformation: Option<Deformation>,
    /// Whether the body keeps its shape for the time being.
    pub shape_held: bool,
    /// What direct appearance painted last, while the Gaussians show what the networks made of it.
    direct_colors: Option<StorageBuffer<[f32; 4]>>,
    /// What the deformation thinks of the last update's views.
    judged: Vec<Option<(f64, bool)>>,
}

impl Engine {
    /// Samples the template's surface and prepares the GPU for the input cameras of `rig`. Takes a few seconds. Without `deform` the body is only
    /// skinned.
    #[allow(clippy::too_many_arguments)]
    pub fn new(
        gpu: GpuContext,
        template: Template,
        gaussian_count: usize,
        node_count: usize,
        rig: &Rig,
        settings: AppearanceSettings,
        deform: Option<DeformOptions>,
    ) -> Result<Self> {
        let surface =
            sample_surface(&template, gaussian_count, SURFACE_SEED).context("sampling the template's surface")?;
        let graph = build_graph(&template, &surface, node_count, DEFAULT_SIGMA2_M2)
            .context("building the deformation graph")?;
        Self::from_parts(gpu, template, &surface, &graph, rig, settings, deform)
    }

    fn from_parts(
        gpu: GpuContext,
        template: Template,
        surface: &SurfaceGaussians,
        graph: &DeformationGraph,
        rig: &Rig,
        settings: AppearanceSettings,
        deform: Option<DeformOptions>,
    ) -> Result<Self> {
        let count = surface.positions.len();
        let gaussians = GaussianBuffers::zeroed(&gpu, count)?;
        let center_scale: Vec<[f32; 4]> =
            surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| p.extend(*s).to_array()).collect();
        gaussians.center_scale.write(&gpu, &center_scale);
        let canonical: Vec<[f32; 4]> = surface.positions.iter().map(|p| p.extend(1.0).to_array()).collect();
        gaussians.canonical.write(&gpu, &canonical);
        gaussians.color.write(&gpu, &vec![[0.5, 0.5, 0.5, 1.0]; count]);
        let rasterizer = Rasterizer::new(&gpu, count)?;
        Ok(Self {
            skinner: match deform {
                Some(_) => GpuSkinner::new(&gpu, &surface.inset(), &template.skeleton)?,
                None => GpuSkinner::new(&gpu, surface, &template.skeleton)?,
            },
            shape_held: false,
            direct_colors: None,
            deformation: deform
                .map(|options| Deformation::new(&gpu, &template, surface, graph, options, finest_pixel_m(rig)))
                .transpose()?,
            rasterizer,
            appearance: DirectAppearance::new(&gpu, surface, graph, rig.cameras.len())?,
            body: BodyGraph::new(surface, graph)?,
            learned: None,
            painted: Vec::new(),
            gpu,
            template,
            gaussians,
            settings,
            posed: Vec::new(),
            judged: Vec::new(),
            visibility: Vec::new(),
            rgba: Vec::new(),
            output: None,
        })
    }

    /// The device that everything runs on.
    pub fn gpu(&self) -> &GpuContext {
        &self.gpu
    }

    /// The template that is being posed.
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// From now on these networks add to direct appearance.
    pub fn use_networks(&mut self, parameters: &Parameters, how: NetworkUse) -> Result<()> {
        how.check()?;
        self.appearance.keep_observations(&self.gpu)?;
        self.learned = Some(match how.networks_on {
            NetworksOn::Processor => {
                let mut learned = LearnedAppearance::new(parameters, self.body.clone());
                learned.reuse = how.reuse;
                Learned::Processor(Box::new(learned))
            }
            NetworksOn::Adapter => Learned::Adapter(SharedAppearance::new(&self.gpu, parameters, &self.body)?),
        });
        let direct = StorageBuffer::zeroed(&self.gpu, "direct colours", self.gaussians.count())?;
        self.gaussians.color.copy_to(&self.gpu, &direct);
        self.direct_colors = Some(direct);
        Ok(())
    }

    /// From now on [`Self::observed`] tells what each view saw.
    pub fn keep_observations(&mut self) -> Result<()> {
        Ok(self.appearance.keep_observations(&self.gpu)?)
    }

    /// The graph as the networks see it.
    pub fn body_graph(&self) -> &BodyGraph {
        &self.body
    }

    /// RGB and mask of an input view of the last update.
    pub fn input(&self, view: usize) -> &[u8] {
        self.rgba.get(view).map_or(&[], Vec::as_slice)
    }

    /// What the last update saw.
    pub fn observed(&self) -> Result<Observed> {
        Ok(Observed {
            observations: self.appearance.observations(&self.gpu, self.painted.len())?,
            pictures: self
                .painted
                .iter()
                .map(|&i| (self.visibility[i].width, self.visibility[i].height, self.rgba[i].clone()))
                .collect(),
            center_scale: self.gaussians.center_scale.read(&self.gpu)?,
            normal: self.gaussians.normal.read(&self.gpu)?,
        })
    }

    /// Takes in one instant: pose, then colours from the views. A view whose mask is empty adds nothing.
    pub fn update(&mut self, pose: &Pose, views: &[InputView<'_>], stages: &mut StageTimes) -> Result<()> {
        stages.time("convert pictures", || self.fill_rgba(views))?;

        // The instant itself, and each other one that a picture was taken at.
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
            self.posed.push(self.gaussians.posed_again(&self.gpu)?);
        }
        let poses = instants;
        let instants: Vec<(&Pose, &GaussianBuffers)> =
            poses.iter().copied().zip(std::iter::once(&self.gaussians).chain(&self.posed)).collect();

        self.judged.clear();
        if let Some(deformation) = self.deformation.as_mut().filter(|_| !views.is_empty() && !self.shape_held) {
            let (start, processor) = (Instant::now(), processor_time());
            let tracked: Vec<TrackedView<'_>> = views
                .iter()
                .zip(&self.rgba)
                .zip(&instant_of)
                .map(|((view, rgba), &instant)| {
                    let size = [view.image.width(), view.image.height()];
                    TrackedView { camera: view.camera, size, rgba, instant }
                })
                .collect();
            let scene = Scene {
                gpu: &self.gpu,
                skeleton: &self.template.skeleton,
                instants: &poses,
                gaussians: &self.gaussians,
            };
            let DeformTimes { prepare, draw, derivatives, solve } = deformation.track(scene, &tracked)?;
            self.judged.extend_from_slice(deformation.judged());
            stages.add("deformation", start.elapsed());
            stages.add("  prepare", prepare);
            stages.add("  draw and compare", draw);
            stages.add("  derivatives", derivatives);
            stages.add("  solve", solve);
            stages.add(PROCESSOR_STAGE, processor_time().saturating_sub(processor));
            let at_rest = deformation.report().is_some_and(|report| report.at_rest);
            stages.count("frames at rest, not solved", u64::from(at_rest));
            let left_out = deformation.judged().iter().filter(|judged| judged.is_none()).count();
            stages.count("views not compared", left_out as u64);
            let distrusted = deformation.judged().iter().flatten().filter(|(_, trusted)| !trusted).count();
            stages.count("views not believed", distrusted as u64);
            stages.count("pictures halved", deformation.halved_pictures() as u64);
        }

        let start = Instant::now();
        let corrected: Vec<Pose> = instants.iter().map(|(pose, _)| self.corrected(pose)).collect();
        let displacement = self.deformation.as_ref().map(Deformation::displacement);
        for (pose, (_, gaussians)) in corrected.iter().zip(&instants) {
            let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
            let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
            let skeleton = &self.template.skeleton;
            self.skinner.encode(&self.gpu, &mut encoder, skeleton, pose, displacement, centers, normals)?;
            self.gpu.queue.submit([encoder.finish()]);
        }
        self.gpu.wait()?;
        stages.add("skinning", start.elapsed());

        if let Some(direct) = &self.direct_colors {
            // Direct appearance goes on from its own colours.
            direct.copy_to(&self.gpu, &self.gaussians.color);
        }
        let start = Instant::now();
        for (i, view) in views.iter().enumerate() {
            let (width, height) = (view.image.width(), view.image.height());
            let fits = self.visibility.get(i).is_some_and(|t| (t.width, t.height) == (width, height));
            if !fits {
                let target = RenderTarget::new(&self.gpu, width, height)?;
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
            let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
            self.rasterizer.encode(
                &self.gpu,
                &mut encoder,
                instants[instant_of[i]].1,
                view.camera,
                &settings,
                &self.visibility[i],
            )?;
            self.gpu.queue.submit([encoder.finish()]);
        }
        self.gpu.wait()?;
        stages.add("visibility", start.elapsed());

        let start = Instant::now();
        // A view that is not believed paints nothing.
        let believed = |i: usize| self.judged.get(i).copied().flatten().is_none_or(|(_, trusted)| trusted);
        self.painted = (0..views.len()).filter(|&i| believed(i)).collect();
        let inputs: Vec<ViewInput<'_>> = self
            .painted
            .iter()
            .map(|&i| ViewInput {
                camera: views[i].camera,
                rgba: &self.rgba[i],
                canonical: &self.visibility[i].canonical,
                drawn: &self.visibility[i].color,
                gaussians: (instant_of[i] > 0).then(|| instants[instant_of[i]].1),
            })
            .collect();
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.appearance.update(&self.gpu, &mut encoder, &self.gaussians, &inputs, &self.settings)?;
        self.submit(encoder)?;
        stages.add("appearance", start.elapsed());
        self.paint_learned(views, stages)
    }

    /// Lets the networks add to what direct appearance painted.
    fn paint_learned(&mut self, views: &[InputView<'_>], stages: &mut StageTimes) -> Result<()> {
        let Some(learned) = &mut self.learned else { return Ok(()) };
        let start = Instant::now();
        if let Some(direct) = &self.direct_colors {
            self.gaussians.color.copy_to(&self.gpu, direct);
        }
        let picture = |&i: &usize| {
            let (width, height) = (views[i].image.width(), views[i].image.height());
            ViewPicture { width, height, rgba: &self.rgba[i] }
        };
        let pictures: Vec<_> = self.painted.iter().map(picture).collect();
        let learned = match learned {
            Learned::Processor(learned) => learned,
            Learned::Adapter(learned) => {
                learned.paint(&self.gpu, &self.appearance, &self.gaussians, &pictures, &self.settings)?;
                self.gpu.wait()?;
                stages.add("networks", start.elapsed());
                return Ok(());
            }
        };
        let observed = self.appearance.observations(&self.gpu, self.painted.len())?;
        let before = learned.counts;
        let colors = learned.paint(&observed, &pictures, &self.settings)?;
        self.gaussians.color.write(&self.gpu, &colors);
        stages.add("networks", start.elapsed());
        let counts = learned.counts;
        stages.count("views not encoded", counts.views_kept - before.views_kept);
        stages.count("Gaussians not corrected anew", counts.colors_kept - before.colors_kept);
        stages.count("corrections that were no numbers", counts.poisoned - before.poisoned);
        Ok(())
    }

    /// Draws the person as `camera` would see it now.
    pub fn render(&mut self, camera: &Camera, stages: &mut StageTimes) -> Result<RenderedView> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let start = Instant::now();
        let target = match self.output.take() {
            Some(target) if (target.width, target.height) == (width, height) => target,
            _ => RenderTarget::new(&self.gpu, width, height)?,
        };
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, &self.gaussians, camera, &settings, &target)?;
        self.submit(encoder)?;
        stages.add("render a view", start.elapsed());
        let rgba = stages
            .time("read a view back", || -> Result<_> { Ok(rgba8_from_target(&target.color.read(&self.gpu)?)) })?;
        self.output = Some(target);
        Ok(RenderedView { width, height, rgba })
    }

    /// Forgets clothes and colours: another person may come.
    pub fn forget(&mut self) {
        if let Some(deformation) = &mut self.deformation {
            deformation.reset();
        }
        self.appearance.reset();
        match &mut self.learned {
            Some(Learned::Processor(learned)) => learned.reset(),
            Some(Learned::Adapter(learned)) => learned.reset(),
            None => {}
        }
    }

    /// The next frames get the iterations of a start.
    pub fn restart(&mut self) {
        if let Some(deformation) = &mut self.deformation {
            deformation.restart();
        }
    }

    /// By view of the last update: how much of the person is where the picture shows it, 0 to 1. Empty when the body was not
    /// compared with the pictures, None for a view that was not.
    pub fn agreement(&self) -> Vec<Option<f64>> {
        self.judged.iter().map(|judged| judged.map(|(quality, _)| quality)).collect()
    }

    /// How many Gaussians are compared with the pictures; 0 where the body is only skinned.
    pub fn compared_gaussians(&self) -> usize {
        self.deformation.as_ref().map_or(0, Deformation::compared)
    }

    /// What the last solve of the deformation did.
    pub fn deform_report(&self) -> Option<&DeformReport> {
        self.deformation.as_ref().and_then(Deformation::report)
    }

    /// The Gaussians of this instant.
    pub fn splats(&self) -> Result<Vec<Splat>> {
        Ok(read_splats(&self.gpu, &self.gaussians)?)
    }

    /// A pose with what the deformation's solver corrected last.
    pub fn corrected(&self, pose: &Pose) -> Pose {
        self.deformation.as_ref().map_or_else(|| pose.clone(), |deformation| deformation.correction().apply(pose))
    }

    /// The tracked surface: world positions and normals of the template's vertices.
    pub fn surface(&self, pose: &Pose) -> (Vec<glam::Vec3>, Vec<glam::Vec3>) {
        let Some(deformation) = &self.deformation else { return skin_mesh(&self.template, pose) };
        let mut moved = self.template.clone();
        for (position, by) in moved.positions.iter_mut().zip(deformation.vertex_displacement()) {
            *position += by;
        }
        skin_mesh(&moved, &deformation.correction().apply(pose))
    }

    fn submit(&self, encoder: wgpu::CommandEncoder) -> Result<()> {
        self.gpu.queue.submit([encoder.finish()]);
        self.gpu.wait()?;
        Ok(())
    }

    fn fill_rgba(&mut self, views: &[InputView<'_>]) -> Result<()> {
        self.rgba.resize_with(self.rgba.len().max(views.len()), Vec::new);
        for (view, rgba) in views.iter().zip(&mut self.rgba) {
            let (image, mask) = (view.image, view.mask);
            ensure!(
                (mask.width(), mask.height()) == (image.width(), image.height()),
                "camera {}: the mask is {}x{} pixels, the picture {}x{}",
                view.camera.id,
                mask.width(),
                mask.height(),
                image.width(),
                image.height()
            );
            let converted;
            let rgb = if image.format() == flyrig_types::PixelFormat::Rgb8 {
                image.bytes()
            } else {
                converted = to_rgb8(image)?;
                &converted
            };
            rgba.clear();
            rgba.extend(rgb.chunks_exact(3).zip(mask.coverage()).flat_map(|(c, &a)| [c[0], c[1], c[2], a]));
        }
        Ok(())
    }
}

/// What a pixel of the finest camera covers at the place that all look at, metres.
fn finest_pixel_m(rig: &Rig) -> f64 {
    let center = center_of_attention(rig);
    let pixel = |camera: &Camera| camera.position().distance(center) / (0.5 * camera.intrinsics.focal_px.element_sum());
    rig.cameras.iter().map(pixel).fold(f64::INFINITY, f64::min)
}
