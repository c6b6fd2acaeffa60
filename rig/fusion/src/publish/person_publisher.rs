//! A person for the stream: template, motion and colours, encoded on a thread of its own.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use flyrig_body::{DeformationGraph, Skeleton, SurfaceGaussians};
use flyrig_capture::{LatestQueue, PopError};
use flyrig_stream::{
    ColorEncoder, ColorSettings, EncodedTemplate, LAYERS, Motion, MotionEncoder, Stamp, StreamError, StreamJoint,
    TemplateSource,
};
use flyrig_transport::Publisher;
use flyrig_types::{PersonId, Pose, SupervisedThread, ThreadHealth};
use glam::DVec3;

use crate::{FusionError, Subject};

/// Frames of people that may wait for the encoder.
const WAITING: usize = 4;

/// Returns a skeleton's joints as the stream has them.
#[must_use]
pub fn stream_joints(skeleton: &Skeleton) -> Vec<StreamJoint> {
    let joint = |joint: &flyrig_body::Joint| StreamJoint {
        parent: joint.parent.map(|parent| parent as u16),
        translation: joint.rest_translation.as_vec3().to_array(),
        joint_from_canonical: [0, 1, 2].map(|row| joint.joint_from_canonical.row(row).as_vec4().to_array()),
    };
    skeleton.joints().iter().map(joint).collect()
}

