//! A router between rig, camera computer and viewer, killed and started again: everything flows again. The router is this test binary again.

use std::{
    net::TcpStream,
    process::{Child, Command, Stdio},
    time::Duration,
};

use flyrig_stream::Stamp;
use flyrig_transport::{
    CameraPublisher, CameraSubscriber, Interests, Publisher, Subscriber, TransportConfig, ViewpointStatus, Views,
};
use flyrig_types::{CameraId, Lens};
use zenoh::Wait;

use crate::{
    cameras::{frame, host_clock, our_clock},
    people::encoded,
    support::*,
};

const ENDPOINT: &str = "FLYRIG_TEST_ROUTER";
/// Time after the router's return within which images come again.
const AGAIN: Duration = Duration::from_secs(5);

/// Not a test of its own: the child's side, a zenoh router that runs until it is killed.
#[test]
#[ignore = "the child process of the other tests"]
fn child_router() {
    let Ok(endpoint) = std::env::var(ENDPOINT) else { return };
    let mut config = zenoh::Config::default();
    let settings = [("mode", "\"router\""), ("scouting/multicast/enabled", "false")];
    for (key, value) in settings {
        config.insert_json5(key, value).unwrap();
    }
    config.insert_json5("listen/endpoints", &format!("[\"{endpoint}\"]")).unwrap();
    let _session = zenoh::open(config).wait().unwrap();
    loop {
        std::thread::park();
    }
}

struct Router(Child);

impl Router {
    /// Starts a router and waits until it listens.
    fn start(endpoint: &str) -> Self {
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "routers::child_router", "--ignored"])
            .env(ENDPOINT, endpoint)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let address = endpoint.strip_prefix("tcp/").unwrap();
        wait_until("the router", || TcpStream::connect(address).is_ok());
        Self(child)
    }
}

impl Drop for Router {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Computer with a camera, rig and viewer, which know the router alone.
struct Parties {
    host: CameraPublisher,
    cameras: CameraSubscriber,
    rig: Publisher,
    viewer: Subscriber,
    template: u64,
    /// Number of the last frame.
    number: u64,
}

impl Parties {
    /// Opens all of them; each connects to the router, or directly to those whose messages it receives.
    fn open(router: Option<&str>) -> Self {
        let is_direct = router.is_none();
        let config = |listen: Vec<String>, direct: &[String]| TransportConfig {
            listen,
            connect: router.iter().map(|router| (*router).to_owned()).chain(direct.iter().cloned()).collect(),
            ..TransportConfig::publisher("test")
        };
        let names = [CameraId::from("a")];
        let own = || vec!["tcp/127.0.0.1:0".to_owned()];
        let host = CameraPublisher::open(&config(own(), &[]), &names, host_clock()).unwrap();
        let to_host = if is_direct { host.endpoints() } else { &[] };
        let cameras = CameraSubscriber::open(&config(Vec::new(), to_host), &names, our_clock()).unwrap();
        // A rig with cameras of other computers has one list of addresses.
        let rig = Publisher::open(&config(own(), to_host)).unwrap();
        let to_rig = if is_direct { rig.endpoints() } else { &[] };
        let interests = Interests { views: Views::All, people: true, stats: true, ..Interests::default() };
        let viewer = Subscriber::open(&config(Vec::new(), to_rig), &interests).unwrap();
        viewer.request_viewpoint(&camera("mine", Lens::PINHOLE), 30.0).unwrap();
        let bytes = encoded(20_000).bytes;
        let template = flyrig_stream::template_hash(&bytes);
        rig.offer_template(0, template, bytes.into());
        Self { host, cameras, rig, viewer, template, number: 0 }
    }

    /// Publishes everything every 20 ms until all of it arrives; returns how long each took: camera, view, own view, motion. The time is that
    /// of the turns that this thread had: a machine that pauses or is busy has fewer of them.
    fn flow(&mut self) -> [Duration; 4] {
        let (mut turns, first) = (0, self.number + 1);
        let mut came = [None; 4];
        wait_until("images of all kinds", || {
            turns += 1;
            self.number += 1;
            let number = self.number;
            self.host.publish(frame("a", number)).unwrap();
            self.rig.publish_view("front", view(number, 20_000)).unwrap();
            let own = self.viewer.viewpoint_view();
            self.rig.publish_view(&own, view(number, 20_000)).unwrap();
            let stamp = Stamp { template: self.template, frame: number, ..Stamp::default() };
            self.rig.publish_person(&stamp, None, vec![1; 3000].into());
            let mut note = |kind: usize| {
                came[kind].get_or_insert(turns * (TURN + Duration::from_millis(20)));
            };
            while let Some(found) = self.cameras.next_frame(&"a".into(), Duration::ZERO).unwrap() {
                (found.sequence >= first).then(|| note(0));
            }
            while let Some(found) = self.viewer.next_view(Duration::ZERO).unwrap() {
                (found.header.frame >= first).then(|| note(if found.topic == own { 2 } else { 1 }));
            }
            while let Some(found) = self.viewer.next_person(Duration::ZERO).unwrap() {
                (found.header.frame >= first).then(|| note(3));
            }
            std::thread::sleep(Duration::from_millis(20));
            came.iter().all(Option::is_some)
        });
        // An answer to a renewal may be late.
        wait_until("the viewpoint", || matches!(self.viewer.viewpoint_status(), ViewpointStatus::Granted { .. }));
        came.map(Option::unwrap_or_default)
    }
}

fn restart_router(times: u32) {
    let endpoint = free_endpoint();
    let mut router = Router::start(&endpoint);
    let mut parties = Parties::open(Some(&endpoint));
    parties.flow();
    let mut longest = Duration::ZERO;
    for round in 0..times {
        drop(router);
        // Absent for a moment, for longer than a retry, and for longer than zenoh keeps a silent session.
        let absent = [0, 500, 1700, 3000, 12_000][round as usize % 5];
        std::thread::sleep(Duration::from_millis(absent));
        router = Router::start(&endpoint);
        let came = parties.flow();
        println!("router absent for {absent} ms; camera, view, own view, motion after {came:.2?}");
        longest = longest.max(came.into_iter().max().unwrap_or_default());
        assert!(came.iter().all(|after| *after <= AGAIN), "{came:?}");
        let template =
            wait_for("the template", || parties.viewer.template(parties.template, Duration::from_secs(5)).unwrap());
        assert_eq!(flyrig_stream::template_hash(&template), parties.template);
    }
    println!("{times} times: everything again within {longest:.2?}");
}

#[test]
fn without_a_router_everything_flows_directly() {
    let mut parties = Parties::open(None);
    parties.flow();
    let came = parties.flow();
    assert!(came.iter().all(|after| *after <= AGAIN), "{came:?}");
}

#[test]
fn images_come_again_when_a_killed_router_is_back() {
    restart_router(3);
}

#[test]
#[ignore = "takes two minutes"]
fn images_come_again_when_a_killed_router_is_back_twenty_times() {
    restart_router(20);
}
