//! Deformation tracking on the GPU: draws the Gaussians with the colours of the last instant into every input view and
//! tells the solver how the pictures differ (FlyHuman Eq. 3).

use std::sync::LazyLock;

use anyhow::Result;
use flyrig_body::{DeformationGraph, GpuSkinner, Skeleton, SurfaceGaussians, Template};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{
    BackwardRasterizer, Carry, GaussianBuffers, GaussianGradients, Outputs, PictureGradients, RasterSettings,
    Rasterizer, RenderTarget, linear_from_srgb,
};
use flyrig_tracker::{DataTerm, DeformReport, DeformSettings, DeformTracker, PointDerivatives};
use flyrig_types::{Camera, Pose};
use glam::Vec3;
use rayon::prelude::*;

/// λ_color and λ_mask of Eq. 3, over the sum of squared differences (linear light, 0..=1) of all pixels.
const COLOR_WEIGHT: f32 = 2.0;
const MASK_WEIGHT: f32 = 2.0;

/// Linear value of each sRGB byte.
static LINEAR: LazyLock<[f32; 256]> =
    LazyLock::new(|| std::array::from_fn(|byte| linear_from_srgb(byte as f32 / 255.0)));

/// The tracked deformation and the buffers it is solved with.
#[derive(Debug)]
pub struct Deformation {
    tracker: DeformTracker,
    backward: BackwardRasterizer,
    displacement: StorageBuffer<[f32; 4]>,
    gradients: GaussianGradients,
    views: Vec<ViewBuffers>,
    vertices: VertexMeans,
    /// Whether the Gaussians have colours yet.
    painted: bool,
}

#[derive(Debug)]
struct ViewBuffers {
    target: RenderTarget,
    incoming: PictureGradients,
}

/// What one frame is compared with: camera, and sRGB bytes with mask coverage, row by row.
pub type TrackedView<'a> = (&'a Camera, [u32; 2], &'a [u8]);

/// What the engine lends for a frame.
pub struct Scene<'a> {
    pub gpu: &'a GpuContext,
    pub skinner: &'a GpuSkinner,
    pub skeleton: &'a Skeleton,
    pub rasterizer: &'a mut Rasterizer,
    pub gaussians: &'a GaussianBuffers,
}

impl Deformation {
    /// At rest, for these Gaussians.
    pub fn new(
        gpu: &GpuContext,
        template: &Template,
        surface: &SurfaceGaussians,
        graph: &DeformationGraph,
        rasterizer: &Rasterizer,
        settings: DeformSettings,
    ) -> Result<Self> {
        let count = surface.len();
        Ok(Self {
            tracker: DeformTracker::new(graph, &surface.skin, settings)?,
            backward: BackwardRasterizer::new(gpu, rasterizer)?,
            displacement: StorageBuffer::zeroed(gpu, "displacements", count)?,
            gradients: GaussianGradients::zeroed(gpu, count)?,
            views: Vec::new(),
            vertices: VertexMeans::new(template, surface),
            painted: false,
        })
    }

    /// Solves one instant. Afterwards [`Self::displacement`] holds its result.
    pub fn track(&mut self, scene: Scene<'_>, pose: &Pose, views: &[TrackedView<'_>]) -> Result<DeformReport> {
        for (i, &(_, [width, height], _)) in views.iter().enumerate() {
            let fits = self.views.get(i).is_some_and(|v| [v.target.width, v.target.height] == [width, height]);
            if !fits {
                let buffers = ViewBuffers {
                    target: RenderTarget::new(scene.gpu, width, height)?,
                    incoming: PictureGradients::zeroed(scene.gpu, width, height)?,
                };
                if i < self.views.len() {
                    self.views[i] = buffers;
                } else {
                    self.views.push(buffers);
                }
            }
        }
        let bones = scene.skeleton.world_from_canonical(pose);
        let gpu = scene.gpu;
        let mut pictures = Pictures {
            scene,
            pose,
            views,
            buffers: &self.views,
            backward: &mut self.backward,
            displacement: &self.displacement,
            gradients: &self.gradients,
            // Before the first colours only the masks can tell anything.
            color_weight: if self.painted { COLOR_WEIGHT } else { 0.0 },
        };
        let report = self.tracker.track(&bones, &mut pictures)?;
        self.displacement.write(gpu, self.tracker.displacement());
        self.painted |= !views.is_empty();
        Ok(report)
    }

    /// Canonical displacement of every Gaussian.
    pub fn displacement(&self) -> &StorageBuffer<[f32; 4]> {
        &self.displacement
    }

    /// Canonical displacement of every vertex of the template, metres.
    pub fn vertex_displacement(&self) -> Vec<Vec3> {
        self.vertices.of(self.tracker.displacement())
    }
}

