//! Places of the face network's landmarks on an average head.

use glam::DVec3;

/// Landmark of the network and its place relative to the head's joint, canonical axes, millimetres on a body of 1.7 m.
pub(crate) struct FacePoint {
    pub landmark: usize,
    pub place_mm: [f64; 3],
}

impl FacePoint {
    /// Returns the place on a body of another height, metres; `scale` is its height over 1.7 m.
    pub fn place_m(&self, scale: f64) -> DVec3 {
        DVec3::from(self.place_mm) * 1e-3 * scale
    }
}

/// Indices of the landmarks that move rigidly with the skull: without lower lip, chin and outline.
pub(crate) const RIGID: [usize; 56] = [
    1, 2, 4, 5, 6, 8, 9, 10, 151, 168, 195, 197, 98, 327, 129, 358, 33, 133, 159, 145, 263, 362, 386, 374, 70, 63, 105,
    66, 107, 300, 293, 334, 296, 336, 50, 280, 205, 425, 117, 346, 101, 330, 36, 266, 0, 37, 267, 61, 291, 21, 251, 54,
    284, 116, 345, 164,
];

/// Places as printed by `flyrig-bench hands --learn-face --seed 301 --people 6 --frames 6 --cameras 7 --px 80`: 108 faces
/// of six simulated people; lines of sight pass the places at a median distance of 4 to 8 mm.
pub(crate) const FACE_POINTS: &[FacePoint] = &[
    FacePoint { landmark: 1, place_mm: [-0.5, 2.3, 130.1] },
    FacePoint { landmark: 2, place_mm: [-0.3, -4.5, 119.1] },
    FacePoint { landmark: 4, place_mm: [-0.6, 8.6, 130.9] },
    FacePoint { landmark: 5, place_mm: [-0.5, 16.6, 127.8] },
    FacePoint { landmark: 6, place_mm: [-0.2, 36.5, 116.4] },
    FacePoint { landmark: 8, place_mm: [-0.1, 52.9, 113.3] },
    FacePoint { landmark: 9, place_mm: [-0.0, 61.6, 113.9] },
    FacePoint { landmark: 10, place_mm: [0.2, 90.7, 109.1] },
    FacePoint { landmark: 151, place_mm: [0.0, 76.0, 112.3] },
    FacePoint { landmark: 168, place_mm: [-0.0, 44.8, 113.0] },
    FacePoint { landmark: 195, place_mm: [-0.4, 23.3, 123.8] },
    FacePoint { landmark: 197, place_mm: [-0.3, 29.5, 120.2] },
    FacePoint { landmark: 98, place_mm: [-19.5, -2.9, 111.9] },
    FacePoint { landmark: 327, place_mm: [19.2, -3.3, 112.2] },
    FacePoint { landmark: 129, place_mm: [-23.7, 3.9, 108.2] },
    FacePoint { landmark: 358, place_mm: [23.3, 3.4, 108.4] },
    FacePoint { landmark: 33, place_mm: [-49.2, 40.1, 85.9] },
    FacePoint { landmark: 133, place_mm: [-19.8, 38.8, 101.3] },
    FacePoint { landmark: 159, place_mm: [-37.6, 44.1, 97.2] },
    FacePoint { landmark: 145, place_mm: [-35.6, 36.2, 98.1] },
    FacePoint { landmark: 263, place_mm: [48.9, 39.1, 86.3] },
    FacePoint { landmark: 362, place_mm: [20.3, 38.4, 102.1] },
    FacePoint { landmark: 386, place_mm: [36.8, 43.5, 96.2] },
    FacePoint { landmark: 374, place_mm: [35.4, 35.5, 98.0] },
    FacePoint { landmark: 70, place_mm: [-61.2, 56.2, 76.1] },
    FacePoint { landmark: 63, place_mm: [-55.6, 62.2, 87.8] },
    FacePoint { landmark: 105, place_mm: [-46.8, 65.0, 99.9] },
    FacePoint { landmark: 66, place_mm: [-33.1, 64.6, 107.1] },
    FacePoint { landmark: 107, place_mm: [-16.9, 63.0, 111.6] },
    FacePoint { landmark: 300, place_mm: [61.2, 54.7, 77.5] },
    FacePoint { landmark: 293, place_mm: [55.6, 60.8, 89.6] },
    FacePoint { landmark: 334, place_mm: [46.8, 64.0, 101.6] },
    FacePoint { landmark: 296, place_mm: [33.2, 64.1, 107.9] },
    FacePoint { landmark: 336, place_mm: [16.9, 62.8, 111.9] },
    FacePoint { landmark: 50, place_mm: [-52.0, 7.7, 84.6] },
    FacePoint { landmark: 280, place_mm: [51.6, 6.7, 85.4] },
    FacePoint { landmark: 205, place_mm: [-43.5, -0.2, 93.6] },
    FacePoint { landmark: 425, place_mm: [42.8, -1.3, 93.9] },
    FacePoint { landmark: 117, place_mm: [-56.1, 23.3, 78.7] },
    FacePoint { landmark: 346, place_mm: [55.8, 22.2, 79.6] },
    FacePoint { landmark: 101, place_mm: [-38.1, 15.3, 97.4] },
    FacePoint { landmark: 330, place_mm: [37.3, 14.4, 97.0] },
    FacePoint { landmark: 36, place_mm: [-34.1, 7.4, 101.6] },
    FacePoint { landmark: 266, place_mm: [33.3, 6.5, 101.3] },
    FacePoint { landmark: 0, place_mm: [-0.3, -17.5, 119.1] },
    FacePoint { landmark: 37, place_mm: [-8.8, -16.8, 117.5] },
    FacePoint { landmark: 267, place_mm: [8.2, -16.8, 117.7] },
    FacePoint { landmark: 61, place_mm: [-29.1, -25.9, 100.9] },
    FacePoint { landmark: 291, place_mm: [28.4, -26.3, 99.4] },
    FacePoint { landmark: 21, place_mm: [-70.0, 64.0, 51.3] },
    FacePoint { landmark: 251, place_mm: [70.4, 63.1, 50.4] },
    FacePoint { landmark: 54, place_mm: [-63.9, 75.4, 64.9] },
    FacePoint { landmark: 284, place_mm: [64.5, 74.3, 64.5] },
    FacePoint { landmark: 116, place_mm: [-67.1, 23.2, 63.4] },
    FacePoint { landmark: 345, place_mm: [66.7, 22.2, 64.4] },
    FacePoint { landmark: 164, place_mm: [-0.3, -8.5, 118.4] },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_face_is_symmetric_and_every_rigid_landmark_has_a_place() {
        assert_eq!(FACE_POINTS.iter().map(|point| point.landmark).collect::<Vec<_>>(), RIGID);
        let place = |landmark| FACE_POINTS.iter().find(|point| point.landmark == landmark).unwrap().place_m(1.0);
        for (right, left) in [(33, 263), (133, 362), (61, 291), (70, 300), (98, 327)] {
            let mirrored = place(right) * DVec3::new(-1.0, 1.0, 1.0);
            assert!(mirrored.distance(place(left)) < 0.005, "{right} {left}");
            assert!(place(left).x > place(right).x);
        }
        assert!(place(1).z > place(168).z, "the nose's tip is in front of its bridge");
    }
}
