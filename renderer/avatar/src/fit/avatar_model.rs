//! Avatar whose lists, light, poses and skin weights are moved by the derivatives of images.

use flyrig_fit::{Element, Model, Neighbors, Step};
use flyrig_learn::ColumnAdam;
use flyrig_renderer::HarmonicOrder;
use flyrig_types::Pose;
use glam::{DVec3, Vec2, Vec3};

use crate::error::AvatarError;
use crate::fit::node_fit::NodeFit;
use crate::fit::pose_fit::PoseFit;
use crate::fit::skin_fit::SkinFit;
use crate::local::networks::{Local, LocalSettings};
use crate::model::avatar::Avatar;
use crate::model::light::LightFit;
use crate::model::posing::{Bones, PosedAvatar};

/// Difference to the neighbours, per list and column, at which their pull equals the usual derivative of the images.
/// Rotations are not pulled, since a quaternion and its negative are the same rotation.
const DIFFERENCES: [Element; 4] =
    [[5e-3, 5e-3, 5e-3, f32::INFINITY], [0.7, 0.7, 0.7, 1.0], [f32::INFINITY; 4], [0.7, 0.7, 0.7, f32::INFINITY]];
/// Factor on the derivatives of colours of higher orders than zero.
const HIGHER: f32 = 0.05;

/// Rates and options of an avatar's fit. Rates are given at the start and at the end, and fall geometrically in between.
#[derive(Debug, Clone, PartialEq)]
pub struct AvatarFitSettings {
    /// Rate of offsets, metres.
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
    /// Whether each frame's node translations are corrected during the fit; only where every frame has them.
    pub refine_nodes: bool,
}

impl Default for AvatarFitSettings {
    fn default() -> Self {
        Self {
            offset_rate_m: [2e-4, 2e-5],
            scale_rate: [1e-2, 2e-3],
            opacity_rate: [2e-2, 5e-3],
            rotation_rate: [5e-3, 1e-3],
            color_rate: [1e-2, 1e-3],
            pull: 5.0,
            light: true,
            refine_poses: false,
            skin_correction: false,
            refine_nodes: false,
        }
    }
}

