//! Compression and publishing of views, Gaussians and statistics beside the session's thread.
//!
//! A thread named "encode" compresses views; a full queue drops its oldest view and counts it.

use std::{
    error::Error,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_capture::{LatestQueue, PopError};
use flyrig_renderer::composite_over;
use flyrig_transport::{
    ImageFormat, Publisher, RigStats, SplatState, StageStats, SubjectStats, TrackingStats, ViewFrame, ViewRate,
    Viewpoint,
};
use flyrig_types::{FrameSet, RenderedView, SupervisedThread, ThreadHealth, caught};
use image::{ExtendedColorType, ImageEncoder as _, codecs::jpeg::JpegEncoder};

use super::person_publisher::PersonPublisher;
use crate::{error::FusionError, session::Session, subject::person::Subject};

/// Capacity of the queue before compression, in views.
const WAITING_PICTURES: usize = 8;
/// Grey behind the people in published views, sRGB.
const BACKDROP: u8 = 30;
/// Time from one publishing of statistics to the next.
const STATS_EVERY: Duration = Duration::from_secs(1);
/// Interval of frame sets above which people are published without subscribers.
const SLOW_SET: Duration = Duration::from_millis(400);

/// View to compress and publish.
struct ViewJob {
    view: String,
    /// Viewer that has requested it; `None` for a view of the rig.
    viewer: Option<String>,
    picture: RenderedView,
    frame: u64,
    capture_nanos: i64,
}

/// Publisher of views, Gaussians, people and statistics, for which the session never waits.
pub struct LivePublisher {
    publisher: Arc<Publisher>,
    jobs: Arc<LatestQueue<ViewJob>>,
    encoder: SupervisedThread,
    people: PersonPublisher,
    /// Views that could not be compressed or published.
    failures: Arc<AtomicU64>,
    started: Instant,
    last_stats: Instant,
    /// Time of the last frame set that could be published.
    last_set: Instant,
    frames_at_last_stats: u64,
}

impl LivePublisher {
    /// Starts the compression thread.
    ///
    /// # Errors
    /// [`FusionError::Thread`] when the system starts none.
    pub fn start(publisher: Publisher, jpeg_quality: u8) -> Result<Self, FusionError> {
        Self::start_with(publisher, move |publisher, job| encode_one(publisher, job, jpeg_quality))
    }

    fn start_with(
        publisher: Publisher,
        encode: impl Fn(&Publisher, &ViewJob) -> Result<(), Box<dyn Error>> + Send + 'static,
    ) -> Result<Self, FusionError> {
        let publisher = Arc::new(publisher);
        let jobs = Arc::new(LatestQueue::new(WAITING_PICTURES));
        let failures = Arc::new(AtomicU64::new(0));
        let encoder = {
            let (publisher, jobs, failures) = (Arc::clone(&publisher), Arc::clone(&jobs), Arc::clone(&failures));
            let mut has_begun = false;
            let work = move || {
                // A restart: the view at which it panicked is lost.
                if std::mem::replace(&mut has_begun, true) {
                    failures.fetch_add(1, Ordering::Relaxed);
                }
                encode_all(&jobs, &failures, |job| encode_or_refuse(&publisher, job, &encode));
            };
            SupervisedThread::start("encode", work).map_err(|source| FusionError::Thread { name: "encode", source })?
        };
        let people = PersonPublisher::start(Arc::clone(&publisher))?;
        Ok(Self {
            publisher,
            jobs,
            encoder,
            people,
            failures,
            started: Instant::now(),
            last_stats: Instant::now(),
            last_set: Instant::now(),
            frames_at_last_stats: 0,
        })
    }

    /// Returns the transport's publisher, which knows the subscriptions.
    #[must_use]
    pub fn publisher(&self) -> &Publisher {
        &self.publisher
    }

    /// Queues a rendered view. When compression is behind, the oldest waiting view is dropped and counted.
    pub fn publish(&self, view: &str, picture: RenderedView, set: &FrameSet) {
        self.queue(view, None, picture, set);
    }

    /// Queues a rendered view that a viewer has requested, as [`Self::publish`] does. A panic while it is compressed ends the viewpoint.
    pub fn publish_viewpoint(&self, viewpoint: &Viewpoint, picture: RenderedView, set: &FrameSet) {
        self.queue(&viewpoint.view, Some(viewpoint.subscriber.clone()), picture, set);
    }

    fn queue(&self, view: &str, viewer: Option<String>, picture: RenderedView, set: &FrameSet) {
        let job = ViewJob { view: view.to_owned(), viewer, picture, frame: set.index, capture_nanos: set.master_nanos };
        drop(self.jobs.push(job));
    }

    /// Reads back the Gaussians of all people and queues them.
    ///
    /// # Errors
    /// [`FusionError::Gpu`].
    pub fn publish_splats(&self, session: &Session, set: &FrameSet) -> Result<(), FusionError> {
        for subject in session.subjects() {
            let splats = session.splats(subject.id())?;
            let state = SplatState {
                person: subject.id().0,
                frame: set.index,
                capture_nanos: set.master_nanos,
                center_scale: splats
                    .iter()
                    .map(|s| [s.position[0], s.position[1], s.position[2], s.scale_m[0]])
                    .collect(),
                color: splats.iter().map(|s| [s.color[0], s.color[1], s.color[2], s.opacity]).collect(),
                invalid: 0,
            };
            self.publisher.publish_splats(Arc::new(state));
        }
        Ok(())
    }

    /// Returns whether the people of this frame set are to be published: to subscribers, and by a slow rig also without any, so that a
    /// viewer that joins need not wait for the next frame set.
    pub fn wants_people(&mut self) -> bool {
        let interval = std::mem::replace(&mut self.last_set, Instant::now()).elapsed();
        interval >= SLOW_SET || self.publisher.has_person_subscribers()
    }

    /// Reads back the colours of all people and queues them with the motion.
    ///
    /// # Errors
    /// [`FusionError::Gpu`].
    pub fn publish_people(&self, session: &Session, set: &FrameSet) -> Result<(), FusionError> {
        for subject in session.subjects() {
            if let Some(frame) = session.person_frame(subject.id(), set)? {
                self.people.push(frame);
            }
        }
        Ok(())
    }

    /// Publishes statistics, once per second; returns whether it did. For `clock_offset_nanos` see [`RigStats`].
    pub fn publish_stats(
        &mut self,
        session: &Session,
        set: &FrameSet,
        frames: u64,
        clock_offset_nanos: Option<i64>,
        drops: &[(String, u64)],
    ) -> bool {
        let interval = self.last_stats.elapsed();
        if interval < STATS_EVERY {
            return false;
        }
        let frames_per_second = (frames - self.frames_at_last_stats.min(frames)) as f64 / interval.as_secs_f64();
        self.last_stats = Instant::now();
        self.frames_at_last_stats = frames;
        let stats = self.stats(session, set, frames_per_second, clock_offset_nanos, drops);
        if let Err(error) = self.publisher.publish_stats(&stats) {
            tracing::warn!(%error, "statistics not published");
        }
        true
    }

    /// Collects the statistics of the rig.
    fn stats(
        &self,
        session: &Session,
        set: &FrameSet,
        frames_per_second: f64,
        clock_offset_nanos: Option<i64>,
        drops: &[(String, u64)],
    ) -> RigStats {
        let uptime_secs = self.started.elapsed().as_secs_f64();
        let counts = self.publisher.counts();
        let views = counts
            .iter()
            .filter_map(|(topic, counts)| {
                Some(ViewRate {
                    view: topic.strip_prefix("view/")?.to_owned(),
                    per_second: counts.sent as f64 / uptime_secs,
                    bytes_per_second: counts.bytes as f64 / uptime_secs,
                })
            })
            .collect();
        RigStats {
            frame: set.index,
            capture_nanos: set.master_nanos,
            clock_offset_nanos,
            uptime_secs,
            frames_per_second,
            stages: session
                .stages
                .summary()
                .iter()
                .map(|s| StageStats {
                    stage: s.name.clone(),
                    mean_millis: f64::from(s.mean_ms),
                    p95_millis: f64::from(s.p95_ms),
                })
                .collect(),
            dropped: drops.iter().cloned().chain(self.drops()).collect(),
            views,
            viewers: self.publisher.viewpoint_counts().active as u32,
            budget: session.budget.stats(),
            learning: session.learning(),
            tracking: TrackingStats::default(),
            subjects: session.subjects().iter().map(stats_of).collect(),
            measuring_secs: session.measuring().map(|since| since.as_secs_f64()),
        }
    }

    /// Returns the health of the threads that compress and publish.
    #[must_use]
    pub fn threads(&self) -> [ThreadHealth; 3] {
        [self.encoder.health(), self.people.health(), self.publisher.thread()]
    }

    /// Counts the views that were lost on the way out, by place.
    #[must_use]
    pub fn drops(&self) -> Vec<(String, u64)> {
        let mut drops = vec![
            ("images waiting for compression".to_owned(), self.jobs.dropped()),
            ("people waiting for the stream".to_owned(), self.people.dropped()),
            ("images that failed".to_owned(), self.failures.load(Ordering::Relaxed)),
        ];
        drops.extend(self.publisher.counts().into_iter().map(|(topic, c)| (format!("published {topic}"), c.replaced)));
        drops
    }

    /// Publishes what waits, and ends the threads and the transport session.
    ///
    /// # Errors
    /// [`FusionError::Transport`].
    pub fn finish(mut self) -> Result<(), FusionError> {
        self.jobs.close();
        self.encoder.join();
        self.people.finish();
        match Arc::try_unwrap(self.publisher) {
            Ok(publisher) => Ok(publisher.close()?),
            Err(_) => Ok(()),
        }
    }
}

/// Returns the tracking statistics of one person.
fn stats_of(subject: &Subject) -> SubjectStats {
    let watch = subject.watch();
    SubjectStats {
        person: subject.id().0,
        state: watch.state().name().to_owned(),
        quality: watch.quality(),
        cameras: watch.cameras().iter().map(|(id, quality)| (id.to_string(), *quality)).collect(),
    }
}

/// Compresses and publishes views until the queue is closed.
fn encode_all(
    jobs: &LatestQueue<ViewJob>,
    failures: &AtomicU64,
    encode: impl Fn(&ViewJob) -> Result<(), Box<dyn Error>>,
) {
    loop {
        let job = match jobs.pop(Duration::from_millis(200)) {
            Ok(job) => job,
            Err(PopError::Timeout) => continue,
            Err(PopError::Closed) => return,
        };
        if let Err(error) = encode(&job) {
            failures.fetch_add(1, Ordering::Relaxed);
            tracing::warn!(view = job.view, %error, "view not published");
        }
    }
}

/// Compresses one view; a panic at one that a viewer has requested ends that viewpoint alone.
fn encode_or_refuse(
    publisher: &Publisher,
    job: &ViewJob,
    encode: impl Fn(&Publisher, &ViewJob) -> Result<(), Box<dyn Error>>,
) -> Result<(), Box<dyn Error>> {
    let Some(viewer) = &job.viewer else { return encode(publisher, job) };
    caught(|| encode(publisher, job)).unwrap_or_else(|panic| {
        let error = FusionError::View(panic);
        publisher.refuse_viewpoint(viewer, &error.to_string());
        Err(error.into())
    })
}

/// Compresses one view over the backdrop, and publishes it as JPEG.
fn encode_one(publisher: &Publisher, job: &ViewJob, quality: u8) -> Result<(), Box<dyn Error>> {
    let RenderedView { width, height, rgba } = &job.picture;
    let backdrop = vec![BACKDROP; *width as usize * *height as usize * 3];
    let mut jpeg = Vec::new();
    let rgb = composite_over(rgba, &backdrop);
    JpegEncoder::new_with_quality(&mut jpeg, quality).write_image(&rgb, *width, *height, ExtendedColorType::Rgb8)?;
    publisher.publish_view(
        &job.view,
        ViewFrame {
            width: *width,
            height: *height,
            format: ImageFormat::Jpeg,
            bytes: jpeg.into(),
            frame: job.frame,
            capture_nanos: job.capture_nanos,
        },
    )?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use flyrig_transport::TransportConfig;
    use flyrig_types::{Camera, Intrinsics, Isometry};

    use super::*;

    /// Publishes views, encoded by `encode`, until the encoder's health is as wanted.
    fn publish_until(
        encode: impl Fn(u64) + Send + 'static,
        is_wanted: impl Fn(&ThreadHealth) -> bool,
    ) -> (LivePublisher, ThreadHealth) {
        let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::default() };
        let publisher = Publisher::open(&config).unwrap();
        let publisher = LivePublisher::start_with(publisher, move |_, job| {
            encode(job.frame);
            Ok(())
        })
        .unwrap();
        for index in 0..1000 {
            let set = FrameSet { index, master_nanos: 0, frames: Vec::new() };
            publisher.publish("main", RenderedView { width: 1, height: 1, rgba: vec![0; 4] }, &set);
            let [encoder, ..] = publisher.threads();
            if is_wanted(&encoder) {
                return (publisher, encoder);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("{:?}", publisher.threads());
    }

    #[test]
    fn views_are_compressed_again_after_a_panic() {
        let last = Arc::new(AtomicU64::new(0));
        let of_thread = Arc::clone(&last);
        let encode = move |frame| {
            assert!(frame != 1, "frame {frame}");
            of_thread.store(frame, Ordering::Relaxed);
        };
        let (publisher, encoder) = publish_until(encode, |_| last.load(Ordering::Relaxed) > 5);
        let panic = Some("frame 1".to_owned());
        assert_eq!(encoder, ThreadHealth { name: "encode".to_owned(), restarts: 1, panic, has_failed: false });
        assert_eq!(publisher.drops()[2], ("images that failed".to_owned(), 1));
        publisher.finish().unwrap();
    }

    #[test]
    fn a_panic_while_a_viewers_view_is_compressed_ends_that_viewpoint_alone() {
        let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::default() };
        let publisher = Publisher::open(&config).unwrap();
        let publisher = LivePublisher::start_with(publisher, |_, job| panic!("frame {}", job.frame)).unwrap();
        let camera = Camera::new("mine", Intrinsics::pinhole(64, 64, 50.0), Isometry::IDENTITY);
        let viewpoint = Viewpoint { subscriber: "a".to_owned(), view: "viewer-a".to_owned(), camera, max_fps: 30.0 };
        let deadline = Instant::now() + Duration::from_secs(90);
        let mut index = 0;
        // On a busy machine images replace others before they are compressed.
        while index < 100 || publisher.drops()[2].1 < 7 {
            assert!(Instant::now() < deadline, "{:?}", publisher.drops());
            let set = FrameSet { index, master_nanos: 0, frames: Vec::new() };
            publisher.publish_viewpoint(&viewpoint, RenderedView { width: 1, height: 1, rgba: vec![0; 4] }, &set);
            index += 1;
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(publisher.threads().iter().all(|thread| thread.restarts == 0), "{:?}", publisher.threads());
        publisher.finish().unwrap();
    }

    #[test]
    fn a_compressor_that_panics_again_and_again_fails_for_good_and_by_name() {
        let (publisher, encoder) = publish_until(|frame| panic!("frame {frame}"), |encoder| encoder.has_failed);
        assert_eq!(encoder.restarts, 5);
        let error = crate::check_threads(publisher.threads()).unwrap_err().to_string();
        assert!(error.contains("the thread 'encode' panicked again and again: frame "), "{error}");
    }
}
