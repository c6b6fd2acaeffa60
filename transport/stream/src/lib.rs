//! Codec of the person stream: tracked people for viewers that draw them themselves, over lines of 10 Mbit/s; and of splat states.
//!
//! | message | content | when |
//! |---|---|---|
//! | [`StreamTemplate`] | Gaussians at rest, skin and node weights, skeleton | once per viewer, by its hash |
//! | [`Motion`] | pose, translations of the deformation graph's nodes | every frame, decodable by itself |
//! | template with axes ([`AvatarSource`]) | avatar: anisotropic Gaussians with opacities | once per viewer, by its hash |
//! | template with axes and colours | avatar that its pose alone drives | once per viewer; then no colours |
//! | colours, in [`LAYERS`] layers | changes since the previous message, from coarse to fine | every frame |
//! | [`WholeColors::whole`] | present state of the colours, by layer | for a viewer that joins, or missed changes |
//! | [`SplatState`] | all Gaussians in the world, without skinning | every frame, decodable by itself |
//!
//! Viewers pose the Gaussians themselves ([`StreamTemplate::pose`]): FlyHuman Eq. 2 is linear in the node translations, and a pose is a few
//! hundred bytes. A node's translation is coded as its difference from a prediction by up to three nodes before it on the surface
//! (`nodes.rs`). Colours are Haar coefficients over a balanced tree of the template's surface (`tree.rs`), coded as changes of whole
//! quantisation steps (`colors.rs`) by an adaptive range coder, in layers of levels. Every segment of the surface is refreshed in turn;
//! segments that exceed the byte budget of a frame wait for the next one.
//!
//! Messages of the person stream other than templates have at most [`MAX_MESSAGE_BYTES`]. No decoder panics on any input, allocates more
//! than in proportion to the template, or takes longer than for a valid message of the same template.
//!
//! The crate needs `alloc` only, so that the same code runs in a browser.
//!
//! ```
//! use flyrig_stream::{
//!     ColorDecoder, ColorEncoder, ColorSettings, Motion, MotionEncoder, Posed, Stamp, StreamJoint, StreamTemplate, TemplateSource,
//! };
//!
//! // A person of two Gaussians on one joint.
//! let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
//! let source = TemplateSource {
//!     joints: &[StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }],
//!     center_scale: &[[0.0, 0.0, 0.0, 0.01], [0.0, 1.0, 0.0, 0.01]],
//!     normals: &[[0.0, 0.0, 1.0]; 2],
//!     skin: &[([0; 4], [1.0, 0.0, 0.0, 0.0]); 2],
//!     node_weights: &[],
//!     nodes: &[],
//! };
//! let encoded = source.encode()?;
//! let template = StreamTemplate::decode(&encoded.bytes)?;
//!
//! let motion = Motion {
//!     stamp: Stamp { frame: 7, ..Stamp::default() },
//!     root_translation: [0.5, 0.0, 0.0],
//!     joint_rotations: vec![[0.0, 0.0, 0.0, 1.0]],
//!     nodes: vec![],
//! };
//! let received = Motion::decode(&MotionEncoder::new(&encoded).encode(&motion)?, &template)?;
//! let mut posed = Posed::default();
//! template.pose(&received, &mut posed);
//! assert!((posed.center_scale[0][0] - 0.5).abs() < 1e-3);
//!
//! let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
//! let (mut decoder, mut colors) = (ColorDecoder::new(&template), Vec::new());
//! for message in encoder.encode(motion.stamp, &[[0.5, 0.2, 0.1, 1.0]; 2]) {
//!     decoder.ingest(&message)?;
//! }
//! decoder.colors(&mut colors);
//! assert!((colors[0][0] - 0.5).abs() < 0.05);
//! # Ok::<(), flyrig_stream::StreamError>(())
//! ```

#![no_std]

extern crate alloc;
#[cfg(test)]
extern crate std;

mod attributes;
mod avatar;
mod bytes;
mod coefficients;
#[cfg(test)]
mod color_tests;
mod colors;
mod error;
mod integers;
mod message;
mod motion;
mod nodes;
mod order;
mod planes;
mod pose;
#[cfg(test)]
mod pose_tests;
mod quantise;
mod range_coder;
mod splats;
mod srgb;
mod stamp;
mod template;
#[cfg(test)]
#[allow(clippy::unwrap_used)] // helpers of tests
mod testing;
mod tree;

pub use attributes::LIGHT_TERMS;
pub use avatar::{AvatarGaussian, AvatarSource, PosedAxes};
pub use colors::{ColorDecoder, ColorEncoder, ColorSettings, LAYERS, WholeColors};
pub use error::StreamError;
pub use message::{CODEC_VERSION, MAX_MESSAGE_BYTES};
pub use motion::{Motion, MotionEncoder};
pub use pose::Posed;
pub use splats::{MAX_SPLAT_BYTES, MAX_SPLATS, SplatError, SplatState};
pub use stamp::{Stamp, restamp, stamp_of};
pub use template::{EncodedTemplate, MAX_TEMPLATE_BYTES, StreamJoint, StreamTemplate, TemplateSource, template_hash};
