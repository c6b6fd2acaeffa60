//! Gradient descent of an avatar on the images of a take.

use std::collections::{BTreeMap, btree_map::Entry};

use flyrig_gpu::{GpuContext, read_all};
use flyrig_renderer::{
    AnisotropicGradients, BackwardRasterizer, HarmonicOrder, ImageGradients, Outputs, RasterSettings, Rasterizer,
    RenderTarget,
};
use flyrig_types::Pose;
use glam::{DVec3, Vec2};
use rand::{SeedableRng as _, rngs::StdRng, seq::SliceRandom as _};

use crate::error::AvatarError;
use crate::fit::adam::Adam;
use crate::fit::image_error::{ErrorWeights, ImageDifference};
use crate::fit::pose_fit::PoseFit;
use crate::fit::skin_fit::SkinFit;
use crate::fit::training_view::TrainingView;
use crate::local::networks::{Local, LocalSettings};
use crate::model::avatar::Avatar;
use crate::model::light::LightFit;
use crate::model::neighbors::Neighbors;
use crate::model::parameters::Element;
use crate::model::posing::{Bones, PosedAvatar};
use crate::model::scene::AvatarBuffers;

/// Difference to the neighbours, per list and column, at which their pull equals the usual derivative of the images.
/// Rotations are not pulled, since a quaternion and its negative are the same rotation.
const DIFFERENCES: [Element; 4] =
    [[5e-3, 5e-3, 5e-3, f32::INFINITY], [0.7, 0.7, 0.7, 1.0], [f32::INFINITY; 4], [0.7, 0.7, 0.7, f32::INFINITY]];
/// Factor on the derivatives of colours of higher orders than zero.
const HIGHER: f32 = 0.05;

/// Multiplier of the round in the seed of its order, which separates the rounds of consecutive seeds.
const ROUND_SEED: u64 = 0x9e37_79b9_7f4a_7c15;

/// Settings of a fit.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSettings {
    /// Seed of the order of images.
    pub seed: u64,
    /// Weights of the error's terms.
    pub weights: ErrorWeights,
    /// Rate of offsets at the start and at the end, metres. All rates fall geometrically in between.
    pub offset_rate_m: [f32; 2],
    /// Rate of logarithms of scales.
    pub scale_rate: [f32; 2],
    /// Rate of logits of opacities.
    pub opacity_rate: [f32; 2],
    /// Rate of quaternions.
    pub rotation_rate: [f32; 2],
    /// Rate of colour coefficients.
    pub color_rate: [f32; 2],
    /// Strength of the pull between neighbours; 0 for none. At 1 the pull equals the usual derivative of the images
    /// where an offset differs by 5 mm from the neighbours', a scale by a factor of two, a colour by a fifth of the
    /// range.
    pub pull: f32,
    /// Whether the room's light is learned.
    pub light: bool,
    /// Whether each frame's pose is corrected during the fit.
    pub refine_poses: bool,
    /// Whether the skin weights are corrected during the fit.
    pub skin_correction: bool,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            weights: ErrorWeights::default(),
            offset_rate_m: [2e-4, 2e-5],
            scale_rate: [1e-2, 2e-3],
            opacity_rate: [2e-2, 5e-3],
            rotation_rate: [5e-3, 1e-3],
            color_rate: [1e-2, 1e-3],
            pull: 5.0,
            light: true,
            refine_poses: false,
            skin_correction: false,
        }
    }
}

/// Person at one instant of the take.
#[derive(Debug, Clone)]
pub struct TrainingFrame {
    /// Pose of the skeleton.
    pub pose: Pose,
    /// Translations of the graph's nodes, canonical metres; empty without a graph.
    pub translations: Vec<DVec3>,
}

/// Result of one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Weighted error of the step's image.
    pub loss: f64,
    /// PSNR of the step's image, decibels.
    pub decibels: f64,
}

/// Rendered image and its derivatives, of one size, on the adapter.
#[derive(Debug)]
struct Targets {
    rendered: RenderTarget,
    slopes: ImageGradients,
}

impl Targets {
    fn new(gpu: &GpuContext, [width, height]: [u32; 2]) -> Result<Self, AvatarError> {
        let rendered = RenderTarget::new(gpu, width, height)?;
        Ok(Self { rendered, slopes: ImageGradients::zeroed(gpu, width, height)? })
    }
}

/// Fit of an avatar to the images of its take.
#[derive(Debug)]
pub struct Fit {
    gpu: GpuContext,
    settings: FitSettings,
    frames: Vec<TrainingFrame>,
    views: Vec<TrainingView>,
    rasterizer: Rasterizer,
    backward: BackwardRasterizer,
    buffers: AvatarBuffers,
    gradients: AnisotropicGradients,
    targets: BTreeMap<[u32; 2], Targets>,
    posed: PosedAvatar,
    pub(crate) moments: [Adam; 4],
    pub(crate) light: LightFit,
    /// `None` where poses are not corrected.
    pub(crate) poses: Option<PoseFit>,
    /// `None` where skin weights are not corrected.
    pub(crate) skin: Option<SkinFit>,
    neighbors: Neighbors,
    /// Networks that predict the lists; `None` where the lists themselves are learned.
    pub(crate) local: Option<Local>,
    pub(crate) step: u64,
    /// Views in the order of a round, and the round's number.
    round: (Vec<usize>, u64),
}