/// Encodes a person's template: `surface` as it is skinned, and the graph that deforms it, if one does.
pub(crate) fn encode_template(
    surface: &SurfaceGaussians,
    graph: Option<&DeformationGraph>,
    skeleton: &Skeleton,
) -> Result<EncodedTemplate, StreamError> {
    let joints = stream_joints(skeleton);
    let center_scale: Vec<[f32; 4]> =
        surface.positions.iter().zip(&surface.scale_m).map(|(p, scale)| p.extend(*scale).to_array()).collect();
    let normals: Vec<[f32; 3]> = surface.normals.iter().map(glam::Vec3::to_array).collect();
    let skin: Vec<_> = surface.skin.iter().map(|skin| (skin.joints.map(u32::from), skin.weights)).collect();
    let node_weights: Vec<_> = graph.map_or_else(Vec::new, |graph| {
        graph.gaussian_nodes.iter().copied().zip(graph.gaussian_weights.iter().copied()).collect()
    });
    let nodes: Vec<[f32; 3]> =
        graph.map_or_else(Vec::new, |graph| graph.nodes.iter().map(glam::Vec3::to_array).collect());
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

/// A pose and the nodes' translations as the stream has them; the stamp is empty.
pub(crate) fn motion(pose: &Pose, translations: &[DVec3]) -> Motion {
    Motion {
        root_translation: pose.root_translation.as_vec3().to_array(),
        joint_rotations: pose.joint_rotations.iter().map(|rotation| rotation.as_quat().to_array()).collect(),
        nodes: translations.iter().map(|translation| translation.as_vec3().to_array()).collect(),
        ..Motion::default()
    }
}

/// A person at one instant, before it is encoded.
#[derive(Debug)]
pub struct PersonFrame {
    template: Arc<EncodedTemplate>,
    motion: Motion,
    /// None of an avatar.
    colors: Vec<[f32; 4]>,
}

impl Subject {
    /// Reads a person's colours back for the stream; None before the first pose.
    pub(crate) fn person_frame(
        &self,
        gpu: &flyrig_gpu::GpuContext,
        frame: u64,
        capture_nanos: i64,
    ) -> Result<Option<PersonFrame>, FusionError> {
        let Some(pose) = self.pose() else { return Ok(None) };
        let mut motion = motion(pose, self.node_translations());
        motion.stamp.person = self.id().0;
        (motion.stamp.frame, motion.stamp.capture_nanos) = (frame, capture_nanos);
        let template = self.stream_template();
        if template.template.is_avatar() {
            return Ok(Some(avatar_frame(template, &motion)));
        }
        Ok(Some(PersonFrame { template, motion, colors: self.gaussians().color.read(gpu)? }))
    }
}

/// A person who is driven by a pose alone: the avatar has its colours.
fn avatar_frame(template: Arc<EncodedTemplate>, motion: &Motion) -> PersonFrame {
    PersonFrame { template, motion: Motion { nodes: Vec::new(), ..motion.clone() }, colors: Vec::new() }
}

/// One person's encoders.
#[derive(Debug)]
pub struct PersonEncoder {
    hash: u64,
    motion: MotionEncoder,
    settings: ColorSettings,
    epoch: u32,
    /// None before the first colours: motion does not wait for it.
    colors: Option<ColorEncoder>,
}

/// Messages of one frame: motion, and the layers of the colours.
#[derive(Debug)]
pub struct PersonMessages {
    /// Which template, person and frame.
    pub stamp: Stamp,
    /// Motion.
    pub motion: Vec<u8>,
    /// Colours.
    pub colors: [Vec<u8>; LAYERS],
}

impl PersonEncoder {
    /// For the person of a frame. `epoch` distinguishes its colours from those of earlier encoders.
    #[must_use]
    pub fn new(frame: &PersonFrame, settings: ColorSettings, epoch: u32) -> Self {
        Self {
            hash: frame.template.template.hash,
            motion: MotionEncoder::new(&frame.template),
            settings,
            epoch,
            colors: None,
        }
    }

    /// Encodes a frame.
    ///
    /// # Errors
    /// [`FusionError::Stream`].
    pub fn encode(&mut self, frame: &PersonFrame) -> Result<PersonMessages, FusionError> {
        let (stamp, motion) = self.encode_motion(frame)?;
        Ok(PersonMessages { stamp, motion, colors: self.encode_colors(frame) })
    }

    fn stamp(&self, frame: &PersonFrame) -> Stamp {
        Stamp { template: self.hash, ..frame.motion.stamp }
    }

    fn encode_motion(&mut self, frame: &PersonFrame) -> Result<(Stamp, Vec<u8>), FusionError> {
        Ok((self.stamp(frame), self.motion.encode(&frame.motion)?))
    }

    /// Empty messages for an avatar.
    fn encode_colors(&mut self, frame: &PersonFrame) -> [Vec<u8>; LAYERS] {
        if frame.colors.is_empty() {
            return Default::default();
        }
        let stamp = self.stamp(frame);
        let (settings, epoch) = (self.settings, self.epoch);
        let encoder = self.colors.get_or_insert_with(|| ColorEncoder::new(&frame.template, settings, epoch));
        encoder.encode(stamp, &frame.colors)
    }
}

impl PersonFrame {
    /// The same pose for viewers who draw an avatar of the same joints.
    #[must_use]
    pub fn of_avatar(&self, avatar: &Arc<EncodedTemplate>) -> Self {
        avatar_frame(Arc::clone(avatar), &self.motion)
    }

    /// The person's template.
    #[must_use]
    pub fn template(&self) -> &EncodedTemplate {
        &self.template
    }
}

/// Encodes and publishes people without making the session wait: of frames that wait, the oldest is dropped.
pub(crate) struct PersonPublisher {
    frames: Arc<LatestQueue<PersonFrame>>,
    thread: SupervisedThread,
}

impl PersonPublisher {
    pub fn start(publisher: Arc<Publisher>) -> Result<Self, FusionError> {
        let frames = Arc::new(LatestQueue::<PersonFrame>::new(WAITING));
        let waiting = Arc::clone(&frames);
        let mut encoders = BTreeMap::<u32, PersonEncoder>::new();
        let work = move || {
            loop {
                let frame = match waiting.pop(Duration::from_millis(200)) {
                    Ok(frame) => frame,
                    Err(PopError::Timeout) => continue,
                    Err(PopError::Closed) => return,
                };
                publish(&publisher, &mut encoders, &frame);
            }
        };
        let thread =
            SupervisedThread::start("person", work).map_err(|source| FusionError::Thread { name: "person", source })?;
        Ok(Self { frames, thread })
    }

    pub fn push(&self, frame: PersonFrame) {
        drop(self.frames.push(frame));
    }

    pub fn dropped(&self) -> u64 {
        self.frames.dropped()
    }

    pub fn health(&self) -> ThreadHealth {
        self.thread.health()
    }

    /// Publishes what waits and ends the thread.
    pub fn finish(mut self) {
        self.frames.close();
        self.thread.join();
    }
}

/// Epoch of an encoder that starts now.
fn epoch() -> u32 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_micros() as u32)
}

fn publish(publisher: &Publisher, encoders: &mut BTreeMap<u32, PersonEncoder>, frame: &PersonFrame) {
    let person = frame.motion.stamp.person;
    let template = &frame.template;
    if encoders.get(&person).is_none_or(|encoder| encoder.hash != template.template.hash) {
        while encoders.len() > flyrig_transport::MAX_PERSON_TOPICS {
            encoders.pop_first();
        }
        publisher.offer_template(person, template.template.hash, template.bytes.clone().into());
        encoders.insert(person, PersonEncoder::new(frame, ColorSettings::default(), epoch()));
    }
    let Some(encoder) = encoders.get_mut(&person) else { return };
    match encoder.encode_motion(frame) {
        Ok((stamp, motion)) => {
            // Before the colours, which take longer to encode.
            publisher.publish_person(&stamp, None, motion.into());
            let colors = encoder.encode_colors(frame).into_iter().enumerate();
            for (layer, bytes) in colors.filter(|(_, bytes)| !bytes.is_empty()) {
                publisher.publish_person(&stamp, Some(layer), bytes.into());
            }
        }
        Err(error) => tracing::warn!(person = %PersonId(person), %error, "person not published"),
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
