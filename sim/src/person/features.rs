//! Individual features of a face beyond the body's shape: nose, mouth, eyes, brows, cheeks and jaw, moved by smooth
//! fields in coordinates of the average body.

use glam::Vec3;
use rand::{RngExt, rngs::StdRng};

use crate::person::regions::EYE;

/// Height of the line between the lips of the average face, metres.
pub(crate) const LIPS_Y: f32 = 1.4858;

/// Strength of each feature, about -1 to 1, 0 for the average face.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Features {
    pub nose_wide: f32,
    pub nose_long: f32,
    pub nose_up: f32,
    pub bridge: f32,
    pub mouth_wide: f32,
    /// Raise of the corners of the mouth.
    pub smile: f32,
    pub lips_full: f32,
    pub eyes_apart: f32,
    pub eyes_large: f32,
    /// Raise of the outer corners.
    pub eyes_slant: f32,
    pub brows_high: f32,
    /// Paint of the brows: arch, thickness, and raise of their inner ends.
    pub brows_arched: f32,
    pub brows_thick: f32,
    pub brows_open: f32,
    pub cheeks: f32,
    pub jaw: f32,
}

impl Features {
    /// Draws features from a seed's numbers; most people are close to the average in most of them.
    pub(crate) fn random(dice: &mut StdRng) -> Self {
        let mut one = || 0.65 * (dice.random_range(-1.0f32..1.0) + dice.random_range(-1.0f32..1.0));
        Self {
            nose_wide: one(),
            nose_long: one(),
            nose_up: one(),
            bridge: one(),
            mouth_wide: one(),
            // Rather friendly than stern.
            smile: 0.6 + 0.75 * one(),
            lips_full: one(),
            eyes_apart: one(),
            eyes_large: 0.2 + 0.8 * one(),
            eyes_slant: one(),
            brows_high: 0.2 + one(),
            brows_arched: one(),
            brows_thick: one(),
            brows_open: 0.4 + 0.8 * one(),
            cheeks: one(),
            jaw: one(),
        }
    }

    /// Returns the displacement of a point, given its position on the average body, metres.
    pub(crate) fn moved(&self, average: Vec3) -> Vec3 {
        if average.y < 1.40 || average.z < 0.0 {
            return Vec3::ZERO;
        }
        let side = average.x.signum();
        let p = Vec3::new(average.x.abs(), average.y, average.z);
        // Smooth bumps around places of the left half of the face.
        let near = |x: f32, y: f32, z: f32, reach: [f32; 3]| {
            let d = (p - Vec3::new(x, y, z)) / Vec3::from(reach);
            (-d.length_squared()).exp()
        };
        // Nothing in the middle of the face moves sideways.
        let aside = (p.x / 0.006).min(1.0);
        let mut moved = Vec3::ZERO;
        moved.x += 0.0038 * self.nose_wide * aside * near(0.013, 1.512, 0.142, [0.010, 0.013, 0.020]);
        let tip = near(0.0, 1.516, 0.156, [0.014, 0.016, 0.022]);
        moved += Vec3::new(0.0, -0.0022, 0.0055) * (self.nose_long * tip);
        moved.y += 0.0038 * self.nose_up * near(0.0, 1.512, 0.158, [0.013, 0.010, 0.018]);
        moved.z += 0.0038 * self.bridge * near(0.0, 1.538, 0.136, [0.009, 0.018, 0.020]);
        moved.x += 0.0036 * self.mouth_wide * aside * near(0.024, LIPS_Y, 0.125, [0.014, 0.012, 0.030]);
        let corner = near(0.026, LIPS_Y + 0.001, 0.122, [0.012, 0.010, 0.030]);
        moved += Vec3::new(0.0010 * aside, 0.0034, -0.0008) * (self.smile * corner);
        moved.y += 0.0016 * self.smile.max(0.0) * near(0.042, 1.508, 0.108, [0.018, 0.014, 0.030]);
        let lips = near(0.0, LIPS_Y, 0.130, [0.026, 0.015, 0.030]);
        moved.y += 0.26 * (p.y - LIPS_Y) * self.lips_full * lips;
        moved.z += 0.0016 * self.lips_full * lips;
        let eye = near(EYE.0.x, EYE.0.y, EYE.0.z, [0.021, 0.017, 0.035]);
        moved.x += 0.0022 * self.eyes_apart * aside * eye;
        moved += (p - EYE.0) * (0.10 * self.eyes_large * eye);
        moved.y += 0.10 * (p.x - EYE.0.x) * self.eyes_slant * eye;
        moved.y += 0.0030 * self.brows_high * near(0.030, 1.573, 0.115, [0.030, 0.009, 0.035]);
        moved += Vec3::new(0.0026, 0.0, 0.0026) * (self.cheeks * near(0.052, 1.520, 0.095, [0.018, 0.020, 0.030]));
        moved.x += 0.0052 * self.jaw * aside * near(0.060, 1.468, 0.062, [0.022, 0.028, 0.040]);
        Vec3::new(moved.x * side, moved.y, moved.z)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn faces_differ_by_millimetres_and_stay_symmetric_and_smooth() {
        let mut dice = StdRng::seed_from_u64(1);
        let all: Vec<Features> = (0..50).map(|_| Features::random(&mut dice)).collect();
        let tip = Vec3::new(0.0, 1.516, 0.156);
        assert!(all.iter().any(|f| f.moved(tip).z > 0.002) && all.iter().any(|f| f.moved(tip).z < -0.002));
        for features in &all {
            for i in 0..4000 {
                let p =
                    Vec3::new((i % 20) as f32 * 0.004, 1.43 + (i / 20 % 20) as f32 * 0.008, (i / 400) as f32 * 0.016);
                let (moved, mirrored) = (features.moved(p), features.moved(p * Vec3::new(-1.0, 1.0, 1.0)));
                assert!(moved.length() < 0.016 && (moved - mirrored * Vec3::new(-1.0, 1.0, 1.0)).length() < 1e-6);
                // Nowhere is the face folded over.
                let next = features.moved(p + Vec3::new(0.0, 0.001, 0.0));
                assert!((next - moved).length() < 0.0008, "{p}: {moved} {next}");
            }
        }
        assert_eq!(all[0].moved(Vec3::new(0.1, 1.0, 0.1)), Vec3::ZERO);
    }
}
