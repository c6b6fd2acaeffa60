//! Closed motion and its sampling as poses.

use flyrig_types::PoseTrack;

use crate::error::SimError;
use crate::motion::curve::smooth_above;
use crate::motion::posture::Posture;
use crate::motion::puppet::Puppet;

/// Sampling rate of the poses, keys per second.
const KEYS_A_SECOND: f64 = 60.0;

/// Closed motion.
pub(crate) struct Clip<'a> {
    /// Duration of a cycle, seconds.
    pub secs: f64,
    /// Posture at a phase in 0..1 of the cycle.
    pub posture: Box<dyn Fn(f64) -> Posture + 'a>,
}

impl<'a> Clip<'a> {
    pub(super) fn new(secs: f64, posture: impl Fn(f64) -> Posture + 'a) -> Self {
        Self { secs, posture: Box::new(posture) }
    }

    /// Samples one cycle as poses, its end equal to its start, from a phase on.
    pub(crate) fn track(&self, puppet: &Puppet<'_>, phase: f64) -> Result<PoseTrack, SimError> {
        /// Keys over which the hips are lowered and raised around a place where the legs require it.
        const SOFT_KEYS: usize = 6;
        let count = (self.secs * KEYS_A_SECOND).ceil().max(2.0) as usize;
        let postures: Vec<Posture> =
            (0..count).map(|key| (self.posture)((key as f64 / count as f64 + phase).rem_euclid(1.0))).collect();
        let too_high: Vec<f64> = postures.iter().map(|posture| puppet.too_high_m(posture)).collect();
        let lower = smooth_above(&too_high, SOFT_KEYS);
        let key = |index: usize| {
            let nanos = (index as f64 / count as f64 * self.secs * 1e9) as i64;
            (nanos, puppet.pose(&postures[index % count], lower[index % count]))
        };
        Ok(PoseTrack::new((0..=count).map(key).collect())?)
    }

    /// Returns the static posture at a phase.
    pub(crate) fn held(&self, puppet: &Puppet<'_>, phase: f64) -> Result<PoseTrack, SimError> {
        let posture = (self.posture)(phase.rem_euclid(1.0));
        Ok(PoseTrack::new(vec![(0, puppet.pose(&posture, puppet.too_high_m(&posture)))])?)
    }
}
