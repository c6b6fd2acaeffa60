//! Where the face network's landmarks lie on an average head.

use glam::DVec3;

/// A landmark of the network and its place: from the head's joint in canonical axes, millimetres on a body of 1.7 m.
pub(crate) struct FacePoint {
    pub landmark: usize,
    pub place_mm: [f64; 3],
}

impl FacePoint {
    /// The place on a body of another height, metres; `scale` is its height over 1.7 m.
    pub fn place_m(&self, scale: f64) -> DVec3 {
        DVec3::from(self.place_mm) * 1e-3 * scale
    }
}

/// Landmarks that lie on the skull, without the lower lip, the chin and the outline, in the network's numbering.
pub(crate) const RIGID: [usize; 56] = [
    1, 2, 4, 5, 6, 8, 9, 10, 151, 168, 195, 197, 98, 327, 129, 358, 33, 133, 159, 145, 263, 362, 386, 374, 70, 63, 105,
    66, 107, 300, 293, 334, 296, 336, 50, 280, 205, 425, 117, 346, 101, 330, 36, 266, 0, 37, 267, 61, 291, 21, 251, 54,
    284, 116, 345, 164,
];

/// Printed by `flyrig-bench hands --learn-face`.
pub(crate) const FACE_POINTS: &[FacePoint] = &[];
