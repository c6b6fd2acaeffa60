//! Template: the attributes of a person that do not change from frame to frame.

use alloc::vec::Vec;

use crate::{
    attributes::{Look, Shapes},
    bytes::Fields,
    error::StreamError,
    message::{CODEC_VERSION, TEMPLATE_MAGIC},
    nodes::{Prediction, predictions},
    order::spatial_order,
    planes::{
        GaussianModel, Influences, NORMAL_LEVELS, POSITION_LEVELS, Quantised, SCALE_LEVELS, normal_of, octahedral,
        spread,
    },
    range_coder::{RangeDecoder, RangeEncoder},
};

/// Largest template, bytes.
pub const MAX_TEMPLATE_BYTES: usize = 32 << 20;
/// Largest number of Gaussians.
const MAX_GAUSSIANS: usize = 1 << 20;
/// Largest number of joints.
const MAX_JOINTS: usize = 1024;
/// Largest number of nodes of the deformation graph.
const MAX_NODES: usize = 1 << 16;
/// Least bytes per Gaussian (people take 9 to 12): it bounds the time and memory that a message can claim.
const LEAST_BYTES: usize = 5;
/// Largest coordinate, metres.
pub(crate) const MAX_COORDINATE_M: f32 = 1e4;

const WHAT: &str = "template";

/// Joint of the skeleton.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamJoint {
    /// Index of the parent, smaller than that of the joint; `None` for the first joint alone.
    pub parent: Option<u16>,
    /// Origin in the parent's frame, metres.
    pub translation: [f32; 3],
    /// Three rows of the inverse bind matrix, from canonical space to the joint's frame.
    pub joint_from_canonical: [[f32; 4]; 3],
}

/// Person to encode; all slices of Gaussians have one element per Gaussian.
#[derive(Debug, Clone, Copy)]
pub struct TemplateSource<'a> {
    /// Joints, parents before children.
    pub joints: &'a [StreamJoint],
    /// Canonical centre, metres, and standard deviation, metres.
    pub center_scale: &'a [[f32; 4]],
    /// Unit normal of the surface.
    pub normals: &'a [[f32; 3]],
    /// Joints that move each Gaussian, with weights.
    pub skin: &'a [([u32; 4], [f32; 4])],
    /// Nodes that move each Gaussian, with weights; empty without a deformation graph.
    pub node_weights: &'a [([u32; 4], [f32; 4])],
    /// Canonical positions of the nodes, metres.
    pub nodes: &'a [[f32; 3]],
}

/// Decoded template; Gaussians and nodes are in the order of its bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamTemplate {
    /// XXH3 of the bytes.
    pub hash: u64,
    pub(crate) joints: Vec<StreamJoint>,
    pub(crate) nodes: usize,
    /// Centre and standard deviation, metres.
    pub(crate) center_scale: Vec<[f32; 4]>,
    pub(crate) normals: Vec<[f32; 3]>,
    /// Joints and nodes that move each Gaussian, those with a weight first.
    pub(crate) skin: Vec<Influences>,
    pub(crate) node_weights: Vec<Influences>,
    /// Spread of the nodes of each Gaussian at rest, square metres, see [`spread`].
    pub(crate) rest_spread: Vec<f32>,
    /// Canonical positions of the nodes, metres: each that of the Gaussian with the largest weight on it.
    pub(crate) node_places: Vec<[f32; 3]>,
    /// Prediction of each node.
    pub(crate) predictions: Vec<Prediction>,
    /// Shapes of anisotropic Gaussians.
    pub(crate) shapes: Option<Shapes>,
    /// Colours that are part of the template.
    pub(crate) look: Option<Look>,
}

/// Template with its bytes and the order of its source.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedTemplate {
    /// Template as decoders get it.
    pub template: StreamTemplate,
    /// Encoded message.
    pub bytes: Vec<u8>,
    /// Index of each of the template's Gaussians in the source.
    pub gaussian_order: Vec<u32>,
    /// Index of each of the template's nodes in the source.
    pub node_order: Vec<u32>,
}

