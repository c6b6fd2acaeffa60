//! Check of the world's up direction against a person: feet are below the head.

use glam::DVec3;

/// Angle between a person and the up direction beyond which the latter is doubted, degrees. People lean and bend.
const MOST_LEAN_DEG: f64 = 60.0;
/// Angle to a world axis within which a person's direction means that axis, degrees.
const SNAP_DEG: f64 = 20.0;
/// Length of the mean of the directions below which the person does not keep one: bends, lies or turns over.
const LEAST_STEADY: f64 = 0.9;

/// Mean direction from the feet to the head of a person, over frame sets.
///
/// ```
/// use flyrig_fusion::Upright;
/// use glam::DVec3;
///
/// let mut upright = Upright::default();
/// upright.add(DVec3::new(0.1, 0.0, 1.0));
/// upright.add(DVec3::new(-0.1, 0.0, 1.0));
/// assert_eq!(upright.up(), Some(DVec3::Z));
/// assert_eq!(upright.fault(DVec3::Z), None);
/// assert!(upright.fault(-DVec3::Z).is_some_and(|fault| fault.starts_with("the world is upside down")));
/// ```
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Upright {
    sum: DVec3,
    count: u32,
}

impl Upright {
    /// Adds the direction from the feet to the head in one frame set, world axes; one that is not finite is left out.
    pub fn add(&mut self, direction: DVec3) {
        if let Some(direction) = direction.try_normalize() {
            self.sum += direction;
            self.count += 1;
        }
    }

    /// Returns the number of added directions.
    #[must_use]
    pub fn count(&self) -> u32 {
        self.count
    }

    /// Returns the up direction that the person tells, a unit vector: the world axis near the mean direction, or that direction.
    /// `None` where the person does not keep one direction.
    #[must_use]
    pub fn up(&self) -> Option<DVec3> {
        let mean = self.sum / f64::from(self.count.max(1));
        let up = mean.try_normalize().filter(|_| mean.length() > LEAST_STEADY)?;
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| axis * axis.dot(up).signum());
        Some(axes.into_iter().find(|axis| axis.angle_between(up).to_degrees() < SNAP_DEG).unwrap_or(up))
    }

    /// Returns what contradicts a world's up direction, in a sentence with the fix; `None` where the person agrees or tells nothing.
    #[must_use]
    pub fn fault(&self, world_up: DVec3) -> Option<String> {
        let up = self.up()?;
        let off = up.angle_between(world_up).to_degrees();
        let fault = if off > 180.0 - MOST_LEAN_DEG {
            "the world is upside down"
        } else if off > MOST_LEAN_DEG {
            "the world lies on its side"
        } else {
            return None;
        };
        let text = |up: DVec3| format!("[{:.3}, {:.3}, {:.3}]", up.x + 0.0, up.y + 0.0, up.z + 0.0);
        Some(format!(
            "{fault}: up is {} in the calibration, but {} from the feet to the head of the person; correct `up` in calibration.toml \
             (`flyrig calibrate convert` writes one)",
            text(world_up),
            text(up)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(directions: &[DVec3]) -> Upright {
        let mut upright = Upright::default();
        directions.iter().for_each(|direction| upright.add(*direction));
        upright
    }

    #[test]
    fn a_world_upside_down_or_on_its_side_is_named() {
        let leaning = of(&[DVec3::new(0.3, 0.1, 1.0), DVec3::new(0.2, -0.1, 1.0)]);
        assert_eq!(leaning.fault(DVec3::Z), None);
        let fault = |up: DVec3| leaning.fault(up).unwrap();
        assert!(fault(DVec3::NEG_Z).contains("upside down: up is [0.000, 0.000, -1.000]"), "{}", fault(DVec3::NEG_Z));
        assert!(fault(DVec3::Y).contains("on its side") && fault(DVec3::Y).contains("but [0.000, 0.000, 1.000]"));
        // Not near an axis: as it is.
        let oblique = of(&[DVec3::new(1.0, 1.0, 0.0)]);
        assert!(oblique.up().unwrap().distance(DVec3::new(1.0, 1.0, 0.0).normalize()) < 1e-12);
    }

    #[test]
    fn who_keeps_no_direction_tells_nothing() {
        assert_eq!(of(&[]).up(), None);
        assert_eq!(of(&[DVec3::Z, DVec3::X]).fault(DVec3::NEG_Z), None);
        assert_eq!(of(&[DVec3::NAN, DVec3::ZERO, DVec3::INFINITY]).count(), 0);
    }
}