impl Fit {
    /// Prepares the fit of an avatar to the images of its take.
    ///
    /// # Errors
    /// [`AvatarError::Images`] without an image, or for an image of a missing frame; [`AvatarError::Gpu`].
    pub fn new(
        gpu: &GpuContext,
        avatar: &Avatar,
        frames: Vec<TrainingFrame>,
        views: Vec<TrainingView>,
        settings: FitSettings,
    ) -> Result<Self, AvatarError> {
        if views.is_empty() {
            return Err(AvatarError::Images("no person is in any image; check masks, cameras and frames".to_owned()));
        }
        if views.iter().any(|view| view.frame >= frames.len()) {
            return Err(AvatarError::Images("an image is of a frame without a pose".to_owned()));
        }
        let (count, order) = (avatar.gaussians(), avatar.parameters.order());
        let mut targets = BTreeMap::new();
        for view in &views {
            if let Entry::Vacant(entry) = targets.entry(view.size()) {
                entry.insert(Targets::new(gpu, view.size())?);
            }
        }
        Ok(Self {
            gpu: gpu.clone(),
            rasterizer: Rasterizer::new(gpu, count)?,
            backward: BackwardRasterizer::new(gpu)?,
            buffers: AvatarBuffers::new(gpu, avatar)?,
            gradients: AnisotropicGradients::zeroed(gpu, count, order)?,
            targets,
            posed: PosedAvatar::default(),
            light: LightFit::new(),
            poses: settings.refine_poses.then(|| PoseFit::new(frames.len(), avatar.template.skeleton.joints().len())),
            skin: settings.skin_correction.then(|| SkinFit::new(&avatar.skin)),
            moments: avatar.parameters.lists().map(|list| Adam::new(list.len())),
            neighbors: Neighbors::new(&avatar.places),
            local: None,
            step: 0,
            round: (Vec::new(), 0),
            settings,
            frames,
            views,
        })
    }

    /// Replaces the avatar's lists by outputs of local networks, which are learned instead, and returns the number of
    /// their parameters. The lists keep their values, except for colours, which are looked up in an atlas. Lists
    /// without a network in the settings are learned directly. `uvs` are the Gaussians' texture coordinates; empty
    /// without any.
    ///
    /// # Errors
    /// [`AvatarError::Images`] for an atlas by texture coordinates without texture coordinates.
    pub fn use_networks(
        &mut self,
        avatar: &mut Avatar,
        uvs: &[Vec2],
        settings: &LocalSettings,
    ) -> Result<usize, AvatarError> {
        let mut local = Local::new(avatar, uvs, settings, self.settings.seed)?;
        local.evaluate(&mut avatar.parameters);
        let numbers = local.numbers();
        self.local = Some(local);
        Ok(numbers)
    }

    /// Returns the number of images.
    #[must_use]
    pub fn images(&self) -> usize {
        self.views.len()
    }

    /// Returns the corrected pose of a frame; `None` for a missing frame.
    #[must_use]
    pub fn pose(&self, frame: usize) -> Option<Pose> {
        let pose = &self.frames.get(frame)?.pose;
        Some(self.poses.as_ref().map_or_else(|| pose.clone(), |poses| poses.corrected(frame, pose)))
    }

    /// Descends by one step on the next image; `progress` in 0..=1 is the completed share of all steps.
    ///
    /// # Errors
    /// [`AvatarError::Gpu`], [`AvatarError::Backward`].
    pub fn step(&mut self, avatar: &mut Avatar, progress: f32) -> Result<StepReport, AvatarError> {
        let index = self.next_view();
        let (error, bones) = self.draw(avatar, index)?;
        let view = &self.views[index];
        let Some(Targets { rendered, slopes }) = self.targets.get(&view.size()) else {
            return Err(AvatarError::Images("an image has no target".to_owned()));
        };
        slopes.color.write(&self.gpu, &error.slope);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.gradients.clear(&mut encoder);
        self.backward.encode_anisotropic(
            &self.gpu,
            &mut encoder,
            &self.rasterizer,
            &self.buffers.gaussians,
            rendered,
            slopes,
            &self.gradients,
        )?;
        self.gpu.queue.submit([encoder.finish()]);
        let mut found = read_all(&self.gpu, &self.gradients.attributes())?;
        self.step += 1;
        if let [centers, scales, rotations, _] = found.as_mut_slice() {
            if let Some(poses) = &mut self.poses {
                let slopes = avatar.bone_slopes(&bones, &self.posed, centers, rotations);
                let pose = (&avatar.template.skeleton, &self.frames[view.frame].pose);
                poses.descend(view.frame, pose, &slopes, self.step, progress);
            }
            if let Some(skin) = &mut self.skin {
                let mut slopes = avatar.weight_slopes(&bones, &self.posed, centers, rotations);
                skin.descend(&mut slopes, &self.neighbors, self.step, progress);
                skin.bake(&mut avatar.skin);
            }
            self.posed.to_parameters([centers, scales, rotations]);
        }
        if let Some(colors) = found.last_mut().filter(|_| self.settings.light) {
            let slopes = self.posed.to_light(avatar, colors);
            self.light.descend(&mut avatar.light, &slopes, self.step, progress);
        }
        let rates = self.rates(progress);
        let coefficients = avatar.parameters.order().coefficients();
        for (list, values) in avatar.parameters.lists_mut().into_iter().enumerate() {
            if let Some(slopes) = found.get_mut(list) {
                if list == 3 {
                    slow_down(slopes, coefficients);
                }
                let usual = self.moments[list].usual();
                let weights = std::array::from_fn(|k| self.settings.pull * usual[k].sqrt() / DIFFERENCES[list][k]);
                let stride = if list == 3 { coefficients } else { 1 };
                self.neighbors.pull(values, slopes, stride, weights);
                // Networks move the lists themselves; the usual size of the derivatives is wanted all the same.
                let is_predicted = self.local.as_ref().is_some_and(|local| local.predicts(list));
                let rates = if is_predicted { [0.0; 4] } else { rates[list] };
                self.moments[list].descend(self.step, rates, values, slopes);
            }
        }
        if let Some(local) = &mut self.local {
            local.descend(&found, progress);
            local.refresh(&avatar.parameters);
            local.evaluate(&mut avatar.parameters);
        }
        Ok(StepReport { loss: error.loss, decibels: -10.0 * error.squared.max(1e-10).log10() })
    }