impl TemplateSource<'_> {
    /// Orders, quantises and encodes the person.
    ///
    /// # Errors
    /// [`StreamError::Template`] when counts differ, an index points nowhere or a number is not finite.
    pub fn encode(&self) -> Result<EncodedTemplate, StreamError> {
        self.check()?;
        let (count, nodes) = (self.center_scale.len(), self.nodes.len());
        let points: Vec<[f32; 3]> = self.center_scale.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        let gaussian_order = spatial_order(&points, Some(self.normals));
        let node_order = spatial_order(self.nodes, None);
        let mut new_node = alloc::vec![0u32; nodes];
        for (new, &old) in node_order.iter().enumerate() {
            new_node[old as usize] = new as u32;
        }

        let mut min = [f32::INFINITY; 3];
        let mut extent = 0.0f32;
        for axis in 0..3 {
            let max = points.iter().map(|p| p[axis]).fold(f32::NEG_INFINITY, f32::max);
            min[axis] = points.iter().map(|p| p[axis]).fold(f32::INFINITY, f32::min);
            extent = extent.max(max - min[axis]);
        }
        let largest = self.center_scale.iter().map(|s| s[3]).fold(0.0, f32::max);
        let per_metre = if extent > 0.0 { POSITION_LEVELS / extent } else { 0.0 };
        let per_scale = if largest > 0.0 { SCALE_LEVELS / largest } else { 0.0 };

        let mut bytes = Vec::new();
        bytes.extend(TEMPLATE_MAGIC);
        bytes.push(CODEC_VERSION);
        // Number of planes beyond those of an isotropic surface: none yet.
        bytes.extend(0u32.to_le_bytes());
        bytes.extend((count as u32).to_le_bytes());
        bytes.extend((nodes as u32).to_le_bytes());
        bytes.extend((self.joints.len() as u16).to_le_bytes());
        for joint in self.joints {
            bytes.extend(joint.parent.unwrap_or(u16::MAX).to_le_bytes());
            let numbers = joint.translation.iter().chain(joint.joint_from_canonical.iter().flatten());
            bytes.extend(numbers.flat_map(|number| number.to_le_bytes()));
        }
        bytes.extend(min.into_iter().chain([extent, largest]).flat_map(f32::to_le_bytes));

        let head = bytes.len();
        let mut encoder = RangeEncoder::new(bytes);
        let mut model = GaussianModel::default();
        let mut before = Quantised::default();
        for &i in &gaussian_order {
            let i = i as usize;
            let [x, y, z, scale] = self.center_scale[i];
            let level = |v: f32, axis: usize| ((v - min[axis]) * per_metre + 0.5) as i32;
            let on_nodes = self.node_weights.get(i).map_or_else(Influences::default, |(index, weight)| {
                Influences::new(index.map(|node| new_node[node as usize]), *weight)
            });
            let gaussian = Quantised {
                position: [level(x, 0), level(y, 1), level(z, 2)],
                normal: octahedral(self.normals[i]),
                scale: (scale * per_scale + 0.5) as i32,
                joints: Influences::new(self.skin[i].0, self.skin[i].1),
                nodes: on_nodes,
            };
            model.code(&mut encoder, &before, &gaussian, nodes > 0);
            before = gaussian;
        }
        let mut bytes = encoder.finish();
        // Similar Gaussians take fewer bytes; a decoder reads zeros behind the end anyway.
        bytes.resize(bytes.len().max(head + LEAST_BYTES * count), 0);
        let template = StreamTemplate::decode_surface(&bytes)?;
        Ok(EncodedTemplate { template, bytes, gaussian_order, node_order })
    }

    fn check(&self) -> Result<(), StreamError> {
        let count = self.center_scale.len();
        let check = |holds: bool, problem| if holds { Ok(()) } else { Err(StreamError::Template(problem)) };
        check((1..=MAX_GAUSSIANS).contains(&count), "it needs one Gaussian to a million")?;
        check((1..=MAX_JOINTS).contains(&self.joints.len()), "it needs one joint to 1024")?;
        check(self.nodes.len() <= MAX_NODES.min(count), "it has more nodes than Gaussians, or than 65,536")?;
        let node_weights = if self.nodes.is_empty() { 0 } else { count };
        check(
            self.normals.len() == count && self.skin.len() == count && self.node_weights.len() == node_weights,
            "its lists differ in length",
        )?;
        let finite = |v: &f32| v.abs() <= MAX_COORDINATE_M;
        check(self.center_scale.iter().flatten().all(finite), "a centre is not finite")?;
        check(self.center_scale.iter().all(|splat| splat[3] >= 0.0), "a scale is negative")?;
        check(self.normals.iter().flatten().all(finite), "a normal is not finite")?;
        check(self.nodes.iter().flatten().all(finite), "a node is not finite")?;
        let mut weights = self.skin.iter().chain(self.node_weights).flat_map(|(_, weights)| weights);
        check(weights.all(|w| (0.0..=MAX_COORDINATE_M).contains(w)), "a weight is negative or not finite")?;
        let within =
            |list: &[([u32; 4], [f32; 4])], end: usize| list.iter().all(|(i, _)| i.iter().all(|&i| (i as usize) < end));
        check(within(self.skin, self.joints.len()), "a Gaussian hangs on a joint that does not exist")?;
        check(within(self.node_weights, self.nodes.len()), "a Gaussian hangs on a node that does not exist")?;
        for (i, joint) in self.joints.iter().enumerate() {
            let numbers = joint.translation.iter().chain(joint.joint_from_canonical.iter().flatten());
            check(numbers.into_iter().all(|v| v.is_finite()), "a joint is not finite")?;
            check(is_parent(joint.parent, i), "a joint stands before its parent")?;
        }
        Ok(())
    }
}