/// The pictures of one instant as the solver's data term.
struct Pictures<'a> {
    scene: Scene<'a>,
    pose: &'a Pose,
    views: &'a [TrackedView<'a>],
    buffers: &'a [ViewBuffers],
    backward: &'a mut BackwardRasterizer,
    displacement: &'a StorageBuffer<[f32; 4]>,
    gradients: &'a GaussianGradients,
    color_weight: f32,
}

impl Pictures<'_> {
    fn pose(&self, displacement: &[[f32; 4]]) -> Result<()> {
        let Scene { gpu, skinner, skeleton, gaussians, .. } = &self.scene;
        self.displacement.write(gpu, displacement);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
        skinner.encode(gpu, &mut encoder, skeleton, self.pose, Some(self.displacement), centers, normals)?;
        gpu.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Draws a view and adds its loss; the drawn picture for who needs more.
    fn draw(&mut self, i: usize) -> Result<Vec<[f32; 4]>> {
        let gpu = self.scene.gpu;
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let target = &self.buffers[i].target;
        self.scene.rasterizer.encode(gpu, &mut encoder, self.scene.gaussians, self.views[i].0, &settings, target)?;
        gpu.queue.submit([encoder.finish()]);
        Ok(target.color.read(gpu)?)
    }
}

impl DataTerm for Pictures<'_> {
    type Error = anyhow::Error;

    fn loss(&mut self, displacement: &[[f32; 4]]) -> Result<f64> {
        self.pose(displacement)?;
        let mut sum = 0.0;
        for i in 0..self.views.len() {
            let drawn = self.draw(i)?;
            sum += picture_loss(&drawn, self.views[i].2, self.views[i].1[0] as usize, self.color_weight);
        }
        Ok(sum)
    }

    fn derivatives(&mut self, displacement: &[[f32; 4]], out: &mut PointDerivatives) -> Result<f64> {
        self.pose(displacement)?;
        let gpu = self.scene.gpu;
        let mut sum = 0.0;
        for i in 0..self.views.len() {
            let drawn = self.draw(i)?;
            let (_, [width, _], wanted) = self.views[i];
            sum += picture_loss(&drawn, wanted, width as usize, self.color_weight);
            let (color, depth_carry) = picture_derivatives(&drawn, wanted, width as usize, self.color_weight);
            let ViewBuffers { target, incoming } = &self.buffers[i];
            incoming.color.write(gpu, &color);
            incoming.depth_carry.write(gpu, &depth_carry);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if i == 0 {
                self.gradients.clear(&mut encoder);
            }
            let (rasterizer, gaussians) = (&*self.scene.rasterizer, self.scene.gaussians);
            let what = (incoming, Carry::Lift);
            self.backward.encode(gpu, &mut encoder, rasterizer, gaussians, target, what, self.gradients)?;
            gpu.queue.submit([encoder.finish()]);
        }
        out.gradient.clear();
        out.curvature.clear();
        if !self.views.is_empty() {
            out.gradient = self.gradients.center.read(gpu)?;
            out.curvature = self.gradients.carried.read(gpu)?;
        }
        Ok(sum)
    }
}

/// Drawn less wanted: premultiplied linear colour, and alpha.
fn residual(drawn: [f32; 4], wanted: &[u8]) -> [f32; 4] {
    let mask = f32::from(wanted[3]) / 255.0;
    let color = |c: usize| drawn[c] - LINEAR[usize::from(wanted[c])] * mask;
    [color(0), color(1), color(2), drawn[3] - mask]
}