    /// Returns the view of the next step. Rounds are shuffled by their number, so that a fit that resumes from a checkpoint sees the same
    /// views.
    fn next_view(&mut self) -> usize {
        let count = self.views.len().max(1) as u64;
        let (number, at) = (self.step / count, (self.step % count) as usize);
        if self.round.0.is_empty() || self.round.1 != number {
            let mut order: Vec<usize> = (0..self.views.len()).collect();
            let seed = self.settings.seed.wrapping_add(number.wrapping_mul(ROUND_SEED));
            order.shuffle(&mut StdRng::seed_from_u64(seed));
            self.round = (order, number);
        }
        self.round.0[at]
    }

    /// Computes the mean PSNR of the avatar over all images, decibels of the mean squared error.
    ///
    /// # Errors
    /// [`AvatarError::Gpu`].
    pub fn decibels(&mut self, avatar: &Avatar) -> Result<f64, AvatarError> {
        let mut sum = 0.0;
        for view in 0..self.views.len() {
            sum += self.draw(avatar, view)?.0.squared;
        }
        Ok(-10.0 * (sum / self.views.len().max(1) as f64).max(1e-10).log10())
    }

    /// Returns the rates of all lists and columns.
    fn rates(&self, progress: f32) -> [Element; 4] {
        let rate = |[from, to]: [f32; 2]| from * (to / from).powf(progress.clamp(0.0, 1.0));
        let FitSettings { offset_rate_m, scale_rate, opacity_rate, rotation_rate, color_rate, .. } = &self.settings;
        let scale = rate(*scale_rate);
        [
            [rate(*offset_rate_m); 4],
            [scale, scale, scale, rate(*opacity_rate)],
            [rate(*rotation_rate); 4],
            [rate(*color_rate); 4],
        ]
    }

    /// Renders a view and compares it with its image. Returns the bones as well.
    fn draw(&mut self, avatar: &Avatar, view: usize) -> Result<(ImageDifference, Bones), AvatarError> {
        let view = &self.views[view];
        let frame = &self.frames[view.frame];
        let pose = self.pose(view.frame).unwrap_or_else(|| frame.pose.clone());
        let bones = Bones::new(&avatar.template.skeleton, &pose);
        let translations = (!frame.translations.is_empty()).then_some(frame.translations.as_slice());
        avatar.pose(&bones, translations, &mut self.posed);
        self.buffers.pose(&self.gpu, &self.posed);
        let size = view.size();
        let Targets { rendered, .. } = match self.targets.entry(size) {
            Entry::Occupied(entry) => entry.into_mut(),
            Entry::Vacant(entry) => entry.insert(Targets::new(&self.gpu, size)?),
        };
        let settings =
            RasterSettings { outputs: Outputs { canonical: false, ..Outputs::ALL }, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, &self.buffers.gaussians, &view.camera, &settings, rendered)?;
        self.gpu.queue.submit([encoder.finish()]);
        let pixels = rendered.color.read(&self.gpu)?;
        let difference = ImageDifference::of(&pixels, view.photograph(), size[0] as usize, &self.settings.weights);
        Ok((difference, bones))
    }
}

/// Scales the derivatives of higher coefficients down. Adam's steps depend on the relative size of derivatives alone.
fn slow_down(slopes: &mut [Element], coefficients: usize) {
    if coefficients == HarmonicOrder::Zero.coefficients() {
        return;
    }
    for rows in slopes.chunks_mut(coefficients) {
        rows.iter_mut().skip(1).flatten().for_each(|slope| *slope *= HIGHER);
    }
}