/// Returns the hash by which motions name a template, XXH3 of its bytes.
#[must_use]
pub fn template_hash(bytes: &[u8]) -> u64 {
    xxhash_rust::xxh3::xxh3_64(bytes)
}

/// Returns whether `parent` is a valid parent of joint `index`.
fn is_parent(parent: Option<u16>, index: usize) -> bool {
    parent.map_or(index == 0, |parent| usize::from(parent) < index)
}

impl StreamTemplate {
    /// Decodes a template without axes and colours.
    pub(crate) fn decode_surface(bytes: &[u8]) -> Result<Self, StreamError> {
        let mut fields = Fields::new(WHAT, TEMPLATE_MAGIC, bytes)?;
        fields.check(bytes.len() <= MAX_TEMPLATE_BYTES, "it is too large")?;
        let planes = fields.u32()?;
        fields.check(planes == 0, "it has planes that this program does not know; update it")?;
        let (count, nodes) = (fields.u32()? as usize, fields.u32()? as usize);
        let joint_count = usize::from(fields.u16()?);
        fields.check((1..=MAX_GAUSSIANS).contains(&count), "it has no Gaussians or too many")?;
        fields.check(nodes <= MAX_NODES.min(count), "it has too many nodes")?;
        fields.check((1..=MAX_JOINTS).contains(&joint_count), "it has no joints or too many")?;
        let mut joints = Vec::new();
        for i in 0..joint_count {
            let parent = Some(fields.u16()?).filter(|parent| *parent != u16::MAX);
            fields.check(is_parent(parent, i), "a joint stands before its parent")?;
            let mut numbers = [0.0; 15];
            for number in &mut numbers {
                *number = fields.f32()?;
            }
            joints.push(StreamJoint {
                parent,
                translation: core::array::from_fn(|k| numbers[k]),
                joint_from_canonical: core::array::from_fn(|row| core::array::from_fn(|k| numbers[3 + 4 * row + k])),
            });
        }
        let min = [fields.f32()?, fields.f32()?, fields.f32()?];
        let (extent, largest) = (fields.f32()?, fields.f32()?);
        let is_box = (0.0..=4.0 * MAX_COORDINATE_M).contains(&extent)
            && min.iter().all(|v| v.abs() <= MAX_COORDINATE_M)
            && (0.0..=MAX_COORDINATE_M).contains(&largest);
        fields.check(is_box, "its bounding box or largest scale makes no sense")?;

        fields.check(count <= fields.bytes.len() / LEAST_BYTES, "it claims more Gaussians than its bytes can hold")?;
        let mut decoder = RangeDecoder::new(fields.bytes);
        let mut model = GaussianModel::default();
        let mut before = Quantised::default();
        let mut template = Self {
            hash: template_hash(bytes),
            joints,
            nodes,
            center_scale: Vec::with_capacity(count),
            normals: Vec::with_capacity(count),
            skin: Vec::with_capacity(count),
            node_weights: Vec::with_capacity(if nodes > 0 { count } else { 0 }),
            rest_spread: Vec::new(),
            node_places: alloc::vec![[0.0; 3]; nodes],
            predictions: Vec::new(),
            shapes: None,
            look: None,
        };
        // Largest weight on each node, and the normal of that Gaussian.
        let mut most = alloc::vec![(0, [0.0; 3]); nodes];
        let (step, scale_step) = (extent / POSITION_LEVELS, largest / SCALE_LEVELS);
        for _ in 0..count {
            before = model.code(&mut decoder, &before, &Quantised::default(), nodes > 0);
            let Quantised { position, normal, scale, joints, nodes: on_nodes } = before;
            let is_in = |values: &[i32], most: f32| values.iter().all(|v| (0..=most as i32).contains(v));
            let is_valid = is_in(&position, POSITION_LEVELS)
                && is_in(&normal, NORMAL_LEVELS)
                && is_in(&[scale], SCALE_LEVELS)
                && hangs_on(&joints, joint_count)
                && (nodes == 0 || hangs_on(&on_nodes, nodes));
            fields.check(is_valid, "a Gaussian is out of range")?;
            let at = |axis: usize| min[axis] + step * position[axis] as f32;
            template.center_scale.push([at(0), at(1), at(2), scale_step * scale as f32]);
            template.normals.push(normal_of(normal));
            template.skin.push(joints.heavy_first());
            if nodes > 0 {
                for (node, weight) in on_nodes.index.into_iter().zip(on_nodes.weight) {
                    let node = node as usize;
                    if weight > most[node].0 {
                        most[node] = (weight, normal_of(normal));
                        template.node_places[node] = [at(0), at(1), at(2)];
                    }
                }
                template.node_weights.push(on_nodes.heavy_first());
            }
        }
        let normals: Vec<[f32; 3]> = most.iter().map(|(_, normal)| *normal).collect();
        template.measure_spread();
        template.predictions = predictions(&template.node_places, &normals, &template.node_weights);
        Ok(template)
    }

    /// Measures the spread of each Gaussian's nodes at rest.
    pub(crate) fn measure_spread(&mut self) {
        let places = &self.node_places;
        self.rest_spread = self.node_weights.iter().map(|on| spread(on, |node| places[node])).collect();
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn gaussians(&self) -> usize {
        self.center_scale.len()
    }

    /// Returns the number of nodes of the deformation graph.
    #[must_use]
    pub fn nodes(&self) -> usize {
        self.nodes
    }

    /// Returns the joints of the skeleton.
    #[must_use]
    pub fn joints(&self) -> &[StreamJoint] {
        &self.joints
    }
}

/// Returns whether all indices are below `end` and no weight is negative.
fn hangs_on(influences: &Influences, end: usize) -> bool {
    influences.index.iter().all(|&i| usize::try_from(i).is_ok_and(|i| i < end))
        && influences.weight.iter().all(|&w| w >= 0)
}
