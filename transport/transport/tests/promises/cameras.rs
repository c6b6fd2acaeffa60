//! Cameras of other computers: frames arrive, whichever computers join, leave, lie or share the network.

use std::{
    sync::OnceLock,
    time::{Duration, Instant},
};

use flyrig_model::SplitMix64;
use flyrig_transport::{
    CameraPublisher, CameraStatus, CameraSubscriber, FrameHeader, HEADER_BYTES, Header, HostClock, MessageKind,
    PublishOutcome, TransportConfig, TransportErrorKind,
};
use flyrig_types::{CameraId, Frame, Image, PixelFormat};
use zenoh::Wait;

use crate::support::*;

/// This process' clock.
pub fn now_nanos() -> i64 {
    static START: OnceLock<Instant> = OnceLock::new();
    1_000_000_000_000 + START.get_or_init(Instant::now).elapsed().as_nanos() as i64
}

pub fn our_clock() -> HostClock {
    HostClock::new(now_nanos)
}

/// A computer whose clock is an hour ahead.
pub fn host_clock() -> HostClock {
    HostClock::new(|| now_nanos() + 3_600_000_000_000)
}

fn host(rig: &str, cameras: &[&str], listen: &str) -> CameraPublisher {
    let cameras: Vec<CameraId> = cameras.iter().map(|name| (*name).into()).collect();
    let config = TransportConfig { listen: vec![listen.into()], ..TransportConfig::publisher(rig) };
    CameraPublisher::open(&config, &cameras, host_clock()).unwrap()
}

fn subscriber(rig: &str, cameras: &[&str], endpoints: &[String]) -> CameraSubscriber {
    let cameras: Vec<CameraId> = cameras.iter().map(|name| (*name).into()).collect();
    let config = TransportConfig { connect: endpoints.to_vec(), ..TransportConfig::subscriber(rig) };
    CameraSubscriber::open(&config, &cameras, our_clock()).unwrap()
}

pub fn frame(camera: &str, sequence: u64) -> Frame {
    let (format, bytes) = match sequence % 2 {
        0 => (PixelFormat::Mjpeg, vec![sequence as u8; 3000 + sequence as usize]),
        _ => (PixelFormat::Yuyv, vec![sequence as u8; 4 * 2 * 2]),
    };
    Frame {
        camera: camera.into(),
        sequence,
        capture_nanos: host_clock().now_nanos(),
        exposure_nanos: sequence.is_multiple_of(3).then_some(8_000_000),
        image: Image::new(4, 2, format, bytes).unwrap(),
        mask: None,
    }
}

/// Publishes frames with growing numbers until one comes out; gives it and how far its time is from the truth.
pub fn publish_until_seen(host: &CameraPublisher, there: &CameraSubscriber, camera: &str, sequence: &mut u64) -> Frame {
    wait_for(&format!("a frame of {camera}"), || {
        *sequence += 1;
        host.publish(frame(camera, *sequence)).unwrap();
        there.next_frame(&camera.into(), Duration::from_millis(20)).unwrap()
    })
}

#[test]
fn a_frame_comes_out_as_it_went_in_with_the_time_of_this_computer() {
    let host = host("test", &["left", "right"], "tcp/127.0.0.1:0");
    let there = subscriber("test", &["left", "right"], host.endpoints());
    let (left, right) = (CameraId::from("left"), CameraId::from("right"));
    let mut sequence = 0;
    publish_until_seen(&host, &there, "left", &mut sequence);
    // Frames from 100 on, and when they were taken.
    let mut taken = Vec::new();
    for _ in 0..10 {
        let round_trip = || there.link(&left).clock.unwrap().round_trip_nanos;
        let before = round_trip();
        // Another one until one is there: on a busy machine zenoh may drop one, or an earlier one comes.
        let found = wait_for("the frame", || {
            let sent = frame("left", 100 + taken.len() as u64);
            taken.push(sent.capture_nanos - 3_600_000_000_000);
            assert_ne!(host.publish(sent).unwrap(), PublishOutcome::Unwatched);
            there.next_frame(&left, Duration::from_millis(100)).unwrap().filter(|frame| frame.sequence >= 100)
        });
        let wanted = frame("left", found.sequence);
        assert_eq!((found.exposure_nanos, found.image.format()), (wanted.exposure_nanos, wanted.image.format()));
        assert_eq!(found.image.bytes(), wanted.image.bytes());
        // The clock may have been asked again since the frame came.
        let round_trip = before.max(round_trip());
        let error = (found.capture_nanos - taken[found.sequence as usize - 100]).abs();
        assert!(error <= round_trip / 2 + 1_000_000, "{error} ns of a round trip of {round_trip} ns");
    }
    assert!(there.next_frame(&right, Duration::ZERO).unwrap().is_none());
    wait_until("the word that it is not sent", || {
        there.absence(&right).contains("no computer of rig 'test' sends a camera of this name")
    });
    let status = CameraStatus { host: "pi-2".into(), problem: "was unplugged".into(), ..CameraStatus::default() };
    wait_until("the status", || {
        host.publish_status(&right, &status).unwrap();
        there.link(&right).status.is_some_and(|found| found == status)
    });
    assert_eq!(there.absence(&right), "its computer 'pi-2' reports: was unplugged");
    let unknown = there.next_frame(&"nobody".into(), Duration::ZERO).unwrap_err();
    assert_eq!(unknown.kind, TransportErrorKind::Config);
    assert!(host.publish(frame("nobody", 1)).unwrap_err().to_string().contains("not one of those"));
    there.close().unwrap();
    host.close().unwrap();
}

