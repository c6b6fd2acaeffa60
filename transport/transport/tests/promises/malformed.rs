//! Nothing that arrives breaks a reader: hand-made cases, then seeded noise.

use std::{sync::Arc, time::Duration};

use flyrig_model::SplitMix64;
use flyrig_transport::{
    HEADER_BYTES, Header, Interests, MessageKind, RigStats, SplatState, Subscriber, TransportConfig, TransportError,
    TransportErrorKind, ViewFrame, ViewpointStatus, Views, decode_calibration, decode_transforms, encode_calibration,
    encode_transforms,
};
use flyrig_types::Lens;
use foxglove::{
    Decode, Encode,
    messages::{CameraCalibration, CompressedImage, FrameTransforms},
};
use zenoh::Wait;

use crate::support::*;

fn header(kind: MessageKind) -> Header {
    Header {
        kind,
        sequence: 0,
        frame: 1,
        capture_nanos: 0,
        publish_unix_nanos: 0,
        publish_nanos: 0,
        host: 0,
        publisher: 1,
        width: 64,
        height: 48,
    }
}

fn bytes_of<M: Encode>(message: &M) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or(0));
    message.encode(&mut bytes).map_err(|error| error.to_string()).unwrap();
    bytes
}

/// The error's text; its kind must be `Malformed`.
fn refused<T: std::fmt::Debug>(result: Result<T, TransportError>) -> String {
    let error = result.unwrap_err();
    assert_eq!(error.kind, TransportErrorKind::Malformed, "{error}");
    error.to_string()
}

#[test]
fn splat_states_that_lie() {
    let good = splats(1, 100).encode().unwrap();
    for end in 0..good.len() {
        assert!(SplatState::decode(&good[..end]).is_err(), "{end}");
    }
    let with = |at: usize, bytes: &[u8]| {
        let mut state = good.clone();
        state[at..at + bytes.len()].copy_from_slice(bytes);
        SplatState::decode(&state).map_err(TransportError::from)
    };
    assert!(refused(with(0, b"NOPE")).contains("not a splat state"));
    assert_eq!(with(4, &[9, 0]).unwrap_err().kind, TransportErrorKind::UnknownVersion);
    assert!(refused(with(6, &[1])).contains("flags"));
    assert!(refused(with(24, &u32::MAX.to_le_bytes())).contains("claims 4294967295 Gaussians"));
    assert!(refused(with(24, &4_000_000u32.to_le_bytes())).contains("need 48000000 bytes, found 1200"));
    assert!(refused(with(28, &101u32.to_le_bytes())).contains("makes no sense"));
    for at in (32..60).step_by(4) {
        assert!(refused(with(at, &f32::NAN.to_le_bytes())).contains("makes no sense"));
        assert!(refused(with(at, &f32::INFINITY.to_le_bytes())).contains("makes no sense"));
    }
    // A box that ends before it begins, and one whose size is infinite though its ends are not.
    assert!(refused(with(44, &(-5.0f32).to_le_bytes())).contains("makes no sense"));
    let mut endless = good.clone();
    endless[32..36].copy_from_slice(&f32::MIN.to_le_bytes());
    endless[44..48].copy_from_slice(&f32::MAX.to_le_bytes());
    assert!(refused(SplatState::decode(&endless).map_err(TransportError::from)).contains("makes no sense"));
    assert!(
        refused(SplatState::decode(&[good.as_slice(), &[0]].concat()).map_err(TransportError::from))
            .contains("found 1201")
    );
}

