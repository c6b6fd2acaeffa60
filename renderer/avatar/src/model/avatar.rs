//! Avatar: body, Gaussians, and their provenance.

use flyrig_body::{DeformationGraph, SkinWeights, SurfaceGaussians, Template};
use flyrig_renderer::{HarmonicOrder, SH_DEGREE_0};
use flyrig_types::Pose;
use glam::{DQuat, DVec3, Quat, Vec3};
use serde::{Deserialize, Serialize};

use crate::error::AvatarError;
use crate::model::known_poses::KnownPoses;
use crate::model::light::Light;
use crate::model::parameters::GaussianParameters;

/// Initial thickness of a Gaussian across the surface, relative to its size along it.
const THICKNESS: f32 = 0.5;
/// Initial opacity.
const OPACITY: f32 = 0.99;

/// Provenance of an avatar: its take and how it was fitted. Stored in the file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Card {
    /// Name of the person or take.
    pub name: String,
    /// Method of the fit.
    pub method: String,
    /// Cameras whose images were used.
    pub cameras: Vec<String>,
    /// Range of frames, end excluded.
    pub frames: [u64; 2],
    /// Origin of the poses: given or estimated.
    pub pose: String,
    /// Origin of the masks: given or estimated.
    pub masks: String,
    /// Steps of gradient descent.
    pub steps: u64,
    /// Seed of the order of images.
    pub seed: u64,
    /// Mean PSNR of the training images at the end, decibels.
    pub training_db: f64,
    /// Later edits of texture and shape, in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub edits: Vec<String>,
}

/// Attachment of the Gaussians to a deformation graph.
#[derive(Debug, Clone, PartialEq)]
pub struct Hanging {
    /// Canonical positions of the nodes, metres.
    pub nodes: Vec<Vec3>,
    /// Nodes of each Gaussian.
    pub gaussian_nodes: Vec<[u32; 4]>,
    /// Weights of these nodes.
    pub gaussian_weights: Vec<[f32; 4]>,
    /// Mean translation of each node over the take, canonical metres: the shape of hair and clothes where the avatar is
    /// driven by a pose alone.
    pub mean: Vec<DVec3>,
}

/// Attachment of a Gaussian to the template's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attachment {
    /// Index of the template's triangle.
    pub triangle: u32,
    /// Weights of the triangle's corners, sum 1.
    pub barycentric: [f32; 3],
}

impl Attachment {
    /// Interpolates values of the template's vertices.
    pub(crate) fn blend(&self, template: &Template, values: &[Vec3]) -> Vec3 {
        template.triangles[self.triangle as usize]
            .iter()
            .zip(self.barycentric)
            .map(|(&corner, weight)| values[corner as usize] * weight)
            .sum()
    }
}

/// Personal avatar. All lists of Gaussians have the same length.
///
/// # Examples
/// ```
/// use flyrig_avatar::{Avatar, Bones, PosedAvatar};
/// use flyrig_body::{ShapeParams, default_template, sample_surface};
/// use flyrig_renderer::HarmonicOrder;
///
/// let template = default_template(&ShapeParams::default())?;
/// let surface = sample_surface(&template, 500, 1)?;
/// let avatar = Avatar::new(&template, &surface, None, &[], HarmonicOrder::Zero)?;
///
/// // The file restores the same avatar.
/// assert!(Avatar::from_bytes(&avatar.to_bytes()?)? == avatar);
///
/// // Pose it.
/// let mut pose = template.skeleton.rest_pose();
/// pose.root_translation.x += 1.0;
/// let mut posed = PosedAvatar::default();
/// avatar.pose(&Bones::new(&template.skeleton, &pose), None, &mut posed);
/// assert_eq!(posed.center.len(), surface.len());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Avatar {
    /// Body, clothes included.
    pub template: Template,
    /// Body without the skirt or coat that has a surface of its own, nor shoes, in the same canonical space; `None` without one, and in files of earlier versions.
    pub undressed: Option<Template>,
    /// Canonical positions of the Gaussians on the body, metres.
    pub places: Vec<Vec3>,
    /// Attachment to the body's surface; inset Gaussians lie below it.
    pub attachments: Vec<Attachment>,
    /// Skin weights of each Gaussian.
    pub skin: Vec<SkinWeights>,
    /// Attachment to a deformation graph; `None` without one.
    pub hanging: Option<Hanging>,
    /// Poses seen in the take.
    pub known_poses: KnownPoses,
    /// Fitted attributes of the Gaussians.
    pub parameters: GaussianParameters,
    /// Light of the take's room.
    pub light: Light,
    /// Provenance.
    pub card: Card,
}

