//! Keys: holders may do what their role allows, wherever they connect, and others nothing.

use std::{
    net::{Ipv4Addr, SocketAddr, TcpListener},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use flyrig_access::{KeyFile, Ring, Role};
use flyrig_stream::{Motion, MotionEncoder, Stamp};
use flyrig_transport::{
    CameraPublisher, CameraSubscriber, Interests, Publisher, Relay, Subscriber, TransportConfig, ViewpointStatus, Views,
};
use flyrig_types::Lens;
use tempfile::TempDir;
use zenoh::{Session, Wait, sample::SampleKind};

use crate::{
    cameras::{self, host_clock, our_clock},
    people,
    support::*,
};

/// A new ring at a port that is free, and so is the next.
fn ring() -> (TempDir, Ring) {
    ring_at("127.0.0.1")
}

fn ring_at(host: &str) -> (TempDir, Ring) {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::create(&folder.path().join("keys"), "test", &[host.to_owned()], free_port()).unwrap();
    (folder, ring)
}

fn open_rig(ring: &Ring) -> Publisher {
    open_publisher(|config| config.keys = ring.folder().to_owned())
}

/// Knocks until the rig refuses the key in these words: an answer may be late, and a change of the keys is read a moment later.
fn refused(key: &KeyFile, words: &str) {
    let mut last = String::new();
    wait_until(words, || {
        last = key.knock().err().map_or_else(|| "admitted".to_owned(), |error| error.to_string());
        println!("{last}");
        last.contains(words)
    });
}

/// Knocks until the rig admits the key.
fn admitted(key: &KeyFile) {
    wait_until("the rig to admit a key", || key.knock().inspect_err(|error| println!("{error}")).is_ok());
}

fn open_viewer(key: &KeyFile, interests: &Interests) -> Subscriber {
    Subscriber::open(&TransportConfig::with_key(key.clone()), interests).unwrap()
}

fn everything() -> Interests {
    Interests { views: Views::All, splats: true, people: true, stats: true }
}

/// Session of a holder of a key that ignores all rules.
fn outlaw(key: &KeyFile) -> Session {
    use base64::{Engine as _, engine::general_purpose::STANDARD};
    let quoted = |text: &str| serde_json::json!(STANDARD.encode(text)).to_string();
    let endpoints: Vec<String> = key.connect.iter().map(|address| format!("tls/{address}")).collect();
    let mut config = zenoh::Config::default();
    for (name, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        ("connect/endpoints", serde_json::json!(endpoints).to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("transport/link/tls/enable_mtls", "true".to_owned()),
        ("transport/link/tls/root_ca_certificate_base64", quoted(&key.authority)),
        ("transport/link/tls/connect_certificate_base64", quoted(&key.certificate)),
        ("transport/link/tls/connect_private_key_base64", quoted(&key.private_key)),
    ] {
        config.insert_json5(name, &value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// Payload of what an outlaw sends.
const OWN: &str = "false";

/// Counts what a session receives for an expression, but for what `known` is of another subscription of its own.
fn count(session: &Session, expression: &str, known: fn(&str) -> bool) -> Arc<AtomicU64> {
    let counter = Arc::<AtomicU64>::default();
    let counted = counter.clone();
    session
        .declare_subscriber(expression)
        .callback(move |sample| {
            // Its own messages come back to it without leaving.
            let is_own = sample.payload().to_bytes() == OWN.as_bytes();
            if !known(sample.key_expr().as_str()) && sample.kind() == SampleKind::Put && !is_own {
                counted.fetch_add(1, Ordering::Relaxed);
            }
        })
        .background()
        .wait()
        .unwrap();
    counter
}

#[test]
fn a_key_is_all_that_a_viewer_needs() {
    let (_folder, mut ring) = ring();
    let rig = open_rig(&ring);
    // Added while the rig runs.
    let key = ring.add("desk", Role::Viewer, 10).unwrap();
    let file = ring.folder().join("desk.key");
    key.write_new(&file).unwrap();
    let key = KeyFile::read(&file, &[Role::Viewer]).unwrap();
    let viewer = open_viewer(&key, &everything());
    publish_until_seen(&rig, &viewer, "main", &mut 0);
    rig.set_calibration(&crate::support::rig()).unwrap();
    wait_for("the calibration", || viewer.rig(Duration::ZERO).unwrap());
    wait_until("the rig's token", || viewer.publishers() == 1);
    wait_until("no trouble", || viewer.trouble().is_none());
    // A viewpoint of its own.
    viewer.request_viewpoint(&camera("mine", Lens::PINHOLE), 15.0).unwrap();
    let asked = wait_for("the request", || rig.requested_viewpoints().pop());
    assert!(asked.subscriber.starts_with(&format!("{}.", key.topic_name)), "{}", asked.subscriber);
    wait_until("the answer", || matches!(viewer.viewpoint_status(), ViewpointStatus::Granted { .. }));
    publish_until_seen(&rig, &viewer, &asked.view, &mut 0);
    // It leaves no trace.
    drop(viewer);
    wait_until("the end of its viewpoint", || rig.requested_viewpoints().is_empty());
}

#[test]
fn a_rig_is_reached_by_ipv6_and_at_the_same_port_by_ipv4() {
    if TcpListener::bind("[::1]:0").is_err() {
        return eprintln!("this computer has no IPv6");
    }
    let (_folder, mut ring) = ring_at("::1");
    let rig = open_rig(&ring);
    let key = ring.add("desk", Role::Viewer, 10).unwrap();
    admitted(&key);
    let viewer = open_viewer(&key, &everything());
    publish_until_seen(&rig, &viewer, "main", &mut 0);
    wait_until("no trouble", || viewer.trouble().is_none());
    let port = rig.gate().unwrap().port();
    std::net::TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
}

#[test]
fn programs_of_the_same_computer_need_no_key() {
    let (_folder, ring) = ring();
    let rig = open_rig(&ring);
    let viewer = open_subscriber(&rig, &everything());
    publish_until_seen(&rig, &viewer, "main", &mut 0);
}

#[test]
fn a_viewer_reads_no_other_viewpoint_and_publishes_nothing() {
    let (_folder, mut ring) = ring();
    // No pause of the machine ends the viewpoint.
    let rig = open_publisher(|config| {
        config.keys = ring.folder().to_owned();
        config.viewpoint_lease_millis = 600_000;
    });
    let (honest, spy) = (ring.add("desk", Role::Viewer, 10).unwrap(), ring.add("spy", Role::Viewer, 10).unwrap());
    let viewer = open_viewer(&honest, &everything());
    viewer.request_viewpoint(&camera("mine", Lens::PINHOLE), 15.0).unwrap();
    let asked = wait_for("the request", || rig.requested_viewpoints().pop());

    let spy = outlaw(&spy);
    let all = count(&spy, "**", |key| key.contains("/view/"));
    let theirs = count(&spy, "flyrig/v1/test/viewer/*/view", |_| false);
    let allowed = count(&spy, "flyrig/v1/test/view/*", |_| false);
    let cameras = count(&spy, "flyrig/v1/test/camera/*", |_| false);
    // It sends under every name of the rig's.
    let mut frame = 0;
    let end = Instant::now() + PATIENCE;
    while allowed.load(Ordering::Relaxed) < 20 {
        assert!(Instant::now() < end, "the views that it may have did not come");
        for key in ["view/main", "person/0/motion", "stats", "transforms", "camera/a", "splats"] {
            spy.put(format!("flyrig/v1/test/{key}"), OWN).wait().unwrap();
        }
        let renewed = spy.get(format!("flyrig/v1/test/viewpoint/{}", viewer.id())).payload("{}").wait().unwrap();
        assert!(renewed.recv_timeout(Duration::from_millis(2)).ok().flatten().is_none());
        publish_until_seen(&rig, &viewer, &asked.view, &mut frame);
        publish_until_seen(&rig, &viewer, "main", &mut frame);
    }
    for (counter, what) in [(all, "everything"), (theirs, "viewpoints"), (cameras, "cameras")] {
        assert_eq!(counter.load(Ordering::Relaxed), 0, "{what}");
    }
    // Nothing of the spy's has come, neither here nor at the rig: nothing was unreadable.
    assert_eq!(viewer.unreadable(), 0);
    assert_eq!(rig.requested_viewpoints().len(), 1);
    assert_eq!(rig.viewpoint_counts().refused, 0, "its questions did not even arrive");
}

#[test]
fn a_revoked_key_is_disconnected_within_two_seconds_and_its_number_may_be_given_again() {
    let (_folder, mut ring) = ring();
    let rig = open_rig(&ring);
    let (gone, stays) = (ring.add("gone", Role::Viewer, 10).unwrap(), ring.add("stays", Role::Viewer, 10).unwrap());
    let (one, two) = (open_viewer(&gone, &everything()), open_viewer(&stays, &everything()));
    let mut frame = 0;
    publish_until_seen(&rig, &one, "main", &mut frame);
    publish_until_seen(&rig, &two, "main", &mut frame);
    ring.revoke("gone").unwrap();
    let took = turns_until("the end of the connection", || one.publishers() == 0);
    assert!(took < Duration::from_secs(2), "{took:?}");
    let is_told = |trouble: String| trouble.contains("refuses the key of 'gone': it was revoked");
    wait_until("the reason", || one.trouble().is_some_and(is_told));
    publish_until_seen(&rig, &two, "main", &mut frame);
    // The number is free; the old certificate stays refused.
    let next = ring.add("next", Role::Viewer, 10).unwrap();
    assert_eq!(next.topic_name, gone.topic_name);
    publish_until_seen(&rig, &open_viewer(&next, &everything()), "main", &mut frame);
    refused(&gone, "it was revoked");
    // A renewed key takes the old one's place.
    let renewed = ring.renew("stays", 10).unwrap();
    wait_until("the end of the old one", || two.publishers() == 0);
    publish_until_seen(&rig, &open_viewer(&renewed, &everything()), "main", &mut frame);
}

#[test]
fn a_missing_or_foreign_key_is_reported() {
    let (_folder, mut ring) = ring();
    let (_other_folder, mut other) = self::ring();
    let rig = open_rig(&ring);
    let (desk, cameras) = (ring.add("desk", Role::Viewer, 10).unwrap(), ring.add("cams", Role::Cameras, 10).unwrap());
    let spy = other.add("spy", Role::Viewer, 10).unwrap();
    // Key of another rig, which expects that one here.
    let at_ours = |key: &KeyFile| KeyFile { connect: desk.connect.clone(), ..key.clone() };
    refused(&at_ours(&spy), "is not the rig 'test': its certificate is signed by another authority");
    // Key of another rig, whose holder knows our authority.
    let forged = KeyFile { authority: desk.authority.clone(), ..at_ours(&spy) };
    refused(&forged, "refuses the key of 'spy': it is of another rig");
    refused(&at_ours(&cameras), "has another port");
    let nowhere = KeyFile { connect: vec!["127.0.0.1:1".to_owned()], ..desk.clone() };
    refused(&nowhere, "no rig answers at 127.0.0.1:1");
    admitted(&desk);
    // Nothing comes to any of them.
    for key in [at_ours(&spy), forged] {
        let (viewer, mut frame) = (open_viewer(&key, &everything()), 0);
        wait_until("the reason", || viewer.trouble().is_some_and(|trouble| trouble.contains("test")));
        for _ in 0..50 {
            frame += 1;
            rig.publish_view("main", view(frame, 9)).unwrap();
            assert!(viewer.next_view(Duration::from_millis(2)).unwrap().is_none());
        }
        assert_eq!(viewer.publishers(), 0);
    }
}

/// As one with a certificate of a public authority would be, which zenoh trusts.
#[test]
fn a_server_that_is_not_the_rig_gets_nothing_and_gives_nothing() {
    let (_folder, mut ring) = ring();
    let (_other_folder, mut other) = self::ring();
    let false_rig = open_rig(&other);
    let (mine, theirs) = (ring.add("desk", Role::Viewer, 10).unwrap(), other.add("desk", Role::Viewer, 10).unwrap());
    // It admits this viewer, and the viewer trusts its authority; it has another name.
    let misled = KeyFile { rig_certificate_name: mine.rig_certificate_name, ..theirs.clone() };
    let (viewer, mut frame) = (open_viewer(&misled, &everything()), 0);
    let honest = open_viewer(&theirs, &everything());
    viewer.request_viewpoint(&camera("mine", Lens::PINHOLE), 15.0).unwrap();
    for _ in 0..20 {
        publish_until_seen(&false_rig, &honest, "main", &mut frame);
        assert!(viewer.next_view(Duration::from_millis(2)).unwrap().is_none());
    }
    assert_eq!(viewer.publishers(), 0);
    assert!(false_rig.requested_viewpoints().is_empty(), "not even a question leaves");
}

#[test]
fn cameras_of_another_computer_need_a_key_alone_and_read_nothing() {
    let (_folder, mut ring) = ring();
    let key = ring.add("cams", Role::Cameras, 10).unwrap();
    let config =
        TransportConfig { keys: ring.folder().to_owned(), listen: Vec::new(), ..TransportConfig::publisher("test") };
    let there = CameraSubscriber::open(&config, &["a".into()], our_clock()).unwrap();
    let here = CameraPublisher::open(&TransportConfig::with_key(key.clone()), &["a".into()], host_clock()).unwrap();
    let mut sequence = 0;
    cameras::publish_until_seen(&here, &there, "a", &mut sequence);
    assert!(there.link(&"a".into()).clock.is_some(), "the clock was compared");
    // No other camera and nothing of the people, even where both are on one computer.
    let rig = open_publisher(|config| config.connect = Vec::new());
    let outlaw = outlaw(&key);
    let all = count(&outlaw, "**", |_| false);
    let images = count(&outlaw, "flyrig/v1/test/camera/*", |_| false);
    for _ in 0..30 {
        outlaw.put("flyrig/v1/test/view/main", OWN).wait().unwrap();
        rig.publish_view("main", view(1, 9)).unwrap();
        cameras::publish_until_seen(&here, &there, "a", &mut sequence);
    }
    assert_eq!((all.load(Ordering::Relaxed), images.load(Ordering::Relaxed)), (0, 0));
    ring.revoke("cams").unwrap();
    wait_until("the word that it is gone", || there.absence(&"a".into()).contains("has left the network"));
    wait_until("the reason", || here.trouble().is_some_and(|trouble| trouble.contains("it was revoked")));
}

/// A camera computer that sends what it likes, at a rig that has another camera of another computer.
#[test]
fn a_camera_key_sends_its_own_cameras_and_answers_for_its_own_clock() {
    let (folder, mut ring) = ring();
    let mut add = |name: &str, camera: &str| {
        let file = folder.path().join(format!("{name}.key"));
        ring.add_file(&file, name, Role::Cameras, &[camera.to_owned()], 10).unwrap()
    };
    let (left, right) = (add("left-pc", "left"), add("right-pc", "right"));
    let config =
        TransportConfig { keys: ring.folder().to_owned(), listen: Vec::new(), ..TransportConfig::publisher("test") };
    let cameras = ["left".into(), "right".into()];
    let there = CameraSubscriber::open(&config, &cameras, our_clock()).unwrap();
    let refused = CameraPublisher::open(&TransportConfig::with_key(left.clone()), &cameras, host_clock()).unwrap_err();
    assert!(refused.to_string().contains("camera right: the key of 'left-pc' is for left"), "{refused}");
    let honest = CameraPublisher::open(&TransportConfig::with_key(right.clone()), &cameras[1..], host_clock()).unwrap();
    let mut sequence = 0;
    cameras::publish_until_seen(&honest, &there, "right", &mut sequence);

    let outlaw = outlaw(&left);
    let (own, its) = (format!("{}.{}", left.topic_name, outlaw.zid()), right.topic_name.clone());
    let other = format!("{its}.0f");
    // It answers for every clock, and claims to be every computer.
    let (asked, mut tokens) = (Arc::<AtomicU64>::default(), Vec::new());
    for name in [own.as_str(), other.as_str(), &format!("{its}.$*"), "*", "ab12"] {
        let (count, own_clock) = (asked.clone(), format!("flyrig/v1/test/clock/{own}"));
        let lie = move |query: zenoh::query::Query| {
            if query.key_expr().as_str() != own_clock {
                count.fetch_add(1, Ordering::Relaxed);
            }
            let _ = query.reply(query.key_expr(), (cameras::now_nanos() + 7_000_000_000).to_le_bytes()).wait();
        };
        outlaw.declare_queryable(format!("flyrig/v1/test/clock/{name}")).callback(lie).background().wait().unwrap();
        if !name.contains('*') {
            let token = format!("flyrig/v1/test/host/{name}");
            tokens.push(outlaw.liveliness().declare_token(token).wait().unwrap());
        }
    }
    // It sends as the other camera under every name, with the publisher of the honest computer as well; and its own camera.
    let names = |camera: &str| {
        ["camera", "camera-status"].map(|kind| {
            [String::new(), format!("/{own}"), format!("/{other}"), "/ab12".to_owned(), "/x.y".to_owned()]
                .map(|end| format!("flyrig/v1/test/{kind}/{camera}{end}"))
        })
    };
    let keys: Vec<String> =
        ["right", "*", "$*right"].into_iter().flat_map(|camera| names(camera).into_iter().flatten()).collect();
    let (right_id, left_id) = (&cameras[1], &cameras[0]);
    let before = there.link(right_id);
    let end = Instant::now() + Duration::from_secs(3);
    let mut forged = 0u64;
    // When the frames of either camera were taken: their first numbers since then.
    let (mut honest_turns, mut own_turns) = (Vec::new(), Vec::new());
    // Returns how far the time of a frame lies from the turn in which it was taken.
    let off = |turns: &[(u64, i64)], number: u64, nanos: i64| {
        let next = turns.partition_point(|(first, _)| *first <= number);
        let ended = turns.get(next).map_or_else(cameras::now_nanos, |(_, at)| *at);
        (turns[next.max(1) - 1].1 - nanos).max(nanos - ended)
    };
    while Instant::now() < end || there.link(left_id).frames < 5 {
        assert!(Instant::now() < end + PATIENCE, "its own camera does not come: {:?}", there.link(left_id));
        forged += 1;
        own_turns.push((forged, cameras::now_nanos()));
        honest_turns.push((sequence + 1, cameras::now_nanos()));
        for publisher in [cameras::publisher_of("ab12"), cameras::publisher_of(&other)] {
            let attachment = cameras::gray_header(1_000_000 + forged, publisher, 7_000_000_000);
            for key in &keys {
                outlaw.put(key, vec![9; 8]).attachment(attachment.clone()).wait().unwrap();
            }
        }
        let attachment = cameras::gray_header(forged, cameras::publisher_of(&other), 7_000_000_000);
        outlaw.put(format!("flyrig/v1/test/camera/left/{own}"), vec![7; 8]).attachment(attachment).wait().unwrap();
        let frame = cameras::publish_until_seen(&honest, &there, "right", &mut sequence);
        assert!(frame.sequence < 1_000_000 && frame.image.bytes() != [9; 8], "a forged image");
        let late = off(&honest_turns, frame.sequence, frame.capture_nanos);
        assert!(late < 2_000_000_000, "timed by another computer's clock, {late} ns");
        while let Some(own) = there.next_frame(left_id, Duration::ZERO).unwrap() {
            let late = off(&own_turns, own.sequence, own.capture_nanos);
            assert!(own.image.bytes() == [7; 8] && late < 2_000_000_000, "timed by its own clock, {late} ns");
        }
    }
    let link = there.link(right_id);
    assert_eq!((link.refused, link.restarts, link.status), (before.refused, before.restarts, before.status));
    assert_eq!(asked.load(Ordering::Relaxed), 0, "it is not even asked for another clock");
    // Keys of earlier versions name no cameras and may send each.
    let old = ring.add("old", Role::Cameras, 10).unwrap();
    drop(honest);
    wait_until("the end of the honest one", || there.absence(right_id).contains("has left the network"));
    let old = CameraPublisher::open(&TransportConfig::with_key(old), &cameras, host_clock()).unwrap();
    cameras::publish_until_seen(&old, &there, "right", &mut 0);
}

#[test]
fn viewers_come_back_when_the_rig_does() {
    let (_folder, mut ring) = ring();
    let key = ring.add("desk", Role::Viewer, 10).unwrap();
    // First of all, the viewer.
    let viewer = open_viewer(&key, &everything());
    let is_told = |trouble: String| trouble.contains("no rig answers at 127.0.0.1");
    wait_until("a reason", || viewer.trouble().is_some_and(is_told));
    let mut frame = 0;
    for _ in 0..2 {
        let rig = open_rig(&ring);
        publish_until_seen(&rig, &viewer, "main", &mut frame);
        wait_until("no more trouble", || viewer.trouble().is_none());
        drop(rig);
        wait_until("the end of the rig", || viewer.publishers() == 0);
    }
}

#[test]
fn half_open_connections_of_others_keep_no_holder_out() {
    let (_folder, mut ring) = ring();
    let rig = open_rig(&ring);
    let key = ring.add("desk", Role::Viewer, 10).unwrap();
    let gate = SocketAddr::from((Ipv4Addr::LOCALHOST, rig.gate().unwrap().port()));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
    let connect = || {
        // From an address of their own.
        let socket = tokio::net::TcpSocket::new_v4()?;
        socket.bind(SocketAddr::from(([127, 0, 0, 2], 0)))?;
        runtime.block_on(socket.connect(gate))
    };
    let mut frame = 0;
    let mut watched_after = || {
        let begun = Instant::now();
        let viewer = open_viewer(&key, &everything());
        publish_until_seen(&rig, &viewer, "main", &mut frame);
        begun.elapsed()
    };
    // What a viewer needs on this machine without them.
    let alone = watched_after();
    let silent: Vec<_> = (0..300).map(|_| connect().unwrap()).collect();
    let crowded = watched_after();
    assert!(crowded < alone + Duration::from_secs(3), "{crowded:?}, {alone:?} without them");
    drop(silent);
}

#[test]
fn keys_of_another_rig_or_none_are_named() {
    let (_folder, ring) = ring();
    let config = TransportConfig {
        listen: vec!["tcp/127.0.0.1:0".to_owned()],
        keys: ring.folder().to_owned(),
        ..TransportConfig::publisher("another")
    };
    let refused = |config: &TransportConfig| Publisher::open(config).unwrap_err().to_string();
    assert!(refused(&config).contains("these are of the rig 'test', not of 'another'"), "{}", refused(&config));
    let config = TransportConfig { keys: Path::new("/none/at/all").to_owned(), rig: "test".to_owned(), ..config };
    assert!(refused(&config).contains("/none/at/all/ring.toml: cannot be read"), "{}", refused(&config));
    // Two rigs cannot have one gate.
    let _first = open_rig(&ring);
    let config = TransportConfig { keys: ring.folder().to_owned(), ..config };
    assert!(refused(&config).contains("is another rig with keys running?"), "{}", refused(&config));
}

#[test]
fn a_relay_passes_people_on_to_its_own_viewers() {
    let (_folder, mut ring) = ring();
    let (_relay_folder, mut of_relay) = self::ring();
    let key = ring.add("hall", Role::Relay, 10).unwrap();
    let guest = of_relay.add("guest", Role::Viewer, 10).unwrap();
    let endpoint = free_endpoint();
    let to = TransportConfig {
        keys: of_relay.folder().to_owned(),
        listen: vec![endpoint.clone()],
        ..TransportConfig::publisher("test")
    };
    let relay = Relay::start(&TransportConfig::with_key(key), &to).unwrap();
    let viewer = open_viewer(&guest, &everything());
    let beside = Subscriber::open(&subscriber_config(&[endpoint]), &everything()).unwrap();
    let trouble = wait_for("the reason", || relay.trouble().filter(|text| text.contains("no rig answers at")));
    assert!(trouble.contains("rig test"), "{trouble}");
    assert_eq!(viewer.publishers(), 0);
    for gaussians in [20_000, 30_000] {
        // The second time with other people.
        let rig = open_rig(&ring);
        rig.set_calibration(&crate::support::rig()).unwrap();
        let encoded = people::encoded(gaussians);
        let mut encoder = MotionEncoder::new(&encoded);
        let (hash, template) = (encoded.template.hash, encoded.bytes);
        rig.offer_template(7, hash, template.clone().into());
        let mut frame = 0;
        let mut publish = || {
            frame += 1;
            let stamp = Stamp { person: 7, frame, capture_nanos: 5, template: hash };
            let motion = Motion { stamp, joint_rotations: vec![[0.0, 0.0, 0.0, 1.0]], ..Motion::default() };
            rig.publish_person(&stamp, None, encoder.encode(&motion).unwrap().into());
        };
        let (mut seen, mut fetched) = ([false; 2], None);
        // The rig never pauses: a relay that loses its line meanwhile learns people from their next motion.
        wait_until("people and their template", || {
            publish();
            for (viewer, seen) in [&viewer, &beside].into_iter().zip(&mut seen) {
                while let Some(received) = viewer.next_person(Duration::from_millis(20)).unwrap() {
                    if received.header.frame > 0 && received.body.person == 7 {
                        assert_eq!((received.header.capture_nanos, received.latency_is_exact), (5, true));
                        *seen = true;
                    }
                }
            }
            if fetched.is_none() {
                fetched = viewer.template(hash, Duration::from_millis(500)).unwrap();
            }
            fetched.is_some() && seen == [true; 2]
        });
        assert_eq!(fetched, Some(template));
        wait_for("the calibration", || viewer.rig(Duration::ZERO).unwrap());
        wait_until("no more trouble", || relay.trouble().is_none());
        drop(rig);
        // The relay does not pretend to be the rig.
        wait_until("the end of the rig", || viewer.publishers() == 0 && beside.publishers() == 0);
    }
    of_relay.revoke("guest").unwrap();
    let rig = open_rig(&ring);
    rig.set_calibration(&crate::support::rig()).unwrap();
    wait_until("the relay", || beside.publishers() == 1);
    wait_until("the reason", || viewer.trouble().is_some_and(|why| why.contains("it was revoked")));
}
