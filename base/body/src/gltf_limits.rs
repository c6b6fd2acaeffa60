//! Largest sizes that the glTF import accepts. A file of a few megabytes can demand terabytes: its parts may share one buffer any
//! number of times, and an animation is sampled for each node that it moves.

/// Bytes of a file, and of all buffers together: a scan with embedded 8k textures has some hundred megabytes.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 30;

/// Objects, arrays and their entries in the JSON part: an entry of three bytes becomes a node of half a kilobyte. A rig of
/// 10,000 nodes has some 300,000.
pub(crate) const MAX_JSON_ENTRIES: usize = 1 << 20;

/// Nodes of the document: a whole scene around a person has some thousands.
pub(crate) const MAX_NODES: usize = 1 << 14;

/// Skins of the document: an avatar has up to some tens, a crowd some hundreds.
pub(crate) const MAX_SKINS: usize = 1 << 10;

/// Joints of a skin, and of all skins of a body: bodies with face and fingers have some hundreds.
pub(crate) const MAX_JOINTS: usize = 1 << 10;

/// Vertices of all meshes on the skin, repeated ones counted again: scans have up to a million. A vertex takes some 300
/// bytes while it is read.
pub(crate) const MAX_VERTICES: usize = 1 << 21;

/// Triangle corners of all meshes on the skin: a closed mesh has twice as many triangles as vertices.
pub(crate) const MAX_INDICES: usize = 2 * 3 * MAX_VERTICES;

/// Sets of four joints and weights per vertex: exporters write one or two.
pub(crate) const MAX_JOINT_SETS: u32 = 4;

/// Keys of all channels of the animation together: ten minutes at 60 per second for 70 joints in translation, rotation and
/// scale are 7.6 million. A key takes 40 to 104 bytes.
pub(crate) const MAX_ANIMATION_KEYS: usize = 1 << 23;

/// Poses of the track times moving nodes: an hour at 30 per second for 77 joints. Each takes 32 bytes in the track.
pub(crate) const MAX_POSED_NODES: usize = 1 << 23;

/// Largest time of a key, seconds (11 days); within it no arithmetic on nanoseconds overflows.
pub(crate) const MAX_KEY_SECS: f64 = 1e6;
