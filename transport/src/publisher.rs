//! The rig's side.

use std::sync::Arc;

use flyrig_types::Rig;

use crate::{RigStats, SplatState, TransportConfig, TransportError, ViewFrame, Viewpoint};

/// What became of a message that was handed in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PublishOutcome {
    /// It waits for the publisher thread.
    Queued,
    /// The same, and an older one that still waited is dropped.
    Replaced,
    /// Nobody subscribes: dropped at once, nothing encoded.
    Unwatched,
}

/// Counts of one topic since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TopicCounts {
    /// Handed in.
    pub offered: u64,
    /// Handed to zenoh.
    pub sent: u64,
    /// Dropped because a newer one came first.
    pub replaced: u64,
    /// Dropped because nobody subscribes.
    pub unwatched: u64,
    /// Could not be encoded or sent; the log says why.
    pub failed: u64,
    /// Payload bytes handed to zenoh.
    pub bytes: u64,
    /// Whether somebody subscribes now.
    pub watched: bool,
}

/// Counts of viewpoint requests since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ViewpointCounts {
    /// Now.
    pub active: usize,
    /// New ones granted (renewals do not count).
    pub granted: u64,
    /// Requests refused.
    pub refused: u64,
    /// Ended by their lease or because the subscriber went away.
    pub expired: u64,
}

/// Publishes a rig; no method waits for the network once it is open.
#[derive(Debug)]
pub struct Publisher {}

impl Publisher {
    /// Opens the session and starts the publisher thread.
    ///
    /// # Errors
    /// `Config` or `Session`.
    pub fn open(config: &TransportConfig) -> Result<Self, TransportError> {
        config.validate()?;
        Ok(Self {})
    }

    /// Endpoints it listens on, port 0 replaced by the real one.
    #[must_use]
    pub fn endpoints(&self) -> &[String] {
        &[]
    }

    /// Makes a view known so that subscribers of it are noticed before its first picture.
    ///
    /// # Errors
    /// `Config` for a bad name or too many views.
    pub fn add_view(&self, view: &str) -> Result<(), TransportError> {
        crate::keys::check_name("view", view)
    }

    /// Whether anybody subscribes to a view that was added or published, or to a requested viewpoint's view.
    #[must_use]
    pub fn has_subscribers(&self, _view: &str) -> bool {
        false
    }

    /// Whether anybody subscribes to the splats.
    #[must_use]
    pub fn has_splat_subscribers(&self) -> bool {
        false
    }

    /// Hands in a picture.
    ///
    /// # Errors
    /// `Config` for a bad name, size or too many views.
    pub fn publish_view(&self, _view: &str, _frame: ViewFrame) -> Result<PublishOutcome, TransportError> {
        Ok(PublishOutcome::Unwatched)
    }

    /// Hands in a splat state; it is encoded on the publisher thread.
    pub fn publish_splats(&self, _state: Arc<SplatState>) -> PublishOutcome {
        PublishOutcome::Unwatched
    }

    /// Hands in statistics.
    ///
    /// # Errors
    /// `Config` when a figure is not finite.
    pub fn publish_stats(&self, _stats: &RigStats) -> Result<PublishOutcome, TransportError> {
        Ok(PublishOutcome::Unwatched)
    }

    /// Sets the calibration; it is sent now, to every new subscriber, and once a second.
    ///
    /// # Errors
    /// `Config` when the rig is not valid or a camera's name cannot stand in a key.
    pub fn set_calibration(&self, _rig: &Rig) -> Result<(), TransportError> {
        Ok(())
    }

    /// Viewpoints whose lease runs.
    #[must_use]
    pub fn requested_viewpoints(&self) -> Vec<Viewpoint> {
        vec![]
    }

    /// Counts of viewpoint requests.
    #[must_use]
    pub fn viewpoint_counts(&self) -> ViewpointCounts {
        ViewpointCounts::default()
    }

    /// Counts a topic: `view/NAME`, `splats`, `stats`, ...
    #[must_use]
    pub fn counts(&self) -> Vec<(String, TopicCounts)> {
        vec![]
    }

    /// Ends the thread and the session; dropping does the same but says nothing.
    ///
    /// # Errors
    /// `Session` when zenoh fails to close.
    pub fn close(self) -> Result<(), TransportError> {
        Ok(())
    }
}