#[test]
fn images_calibrations_and_statistics_that_lie() {
    let view_header = header(MessageKind::View);
    let decode = |image: &CompressedImage| ViewFrame::decode("front", &view_header, bytes_of(image).into());
    let good = view(1, 10).encode("front").unwrap();
    let image = <CompressedImage as Decode>::decode(good.as_slice()).unwrap();
    assert!(refused(decode(&CompressedImage { format: "tiff".into(), ..image.clone() })).contains("tiff"));
    assert!(refused(decode(&CompressedImage { data: vec![].into(), ..image })).contains("0 bytes"));
    let flat = Header { width: 0, ..view_header };
    assert!(refused(ViewFrame::decode("front", &flat, good.into())).contains("0x48"));

    let rig = rig();
    let good = <CameraCalibration as Decode>::decode(encode_calibration(&rig.cameras[0]).unwrap().as_slice()).unwrap();
    let decode = |message: CameraCalibration| decode_calibration(&bytes_of(&message));
    assert!(refused(decode(CameraCalibration { k: vec![], ..good.clone() })).contains("K has 0 numbers"));
    let mut k = good.k.clone();
    k[0] = f64::NAN;
    assert!(refused(decode(CameraCalibration { k: k.clone(), ..good.clone() })).contains("not a finite number"));
    (k[0], k[1]) = (500.0, 3.0);
    assert!(refused(decode(CameraCalibration { k, ..good.clone() })).contains("skew"));
    assert!(refused(decode(CameraCalibration { d: vec![0.0; 3], ..good.clone() })).contains("with 3 numbers"));
    assert!(refused(decode(CameraCalibration { distortion_model: "?".into(), ..good.clone() })).contains("\"?\""));
    assert!(refused(decode(CameraCalibration { width: u32::MAX, ..good.clone() })).contains("image width"));
    assert!(refused(decode(CameraCalibration { frame_id: "a/b".into(), ..good })).contains("a/b"));

    let good = <FrameTransforms as Decode>::decode(encode_transforms(&rig).unwrap().as_slice()).unwrap();
    let decode = |change: &dyn Fn(&mut FrameTransforms)| {
        let mut message = good.clone();
        change(&mut message);
        decode_transforms(&bytes_of(&message))
    };
    assert!(refused(decode(&|m| drop(m.transforms.remove(0)))).contains("transform of the world is absent"));
    assert!(refused(decode(&|m| m.transforms.push(m.transforms[1].clone()))).contains("appears twice"));
    assert!(refused(decode(&|m| m.transforms[1].rotation = None)).contains("zeta"));
    assert!(refused(decode(&|m| m.transforms[1].rotation.as_mut().unwrap().w = f64::NAN)).contains("zeta"));
    assert!(refused(decode(&|m| m.transforms[1].parent_frame_id = "moon".into())).contains("moon"));
    assert!(refused(decode(&|m| m.transforms = vec![Default::default(); 5000])).contains("5000 transforms"));

    for bad in ["", "{}", "[]", "null", r#"{"schema_version":1}"#, r#"{"schema_version":-1}"#] {
        refused(RigStats::decode(bad.as_bytes()));
    }
    refused(RigStats::decode("[".repeat(100_000).as_bytes()));
    assert!(refused(RigStats::decode(&vec![b' '; 1 << 20])).contains("at most"));
    let newer = RigStats::decode(br#"{"schema_version":12,"anything":[]}"#).unwrap_err();
    assert_eq!(newer.kind, TransportErrorKind::UnknownVersion);
    assert!(newer.to_string().contains("schema version 12"), "{newer}");
}

#[test]
fn seeded_noise_never_panics() {
    let mut random = SplitMix64(2026);
    let camera = &rig().cameras[0];
    let seeds = [
        header(MessageKind::Stats).encode().to_vec(),
        splats(1, 20).encode().unwrap(),
        view(1, 40).encode("front").unwrap(),
        encode_calibration(camera).unwrap(),
        encode_transforms(&rig()).unwrap(),
        RigStats { stages: vec![], ..RigStats::default() }.encode().unwrap(),
    ];
    let view_header = header(MessageKind::View);
    let (mut good, mut bad) = (0, 0);
    for round in 0..60_000 {
        let mut bytes = if round % 3 == 0 {
            let len = random.index(200);
            random_bytes(&mut random, len)
        } else {
            seeds[random.index(seeds.len())].clone()
        };
        for _ in 0..random.index(4) {
            let at = random.index(bytes.len());
            match (random.index(3), bytes.is_empty()) {
                (_, true) => {}
                (0, _) => bytes[at] = random.next_u64() as u8,
                (1, _) => bytes.truncate(at),
                (_, _) => bytes.insert(at, random.next_u64() as u8),
            }
        }
        for ok in [
            Header::decode("x", &bytes).is_ok(),
            SplatState::decode(&bytes).is_ok(),
            ViewFrame::decode("x", &view_header, bytes.clone().into()).is_ok(),
            decode_calibration(&bytes).is_ok(),
            decode_transforms(&bytes).is_ok(),
            RigStats::decode(&bytes).is_ok(),
        ] {
            if ok { good += 1 } else { bad += 1 }
        }
    }
    // Were one of them never reached, the noise would prove nothing.
    assert!(good > 1000 && bad > 1000, "{good} {bad}");
}

/// A session that says what it likes, and where it listens.
fn stranger() -> (zenoh::Session, String) {
    let mut config = zenoh::Config::default();
    for (key, value) in [("mode", "\"peer\""), ("scouting/multicast/enabled", "false"), ("connect/endpoints", "[]")] {
        config.insert_json5(key, value).unwrap();
    }
    let endpoint = free_endpoint();
    config.insert_json5("listen/endpoints", &format!("[{endpoint:?}]")).unwrap();
    (zenoh::open(config).wait().unwrap(), endpoint)
}

#[test]
fn foreign_messages_on_our_keys_are_told_counted_and_survived() {
    let publisher = open_publisher(|_| {});
    let interests = Interests { views: Views::All, splats: true, people: true, stats: true };
    let subscriber = open_subscriber(&publisher, &interests);
    publish_until_seen(&publisher, &subscriber, "front", &mut 0);

    let (stranger, endpoint) = stranger();
    let mut both = subscriber_config(publisher.endpoints());
    both.connect.push(endpoint);
    let subscriber = Subscriber::open(&both, &interests).unwrap();

    let mut future = header(MessageKind::View).encode();
    future[4] = 2;
    let cases: [(&str, &[u8], &[u8], &str); 5] = [
        ("view/front", &[], b"hello", "no flyrig header"),
        ("view/front", &future, b"hello", "schema version 2, this program knows version 1"),
        ("view/front", &header(MessageKind::Splats).encode(), b"hello", "holds Splats, expected View"),
        ("view/front", &header(MessageKind::View).encode(), b"hello", "not a CompressedImage"),
        ("calibration/x", &header(MessageKind::Calibration).encode(), b"hello", "calibration"),
    ];
    for (label, attachment, payload, text) in cases {
        assert!(attachment.is_empty() || attachment.len() == HEADER_BYTES);
        let error = wait_for(text, || {
            stranger.put(format!("flyrig/v1/test/{label}"), payload).attachment(attachment.to_vec()).wait().unwrap();
            subscriber.next_view(Duration::from_millis(20)).err().filter(|error| error.to_string().contains(text))
        });
        assert!(matches!(error.kind, TransportErrorKind::Malformed | TransportErrorKind::UnknownVersion), "{error}");
    }
    wait_until("their count", || subscriber.unreadable() >= 5);

    // A whole publisher of a later version is noticed by its token alone.
    let _token = stranger.liveliness().declare_token("flyrig/v2/test/alive/abc").wait().unwrap();
    let error = wait_for("the later version", || {
        subscriber.next_splats(Duration::from_millis(20)).err().filter(|error| error.to_string().contains("v2"))
    });
    assert_eq!(error.kind, TransportErrorKind::UnknownVersion);
    assert!(error.to_string().contains("flyrig/v2/test/alive/abc: speaks schema version v2"), "{error}");
    assert!(error.to_string().contains("run the same flyrig on both sides"), "{error}");

    // After all that, good messages still come through.
    wait_for("splats", || {
        publisher.publish_splats(Arc::new(splats(2, 50)));
        subscriber.next_splats(Duration::from_millis(20)).ok().flatten()
    });
    stranger.close().wait().unwrap();
}

#[test]
fn a_hostile_publisher_ends_no_watcher_and_holds_no_message_up() {
    let publisher = open_publisher(|_| {});
    publisher.set_calibration(&rig()).unwrap();
    let (stranger, endpoint) = stranger();
    let mut both = subscriber_config(publisher.endpoints());
    both.connect.push(endpoint);
    let subscriber =
        Subscriber::open(&both, &Interests { views: Views::All, splats: true, people: true, stats: true }).unwrap();
    // Answers to the viewpoint's question: nonsense, and no end of it.
    let noise = ["{", r#"{"schema_version":1,"granted":7}"#, &"x".repeat(300_000)].map(String::from);
    stranger
        .declare_queryable("flyrig/v1/test/viewpoint/*")
        .callback(move |query| {
            for answer in &noise {
                let _ = query.reply(query.key_expr(), answer.as_str()).wait();
            }
        })
        .background()
        .wait()
        .unwrap();
    let esc = "\u{1b}[2J\u{202e}";
    let flood = || {
        let put = |label: &str, kind: Option<MessageKind>, payload: &[u8]| {
            let attachment = kind.map_or(vec![7; 64], |kind| header(kind).encode().to_vec());
            stranger.put(format!("flyrig/v1/test/{label}"), payload).attachment(attachment).wait().unwrap();
        };
        let calibration = CameraCalibration { frame_id: esc.into(), ..Default::default() };
        put("calibration/zeta", Some(MessageKind::Calibration), &bytes_of(&calibration));
        put("calibration/alpha", Some(MessageKind::Calibration), b"noise");
        put("transforms", Some(MessageKind::Transforms), b"noise");
        put("transforms", None, b"noise");
        put("view/front", Some(MessageKind::View), b"noise");
        put("view/front", None, &[0; 5000]);
        put(&format!("view/{esc}"), Some(MessageKind::View), b"noise");
        put("splats", Some(MessageKind::Splats), esc.as_bytes());
        put("splats/x", Some(MessageKind::Splats), b"noise");
        put("stats", Some(MessageKind::Stats), br#"{"schema_version":1,"frame":"\u001b[2J"}"#);
    };
    let mut errors = Vec::new();
    let mut note = |error: TransportError| {
        assert!(!error.to_string().chars().any(|c| c.is_control() || c == '\u{202e}'), "{error:?}");
        assert!(error.to_string().len() < 2000);
        errors.push(error);
    };
    // Each in the midst of the flood, as a watcher asks.
    let found = wait_for("the rig", || {
        flood();
        subscriber.rig(Duration::from_millis(20)).unwrap_or_else(|error| {
            note(error);
            None
        })
    });
    assert_same_rig(&found, &rig());
    subscriber.request_viewpoint(&camera("mine", Lens::PINHOLE), 30.0).unwrap();
    wait_until("the viewpoint", || {
        flood();
        matches!(subscriber.viewpoint_status(), ViewpointStatus::Granted { .. })
    });
    let mut frame = 0;
    for name in ["front".to_owned(), subscriber.viewpoint_view()] {
        wait_until("an image", || {
            flood();
            frame += 1;
            publisher.publish_view(&name, view(frame, 5000)).unwrap();
            match subscriber.next_view(Duration::from_millis(20)) {
                Ok(picture) => picture.is_some_and(|picture| picture.topic == name),
                Err(error) => {
                    note(error);
                    false
                }
            }
        });
    }
    wait_until("splats", || {
        flood();
        publisher.publish_splats(Arc::new(splats(2, 50)));
        matches!(subscriber.next_splats(Duration::from_millis(20)).map_err(&mut note), Ok(Some(_)))
    });
    wait_until("statistics", || {
        flood();
        publisher.publish_stats(&RigStats::default()).unwrap();
        matches!(subscriber.next_stats(Duration::from_millis(20)).map_err(&mut note), Ok(Some(_)))
    });
    wait_until("unreadable messages", || {
        flood();
        subscriber.unreadable() > 10
    });
    assert!(!errors.is_empty());
    println!("{} unreadable messages, {} errors", subscriber.unreadable(), errors.len());
    stranger.close().wait().unwrap();
}

#[test]
fn an_inbox_over_its_bytes_drops_the_largest_and_refuses_by_name() {
    let publisher = open_publisher(|_| {});
    let config = TransportConfig { inbox_bytes: 100_000, ..subscriber_config(publisher.endpoints()) };
    let subscriber = Subscriber::open(&config, &all_views()).unwrap();
    let dropped = || subscriber.reports().iter().map(|(_, report)| report.dropped).sum::<u64>();
    let mut frame = 0;
    wait_until("a full inbox", || {
        frame += 1;
        for (name, bytes) in [("small", 5_000), ("a", 60_000), ("b", 60_000)] {
            publisher.publish_view(name, view(frame, bytes)).unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
        dropped() > 3
    });
    let of = |name: &str| subscriber.reports().into_iter().find(|(label, _)| label == name).unwrap().1;
    wait_until_settled("the last of them", || {
        subscriber.reports().iter().map(|(_, report)| report.received).collect::<Vec<_>>()
    });
    assert_eq!(of("view/small").dropped, 0);
    let mut waiting = Vec::new();
    while let Some(received) = subscriber.next_view(Duration::ZERO).unwrap() {
        waiting.push(received.body.bytes.len());
    }
    assert!(waiting.iter().sum::<usize>() <= 100_000, "{waiting:?}");
    let error = wait_for("the refusal", || {
        publisher.publish_view("huge", view(1, 100_000)).unwrap();
        subscriber.next_view(Duration::from_millis(20)).err()
    });
    assert_eq!(error.kind, TransportErrorKind::Malformed);
    assert!(error.to_string().contains("view/huge: 1000"), "{error}");
    assert!(error.to_string().contains("over the inbox of 100000 bytes; raise inbox-bytes"), "{error}");
}
