//! The watcher's side.

use std::time::Duration;

use flyrig_types::{Camera, Rig};

use crate::{Header, RigStats, SplatState, TransportConfig, TransportError, ViewFrame, ViewpointStatus};

/// Which views to receive.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Views {
    /// None.
    #[default]
    None,
    /// Every view of the rig (not other subscribers' viewpoints).
    All,
    /// These.
    Named(Vec<String>),
}

/// What to receive; the rest is not sent to us at all. Calibration always comes, a viewpoint when asked for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Interests {
    /// Views.
    pub views: Views,
    /// The splat stream.
    pub splats: bool,
    /// The rig's statistics.
    pub stats: bool,
}

/// A message with what its header said.
#[derive(Debug, Clone, PartialEq)]
pub struct Received<T> {
    /// Name of the view, else the topic.
    pub topic: String,
    /// Its header.
    pub header: Header,
    /// Publisher's hand-in to our receipt, by wall clocks; may be negative between hosts.
    pub latency_nanos: i64,
    /// Whether both ends run on one host, so that the latency is exact (unless the clock is set meanwhile).
    pub latency_is_exact: bool,
    /// The message.
    pub body: T,
}

/// Latencies of the last messages (at most 256).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatencyReport {
    /// Median, milliseconds.
    pub p50_millis: f64,
    /// 99 of 100 are below, milliseconds.
    pub p99_millis: f64,
    /// Longest, milliseconds.
    pub max_millis: f64,
    /// Whether all came from this host; if not, the difference of the hosts' clocks is inside.
    pub is_exact: bool,
}

/// What came in on one topic since the start.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TopicReport {
    /// Messages.
    pub received: u64,
    /// Payload bytes.
    pub bytes: u64,
    /// Messages that the publisher handed in but that never came, by gaps of the sequence.
    pub missed: u64,
    /// Messages that a newer one replaced before we were asked for them.
    pub replaced: u64,
    /// Changes of publisher (restarts).
    pub restarts: u64,
    /// Messages a second, over the last ones (at most 256).
    pub per_second: f64,
    /// Latency, once something came.
    pub latency: Option<LatencyReport>,
}

/// Receives a rig; the newest message of a topic waits for its reader, older ones are replaced and counted.
#[derive(Debug)]
pub struct Subscriber {}

impl Subscriber {
    /// Opens the session; the publisher may come later.
    ///
    /// # Errors
    /// `Config` or `Session`.
    pub fn open(config: &TransportConfig, _interests: &Interests) -> Result<Self, TransportError> {
        config.validate()?;
        Ok(Self {})
    }

    /// Our name towards the publisher.
    #[must_use]
    pub fn id(&self) -> &str {
        ""
    }

    /// Name of the view that our own viewpoint arrives as.
    #[must_use]
    pub fn viewpoint_view(&self) -> String {
        String::new()
    }

    /// The next picture nobody has taken yet, of any view (views take turns); `None` after the timeout.
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`, once for each such message; it is fine to go on.
    pub fn next_view(&self, _timeout: Duration) -> Result<Option<Received<ViewFrame>>, TransportError> {
        Ok(None)
    }

    /// The newest splat state nobody has taken yet; `None` after the timeout.
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn next_splats(&self, _timeout: Duration) -> Result<Option<Received<SplatState>>, TransportError> {
        Ok(None)
    }

    /// The newest statistics nobody has taken yet; `None` after the timeout.
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn next_stats(&self, _timeout: Duration) -> Result<Option<Received<RigStats>>, TransportError> {
        Ok(None)
    }

    /// The rig's cameras once all of them have come; waits at most `timeout` (may be zero).
    ///
    /// # Errors
    /// As [`Self::next_view`].
    pub fn rig(&self, _timeout: Duration) -> Result<Option<Rig>, TransportError> {
        Ok(None)
    }

    /// Asks for pictures through a camera of our own, or moves it; renewed until given back. The
    /// pictures come with [`Self::next_view`] as the view [`Self::viewpoint_view`].
    ///
    /// # Errors
    /// `Config` when the camera is not valid, larger than 4096 pixels a side, or `max_fps` is not in 0..=1000.
    pub fn request_viewpoint(&self, _camera: &Camera, _max_fps: f64) -> Result<(), TransportError> {
        Ok(())
    }

    /// Gives our viewpoint back.
    pub fn release_viewpoint(&self) {}

    /// How our viewpoint stands.
    #[must_use]
    pub fn viewpoint_status(&self) -> ViewpointStatus {
        ViewpointStatus::Idle
    }

    /// Number of publishers of this rig and our schema version that live now.
    #[must_use]
    pub fn publishers(&self) -> usize {
        0
    }

    /// What came in, a topic each (`view/NAME`, `splats`, ...).
    #[must_use]
    pub fn reports(&self) -> Vec<(String, TopicReport)> {
        vec![]
    }

    /// Messages that could not be read since the start.
    #[must_use]
    pub fn unreadable(&self) -> u64 {
        0
    }

    /// Ends the session; dropping does the same but says nothing.
    ///
    /// # Errors
    /// `Session` when zenoh fails to close.
    pub fn close(self) -> Result<(), TransportError> {
        Ok(())
    }
}