impl Avatar {
    /// Creates an avatar with the look of the live reconstruction: `surface` has the Gaussians of `template`, `graph`
    /// deforms them, `colors` are linear RGB, one value per Gaussian (grey where missing).
    ///
    /// # Errors
    /// [`AvatarError::Body`] where template and lists do not belong together.
    pub fn new(
        template: &Template,
        surface: &SurfaceGaussians,
        graph: Option<&DeformationGraph>,
        colors: &[[f32; 3]],
        order: HarmonicOrder,
    ) -> Result<Self, AvatarError> {
        template.check()?;
        let count = surface.len();
        let mut parameters = GaussianParameters::zeroed(count, order);
        let logit = (OPACITY / (1.0 - OPACITY)).ln();
        for i in 0..count {
            let scale = surface.scale_m[i].max(1e-4).ln();
            parameters.shape[i] = [scale, scale, scale + THICKNESS.ln(), logit];
            parameters.rotation[i] =
                Quat::from_rotation_arc(Vec3::Z, surface.normals[i].normalize_or(Vec3::Z)).to_array();
            let [r, g, b] = colors.get(i).copied().unwrap_or([0.2; 3]).map(|value| value / SH_DEGREE_0);
            parameters.harmonics[i * order.coefficients()] = [r, g, b, 0.0];
        }
        let hanging = graph.map(|graph| Hanging {
            nodes: graph.nodes.clone(),
            gaussian_nodes: graph.gaussian_nodes.clone(),
            gaussian_weights: graph.gaussian_weights.clone(),
            mean: vec![DVec3::ZERO; graph.nodes.len()],
        });
        Ok(Self {
            template: template.clone(),
            undressed: None,
            places: surface.positions.clone(),
            attachments: surface
                .triangle
                .iter()
                .zip(&surface.barycentric)
                .map(|(&triangle, &barycentric)| Attachment { triangle, barycentric })
                .collect(),
            skin: surface.skin.clone(),
            hanging,
            known_poses: KnownPoses::default(),
            parameters,
            light: Light::default(),
            card: Card::default(),
        })
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.places.len()
    }

    /// Returns the canonical unit normal of the body's surface at each Gaussian.
    #[must_use]
    pub fn normals(&self) -> Vec<Vec3> {
        let normals = &self.template.normals;
        self.attachments
            .iter()
            .map(|attachment| attachment.blend(&self.template, normals).normalize_or(Vec3::Y))
            .collect()
    }

    /// Returns the share of the Gaussians in a pose unlike those of the take, see [`KnownPoses::far_share`].
    #[must_use]
    pub fn far_share(&self, pose: &Pose) -> f64 {
        self.known_poses.far_share(&self.template.skeleton, &self.skin, pose)
    }

