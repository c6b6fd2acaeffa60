//! Viewpoints of subscribers: granted, renewed, bounded, ended.

use std::time::Duration;

use flyrig_transport::{Interests, MAX_VIEWPOINT_SIDE, ViewpointStatus};
use flyrig_types::Lens;

use crate::support::*;

#[test]
fn a_viewpoint_is_granted_moved_seen_and_given_back() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &Interests::default());
    assert_eq!(subscriber.viewpoint_status(), ViewpointStatus::Idle);
    let mut wanted = camera("mine", Lens::PINHOLE);
    subscriber.request_viewpoint(&wanted, 15.0).unwrap();
    let asked = wait_for("the request", || publisher.requested_viewpoints().pop());
    assert_eq!((asked.subscriber.as_str(), asked.max_fps, &asked.camera), (subscriber.id(), 15.0, &wanted));
    assert_eq!(asked.view, subscriber.viewpoint_view());
    let granted = ViewpointStatus::Granted { view: subscriber.viewpoint_view() };
    wait_until("the answer", || subscriber.viewpoint_status() == granted);

    wait_until("somebody to watch it", || publisher.has_subscribers(&asked.view));
    let received = publish_until_seen(&publisher, &subscriber, &asked.view, &mut 0);
    assert_eq!(received.topic, subscriber.viewpoint_view());

    wanted.intrinsics.width = 320;
    subscriber.request_viewpoint(&wanted, 15.0).unwrap();
    wait_until("the move", || publisher.requested_viewpoints().iter().any(|v| v.camera.intrinsics.width == 320));
    assert_eq!(publisher.viewpoint_counts().granted, 1);

    subscriber.release_viewpoint();
    wait_until("the return", || publisher.requested_viewpoints().is_empty());
    wait_until("the end of its topic", || !publisher.has_subscribers(&asked.view));
    assert_eq!(subscriber.viewpoint_status(), ViewpointStatus::Idle);
    wait_until("no trace of the viewer", || publisher.counts().iter().all(|(label, _)| !label.starts_with("viewer/")));
}

#[test]
fn viewers_are_bounded_refusals_answered_and_a_free_place_is_found() {
    let publisher = open_publisher(|config| {
        config.max_viewers = 1;
        config.viewpoint_lease_millis = 600_000;
    });
    let (one, two) =
        (open_subscriber(&publisher, &Interests::default()), open_subscriber(&publisher, &Interests::default()));
    let wanted = camera("mine", Lens::PINHOLE);
    let granted = |status| matches!(status, ViewpointStatus::Granted { .. });
    one.request_viewpoint(&wanted, 30.0).unwrap();
    wait_until("the first", || granted(one.viewpoint_status()));
    two.request_viewpoint(&wanted, 30.0).unwrap();
    let reason = wait_for("the refusal", || match two.viewpoint_status() {
        ViewpointStatus::Refused { reason } => Some(reason),
        _ => None,
    });
    assert!(reason.contains("all 1 viewpoints of the rig are taken"), "{reason}");
    assert!(publisher.viewpoint_counts().refused > 0);
    assert_eq!(publisher.requested_viewpoints().len(), 1);
    // Going away frees the place, without waiting for the lease.
    one.close().unwrap();
    wait_until("the second", || granted(two.viewpoint_status()));
    assert_eq!(publisher.requested_viewpoints()[0].subscriber, two.id());
}

#[test]
fn a_lease_outlives_its_length_only_by_renewal() {
    let publisher = open_publisher(|config| config.viewpoint_lease_millis = 150);
    let subscriber = open_subscriber(&publisher, &Interests::default());
    subscriber.request_viewpoint(&camera("mine", Lens::PINHOLE), 30.0).unwrap();
    wait_until("the request", || !publisher.requested_viewpoints().is_empty());
    std::thread::sleep(Duration::from_millis(600));
    wait_until("the renewed lease", || !publisher.requested_viewpoints().is_empty());

    // A question by hand is not renewed: it ends by itself, while its session lives on.
    let mut config = zenoh::Config::default();
    for (key, value) in [("mode", "\"client\""), ("scouting/multicast/enabled", "false")] {
        config.insert_json5(key, value).unwrap();
    }
    config.insert_json5("connect/endpoints", &format!("{:?}", publisher.endpoints())).unwrap();
    use zenoh::Wait;
    let session = zenoh::open(config).wait().unwrap();
    let ask = |payload: String| {
        let replies = session.get("flyrig/v1/test/viewpoint/by-hand").payload(payload).wait().unwrap();
        let reply = replies.recv().unwrap();
        String::from_utf8(reply.result().unwrap().payload().to_bytes().into_owned()).unwrap()
    };
    let camera = serde_json::to_string(&camera("mine", Lens::PINHOLE)).unwrap();
    let answer = ask(format!(r#"{{"schema_version":1,"max_fps":5.0,"camera":{camera}}}"#));
    assert!(answer.contains(r#""granted":true"#), "{answer}");
    wait_until("the end of the lease", || publisher.requested_viewpoints().iter().all(|v| v.subscriber != "by-hand"));
    assert!(publisher.viewpoint_counts().expired > 0);

    // Other versions, nonsense and absurd sizes are answered with a reason.
    let answer = ask(format!(r#"{{"schema_version":2,"max_fps":5.0,"camera":{camera}}}"#));
    assert!(answer.contains("schema version 2, this program knows version 1"), "{answer}");
    assert!(ask("{".to_owned()).contains(r#""granted":false"#));
    let wide = camera.replace("640", "5000");
    let answer = ask(format!(r#"{{"schema_version":1,"max_fps":5.0,"camera":{wide}}}"#));
    assert!(answer.contains("5000x480 pixels asked for, at most 4096 a side"), "{answer}");
    session.close().wait().unwrap();
}

#[test]
fn a_viewpoint_that_cannot_be_is_refused_before_it_is_sent() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &Interests::default());
    let good = camera("mine", Lens::PINHOLE);
    let mut bad = vec![good.clone(); 4];
    bad[0].intrinsics.width = MAX_VIEWPOINT_SIDE + 1;
    bad[1].intrinsics.focal_px.y = f64::INFINITY;
    bad[2].camera_from_world.translation.x = f64::NAN;
    bad[3].intrinsics.height = 0;
    for camera in &bad {
        assert!(subscriber.request_viewpoint(camera, 30.0).is_err(), "{camera:?}");
    }
    for fps in [0.0, -1.0, f64::NAN, 1e9] {
        assert!(subscriber.request_viewpoint(&good, fps).is_err(), "{fps}");
    }
    assert_eq!(subscriber.viewpoint_status(), ViewpointStatus::Idle);
}