#[test]
fn a_reader_that_sleeps_gets_the_newest_and_every_loss_has_its_cause() {
    let host = host("test", &["a"], "tcp/127.0.0.1:0");
    let there = subscriber("test", &["a"], host.endpoints());
    let a = CameraId::from("a");
    let mut sequence = 0;
    publish_until_seen(&host, &there, "a", &mut sequence);
    wait_until_settled("the frames until then", || there.link(&a).frames);
    let before = (there.link(&a), host.counts()[0].1);
    let mut last = 0;
    for n in 1000..1200 {
        host.publish(frame("a", n)).unwrap();
        if n % 4 == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        last = n;
    }
    // Everything that was sent has come, or a later message has shown that it is lost.
    let settled = || {
        let link = there.link(&a);
        let gone = link.frames - before.0.frames + link.withheld - before.0.withheld + link.lost - before.0.lost;
        let has_come = gone >= 200 && gone >= host.counts()[0].1.offered - before.1.offered;
        (has_come && link.overtaken > before.0.overtaken).then_some((link, gone))
    };
    let (link, gone) = wait_for("the last frame", || {
        settled().or_else(|| {
            last += 1;
            host.publish(frame("a", last)).unwrap();
            std::thread::sleep(Duration::from_millis(20));
            None
        })
    });
    let sent = host.counts()[0].1;
    assert!(gone <= sent.offered - before.1.offered, "{gone} of {sent:?}");
    assert_eq!(link.withheld - before.0.withheld, sent.replaced - before.1.replaced, "{sent:?}");
    let mut waiting = Vec::new();
    while let Some(frame) = there.next_frame(&a, Duration::ZERO).unwrap() {
        waiting.push(frame.sequence);
    }
    assert!(waiting.len() <= 4 && waiting.is_sorted() && waiting.last().is_some_and(|n| *n > 1190), "{waiting:?}");
}

#[test]
fn a_computer_that_vanishes_and_returns_goes_on() {
    let endpoint = free_endpoint();
    let there = subscriber("test", &["a"], std::slice::from_ref(&endpoint));
    let a = CameraId::from("a");
    assert!(there.absence(&a).starts_with("no computer of rig 'test' is present; run `flyrig capture` on it"));
    let mut sequence = 0;
    let first = host("test", &["a"], &endpoint);
    publish_until_seen(&first, &there, "a", &mut sequence);
    drop(first);
    wait_until("the report that it has left", || there.absence(&a).contains("its computer has left the network"));
    let config = TransportConfig { listen: vec![endpoint], ..TransportConfig::publisher("test") };
    let second = wait_for("the port", || CameraPublisher::open(&config, std::slice::from_ref(&a), host_clock()).ok());
    // As a restarted program does, it counts from the beginning. Frames of the first one may still wait.
    let mut restarted = 0;
    wait_until("a frame of the second", || {
        let found = publish_until_seen(&second, &there, "a", &mut restarted);
        assert!(found.sequence < sequence.max(1000));
        there.link(&a).restarts > 0
    });
    let link = there.link(&a);
    assert_eq!((link.restarts, link.refused), (1, 0), "{link:?}");
}

#[test]
fn rigs_of_one_network_do_not_mix_and_a_wrong_name_is_told() {
    let (one, two) = (host("one", &["a"], "tcp/127.0.0.1:0"), host("two", &["a"], "tcp/127.0.0.1:0"));
    let both = [one.endpoints(), two.endpoints()].concat();
    let (of_one, of_three) = (subscriber("one", &["a"], &both), subscriber("three", &["a"], &both));
    let mut sequence = 0;
    for _ in 0..20 {
        two.publish(frame("a", 1_000_000)).unwrap();
        assert!(publish_until_seen(&one, &of_one, "a", &mut sequence).sequence < 1_000_000);
    }
    wait_until("the names of the others", || of_three.absence(&"a".into()).contains("'one', 'two'"));
    assert!(of_three.absence(&"a".into()).contains("set the same rig.name"));
    assert!(of_three.next_frame(&"a".into(), Duration::ZERO).unwrap().is_none());
}

