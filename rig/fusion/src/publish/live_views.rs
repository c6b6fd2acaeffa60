//! Views that a live rig publishes: its own, and those that viewers request. Only watched views are rendered, within the viewers' budget
//! of pixels.

use std::time::{Duration, Instant};

use flyrig_types::FrameSet;
use serde::{Deserialize, Serialize};

use super::{live_publisher::LivePublisher, orbit::orbit};
use crate::{error::FusionError, session::Session, settings::range::check};

/// Turns per second of the rig's own views, so that a viewer who stands still sees all sides.
const ORBIT_TURNS_PER_SECOND: f64 = 0.05;

/// Table `[output]`: the published views and people.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OutputSettings {
    /// Number of views on a circle around the people.
    pub views: usize,
    /// Width of each view, pixels.
    pub width: u32,
    /// Height of each view, pixels.
    pub height: u32,
    /// Quality of the published JPEG images, 1..=100.
    pub jpeg_quality: u8,
    /// Whether the Gaussians are published as well.
    pub splats: bool,
    /// Whether viewers get the first person's avatar once and then its pose alone, in place of its surface, motion and colours.
    pub avatar: bool,
}

impl Default for OutputSettings {
    fn default() -> Self {
        Self { views: 1, width: 512, height: 512, jpeg_quality: 85, splats: true, avatar: false }
    }
}

impl OutputSettings {
    /// Checks every value.
    ///
    /// # Errors
    /// [`FusionError::Setting`] names the key and the range.
    pub fn validate(&self) -> Result<(), FusionError> {
        check("output.views", self.views as f64, 0.0, 16.0)?;
        check("output.width", f64::from(self.width), 16.0, 4096.0)?;
        check("output.height", f64::from(self.height), 16.0, 4096.0)?;
        check("output.jpeg_quality", f64::from(self.jpeg_quality), 1.0, 100.0)
    }
}

/// Renderer and publisher of views. Nothing is rendered without a recipient.
#[derive(Debug)]
pub struct LiveViews {
    names: Vec<String>,
    width: u32,
    height: u32,
}

impl LiveViews {
    /// Chooses the rig's own views: `main`, `main-1`, ... spread around the people.
    #[must_use]
    pub fn new(settings: &OutputSettings) -> Self {
        let name = |i: usize| if i == 0 { "main".to_owned() } else { format!("main-{i}") };
        Self { names: (0..settings.views).map(name).collect(), width: settings.width, height: settings.height }
    }

    /// Renders the watched views and hands them to the publisher. `at` turns the rig's own views. Returns the number of rendered views.
    ///
    /// # Errors
    /// Faults of the graphics device and of the transport session. A requested view that cannot be rendered is no error.
    pub fn publish(
        &self,
        session: &mut Session,
        publisher: &LivePublisher,
        set: &FrameSet,
        at: Duration,
    ) -> Result<usize, FusionError> {
        let mut count = 0;
        if !session.has_people() {
            return Ok(0);
        }
        for (i, name) in self.names.iter().enumerate() {
            publisher.publisher().add_view(name)?;
            if !publisher.publisher().has_subscribers(name) {
                continue;
            }
            let turn = i as f64 / self.names.len() as f64 + at.as_secs_f64() * ORBIT_TURNS_PER_SECOND;
            if let Some(camera) = orbit(session.rig(), turn, self.width, self.height, name) {
                publisher.publish(name, session.render(&camera)?, set);
                count += 1;
            }
        }
        for viewpoint in publisher.publisher().due_viewpoints(Instant::now()) {
            match session.render(&viewpoint.camera) {
                Ok(view) => {
                    publisher.publish(&viewpoint.view, view, set);
                    count += 1;
                }
                Err(error) => {
                    // The request is to blame, whatever it did to the device: no other viewer loses anything by it.
                    publisher.publisher().refuse_viewpoint(&viewpoint.subscriber, &error.to_string());
                    tracing::warn!(viewer = viewpoint.subscriber, %error, "viewpoint refused");
                    if error.is_device_fault() {
                        return Err(error);
                    }
                }
            }
        }
        Ok(count)
    }
}
