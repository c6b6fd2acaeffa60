//! Viewpoints of subscribers: granted, renewed, bounded, ended.

use std::time::{Duration, Instant};

use flyrig_transport::{Interests, MAX_VIEWPOINT_SIDE, Subscriber, Viewpoint, ViewpointStatus};
use flyrig_types::Lens;
use zenoh::Wait;

use crate::support::*;

/// A session of no flyrig program.
fn client(endpoints: &[String]) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [("mode", "\"client\""), ("scouting/multicast/enabled", "false")] {
        config.insert_json5(key, value).unwrap();
    }
    config.insert_json5("connect/endpoints", &format!("{endpoints:?}")).unwrap();
    zenoh::open(config).wait().unwrap()
}

/// Asks for a viewpoint by hand until the rig answers: a session that was opened a moment ago may not know it yet.
fn answer_of(session: &zenoh::Session, question: &str) -> String {
    let reply = wait_for("an answer", || {
        session.get("flyrig/v1/test/viewpoint/by-hand").payload(question).wait().unwrap().recv().ok()
    });
    String::from_utf8(reply.result().unwrap().payload().to_bytes().into_owned()).unwrap()
}

#[test]
fn a_viewpoint_is_granted_moved_seen_and_given_back() {
    // No pause of the machine ends the lease.
    let publisher = open_publisher(|config| config.viewpoint_lease_millis = 600_000);
    let subscriber = open_subscriber(&publisher, &Interests::default());
    assert_eq!(subscriber.viewpoint_status(), ViewpointStatus::Idle);
    let mut wanted = camera("mine", Lens::PINHOLE);
    subscriber.request_viewpoint(&wanted, 15.0).unwrap();
    let asked = wait_for("the request", || publisher.requested_viewpoints().pop());
    assert_eq!((asked.subscriber.as_str(), asked.max_fps, &asked.camera), (subscriber.id(), 15.0, &wanted));
    assert_eq!(asked.view, subscriber.viewpoint_view());
    let granted = ViewpointStatus::Granted { view: subscriber.viewpoint_view() };
    wait_until("the answer", || subscriber.viewpoint_status() == granted);

    wait_until("a subscriber of the view", || publisher.has_subscribers(&asked.view));
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
    let session = client(publisher.endpoints());
    let ask = |payload: String| answer_of(&session, &payload);
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
    assert!(answer.contains("5000x480 pixels requested, at most 4096 per side"), "{answer}");
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

/// The reason once the rig refuses.
fn refusal(subscriber: &Subscriber) -> Option<String> {
    match subscriber.viewpoint_status() {
        ViewpointStatus::Refused { reason } => Some(reason),
        _ => None,
    }
}

fn is_granted(subscriber: &Subscriber) -> bool {
    matches!(subscriber.viewpoint_status(), ViewpointStatus::Granted { .. })
}

#[test]
fn viewers_share_the_pixels_and_a_failure_reaches_only_its_viewer() {
    let publisher = open_publisher(|config| {
        config.viewpoint_pixels_per_second = 640 * 480 * 60;
        // No pause of the machine ends a lease, which is renewed in a third of it.
        config.viewpoint_lease_millis = 12_000;
    });
    let [one, two, three] = std::array::from_fn(|_| open_subscriber(&publisher, &Interests::default()));
    let wanted = camera("mine", Lens::PINHOLE);
    for subscriber in [&one, &two] {
        subscriber.request_viewpoint(&wanted, 30.0).unwrap();
        wait_until("the grant", || is_granted(subscriber));
    }
    three.request_viewpoint(&wanted, 30.0).unwrap();
    let reason = wait_for("the refusal", || refusal(&three));
    assert!(reason.contains("640x480 at 30 per second is 9.2 Mpx/s; 0.0 of the rig's 18.4 Mpx/s are left"), "{reason}");
    one.release_viewpoint();
    wait_until("the third", || is_granted(&three));

    // What cannot be drawn ends for its viewer alone, in the rig's words, also when it asks again.
    publisher.refuse_viewpoint(three.id(), "the adapter is out of memory \u{1b}[2J");
    assert!(publisher.requested_viewpoints().iter().all(|viewpoint| viewpoint.subscriber != three.id()));
    let reason = wait_for("the reason", || refusal(&three));
    assert!(reason.contains("the adapter is out of memory \\u{1b}[2J"), "{reason}");
    three.request_viewpoint(&wanted, 30.0).unwrap();
    assert!(wait_for("the same answer", || refusal(&three)).contains("out of memory"));
    // An answer to a renewal may be late.
    wait_until("the second, as before", || is_granted(&two));
    let mut smaller = wanted.clone();
    smaller.intrinsics.width = 320;
    three.request_viewpoint(&smaller, 30.0).unwrap();
    wait_until("another request", || is_granted(&three));

    publisher.set_max_view_pixels(320 * 480);
    assert_eq!(publisher.requested_viewpoints().len(), 1);
    let reason = wait_for("the limit", || refusal(&two));
    assert!(reason.contains("640x480 is 0.3 Mpx, the rig draws at most 0.2 Mpx; ask for 452x339"), "{reason}");
    wait_until("the third, as before", || is_granted(&three));
}

#[test]
fn due_viewpoints_are_watched_ones_at_their_own_rate() {
    let publisher = open_publisher(|config| config.viewpoint_lease_millis = 600_000);
    let subscriber = open_subscriber(&publisher, &Interests::default());
    subscriber.request_viewpoint(&camera("mine", Lens::PINHOLE), 10.0).unwrap();
    let viewpoint = wait_for("the request", || publisher.requested_viewpoints().pop());
    wait_until("a subscriber of the view", || publisher.has_subscribers(&viewpoint.view));
    // Two seconds of a rig at 30 frame sets per second, without waiting for them.
    let start = Instant::now();
    let due = |set: u32| publisher.due_viewpoints(start + Duration::from_secs(1) * set / 30);
    let taken: Vec<u32> = (0..60).filter(|set| due(*set) == [viewpoint.clone()]).collect();
    assert_eq!(taken, (0..20).map(|n| 3 * n).collect::<Vec<_>>());

    // A request without a subscription is granted and never drawn.
    let session = client(publisher.endpoints());
    let ask = |name: &str| {
        let camera = serde_json::to_string(&camera(name, Lens::PINHOLE)).unwrap();
        let question = format!(r#"{{"schema_version":1,"max_fps":5.0,"camera":{camera}}}"#);
        answer_of(&session, &question)
    };
    let refused = ask("\u{1b}[2J");
    assert!(refused.contains("has characters that cannot be seen") && !refused.contains('\u{1b}'), "{refused}");
    ask("mine too");
    let by_hand = |viewpoint: &Viewpoint| viewpoint.subscriber == "by-hand";
    let asked = publisher.requested_viewpoints().into_iter().find(by_hand).unwrap();
    assert_eq!(asked.camera.id.as_str(), "mine too");
    assert!(!publisher.due_viewpoints(start + Duration::from_secs(60)).iter().any(by_hand));
    session.close().wait().unwrap();
}