impl AvatarFitSettings {
    /// Returns the rates of all lists and columns.
    fn rates(&self, progress: f32) -> [Element; 4] {
        let rate = |[from, to]: [f32; 2]| from * (to / from).powf(progress.clamp(0.0, 1.0));
        let scale = rate(self.scale_rate);
        [
            [rate(self.offset_rate_m); 4],
            [scale, scale, scale, rate(self.opacity_rate)],
            [rate(self.rotation_rate); 4],
            [rate(self.color_rate); 4],
        ]
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

/// Avatar as a model that [`flyrig_fit::Fit`] fits to the images of a take.
#[derive(Debug)]
pub struct AvatarModel {
    avatar: Avatar,
    settings: AvatarFitSettings,
    frames: Vec<TrainingFrame>,
    posed: PosedAvatar,
    /// Scales and opacities of the Gaussians as the image's camera sees them.
    facing: Vec<Element>,
    /// Bones of the frame that the Gaussians were placed in last.
    bones: Option<Bones>,
    moments: [ColumnAdam<4>; 4],
    light: LightFit,
    /// `None` where poses are not corrected.
    poses: Option<PoseFit>,
    /// `None` where skin weights are not corrected.
    skin: Option<SkinFit>,
    /// `None` where node translations are not corrected.
    nodes: Option<NodeFit>,
    neighbors: Neighbors,
    /// Networks that predict the lists; `None` where the lists themselves are learned.
    local: Option<Local>,
}

impl AvatarModel {
    /// Prepares the fit of an avatar in the frames of its take.
    #[must_use]
    pub fn new(avatar: Avatar, frames: Vec<TrainingFrame>, settings: AvatarFitSettings) -> Self {
        let joints = avatar.template.skeleton.joints().len();
        Self {
            posed: PosedAvatar::default(),
            facing: Vec::new(),
            bones: None,
            moments: avatar.parameters.lists().map(|list| ColumnAdam::new(list.len())),
            light: LightFit::new(),
            poses: settings.refine_poses.then(|| PoseFit::new(frames.len(), joints)),
            skin: settings.skin_correction.then(|| SkinFit::new(&avatar.skin)),
            nodes: avatar
                .hanging
                .as_ref()
                .filter(|hanging| {
                    let has_all = |frame: &TrainingFrame| frame.translations.len() == hanging.nodes.len();
                    settings.refine_nodes && frames.iter().all(has_all)
                })
                .map(|hanging| NodeFit::new(frames.len(), &hanging.nodes)),
            neighbors: Neighbors::new(&avatar.places),
            local: None,
            avatar,
            settings,
            frames,
        }
    }

    /// Replaces the avatar's lists by outputs of local networks, which are learned instead, and returns the number of
    /// their parameters. The lists keep their values, except for colours, which are looked up in an atlas. Lists
    /// without a network in the settings are learned directly. `uvs` are the Gaussians' texture coordinates, empty
    /// without any; `seed` draws the first parameters.
    ///
    /// # Errors
    /// [`AvatarError::Networks`] for an atlas by texture coordinates without texture coordinates.
    pub fn use_networks(&mut self, uvs: &[Vec2], settings: &LocalSettings, seed: u64) -> Result<usize, AvatarError> {
        let mut local = Local::new(&self.avatar, uvs, settings, seed)?;
        local.evaluate(&mut self.avatar.parameters);
        let numbers = local.numbers();
        self.local = Some(local);
        Ok(numbers)
    }

    /// Returns the avatar.
    #[must_use]
    pub fn avatar(&self) -> &Avatar {
        &self.avatar
    }

    /// Returns the avatar as it is after the last step.
    #[must_use]
    pub fn into_avatar(self) -> Avatar {
        self.avatar
    }

    /// Returns the avatar as it is after the last step, and the frames with their corrections. The mean of corrected node translations
    /// becomes the avatar's.
    #[must_use]
    pub fn into_parts(mut self) -> (Avatar, Vec<TrainingFrame>) {
        let corrected = |(at, frame): (usize, &TrainingFrame)| TrainingFrame {
            pose: self.pose(at).unwrap_or_else(|| frame.pose.clone()),
            translations: self.translations(at),
        };
        let frames: Vec<TrainingFrame> = self.frames.iter().enumerate().map(corrected).collect();
        if self.nodes.is_some() {
            self.avatar.set_mean(frames.iter().map(|frame| frame.translations.as_slice()));
        }
        (self.avatar, frames)
    }

    /// Returns the corrected node translations of a frame; empty without a graph.
    fn translations(&self, frame: usize) -> Vec<DVec3> {
        let own = self.frames.get(frame).map_or(&[][..], |frame| &frame.translations);
        self.nodes.as_ref().map_or_else(|| own.to_vec(), |nodes| nodes.corrected(frame, own))
    }

    /// Returns the corrected pose of a frame; `None` for a missing frame.
    #[must_use]
    pub fn pose(&self, frame: usize) -> Option<Pose> {
        let pose = &self.frames.get(frame)?.pose;
        Some(self.poses.as_ref().map_or_else(|| pose.clone(), |poses| poses.corrected(frame, pose)))
    }

    /// Moves poses, skin weights and light, and turns the derivatives into those of the avatar's lists.
    fn descend_shared(&mut self, frame: usize, slopes: &mut [Vec<Element>], step: Step) {
        let Step { count, progress } = step;
        if let ([centers, scales, rotations, _], Some(bones)) = (&mut *slopes, &self.bones) {
            if let Some(poses) = &mut self.poses {
                let slopes = self.avatar.bone_slopes(bones, &self.posed, centers, rotations);
                let pose = (&self.avatar.template.skeleton, &self.frames[frame].pose);
                poses.descend(frame, pose, &slopes, count, progress);
            }
            if let Some(skin) = &mut self.skin {
                let mut slopes = self.avatar.weight_slopes(bones, &self.posed, centers, rotations);
                skin.descend(&mut slopes, &self.neighbors, count, progress);
                skin.bake(&mut self.avatar.skin);
            }
            self.posed.to_parameters([centers, scales, rotations]);
            if let (Some(nodes), Some(hanging)) = (&mut self.nodes, &self.avatar.hanging) {
                let of = (hanging.gaussian_nodes.as_slice(), hanging.gaussian_weights.as_slice());
                nodes.descend(frame, centers, of, count, progress);
            }
        }
        if let Some(colors) = slopes.last_mut().filter(|_| self.settings.light) {
            let slopes = self.posed.to_light(&self.avatar, colors);
            self.light.descend(&mut self.avatar.light, &slopes, count, progress);
        }
    }
}

impl Model for AvatarModel {
    fn gaussians(&self) -> usize {
        self.avatar.gaussians()
    }

    fn order(&self) -> HarmonicOrder {
        self.avatar.parameters.order()
    }

    fn frames(&self) -> usize {
        self.frames.len()
    }

    fn place(&mut self, frame: usize, eye: Vec3) -> [&[Element]; 4] {
        if let Some(pose) = self.pose(frame) {
            let translations = self.translations(frame);
            let bones = Bones::new(&self.avatar.template.skeleton, &pose);
            let translations = (!translations.is_empty()).then_some(translations.as_slice());
            self.avatar.pose(&bones, translations, &mut self.posed);
            self.bones = Some(bones);
        }
        // As avatars are drawn.
        self.posed.facing(eye, &mut self.facing);
        let PosedAvatar { center, rotation, harmonics, .. } = &self.posed;
        [center, &self.facing, rotation, harmonics]
    }

    fn below_surface_m(&self) -> f32 {
        self.posed.below_surface_m()
    }

    fn descend(&mut self, frame: usize, slopes: &mut [Vec<Element>], step: Step) {
        self.descend_shared(frame, slopes, step);
        let rates = self.settings.rates(step.progress);
        let coefficients = self.avatar.parameters.order().coefficients();
        for (list, values) in self.avatar.parameters.lists_mut().into_iter().enumerate() {
            if let Some(slopes) = slopes.get_mut(list) {
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
                self.moments[list].descend(step.count, rates, values, slopes);
            }
        }
        if let Some(local) = &mut self.local {
            local.descend(slopes, step.progress);
            local.refresh(&self.avatar.parameters);
            local.evaluate(&mut self.avatar.parameters);
        }
    }

    fn state(&mut self) -> Vec<(String, &mut [f32])> {
        let mut all = Vec::new();
        for (number, list) in self.avatar.parameters.lists_mut().into_iter().enumerate() {
            all.push((format!("list.{number}"), list.as_flattened_mut()));
        }
        all.push(("light".to_owned(), self.avatar.light.terms.as_flattened_mut()));
        for (number, moment) in self.light.moments.iter_mut().enumerate() {
            all.push((format!("light.{number}"), moment.as_mut_slice()));
        }
        if let Some(poses) = &mut self.poses {
            all.push(("poses".to_owned(), poses.corrections.as_mut_slice()));
            all.push(("poses.squares".to_owned(), poses.squares.as_mut_slice()));
        }
        if let Some(nodes) = &mut self.nodes {
            all.push(("nodes".to_owned(), nodes.corrections.as_flattened_mut()));
            all.push(("nodes.squares".to_owned(), nodes.squares.as_mut_slice()));
        }
        if let Some(skin) = &mut self.skin {
            all.push(("skin".to_owned(), skin.factors.as_flattened_mut()));
            for (k, list) in skin.adam.lists_mut().into_iter().enumerate() {
                all.push((format!("skin.adam.{k}"), list.as_flattened_mut()));
            }
        }
        for (number, adam) in self.moments.iter_mut().enumerate() {
            for (k, list) in adam.lists_mut().into_iter().enumerate() {
                all.push((format!("adam.{k}.{number}"), list.as_flattened_mut()));
            }
        }
        all.extend(self.local.iter_mut().flat_map(|local| local.state()));
        all
    }

    fn restore(&mut self, count: u64) {
        if let Some(skin) = &self.skin {
            skin.bake(&mut self.avatar.skin);
        }
        if let Some(local) = &mut self.local {
            local.resume(count, &mut self.avatar.parameters);
        }
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
