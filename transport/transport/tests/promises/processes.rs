//! Subscribers in processes of their own: killed, paused, gone for long. They are this test binary again.

use std::{
    io::{BufRead, BufReader, Write},
    process::{Child, Command, Stdio},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use flyrig_transport::{Interests, Publisher, Subscriber, Views};
use flyrig_types::Lens;

use crate::support::*;

const ENDPOINT: &str = "FLYRIG_TEST_ENDPOINT";

/// Not a test of its own: the child's side, a watcher that prints the number of every frame that it gets.
#[test]
#[ignore = "the child process of the other tests"]
fn child_watcher() {
    let Ok(endpoint) = std::env::var(ENDPOINT) else { return };
    let interests = Interests { views: Views::All, splats: true, people: true, stats: true };
    let subscriber = Subscriber::open(&subscriber_config(&[endpoint]), &interests).unwrap();
    subscriber.request_viewpoint(&camera("mine", Lens::PINHOLE), 30.0).unwrap();
    let mut out = std::io::stdout();
    loop {
        if let Ok(Some(received)) = subscriber.next_view(Duration::from_millis(100)) {
            // A failed write means that the parent has ended.
            if writeln!(out, "\nframe {}", received.header.frame).and_then(|()| out.flush()).is_err() {
                return;
            }
        }
        let _ = subscriber.next_splats(Duration::ZERO);
    }
}

struct Watcher {
    child: Child,
    newest: Arc<AtomicU64>,
}

impl Watcher {
    fn start(publisher: &Publisher) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "processes::child_watcher", "--ignored", "--nocapture"])
            .env(ENDPOINT, &publisher.endpoints()[0])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let newest = Arc::new(AtomicU64::new(0));
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let seen = newest.clone();
        // It ends with the child.
        std::thread::Builder::new()
            .name("child output".to_owned())
            .spawn(move || {
                for line in lines.map_while(Result::ok) {
                    if let Some(frame) = line.strip_prefix("frame ").and_then(|number| number.parse().ok()) {
                        seen.store(frame, Ordering::SeqCst);
                    }
                }
            })
            .unwrap();
        Self { child, newest }
    }

    fn newest(&self) -> u64 {
        self.newest.load(Ordering::SeqCst)
    }

    fn signal(&self, name: &str) {
        let status = Command::new("kill").args([name, &self.child.id().to_string()]).status().unwrap();
        assert!(status.success());
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // Kills a stopped process too.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn publish(publisher: &Publisher, frame: &mut u64) {
    *frame += 1;
    publisher.publish_view("front", view(*frame, 60_000)).unwrap();
    publisher.publish_splats(Arc::new(splats(*frame, 2_000)));
}

#[test]
fn a_killed_watcher_is_forgotten_and_costs_no_other_a_frame() {
    // A lease this long: only the watcher's vanished token can end its viewpoint.
    let publisher = open_publisher(|config| config.viewpoint_lease_millis = 600_000);
    let healthy =
        open_subscriber(&publisher, &Interests { views: Views::Named(vec!["front".into()]), ..Interests::default() });
    let mut watcher = Watcher::start(&publisher);
    let mut frame = 0;
    wait_until("the watcher's first frame and viewpoint", || {
        publish(&publisher, &mut frame);
        let is_known = publisher.requested_viewpoints().len() == 1 && publisher.has_splat_subscribers();
        watcher.newest() > 0 && is_known
    });
    watcher.child.kill().unwrap();
    wait_until("the watcher to be forgotten", || {
        publish(&publisher, &mut frame);
        !publisher.has_splat_subscribers() && publisher.requested_viewpoints().is_empty()
    });
    let before = frame;
    wait_until("later frames at the healthy one", || {
        publish(&publisher, &mut frame);
        healthy.next_view(Duration::from_millis(20)).unwrap().is_some_and(|received| received.header.frame > before)
    });
}

#[test]
fn a_paused_watcher_slows_no_other_and_catches_up_with_the_newest_frame() {
    let publisher = open_publisher(|config| config.viewpoint_lease_millis = 1000);
    let healthy =
        open_subscriber(&publisher, &Interests { views: Views::Named(vec!["front".into()]), ..Interests::default() });
    let watcher = Watcher::start(&publisher);
    let mut frame = 0;
    wait_until("the watcher's first frame and viewpoint", || {
        publish(&publisher, &mut frame);
        watcher.newest() > 0 && publisher.requested_viewpoints().len() == 1
    });
    watcher.signal("-STOP");

    // Far more than all the buffers on the way hold: a publisher that waited for the watcher would stand still.
    let mut healthy_frames = 0;
    let mut turns = 0;
    wait_until("six hundred frames, and some at the healthy one", || {
        for _ in 0..100 {
            publish(&publisher, &mut frame);
            healthy_frames += u32::from(healthy.next_view(Duration::from_millis(2)).unwrap().is_some());
        }
        turns += 100;
        turns >= 600 && healthy_frames > 0
    });
    let counts = || publisher.counts().into_iter().find(|(label, _)| label == "view/front").unwrap().1;
    wait_until("the slot to drain", || counts().offered == counts().sent + counts().replaced + counts().unwatched);
    assert_eq!((counts().offered, counts().failed), (frame, 0));
    wait_until("the newest frame at the healthy one", || {
        publish(&publisher, &mut frame);
        // On a busy machine earlier ones are still on their way.
        let mut came = std::iter::from_fn(|| healthy.next_view(Duration::from_millis(50)).unwrap());
        came.any(|received| received.header.frame == frame)
    });
    wait_until("the end of its lease", || publisher.requested_viewpoints().is_empty());

    // Paused for longer than zenoh keeps a silent session: the splats, which it alone watched, are skipped.
    wait_until("the end of its session", || {
        publish(&publisher, &mut frame);
        !publisher.has_splat_subscribers()
    });
    let paused = watcher.newest();
    watcher.signal("-CONT");
    let target = frame;
    wait_until("the watcher to catch up", || {
        publish(&publisher, &mut frame);
        watcher.newest() > target && publisher.requested_viewpoints().len() == 1
    });
    assert!(watcher.newest() > paused);
}

