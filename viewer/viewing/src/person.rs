//! One person of the stream.

use std::{collections::VecDeque, sync::Arc};

use flyrig_stream::{ColorDecoder, Motion, Posed, PosedAxes, Stamp, StreamError, StreamTemplate};

/// Number of motions that are kept for interpolation.
const KEPT: usize = 16;
/// Largest delay that interpolation adds.
const MOST_DELAY_SECS: f64 = 0.5;
/// Rate at which the estimate of the least latency follows a drifting clock, seconds per second.
const DRIFT: f64 = 1e-3;
/// Longest time for which a person is held while motion of a template comes that is on its way, seconds.
const MOST_HELD_SECS: f64 = 30.0;
/// Time without motion, in addition to three intervals, after which a person is gone.
const GONE_AFTER_SECS: f64 = 3.0;

/// Template, last motions and colours of one person.
///
/// ```
/// use std::sync::Arc;
///
/// use flyrig_stream::{Motion, MotionEncoder, Posed, Stamp, StreamJoint, TemplateSource};
/// use flyrig_viewing::StreamPerson;
///
/// let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
/// let source = TemplateSource {
///     joints: &[StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }],
///     center_scale: &[[0.0, 0.0, 0.0, 0.01]],
///     normals: &[[0.0, 0.0, 1.0]],
///     skin: &[([0; 4], [1.0, 0.0, 0.0, 0.0])],
///     node_weights: &[],
///     nodes: &[],
/// };
/// let encoded = source.encode()?;
/// let mut person = StreamPerson::new(Arc::new(encoded.template.clone()));
/// let mut encoder = MotionEncoder::new(&encoded);
/// for (frame, x) in [(0, 0.0), (1, 0.4)] {
///     let stamp = Stamp { frame, capture_nanos: 100_000_000 * frame as i64, ..Stamp::default() };
///     let rotations = vec![[0.0, 0.0, 0.0, 1.0]];
///     let motion = Motion { stamp, root_translation: [x, 0.0, 0.0], joint_rotations: rotations, nodes: vec![] };
///     person.ingest_motion(&encoder.encode(&motion)?, 0.1 * frame as f64)?;
/// }
/// let between = person.motion_at(0.2, true).unwrap_or_default();
/// let mut posed = Posed::default();
/// let colors = person.pose(&between, &mut posed);
/// assert!((posed.center_scale[0][0] - 0.2).abs() < 1e-2 && colors.len() == 1);
/// # Ok::<(), flyrig_stream::StreamError>(())
/// ```
#[derive(Debug)]
pub struct StreamPerson {
    template: Arc<StreamTemplate>,
    decoder: ColorDecoder,
    /// Linear colours, shared with the views under way.
    colors: Arc<Vec<[f32; 4]>>,
    colors_are_current: bool,
    /// Number of messages of colours.
    color_changes: u64,
    /// Arrival by the viewer's clock, seconds, and motion.
    motions: VecDeque<(f64, Motion)>,
    /// Last arrival of a motion of another template, seconds; see [`Self::hold`].
    held: Option<f64>,
    /// Smoothed time between motions by the rig's clock, seconds.
    interval: f64,
    /// Least latency: arrival minus capture time, seconds.
    fastest: Option<f64>,
}

impl StreamPerson {
    /// Creates a person of whom only the template is known.
    #[must_use]
    pub fn new(template: Arc<StreamTemplate>) -> Self {
        Self {
            decoder: ColorDecoder::new(&template),
            colors: Arc::default(),
            colors_are_current: false,
            color_changes: 0,
            motions: VecDeque::new(),
            held: None,
            interval: 0.0,
            fastest: None,
            template,
        }
    }

    /// Returns the template.
    #[must_use]
    pub fn template(&self) -> &StreamTemplate {
        &self.template
    }

    /// Ingests a motion that arrived at `now`, seconds of the viewer's clock; motions older than the newest are ignored.
    ///
    /// # Errors
    /// As [`Motion::decode`].
    pub fn ingest_motion(&mut self, bytes: &[u8], now: f64) -> Result<(), StreamError> {
        let motion = Motion::decode(bytes, &self.template)?;
        let capture = |motion: &Motion| motion.stamp.capture_nanos as f64 / 1e9;
        if let Some((_, last)) = self.motions.back() {
            let step = capture(&motion) - capture(last);
            if step <= 0.0 && step > -GONE_AFTER_SECS {
                return Ok(());
            }
            if step <= 0.0 || step > 10.0 * GONE_AFTER_SECS {
                // The rig restarted, or was absent.
                self.motions.clear();
                (self.fastest, self.interval) = (None, 0.0);
            } else {
                self.interval = if self.interval > 0.0 { self.interval + 0.2 * (step - self.interval) } else { step };
            }
        }
        let way = now - capture(&motion);
        self.fastest = Some(self.fastest.map_or(way, |fastest| way.min(fastest + DRIFT * self.interval)));
        self.motions.push_back((now, motion));
        while self.motions.len() > KEPT {
            self.motions.pop_front();
        }
        Ok(())
    }

