//! Feet that stand, roll and swing from plant to plant.

use glam::DVec2;

use crate::motion::curve::{closed, ease, hump};
use crate::motion::posture::Foot;

/// Stance fraction of a walking foot's cycle (Perry, Gait Analysis, 1992).
pub(crate) const STANCE: f64 = 0.62;

/// Place where a foot stands. Phases run over a closed clip.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plant {
    /// Phase at which the foot leaves the previous plant.
    pub leaves: f64,
    /// Phase at which the foot lands here.
    pub lands: f64,
    /// Ankle on the ground (x, z), metres of the average body.
    pub at: DVec2,
    /// Heading, radians.
    pub yaw: f64,
}

/// Lift of swinging feet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Gait {
    /// Height of a swinging foot, metres of the average body.
    pub lift_m: f64,
    /// Heel up when it leaves, radians.
    pub push: f64,
    /// Toes up when it lands, radians.
    pub strike: f64,
}

/// Returns the foot at a phase of a closed clip whose plants land one after the other; each cycle turns by `turn`
/// radians.
pub(crate) fn foot(plants: &[Plant], phase: f64, turn: f64, gait: Gait) -> Foot {
    // The plant of any round, -1 being the round before.
    let count = plants.len() as i64;
    let plant = |index: i64| {
        let round = index.div_euclid(count) as f64;
        let plant = plants[index.rem_euclid(count) as usize];
        Plant { leaves: plant.leaves + round, lands: plant.lands + round, yaw: plant.yaw + turn * round, ..plant }
    };
    if plants.is_empty() {
        return Foot::planted(DVec2::ZERO, 0.0);
    }
    let mut next = 0;
    while plant(next).lands > phase {
        next -= 1;
    }
    while plant(next).lands <= phase {
        next += 1;
    }
    let (from, to) = (plant(next - 1), plant(next));
    let rolled = |cycle: f64| {
        let (push, strike) = (gait.push, gait.strike);
        let rise =
            closed(cycle, &[(0.12, 0.0), (0.34, 0.0), (STANCE, 0.80), (0.70, 1.0), (0.86, 0.0), (1.0 - 1e-9, 0.0)]);
        let toes = closed(cycle, &[(0.0, 1.0), (0.12, 0.0), (0.86, 0.0)]);
        push * rise - strike * toes
    };
    if phase < to.leaves {
        let share = (phase - from.lands) / (to.leaves - from.lands).max(1e-9);
        let roll = rolled(STANCE * share);
        return Foot { roll, pivot: ease((share - 0.25) / 0.2), ..Foot::planted(from.at, from.yaw) };
    }
    let share = (phase - to.leaves) / (to.lands - to.leaves).max(1e-9);
    // Up before it goes on, down after it has arrived.
    let moved = ease((share - 0.12) / 0.78);
    Foot {
        at: from.at.lerp(to.at, moved),
        lift: gait.lift_m * hump(share),
        yaw: from.yaw + (to.yaw - from.yaw) * moved,
        roll: rolled(STANCE + (1.0 - STANCE) * share),
        // While it neither points down nor up.
        pivot: 1.0 - ease((share - 0.57) / 0.12),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn feet_stand_where_planted_swing_between_and_close_the_round() {
        let plant = |leaves, lands, x, yaw| Plant { leaves, lands, at: DVec2::new(x, 0.0), yaw };
        let plants = [plant(-0.2, 0.1, 0.0, 0.0), plant(0.4, 0.6, 0.5, 1.0)];
        let gait = Gait { lift_m: 0.1, push: 0.6, strike: 0.2 };
        let at = |phase| foot(&plants, phase, 2.0, gait);
        assert!(at(0.3).lift.abs() < 1e-12 && at(0.3).at.x.abs() < 1e-12 && at(0.3).roll >= 0.0);
        assert!((at(0.5).at.x - 0.25).abs() < 0.02 && (at(0.5).lift - 0.1).abs() < 1e-9);
        assert!((at(0.7).at.x - 0.5).abs() < 1e-12 && (at(0.7).yaw - 1.0).abs() < 1e-12);
        // A round later it is at the same place and has turned.
        for phase in [-1.3, 0.0, 0.05, 0.45, 0.9] {
            let (a, b) = (at(phase), at(phase + 1.0));
            assert!(a.at.distance(b.at) < 1e-9 && (b.yaw - a.yaw - 2.0).abs() < 1e-9 && (a.roll - b.roll).abs() < 1e-9);
        }
        // No jumps.
        for i in 0..4000 {
            let (a, b) = (at(f64::from(i) / 2000.0), at(f64::from(i + 1) / 2000.0));
            assert!(a.at.distance(b.at) < 7e-3 && (a.lift - b.lift).abs() < 2e-3 && (a.roll - b.roll).abs() < 0.02);
        }
    }
}
