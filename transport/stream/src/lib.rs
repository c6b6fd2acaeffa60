//! Codec of the tracked person, for lines of 10 Mbit/s: what a rig sends to those who draw the person themselves.
//!
//! | message | content | when |
//! |---|---|---|
//! | [`StreamTemplate`] | Gaussians at rest, skin and node weights, skeleton | once a viewer, by its hash |
//! | [`Motion`] | pose, translations of the deformation graph's nodes | every frame, readable by itself |
//! | the same with axes and colours ([`AvatarSource`]) | an avatar, which a pose alone moves | once a viewer; then no colours |
//! | colours, in [`LAYERS`] layers | changes since the message before, from coarse to fine | every frame |
//!
//! The viewer poses the Gaussians itself ([`StreamTemplate::pose`]): FlyHuman Eq. 2 is linear in the node translations, and a pose is
//! a few hundred bytes. Colours are coded as Haar coefficients over a tree of the template's surface ([`ColorEncoder`]).
//!
//! Each message but the template has at most [`MAX_MESSAGE_BYTES`]. No decoder panics on any input, allocates more than
//! in proportion to the template, or takes longer than for a valid message of the same template.
//!
//! The crate needs `alloc` only, so that the same code runs in a browser.

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
pub use colors::{ColorDecoder, ColorEncoder, ColorSettings, LAYERS};
pub use error::StreamError;
pub use message::{CODEC_VERSION, MAX_MESSAGE_BYTES};
pub use motion::{Motion, MotionEncoder};
pub use pose::Posed;
pub use splats::{MAX_SPLAT_BYTES, MAX_SPLATS, SplatError, SplatState};
pub use stamp::{Stamp, restamp, stamp_of};
pub use template::{EncodedTemplate, MAX_TEMPLATE_BYTES, StreamJoint, StreamTemplate, TemplateSource, template_hash};
