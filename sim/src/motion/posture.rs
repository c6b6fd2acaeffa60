//! Posture of a body at an instant in terms of a clip: hips, feet, bend of the trunk, directions of the arms.

use glam::{DQuat, DVec2, DVec3};

/// Posture of a foot. Lengths are those of the average body; the frame is canonical axes on the ground, the body at the
/// start facing +z.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Foot {
    /// Position of the ankle of the flat foot on the ground (x, z), metres.
    pub at: DVec2,
    /// Height of the flat foot above the ground, metres.
    pub lift: f64,
    /// Heading, radians from +z to +x.
    pub yaw: f64,
    /// Heel up (positive) or toes up (negative), radians.
    pub roll: f64,
    /// Pivot of the roll: the heel at 0, the ball at 1.
    pub pivot: f64,
}

/// Posture of an arm in the chest's frame, x away from the body's middle, y up, z to the front.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Arm {
    /// Direction of the upper arm.
    pub upper: DVec3,
    /// Direction of the forearm.
    pub fore: DVec3,
    /// Flexion of the wrist towards the palm and rotation palm up, radians.
    pub hand: [f64; 2],
    /// Bend of the fingers, 0 stretched to 1 a fist.
    pub curl: f64,
}

/// Posture of a whole body. Pairs are left, right.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Posture {
    /// Hips on the ground (x, z), and above the height of straight legs on flat feet, metres of the average body.
    pub hips: DVec3,
    /// Heading of the hips, radians from +z to +x.
    pub yaw: f64,
    /// Hips bent forward, tilted to the left, turned to the left of `yaw`, radians.
    pub pelvis: DVec3,
    /// Trunk bent forward, tilted to the left, twisted to the left, on top of the hips, radians.
    pub trunk: DVec3,
    /// Head nodding, tilted to the left, looking left, on top of the trunk, radians.
    pub head: DVec3,
    pub feet: [Foot; 2],
    pub arms: [Arm; 2],
    /// Outward rotation of the knees from the feet, radians.
    pub knees_out: f64,
}

impl Foot {
    /// Returns a foot flat on the ground.
    pub(crate) fn planted(at: DVec2, yaw: f64) -> Self {
        Self { at, lift: 0.0, yaw, roll: 0.0, pivot: 1.0 }
    }

    fn mix(&self, other: &Self, t: f64) -> Self {
        let lerp = |a: f64, b: f64| a + (b - a) * t;
        Self {
            at: self.at.lerp(other.at, t),
            lift: lerp(self.lift, other.lift),
            yaw: lerp(self.yaw, other.yaw),
            roll: lerp(self.roll, other.roll),
            pivot: lerp(self.pivot, other.pivot),
        }
    }
}

impl Arm {
    /// Returns an arm from angles: elevation of the upper arm to the front and to the side, bend of the elbow and its
    /// direction (0 to the front, positive inwards), radians.
    pub(crate) fn angled(forward: f64, out: f64, bend: f64, inwards: f64) -> Self {
        let upper = DQuat::from_rotation_z(out) * DQuat::from_rotation_x(-forward);
        let fore = upper * DQuat::from_rotation_y(-inwards) * DQuat::from_rotation_x(-bend);
        Self { upper: upper * DVec3::NEG_Y, fore: fore * DVec3::NEG_Y, hand: [0.0; 2], curl: 0.35 }
    }

    pub(crate) fn with_hand(self, bent: f64, palm_up: f64, curl: f64) -> Self {
        Self { hand: [bent, palm_up], curl, ..self }
    }

    pub(crate) fn mix(&self, other: &Self, t: f64) -> Self {
        let turn = |a: DVec3, b: DVec3| a.lerp(b, t).normalize_or(b);
        let lerp = |a: f64, b: f64| a + (b - a) * t;
        Self {
            upper: turn(self.upper, other.upper),
            fore: turn(self.fore, other.fore),
            hand: std::array::from_fn(|i| lerp(self.hand[i], other.hand[i])),
            curl: lerp(self.curl, other.curl),
        }
    }
}

impl Posture {
    /// Returns an upright posture at the origin, feet side by side, arms hanging `out` radians from the body.
    pub(crate) fn standing(out: f64) -> Self {
        const HALF_STANCE_M: f64 = 0.105;
        let foot = |side: f64| Foot::planted(DVec2::new(side * HALF_STANCE_M, 0.0), side * 0.14);
        let arm = Arm::angled(0.03, out, 0.22, 0.25);
        Self {
            hips: DVec3::new(0.0, -0.006, 0.0),
            yaw: 0.0,
            pelvis: DVec3::ZERO,
            trunk: DVec3::ZERO,
            head: DVec3::ZERO,
            feet: [foot(1.0), foot(-1.0)],
            arms: [arm; 2],
            knees_out: 0.0,
        }
    }

    /// Interpolates, `t` of the way to the other.
    pub(crate) fn mix(&self, other: &Self, t: f64) -> Self {
        Self {
            hips: self.hips.lerp(other.hips, t),
            yaw: self.yaw + (other.yaw - self.yaw) * t,
            pelvis: self.pelvis.lerp(other.pelvis, t),
            trunk: self.trunk.lerp(other.trunk, t),
            head: self.head.lerp(other.head, t),
            feet: [0, 1].map(|i| self.feet[i].mix(&other.feet[i], t)),
            arms: [0, 1].map(|i| self.arms[i].mix(&other.arms[i], t)),
            knees_out: self.knees_out + (other.knees_out - self.knees_out) * t,
        }
    }
}
