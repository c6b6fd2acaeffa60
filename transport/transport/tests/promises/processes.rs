//! Subscribers in processes of their own: killed, paused, gone for long. They are this test binary again.

use std::{
    io::{BufRead, BufReader, Write},
    process::{Child, Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
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
        watcher.newest() > 0 && publisher.requested_viewpoints().len() == 1
    });
    assert!(publisher.has_splat_subscribers());
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
    for _ in 0..600 {
        publish(&publisher, &mut frame);
        healthy_frames += u32::from(healthy.next_view(Duration::from_millis(2)).unwrap().is_some());
    }
    let counts = || publisher.counts().into_iter().find(|(label, _)| label == "view/front").unwrap().1;
    wait_until("the slot to drain", || counts().offered == counts().sent + counts().replaced + counts().unwatched);
    assert_eq!((counts().offered, counts().failed), (frame, 0));
    wait_until("the newest frame at the healthy one", || {
        publish(&publisher, &mut frame);
        healthy.next_view(Duration::from_millis(50)).unwrap().is_some_and(|received| received.header.frame == frame)
    });
    assert!(healthy_frames > 0);
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