/// Returns the publisher of this name, as headers state it.
pub fn publisher_of(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, b| (hash ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

/// Returns the attachment of a grey image taken now, by a clock that is this far ahead.
pub fn gray_header(sequence: u64, publisher: u64, ahead_nanos: i64) -> Vec<u8> {
    let good = good_header(sequence);
    let capture_nanos = now_nanos() + ahead_nanos;
    FrameHeader { header: Header { publisher, capture_nanos, ..good.header }, ..good }.encode().to_vec()
}

/// A session that says what it likes.
fn stranger(endpoints: &[String]) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        ("connect/endpoints", serde_json::json!(endpoints).to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

fn good_header(sequence: u64) -> FrameHeader {
    FrameHeader {
        header: Header {
            kind: MessageKind::Frame,
            sequence,
            frame: sequence,
            capture_nanos: host_clock().now_nanos(),
            publish_unix_nanos: 0,
            publish_nanos: 0,
            host: 1,
            publisher: 0x666,
            width: 4,
            height: 2,
        },
        exposure_nanos: None,
        withheld: 0,
        format: PixelFormat::Gray8,
    }
}

#[test]
fn another_version_is_told_once_and_plainly() {
    let config =
        TransportConfig { listen: vec![free_endpoint()], connect: vec![], ..TransportConfig::subscriber("test") };
    let there = CameraSubscriber::open(&config, &["a".into()], our_clock()).unwrap();
    let stranger = stranger(&config.listen);
    let _token = stranger.liveliness().declare_token("flyrig/v9/test/host/abc").wait().unwrap();
    wait_until("the version", || there.absence(&"a".into()).contains("schema version 'v9', this program knows v1"));
    let mut attachment = good_header(1).encode();
    attachment[4] = 9;
    let error = wait_for("the refusal", || {
        stranger.put("flyrig/v1/test/camera/a", vec![0; 8]).attachment(attachment.to_vec()).wait().unwrap();
        there.next_frame(&"a".into(), Duration::from_millis(50)).err()
    });
    assert_eq!(error.kind, TransportErrorKind::UnknownVersion);
    stranger.put("flyrig/v1/test/camera/a", vec![0; 8]).attachment(attachment.to_vec()).wait().unwrap();
    wait_until("the second one", || there.link(&"a".into()).refused >= 2);
    assert!(there.next_frame(&"a".into(), Duration::ZERO).unwrap().is_none(), "not reported again at once");
}

#[test]
fn hostile_messages_are_refused_and_the_camera_goes_on() {
    let host = host("test", &["a"], "tcp/127.0.0.1:0");
    let a = CameraId::from("a");
    let config = TransportConfig {
        listen: vec![free_endpoint()],
        connect: host.endpoints().to_vec(),
        ..TransportConfig::subscriber("test")
    };
    let there = CameraSubscriber::open(&config, std::slice::from_ref(&a), our_clock()).unwrap();
    let stranger = stranger(&config.listen);
    let mut sequence = 0;
    publish_until_seen(&host, &there, "a", &mut sequence);
    let mut random = SplitMix64(3);
    let _token = stranger.liveliness().declare_token("flyrig/v1/test/host/666").wait().unwrap();
    let put = |key: &str, payload: Vec<u8>, attachment: Vec<u8>| {
        stranger.put(key, payload).attachment(attachment).wait().unwrap();
    };
    let before = there.link(&a).refused;
    let mut flood = || {
        for n in 0..300u64 {
            let mut attachment = good_header(n).encode().to_vec();
            let mut payload = vec![0; 8];
            match n % 7 {
                0 => attachment.truncate(random.index(88)),
                1 => attachment = random_bytes(&mut random, 88),
                2 => attachment[random.index(HEADER_BYTES)] ^= 1 << random.index(8),
                3 => payload.truncate(random.index(8)),
                4 => attachment[HEADER_BYTES + 16] = random.next_u64() as u8,
                5 => attachment[56..64].copy_from_slice(&[0xff; 8]),
                // Of an age that cannot be.
                _ => attachment[24..32].copy_from_slice(&i64::MAX.to_le_bytes()),
            }
            put("flyrig/v1/test/camera/a", payload, attachment);
            put("flyrig/v1/test/camera-status/a", random_bytes(&mut random, 50), vec![]);
        }
    };
    flood();
    wait_until("the refusals", || {
        std::thread::sleep(Duration::from_millis(100));
        let refused = there.link(&a).refused;
        // On a busy machine zenoh may drop most of them.
        if refused <= before + 100 {
            flood();
        }
        refused > before + 100
    });
    let mut reported = 0;
    let found = wait_for("a good frame", || {
        sequence += 1;
        host.publish(frame("a", sequence)).unwrap();
        match there.next_frame(&a, Duration::from_millis(20)) {
            Ok(frame) => frame,
            Err(error) => {
                assert!(!error.to_string().is_empty());
                reported += 1;
                None
            }
        }
    });
    assert_eq!(found.image.width(), 4);
    assert!(there.link(&a).status.is_none());
    println!("{} messages refused, reported {reported} times", there.link(&a).refused - before);
}

#[test]
fn two_computers_with_one_camera_name_are_told() {
    let (one, two) = (host("test", &["a"], "tcp/127.0.0.1:0"), host("test", &["a"], "tcp/127.0.0.1:0"));
    let there = subscriber("test", &["a"], &[one.endpoints(), two.endpoints()].concat());
    publish_until_seen(&one, &there, "a", &mut 0);
    let mut sequence = 5000;
    let error = wait_for("the refusal", || {
        sequence += 1;
        one.publish(frame("a", sequence)).unwrap();
        two.publish(frame("a", sequence)).unwrap();
        loop {
            match there.next_frame(&"a".into(), Duration::from_millis(5)) {
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(error) => return Some(error),
            }
        }
    });
    assert!(error.to_string().contains("camera a: two computers publish a camera of this name"), "{error}");
}

#[test]
fn a_computer_whose_clock_does_not_answer_gives_no_frames() {
    let config =
        TransportConfig { listen: vec![free_endpoint()], connect: vec![], ..TransportConfig::subscriber("test") };
    let there = CameraSubscriber::open(&config, &["a".into()], our_clock()).unwrap();
    let stranger = stranger(&config.listen);
    let _token = stranger.liveliness().declare_token("flyrig/v1/test/host/abc").wait().unwrap();
    let mut sequence = 0;
    wait_until("frames without a time", || {
        sequence += 1;
        let attachment = good_header(sequence).encode().to_vec();
        stranger.put("flyrig/v1/test/camera/a", vec![0; 8]).attachment(attachment).wait().unwrap();
        std::thread::sleep(Duration::from_millis(5));
        there.link(&"a".into()).before_clock > 3
    });
    assert!(there.next_frame(&"a".into(), Duration::ZERO).unwrap().is_none());
    assert_eq!(there.link(&"a".into()).frames, 0);
}

#[test]
fn the_camera_of_huge_images_loses_its_own_where_bytes_are_short() {
    let host = host("test", &["small", "huge"], "tcp/127.0.0.1:0");
    let (small, huge) = (CameraId::from("small"), CameraId::from("huge"));
    let config = TransportConfig {
        connect: host.endpoints().to_vec(),
        inbox_bytes: 100_000,
        ..TransportConfig::subscriber("test")
    };
    let there = CameraSubscriber::open(&config, &[small.clone(), huge.clone()], our_clock()).unwrap();
    let mut sequence = 0;
    publish_until_seen(&host, &there, "small", &mut sequence);
    let picture = |bytes: usize, sequence: u64| Frame {
        image: Image::new(640, 480, PixelFormat::Mjpeg, vec![1; bytes]).unwrap(),
        ..frame("huge", sequence)
    };
    // Two of four that may wait fit.
    wait_until("four huge images", || {
        sequence += 1;
        host.publish(picture(45_000, sequence)).unwrap();
        host.publish(frame("small", sequence | 1)).unwrap();
        std::thread::sleep(Duration::from_millis(2));
        there.link(&huge).frames >= 6 && there.link(&small).frames >= 6
    });
    wait_until_settled("the last of them", || [&huge, &small].map(|camera| there.link(camera).frames));
    let drain = |camera: &CameraId| {
        std::iter::from_fn(|| there.next_frame(camera, Duration::ZERO).unwrap())
            .map(|f| f.image.bytes().len())
            .collect()
    };
    let (of_small, of_huge): (Vec<usize>, Vec<usize>) = (drain(&small), drain(&huge));
    assert!(of_small.len() >= 3 && (1..=2).contains(&of_huge.len()), "{of_small:?} {of_huge:?}");
    assert!(there.link(&huge).overtaken >= 2);
    let error = wait_for("the refusal", || {
        sequence += 1;
        host.publish(picture(100_001, sequence)).unwrap();
        there.next_frame(&huge, Duration::from_millis(20)).err()
    });
    assert!(error.to_string().contains("camera/huge: 100001 bytes, at most 100000; raise inbox-bytes"), "{error}");
}