/// Row by row, so that the order of the sum is fixed.
fn picture_loss(drawn: &[[f32; 4]], wanted: &[u8], width: usize, color_weight: f32) -> f64 {
    let rows: Vec<f64> = drawn
        .par_chunks(width.max(1))
        .zip(wanted.par_chunks(4 * width.max(1)))
        .map(|(drawn, wanted)| {
            let pixels = drawn.iter().zip(wanted.chunks_exact(4));
            let one = |(drawn, wanted): (&[f32; 4], &[u8])| {
                let [r, g, b, a] = residual(*drawn, wanted);
                f64::from(color_weight * (r * r + g * g + b * b) + MASK_WEIGHT * a * a)
            };
            pixels.map(one).sum()
        })
        .collect();
    rows.iter().sum()
}

/// dL/d (colour, alpha); and, for the Gauss-Newton matrix, the outer product of the drawn picture's own slopes: how the
/// loss bends when all that a pixel shows moves along (Lucas and Kanade 1981).
fn picture_derivatives(
    drawn: &[[f32; 4]],
    wanted: &[u8],
    width: usize,
    color_weight: f32,
) -> (Vec<[f32; 4]>, Vec<[f32; 4]>) {
    let weights = [color_weight, color_weight, color_weight, MASK_WEIGHT];
    let height = drawn.len() / width.max(1);
    (0..drawn.len())
        .into_par_iter()
        .map(|at| {
            let off = residual(drawn[at], &wanted[4 * at..4 * at + 4]);
            let color = std::array::from_fn(|c| 2.0 * weights[c] * off[c]);
            let (x, y) = (at % width, at / width);
            if x == 0 || y == 0 || x + 1 >= width || y + 1 >= height {
                return (color, [0.0; 4]);
            }
            let mut bend = [0.0; 4];
            for c in 0..4 {
                let dx = 0.5 * (drawn[at + 1][c] - drawn[at - 1][c]);
                let dy = 0.5 * (drawn[at + width][c] - drawn[at - width][c]);
                bend[1] += 2.0 * weights[c] * dx * dx;
                bend[2] += 2.0 * weights[c] * dx * dy;
                bend[3] += 2.0 * weights[c] * dy * dy;
            }
            (color, bend)
        })
        .unzip()
}

/// Displacements of the template's vertices as means of the Gaussians on the triangles around them.
#[derive(Debug)]
struct VertexMeans {
    triangles: Vec<[u32; 3]>,
    /// Triangle's corners and weights of each Gaussian.
    corners: Vec<([u32; 3], [f32; 3])>,
    vertices: usize,
}

impl VertexMeans {
    fn new(template: &Template, surface: &SurfaceGaussians) -> Self {
        let corner = |(&triangle, &weights): (&u32, &[f32; 3])| (template.triangles[triangle as usize], weights);
        Self {
            triangles: template.triangles.clone(),
            corners: surface.triangle.iter().zip(&surface.barycentric).map(corner).collect(),
            vertices: template.positions.len(),
        }
    }

    fn of(&self, displacement: &[[f32; 4]]) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO.extend(0.0); self.vertices];
        for ((corners, weights), d) in self.corners.iter().zip(displacement) {
            for (&corner, &weight) in corners.iter().zip(weights) {
                sums[corner as usize] += Vec3::new(d[0], d[1], d[2]).extend(1.0) * weight;
            }
        }
        // A vertex that no Gaussian lies next to takes its neighbours' mean, from the rim of the hole inwards.
        while sums.iter().any(|s| s.w <= 0.0) {
            let mut more = vec![Vec3::ZERO.extend(0.0); self.vertices];
            for triangle in &self.triangles {
                for (&a, &b) in triangle.iter().zip(triangle.iter().cycle().skip(1)) {
                    for (to, from) in [(a, b), (b, a)] {
                        let from = sums[from as usize];
                        if from.w > 0.0 {
                            more[to as usize] += from / from.w;
                        }
                    }
                }
            }
            let mut filled = false;
            for (sum, more) in sums.iter_mut().zip(more) {
                if sum.w <= 0.0 && more.w > 0.0 {
                    *sum = more;
                    filled = true;
                }
            }
            if !filled {
                break;
            }
        }
        sums.iter().map(|s| if s.w > 0.0 { s.truncate() / s.w } else { Vec3::ZERO }).collect()
    }
}
