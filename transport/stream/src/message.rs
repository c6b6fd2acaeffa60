//! Common properties of all messages: the codec's version, the magic letters, the largest size.

/// Version of every message of this codec.
pub const CODEC_VERSION: u8 = 2;

/// Largest message that is not a template, bytes: with zenoh's own header it fits in one of its batches of 65,535 bytes.
pub const MAX_MESSAGE_BYTES: usize = 65_000;

/// Magic letters of a [`crate::StreamTemplate`] without axes and colours.
pub(crate) const TEMPLATE_MAGIC: [u8; 3] = *b"FLT";
/// Magic letters of an avatar with its colours.
pub(crate) const AVATAR_MAGIC: [u8; 3] = *b"FLA";
/// Magic letters of an avatar whose colours are messages.
pub(crate) const TRACKED_MAGIC: [u8; 3] = *b"FLE";
/// Magic letters of a [`crate::Motion`].
pub(crate) const MOTION_MAGIC: [u8; 3] = *b"FLM";
/// Magic letters of a layer of colours.
pub(crate) const COLOR_MAGIC: [u8; 3] = *b"FLC";