    /// Sets the mean shape to the mean of these node translations, one list per frame.
    pub fn set_mean<'a>(&mut self, frames: impl IntoIterator<Item = &'a [DVec3]>) {
        let Some(hanging) = &mut self.hanging else { return };
        let (mut sum, mut count) = (vec![DVec3::ZERO; hanging.nodes.len()], 0);
        for frame in frames.into_iter().filter(|frame| frame.len() == hanging.nodes.len()) {
            sum.iter_mut().zip(frame).for_each(|(sum, translation)| *sum += *translation);
            count += 1;
        }
        hanging.mean = sum.iter().map(|sum| *sum / f64::from(count.max(1))).collect();
    }

    /// Checks that all lists belong together and every number is finite.
    pub(crate) fn check(&self) -> Result<(), String> {
        self.template.check().map_err(|error| error.to_string())?;
        if let Some(body) = &self.undressed {
            let checked = body.check().and_then(|()| self.template.check_same_joints(body));
            checked.map_err(|error| format!("the body below its clothes does not fit: {error}"))?;
        }
        let count = self.places.len();
        if count == 0 || self.skin.len() != count || self.parameters.len() != count {
            return Err(format!("lists of {count}, {} and {} Gaussians", self.skin.len(), self.parameters.len()));
        }
        let hangs = |attachment: &Attachment| {
            (attachment.triangle as usize) < self.template.triangles.len()
                && attachment.barycentric.iter().all(|weight| (-0.01..=1.01).contains(weight))
        };
        if self.attachments.len() != count || !self.attachments.iter().all(hangs) {
            return Err("its Gaussians do not hang on its body".to_owned());
        }
        if let Some(hanging) = &self.hanging {
            let nodes = hanging.nodes.len();
            let known = hanging.gaussian_nodes.iter().flatten().all(|node| (*node as usize) < nodes);
            if hanging.gaussian_nodes.len() != count
                || hanging.gaussian_weights.len() != count
                || hanging.mean.len() != nodes
                || !known
            {
                return Err("its deformation graph is of another avatar".to_owned());
            }
        }
        let joints = self.template.skeleton.joints().len();
        let is_pose = |frame: &Vec<DQuat>| frame.len() == joints && frame.iter().all(|turn| turn.is_finite());
        if !self.known_poses.0.iter().all(is_pose) {
            return Err("the poses of its take are of another body".to_owned());
        }
        let is_lit = self.light.terms.as_flattened().iter().all(|term| term.is_finite());
        let is_finite = is_lit && self.places.iter().all(|place| place.is_finite()) && self.parameters.is_finite();
        if is_finite { Ok(()) } else { Err("it holds numbers that are not finite".to_owned()) }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use flyrig_body::{DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, sample_surface};
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    /// Creates an avatar of the built-in body with random attributes.
    pub(crate) fn small(gaussians: usize, nodes: usize) -> Avatar {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, gaussians, 5).unwrap();
        let graph = build_graph(&template, &surface, nodes, DEFAULT_SIGMA2_M2).unwrap();
        let mut avatar = Avatar::new(&template, &surface, Some(&graph), &[], HarmonicOrder::One).unwrap();
        let mut random = StdRng::seed_from_u64(9);
        for list in avatar.parameters.lists_mut() {
            list.iter_mut().flatten().for_each(|value| *value += random.random_range(-0.01f32..0.01));
        }
        avatar
    }

    pub(crate) fn random_pose(avatar: &Avatar, seed: u64) -> (Pose, Vec<DVec3>) {
        let mut random = StdRng::seed_from_u64(seed);
        let mut pose = avatar.template.skeleton.rest_pose();
        pose.root_translation = DVec3::new(0.3, -1.0, 2.0);
        for rotation in &mut pose.joint_rotations {
            let axis = DVec3::new(random.random(), random.random(), random.random()).normalize();
            *rotation *= DQuat::from_axis_angle(axis, random.random_range(-0.5..0.5));
        }
        let nodes = avatar.hanging.as_ref().map_or(0, |hanging| hanging.nodes.len());
        let translations = (0..nodes).map(|_| DVec3::new(random.random(), random.random(), random.random()) * 0.02);
        (pose, translations.collect())
    }

    #[test]
    fn lists_that_do_not_belong_together_are_named() {
        let avatar = small(40, 7);
        avatar.check().unwrap();
        let with = |change: &dyn Fn(&mut Avatar)| {
            let mut changed = avatar.clone();
            change(&mut changed);
            changed.check().unwrap_err()
        };
        assert!(with(&|avatar| avatar.skin.truncate(9)).contains("lists of"));
        let bodiless =
            |avatar: &mut Avatar| avatar.undressed = Some(Template { skin: Vec::new(), ..avatar.template.clone() });
        assert!(with(&bodiless).contains("below its clothes"));
        assert!(with(&|avatar| avatar.hanging.as_mut().unwrap().gaussian_nodes[3][1] = 7).contains("graph"));
        assert!(with(&|avatar| avatar.attachments[3].triangle = u32::MAX).contains("hang"));
        assert!(with(&|avatar| avatar.attachments[3].barycentric[1] = f32::NAN).contains("hang"));
        assert!(with(&|avatar| avatar.parameters.shape[3][1] = f32::NAN).contains("not finite"));
        assert!(with(&|avatar| avatar.template.triangles[0][0] = u32::MAX).contains("triangle"));
        assert_eq!(
            GaussianParameters::from_lists([
                vec![[0.0; 4]; 3],
                vec![[0.0; 4]; 3],
                vec![[0.0; 4]; 3],
                vec![[0.0; 4]; 13]
            ]),
            None
        );
    }

    #[test]
    fn the_mean_is_that_of_the_frames() {
        let mut avatar = small(40, 2);
        let frames = [[DVec3::X, DVec3::ZERO], [DVec3::Y, DVec3::Z]];
        avatar.set_mean(frames.iter().map(<[DVec3; 2]>::as_slice).chain([&[DVec3::X][..]]));
        assert_eq!(avatar.hanging.as_ref().unwrap().mean, [DVec3::new(0.5, 0.5, 0.0), DVec3::Z * 0.5]);
    }
}
