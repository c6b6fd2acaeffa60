//! One frame of the person stream, read back from the GPU before it is encoded.
//!
//! A frame holds the person's pose, the canonical translations of the deformation graph's nodes and the Gaussians' colours. Viewers have
//! the template already and skin it themselves. Where the template holds the colours, a frame is a pose alone.

use std::sync::Arc;

use flyrig_body::{DeformationGraph, Joint, Skeleton, SurfaceGaussians};
use flyrig_stream::{EncodedTemplate, Motion, StreamError, StreamJoint, TemplateSource};
use flyrig_types::Pose;
use glam::{DVec3, Vec3};

/// Converts a skeleton's joints to those of the stream.
#[must_use]
pub fn stream_joints(skeleton: &Skeleton) -> Vec<StreamJoint> {
    let joint = |joint: &Joint| StreamJoint {
        parent: joint.parent.map(|parent| parent as u16),
        translation: joint.rest_translation.as_vec3().to_array(),
        joint_from_canonical: [0, 1, 2].map(|row| joint.joint_from_canonical.row(row).as_vec4().to_array()),
    };
    skeleton.joints().iter().map(joint).collect()
}

/// Encodes a person's template: the skinned Gaussians of `surface`, and the graph that deforms them, if one does.
pub(crate) fn encode_template(
    surface: &SurfaceGaussians,
    graph: Option<&DeformationGraph>,
    skeleton: &Skeleton,
) -> Result<EncodedTemplate, StreamError> {
    let joints = stream_joints(skeleton);
    let center_scale: Vec<[f32; 4]> =
        surface.positions.iter().zip(&surface.scale_m).map(|(p, scale)| p.extend(*scale).to_array()).collect();
    let normals: Vec<[f32; 3]> = surface.normals.iter().map(Vec3::to_array).collect();
    let skin: Vec<_> = surface.skin.iter().map(|skin| (skin.joints.map(u32::from), skin.weights)).collect();
    let node_weights: Vec<_> = graph.map_or_else(Vec::new, |graph| {
        graph.gaussian_nodes.iter().copied().zip(graph.gaussian_weights.iter().copied()).collect()
    });
    let nodes: Vec<[f32; 3]> = graph.map_or_else(Vec::new, |graph| graph.nodes.iter().map(Vec3::to_array).collect());
    TemplateSource {
        joints: &joints,
        center_scale: &center_scale,
        normals: &normals,
        skin: &skin,
        node_weights: &node_weights,
        nodes: &nodes,
    }
    .encode()
}

/// Converts a pose and the nodes' canonical translations, metres, to the stream's motion, with an empty stamp.
pub(crate) fn motion(pose: &Pose, translations: &[DVec3]) -> Motion {
    Motion {
        root_translation: pose.root_translation.as_vec3().to_array(),
        joint_rotations: pose.joint_rotations.iter().map(|rotation| rotation.as_quat().to_array()).collect(),
        nodes: translations.iter().map(|translation| translation.as_vec3().to_array()).collect(),
        ..Motion::default()
    }
}

/// One person at one instant, before encoding.
#[derive(Debug)]
pub struct PersonFrame {
    pub(crate) template: Arc<EncodedTemplate>,
    pub(crate) motion: Motion,
    /// Linear RGB and opacity of each Gaussian; empty where the template has the colours.
    pub(crate) colors: Vec<[f32; 4]>,
}

impl PersonFrame {
    /// Builds the frame of an avatar, which a pose alone drives.
    pub(crate) fn of_pose(template: Arc<EncodedTemplate>, motion: &Motion) -> Self {
        Self { template, motion: Motion { nodes: Vec::new(), ..motion.clone() }, colors: Vec::new() }
    }

    /// Returns this pose for viewers that draw an avatar with the same joints.
    #[must_use]
    pub fn of_avatar(&self, avatar: &Arc<EncodedTemplate>) -> Self {
        Self::of_pose(Arc::clone(avatar), &self.motion)
    }

    /// Returns the person's template.
    #[must_use]
    pub fn template(&self) -> &EncodedTemplate {
        &self.template
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{
        DEFAULT_NODE_COUNT, DEFAULT_SIGMA2_M2, ShapeParams, build_graph, default_template, displacement,
        sample_surface, skin_point_f64,
    };
    use flyrig_stream::Posed;
    use glam::{DQuat, Vec3};

    use super::*;

    /// Viewers skin, displace and grow the Gaussians with code of their own; it must be the rig's formula.
    #[test]
    fn viewers_pose_and_grow_gaussians_as_the_rig_does() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 20_000, 1).unwrap();
        let graph = build_graph(&template, &surface, DEFAULT_NODE_COUNT, DEFAULT_SIGMA2_M2).unwrap();
        let wave = |k: usize| (k as f64 * 12.9898).sin();
        let mut pose = template.skeleton.rest_pose();
        for (k, rotation) in pose.joint_rotations.iter_mut().enumerate() {
            *rotation *= DQuat::from_rotation_y(0.3 * wave(k));
        }
        let by = |node: usize| if node.is_multiple_of(3) { 0.3 } else { 0.02 };
        let translations: Vec<DVec3> = (0..graph.nodes.len())
            .map(|node| by(node) * DVec3::new(wave(3 * node), wave(3 * node + 1), wave(3 * node + 2)))
            .collect();

        let encoded = encode_template(&surface, Some(&graph), &template.skeleton).unwrap();
        let source = motion(&pose, &translations);
        let own =
            Motion { nodes: encoded.node_order.iter().map(|node| source.nodes[*node as usize]).collect(), ..source };
        let mut posed = Posed::default();
        encoded.template.pose(&own, &mut posed);

        let matrices = template.skeleton.world_from_canonical(&pose);
        let (mut grown, mut different, mut most, mut sum) = (0, 0, 0.0f32, 0.0f32);
        for (splat, &source) in posed.center_scale.iter().zip(&encoded.gaussian_order) {
            let i = source as usize;
            let [x, y, z, growth] =
                displacement(&graph.nodes, &translations, graph.gaussian_nodes[i], graph.gaussian_weights[i]);
            let moved = surface.positions[i] + Vec3::new(x, y, z);
            let expected = skin_point_f64(&matrices, &surface.skin[i], moved.as_dvec3()).as_vec3();
            let place = Vec3::from_slice(&splat[..3]);
            assert!(place.distance(expected) < 4e-3, "Gaussian {i}: {place} for {expected}");
            // The template holds steps of positions and weights, and places of nodes that Gaussians stand in for.
            let off = (splat[3] / (surface.scale_m[i] * (1.0 + growth)) - 1.0).abs();
            assert!(off < 0.5, "Gaussian {i} differs by a share of {off}, it grew by {growth}");
            sum += off;
            different += usize::from(off > 0.1);
            grown += usize::from(growth > 0.1);
            most = most.max(growth);
        }
        let count = posed.center_scale.len();
        let mean = sum / count as f32;
        assert!(mean < 0.02 && different < count / 50, "sizes differ by {mean} on average, {different} by a tenth");
        assert!(grown > 3000 && grown < 19_000 && most > 1.0, "{grown} grew, by {most} at most");
    }
}
