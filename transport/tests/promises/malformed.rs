//! Nothing that arrives breaks a reader: hand-made cases, then seeded noise.

use std::{sync::Arc, time::Duration};

use flyrig_transport::{
    HEADER_BYTES, Header, Interests, MessageKind, RigStats, SplatState, Subscriber, TransportErrorKind, ViewFrame,
    Views, decode_calibration, decode_transforms, encode_calibration, encode_transforms,
};
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
fn refused<T: std::fmt::Debug>(result: Result<T, flyrig_transport::TransportError>) -> String {
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
        SplatState::decode(&state)
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
    assert!(refused(SplatState::decode(&endless)).contains("makes no sense"));
    assert!(refused(SplatState::decode(&[good.as_slice(), &[0]].concat())).contains("found 1201"));
}

#[test]
fn pictures_calibrations_and_statistics_that_lie() {
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
    let mut random = Random(2026);
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
            let len = random.below(200);
            random.bytes(len)
        } else {
            seeds[random.below(seeds.len())].clone()
        };
        for _ in 0..random.below(4) {
            let at = random.below(bytes.len());
            match (random.below(3), bytes.is_empty()) {
                (_, true) => {}
                (0, _) => bytes[at] = random.next() as u8,
                (1, _) => bytes.truncate(at),
                (_, _) => bytes.insert(at, random.next() as u8),
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

#[test]
fn foreign_messages_on_our_keys_are_told_counted_and_survived() {
    let publisher = open_publisher(|_| {});
    let interests = Interests { views: Views::All, splats: true, stats: true };
    let subscriber = open_subscriber(&publisher, &interests);
    publish_until_seen(&publisher, &subscriber, "front", &mut 0);

    let mut config = zenoh::Config::default();
    for (key, value) in [("mode", "\"peer\""), ("scouting/multicast/enabled", "false"), ("connect/endpoints", "[]")] {
        config.insert_json5(key, value).unwrap();
    }
    let endpoint = free_endpoint();
    config.insert_json5("listen/endpoints", &format!("[{endpoint:?}]")).unwrap();
    let stranger = zenoh::open(config).wait().unwrap();
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
    assert!(subscriber.unreadable() >= 5);

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
