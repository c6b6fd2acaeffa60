//! Views that a live rig publishes: its own, and those that viewers request. Only watched views are rendered, within the viewers' budget
//! of pixels.

use std::time::{Duration, Instant};

use flyrig_types::{Camera, FrameSet, RenderedView};
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
    /// Draws a requested view.
    draw: fn(&mut Session, &Camera) -> Result<RenderedView, FusionError>,
}

impl LiveViews {
    /// Chooses the rig's own views: `main`, `main-1`, ... spread around the people.
    #[must_use]
    pub fn new(settings: &OutputSettings) -> Self {
        let name = |i: usize| if i == 0 { "main".to_owned() } else { format!("main-{i}") };
        let names = (0..settings.views).map(name).collect();
        Self { names, width: settings.width, height: settings.height, draw: Session::render }
    }

    /// Renders the watched views and hands them to the publisher. `at` turns the rig's own views. Returns the number of rendered views.
    ///
    /// # Errors
    /// Faults of the graphics device and of the transport session. A requested view that cannot be rendered, or panics, is no error.
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
            match session.render_or_catch(|session| (self.draw)(session, &viewpoint.camera)) {
                Ok(view) => {
                    publisher.publish_viewpoint(&viewpoint, view, set);
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

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use flyrig_gpu::{AdapterChoice, GpuContext};
    use flyrig_transport::{Interests, Publisher, Subscriber, TransportConfig, ViewpointStatus};
    use flyrig_types::{Frame, Image, Intrinsics, Isometry, PersonId, PixelFormat, PoseTrack, Rig};
    use glam::DVec3;

    use super::*;
    use crate::{
        perception::given::{GivenPerception, GivenPerson},
        session::SessionBuilder,
        settings::{body::BodySettings, session::SessionSettings},
    };

    fn camera(name: &str, side: u32) -> Camera {
        let pose = Isometry::look_at(DVec3::new(0.0, 1.0, 3.4), DVec3::new(0.0, 0.85, 0.0), DVec3::Y);
        Camera::new(name, Intrinsics::pinhole(side, side, f64::from(side)), pose)
    }

    /// Returns a session whose one person is posed, and its frame set.
    fn session() -> (Session, FrameSet) {
        let rig = Rig { cameras: vec![camera("a", 32)], world_up: DVec3::Y };
        let template = default_template(&ShapeParams::default()).unwrap();
        let track = PoseTrack::new(vec![(0, template.skeleton.rest_pose())]).unwrap();
        let person = GivenPerson { person: PersonId(0), template, track, repeat: false };
        let perception = GivenPerception::new(&rig, vec![person]);
        let settings = SessionSettings { body: BodySettings::with_gaussians(600), ..SessionSettings::default() };
        let frame = Frame {
            camera: "a".into(),
            sequence: 0,
            capture_nanos: 0,
            exposure_nanos: None,
            image: Image::new(32, 32, PixelFormat::Rgb8, vec![90; 32 * 32 * 3]).unwrap(),
            mask: Some(flyrig_types::Mask::new(32, 32, vec![0; 32 * 32]).unwrap()),
        };
        let set = FrameSet { index: 0, master_nanos: 0, frames: vec![Some(std::sync::Arc::new(frame))] };
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let mut session = SessionBuilder::new(gpu, rig).settings(settings).perception(perception).build().unwrap();
        session.process(&set).unwrap();
        assert!(session.has_people());
        (session, set)
    }

    fn wait_until(what: &str, mut is_true: impl FnMut() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(90);
        while !is_true() {
            assert!(Instant::now() < deadline, "waited in vain for {what}");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    #[test]
    fn a_panic_while_a_viewers_view_is_drawn_ends_that_viewpoint_alone() {
        let (mut session, set) = session();
        // No pause of the machine ends a lease, which is renewed in a third of it.
        let config = TransportConfig {
            listen: vec!["tcp/127.0.0.1:0".to_owned()],
            viewpoint_lease_millis: 12_000,
            ..TransportConfig::publisher("v")
        };
        let publisher = LivePublisher::start(Publisher::open(&config).unwrap(), 85).unwrap();
        let connect = publisher.publisher().endpoints().to_vec();
        let [bad, good] = [16, 64].map(|side| {
            let config = TransportConfig { connect: connect.clone(), ..TransportConfig::subscriber("v") };
            let subscriber = Subscriber::open(&config, &Interests::default()).unwrap();
            subscriber.request_viewpoint(&camera("mine", side), 30.0).unwrap();
            wait_until("a watched viewpoint", || {
                publisher.publisher().has_subscribers(&subscriber.viewpoint_view())
                    && matches!(subscriber.viewpoint_status(), ViewpointStatus::Granted { .. })
            });
            subscriber
        });
        let before = session.render(&camera("mine", 64)).unwrap();
        let mut views = LiveViews::new(&OutputSettings { views: 0, ..OutputSettings::default() });
        views.draw = |session, camera| {
            let drawn = session.render(camera);
            assert!(camera.size() != [16, 16], "injected");
            drawn
        };
        let mut drawn = 0;
        wait_until("the refusal", || {
            drawn += views.publish(&mut session, &publisher, &set, Duration::ZERO).unwrap();
            matches!(bad.viewpoint_status(), ViewpointStatus::Refused { reason } if reason.contains("panicked: injected"))
        });
        assert!(drawn > 0 && matches!(good.viewpoint_status(), ViewpointStatus::Granted { .. }));
        assert_eq!(session.render(&camera("mine", 64)).unwrap().rgba, before.rgba);
        assert_eq!(publisher.publisher().viewpoint_counts().active, 1);
        assert!(publisher.threads().iter().all(|thread| thread.restarts == 0));
        publisher.finish().unwrap();
    }
}
