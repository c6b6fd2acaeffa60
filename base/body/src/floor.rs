//! Floor of a bind pose.

use crate::part::part_of_joints;
use crate::{Part, Template};

/// Largest distance of soles below the lowest joint of the feet, metres: vertices farther below belong to something else.
const LOWEST_SOLE_M: f64 = 0.25;
/// Height of the lowest joint of the feet above the floor of a body whose feet have no vertices, metres.
const USUAL_TOE_HEIGHT_M: f64 = 0.03;

impl Template {
    /// Returns the height of the floor that the bind pose stands on, canonical y, metres: that of the lowest vertex of the feet, shoes
    /// included. The origin may lie anywhere, for example in the pelvis. Where the feet have no vertices, the floor is 3 cm below
    /// their lowest joint.
    ///
    /// ```
    /// use flyrig_body::{ShapeParams, Shoes, default_template};
    ///
    /// let body = default_template(&ShapeParams::man())?;
    /// assert!(body.floor_y().abs() < 1e-6);
    /// let shod = Shoes { sole_m: 0.03 }.on(&body)?;
    /// assert!((shod.floor_y() + 0.03).abs() < 1e-3);
    /// # Ok::<(), flyrig_body::BodyError>(())
    /// ```
    #[must_use]
    pub fn floor_y(&self) -> f64 {
        let is_foot = |part: &Part| matches!(part, Part::LeftFoot | Part::RightFoot);
        let origins = self.skeleton.canonical_origins();
        let parts = part_of_joints(&self.skeleton);
        let has_feet = parts.iter().any(is_foot);
        let joints = origins.iter().zip(&parts).filter(|(_, part)| is_foot(part) || !has_feet);
        let lowest_joint = lowest(joints.map(|(origin, _)| origin.y)).unwrap_or(0.0);
        let range = lowest_joint - LOWEST_SOLE_M..=lowest_joint + LOWEST_SOLE_M;
        let feet = self.positions.iter().zip(&self.parts).filter(|(_, part)| is_foot(part));
        let heights = feet.map(|(position, _)| f64::from(position.y)).filter(|height| range.contains(height));
        lowest(heights).unwrap_or(lowest_joint - USUAL_TOE_HEIGHT_M)
    }
}

fn lowest(heights: impl Iterator<Item = f64>) -> Option<f64> {
    heights.filter(|height| height.is_finite()).min_by(f64::total_cmp)
}
