//! One person of the stream, as it has come so far.

use std::{collections::VecDeque, sync::Arc};

use flyrig_stream::{ColorDecoder, Motion, Posed, PosedAxes, Stamp, StreamError, StreamTemplate};

/// Motions that are kept to interpolate between.
const KEPT: usize = 16;
/// Longest delay that interpolation may add.
const MOST_DELAY_SECS: f64 = 0.5;
/// How fast the estimate of the fastest way follows a clock that drifts, seconds a second.
const DRIFT: f64 = 1e-3;
/// A person of whom no motion came for so long, and three intervals, is gone.
const GONE_AFTER_SECS: f64 = 3.0;

/// Template, last motions and colours of one person.
#[derive(Debug)]
pub struct StreamPerson {
    template: Arc<StreamTemplate>,
    decoder: ColorDecoder,
    /// Shared with the views under way.
    colors: Arc<Vec<[f32; 4]>>,
    colors_are_current: bool,
    /// Counts the messages of colours.
    color_changes: u64,
    /// Arrival, seconds of the viewer's clock, and motion.
    motions: VecDeque<(f64, Motion)>,
    /// Smoothed time between motions, seconds of the rig's clock.
    interval: f64,
    /// Least of arrival minus capture time: the fastest way, seconds.
    fastest: Option<f64>,
}

impl StreamPerson {
    /// A person nothing is known of but its template.
    #[must_use]
    pub fn new(template: Arc<StreamTemplate>) -> Self {
        Self {
            decoder: ColorDecoder::new(&template),
            colors: Arc::default(),
            colors_are_current: false,
            color_changes: 0,
            motions: VecDeque::new(),
            interval: 0.0,
            fastest: None,
            template,
        }
    }

    /// The template.
    #[must_use]
    pub fn template(&self) -> &StreamTemplate {
        &self.template
    }

    /// Takes in a motion that came at `now`, seconds of the viewer's clock; one that is older than the newest is left out.
    ///
    /// # Errors
    /// [`StreamError`].
    pub fn take_motion(&mut self, bytes: &[u8], now: f64) -> Result<(), StreamError> {
        let motion = Motion::decode(bytes, &self.template)?;
        let capture = |motion: &Motion| motion.stamp.capture_nanos as f64 / 1e9;
        if let Some((_, last)) = self.motions.back() {
            let step = capture(&motion) - capture(last);
            if step <= 0.0 && step > -GONE_AFTER_SECS {
                return Ok(());
            }
            if step <= 0.0 || step > 10.0 * GONE_AFTER_SECS {
                // The rig began anew, or was away.
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

    /// Takes in a layer of colours.
    ///
    /// # Errors
    /// [`StreamError`].
    pub fn take_colors(&mut self, bytes: &[u8]) -> Result<Stamp, StreamError> {
        let stamp = self.decoder.take(bytes)?;
        self.colors_are_current = false;
        self.color_changes += 1;
        Ok(stamp)
    }

    /// The motion to show at `now`: the newest, or interpolated one interval and a half later than the fastest message would
    /// allow, so that the next one has usually come. None for a person who is gone.
    #[must_use]
    pub fn motion_at(&self, now: f64, interpolate: bool) -> Option<Motion> {
        let (arrived, newest) = self.motions.back()?;
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

    /// Poses the person and returns its colours, an element a Gaussian each.
    pub fn pose(&mut self, motion: &Motion, posed: &mut Posed) -> Arc<Vec<[f32; 4]>> {
        self.template.pose(motion, posed);
        if self.template.is_avatar() {
            // Its light shows them differently in each pose.
            self.template.avatar_colors(posed, Arc::make_mut(&mut self.colors));
            return Arc::clone(&self.colors);
        }
        if !std::mem::replace(&mut self.colors_are_current, true) {
            self.decoder.colors(Arc::make_mut(&mut self.colors));
        }
        Arc::clone(&self.colors)
    }

    /// Poses the three axes of an avatar's Gaussians. Returns false for a person of isotropic ones.
    pub fn pose_axes(&self, motion: &Motion, axes: &mut PosedAxes) -> bool {
        self.template.pose_axes(motion, axes)
    }

    /// Whether every part of the person has its colours, down to the finest layer.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.template.is_avatar() || (0..flyrig_stream::LAYERS).all(|layer| self.decoder.known(layer) >= 1.0)
    }

    /// Number of colour messages so far: the same number means the same colours.
    #[must_use]
    pub fn color_changes(&self) -> u64 {
        self.color_changes
    }
}