    /// Notes that a motion of a template that is on its way has arrived at `now`: unless the person is gone, its last motion is shown on,
    /// for 30 s at most.
    pub fn hold(&mut self, now: f64) {
        let is_recent = self.motions.back().is_some_and(|(arrived, _)| now - arrived < MOST_HELD_SECS);
        if is_recent && self.motion_at(now, false).is_some() {
            self.held = Some(now);
        }
    }

    /// Ingests a layer of colours.
    ///
    /// # Errors
    /// As [`ColorDecoder::ingest`].
    pub fn ingest_colors(&mut self, bytes: &[u8]) -> Result<Stamp, StreamError> {
        let stamp = self.decoder.ingest(bytes)?;
        self.colors_are_current = false;
        self.color_changes += 1;
        Ok(stamp)
    }

    /// Returns the motion to show at `now`: the newest, or interpolated with a delay of one interval and a half beyond the least latency, so
    /// that the next motion has usually arrived. `None` for a person that is gone.
    #[must_use]
    pub fn motion_at(&self, now: f64, interpolate: bool) -> Option<Motion> {
        let (arrived, newest) = self.motions.back()?;
        let arrived = self.held.map_or(*arrived, |held| held.max(*arrived));
        // A slow rig has long intervals.
        if now - arrived > GONE_AFTER_SECS + 3.0 * self.interval {
            return None;
        }
        let (Some(fastest), true) = (self.fastest, interpolate) else { return Some(newest.clone()) };
        let delay = (1.5 * self.interval).min(MOST_DELAY_SECS);
        let wanted = now - fastest - delay;
        let capture = |at: usize| self.motions[at].1.stamp.capture_nanos as f64 / 1e9;
        let next = (0..self.motions.len()).find(|&at| capture(at) > wanted);
        Some(match next {
            None => newest.clone(),
            Some(0) => self.motions[0].1.clone(),
            Some(at) => {
                let (before, after) = (&self.motions[at - 1].1, &self.motions[at].1);
                let share = (wanted - capture(at - 1)) / (capture(at) - capture(at - 1));
                before.interpolate(after, share as f32)
            }
        })
    }

    /// Poses the person and returns its linear colours, one element per Gaussian each.
    pub fn pose(&mut self, motion: &Motion, posed: &mut Posed) -> Arc<Vec<[f32; 4]>> {
        self.template.pose(motion, posed);
        if self.template.has_colors() {
            // The light changes the colours in each pose.
            self.template.avatar_colors(posed, Arc::make_mut(&mut self.colors));
            return Arc::clone(&self.colors);
        }
        if !std::mem::replace(&mut self.colors_are_current, true) {
            self.decoder.colors(Arc::make_mut(&mut self.colors));
        }
        Arc::clone(&self.colors)
    }

    /// Poses the axes of an avatar's Gaussians, which [`Self::pose`] has put in `posed`. Returns false for a person of isotropic Gaussians.
    pub fn pose_axes(&self, motion: &Motion, posed: &Posed, axes: &mut PosedAxes) -> bool {
        self.template.pose_axes(motion, posed, axes)
    }

    /// Returns whether every part of the person has its colours, down to the finest layer.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.template.has_colors() || (0..flyrig_stream::LAYERS).all(|layer| self.decoder.known(layer) >= 1.0)
    }

    /// Returns whether every part of the person has at least its coarsest colours.
    #[must_use]
    pub fn is_painted(&self) -> bool {
        self.template.has_colors() || self.decoder.known(0) >= 1.0
    }

    /// Returns whether a motion has arrived.
    #[must_use]
    pub fn is_moving(&self) -> bool {
        !self.motions.is_empty()
    }

    /// Returns the number of colour messages so far: an unchanged number means unchanged colours.
    #[must_use]
    pub fn color_changes(&self) -> u64 {
        self.color_changes
    }
}