/// Latencies of a viewer, milliseconds, as long as its owner lives.
struct Latencies {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    millis: Arc<Mutex<Vec<f64>>>,
}

impl Latencies {
    fn start(subscriber: Subscriber) -> Self {
        let (stop, millis) = (Arc::<AtomicBool>::default(), Arc::<Mutex<Vec<f64>>>::default());
        let (stopped, noted) = (stop.clone(), millis.clone());
        let work = move || {
            while !stopped.load(Ordering::Relaxed) {
                if let Ok(Some(received)) = subscriber.next_view(Duration::from_millis(50)) {
                    noted.lock().unwrap().push(received.latency_nanos as f64 / 1e6);
                }
            }
        };
        let thread = std::thread::Builder::new().name("latencies".to_owned()).spawn(work).unwrap();
        Self { stop, thread: Some(thread), millis }
    }

    /// Takes the latencies since the last call; returns number, median and 99th percentile.
    fn take(&self) -> (usize, f64, f64) {
        let mut millis = std::mem::take(&mut *self.millis.lock().unwrap());
        millis.sort_by(f64::total_cmp);
        (millis.len(), millis[millis.len() / 2], millis[millis.len() * 99 / 100])
    }
}

impl Drop for Latencies {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().into_iter().for_each(|thread| thread.join().unwrap());
    }
}

/// Returns the resident memory of this process, MB.
fn resident_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() * 1024.0 / 1e6
}

/// Publishes 30 times per second for `secs`; returns the most memory meanwhile, MB.
fn publish_for(publisher: &Publisher, frame: &mut u64, secs: u64) -> f64 {
    let (begun, mut most) = (Instant::now(), 0.0f64);
    for turn in 0..30 * secs as u32 {
        publish(publisher, frame);
        for layer in [None, Some(0), Some(1), Some(2)] {
            let stamp = flyrig_stream::Stamp { frame: *frame, ..Default::default() };
            publisher.publish_person(&stamp, layer, vec![7; 6000].into());
        }
        most = most.max(resident_mb());
        std::thread::sleep((begun + turn * Duration::from_micros(33_333)).saturating_duration_since(Instant::now()));
    }
    most
}

#[test]
#[cfg(target_os = "linux")]
#[ignore = "takes three minutes"]
fn a_viewer_that_is_stopped_for_a_minute_costs_the_others_neither_latency_nor_memory() {
    let publisher = open_publisher(|_| {});
    let front = || Interests { views: Views::Named(vec!["front".into()]), ..Interests::default() };
    let latencies = Latencies::start(open_subscriber(&publisher, &front()));
    let watcher = Watcher::start(&publisher);
    let mut frame = 0;
    wait_until("the watcher's first frame", || {
        publish(&publisher, &mut frame);
        watcher.newest() > 0
    });
    publish_for(&publisher, &mut frame, 10);
    latencies.take();
    let before_mb = publish_for(&publisher, &mut frame, 60);
    let (count, median, before) = latencies.take();
    println!("all viewers up: {count} images, median {median:.2} ms, p99 {before:.2} ms, {before_mb:.1} MB");
    watcher.signal("-STOP");
    // The first seconds, until zenoh ends the session of the stopped viewer, and the rest.
    let stopped_mb = publish_for(&publisher, &mut frame, 12);
    let (count, median, stalled) = latencies.take();
    println!("one stopped, 0 to 12 s: {count} images, median {median:.2} ms, p99 {stalled:.2} ms, {stopped_mb:.1} MB");
    let later_mb = publish_for(&publisher, &mut frame, 48);
    let (count, median, later) = latencies.take();
    println!("one stopped, 12 to 60 s: {count} images, median {median:.2} ms, p99 {later:.2} ms, {later_mb:.1} MB");
    watcher.signal("-CONT");
    assert!(stopped_mb.max(later_mb) <= before_mb + 50.0, "{before_mb} MB, then {stopped_mb} and {later_mb}");
    // Other programs of a busy machine add a millisecond to any of these; a publisher that waited for the viewer would add fifty.
    assert!(stalled.max(later) <= 1.05 * before + 1.0, "{before} ms, then {stalled} and {later}");
}
