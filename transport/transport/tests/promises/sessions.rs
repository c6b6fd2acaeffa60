//! Publisher and subscribers in one process: messages arrive, whichever side starts first.

use std::{sync::Arc, time::Duration};

use flyrig_transport::{
    Interests, PublishOutcome, Publisher, RigStats, StageStats, Subscriber, TransportConfig, TransportErrorKind, Views,
};

use crate::support::*;

#[test]
fn an_image_comes_out_as_it_went_in() {
    let publisher = open_publisher(|_| {});
    publisher.add_view("front").unwrap();
    assert!(!publisher.has_subscribers("front"));
    let subscriber = open_subscriber(&publisher, &all_views());
    wait_until("the subscription", || publisher.has_subscribers("front"));
    let sent = view(7, 61_234);
    // Again until it is there: on a busy machine zenoh may drop one.
    let received = wait_for("the image", || {
        assert_ne!(publisher.publish_view("front", sent.clone()).unwrap(), PublishOutcome::Unwatched);
        subscriber.next_view(Duration::from_millis(200)).unwrap()
    });
    assert_eq!((received.topic.as_str(), &received.body), ("front", &sent));
    assert_eq!((received.header.frame, received.header.capture_nanos), (7, 7_000_000));
    if cfg!(target_os = "linux") {
        assert!(received.latency_is_exact);
    }
    let (label, report) = subscriber.reports().into_iter().find(|(label, _)| label == "view/front").unwrap();
    assert_eq!((label.as_str(), report.restarts), ("view/front", 0));
    assert!(report.received >= 1);
    assert!(report.bytes > 61_234);
    subscriber.close().unwrap();
    wait_until("the end of the subscription", || !publisher.has_subscribers("front"));
    publisher.close().unwrap();
}

#[test]
fn splats_and_statistics_come_out_as_they_went_in() {
    let publisher = open_publisher(|_| {});
    let interests = Interests { splats: true, stats: true, ..Interests::default() };
    let subscriber = open_subscriber(&publisher, &interests);
    wait_until("the subscription", || publisher.has_splat_subscribers());
    let sent = Arc::new(splats(3, 115_000));
    let received = wait_for("the splats", || {
        assert_ne!(publisher.publish_splats(sent.clone()), PublishOutcome::Unwatched);
        subscriber.next_splats(Duration::from_millis(500)).unwrap()
    });
    assert_eq!((received.body.frame, received.body.capture_nanos, received.header.frame), (3, -7, 3));
    assert_eq!(received.body.center_scale.len(), 115_000);
    let limit = sent.position_error_m();
    for (a, b) in sent.center_scale.iter().zip(&received.body.center_scale) {
        assert!((0..3).all(|axis| (a[axis] - b[axis]).abs() <= limit[axis]), "{a:?} {b:?}");
    }

    let stats = RigStats {
        frame: 9,
        capture_nanos: -1,
        frames_per_second: 29.97,
        stages: vec![StageStats { stage: "render".into(), mean_millis: 4.5, p95_millis: 9.25 }],
        dropped: [("sync".to_owned(), 3)].into(),
        ..RigStats::default()
    };
    let received = wait_for("statistics", || {
        publisher.publish_stats(&stats).unwrap();
        subscriber.next_stats(Duration::from_millis(20)).unwrap()
    });
    assert_eq!(received.body, stats);
    let poisoned = RigStats { frames_per_second: f64::NAN, ..stats };
    assert_eq!(publisher.publish_stats(&poisoned).unwrap_err().kind, TransportErrorKind::Config);
    subscriber.close().unwrap();
    publisher.close().unwrap();
}

#[test]
fn unwatched_messages_are_dropped_unencoded_and_counted() {
    let publisher = open_publisher(|_| {});
    let named = Interests { views: Views::Named(vec!["a".into()]), ..Interests::default() };
    let subscriber = open_subscriber(&publisher, &named);
    publish_until_seen(&publisher, &subscriber, "a", &mut 0);
    assert_eq!(publisher.publish_view("b", view(1, 100)).unwrap(), PublishOutcome::Unwatched);
    assert_eq!(publisher.publish_splats(Arc::new(splats(1, 10))), PublishOutcome::Unwatched);
    assert!(publisher.has_subscribers("a") && !publisher.has_subscribers("b") && !publisher.has_splat_subscribers());
    let of = |label: &str| publisher.counts().into_iter().find(|(other, _)| other == label).unwrap().1;
    assert_eq!((of("view/b").offered, of("view/b").unwatched, of("view/b").sent), (1, 1, 0));
    assert_eq!((of("splats").unwatched, of("splats").bytes), (1, 0));
    // A message is counted as sent a moment after it is.
    wait_until("every image to be accounted for", || {
        let a = of("view/a");
        a.offered == a.unwatched + a.replaced + a.sent && a.sent > 0
    });
}

#[test]
fn bad_names_sizes_and_too_many_views_are_refused() {
    let publisher = open_publisher(|_| {});
    assert!(publisher.publish_view("a/*", view(1, 10)).unwrap_err().to_string().contains("a/*"));
    assert!(publisher.publish_view("a", view(1, 0)).unwrap_err().to_string().contains("image of 0 bytes"));
    let flat = flyrig_transport::ViewFrame { height: 0, ..view(1, 10) };
    assert!(publisher.publish_view("a", flat).unwrap_err().to_string().contains("64x0"));
    for i in 0..64 {
        publisher.add_view(&format!("v{i}")).unwrap();
    }
    assert!(publisher.add_view("v64").unwrap_err().to_string().contains("at most 64 views"));
    // The view of an unknown viewer is unwatched, not an error: a lease may end at any moment.
    assert_eq!(publisher.publish_view("viewer-ghost", view(1, 10)).unwrap(), PublishOutcome::Unwatched);
}

#[test]
fn a_subscriber_may_come_first_and_outlives_a_restart_of_the_publisher() {
    let endpoint = free_endpoint();
    let subscriber = Subscriber::open(&subscriber_config(std::slice::from_ref(&endpoint)), &all_views()).unwrap();
    assert_eq!(subscriber.publishers(), 0);
    assert!(subscriber.next_view(Duration::from_millis(50)).unwrap().is_none());
    let open = || {
        let config = TransportConfig { listen: vec![endpoint.clone()], ..TransportConfig::publisher("test") };
        wait_for("the port", || Publisher::open(&config).ok())
    };

    let first = open();
    let mut frame = 0;
    publish_until_seen(&first, &subscriber, "front", &mut frame);
    wait_until("the publisher's token", || subscriber.publishers() == 1);
    first.close().unwrap();
    wait_until("the end of the token", || subscriber.publishers() == 0);

    let second = open();
    // Images of the first may still wait: go on until one of the second is there.
    let restarted = frame;
    wait_until("an image of the second", || {
        publish_until_seen(&second, &subscriber, "front", &mut frame).header.frame > restarted
    });
    wait_until("the second token", || subscriber.publishers() == 1);
    let restarts: u64 = subscriber.reports().iter().map(|(_, report)| report.restarts).sum();
    assert_eq!(restarts, 1);
    subscriber.close().unwrap();
    second.close().unwrap();
}

#[test]
fn two_subscribers_each_get_all_and_one_may_leave() {
    let publisher = open_publisher(|_| {});
    let (one, two) = (open_subscriber(&publisher, &all_views()), open_subscriber(&publisher, &all_views()));
    assert_ne!(one.id(), two.id());
    let mut frame = 0;
    publish_until_seen(&publisher, &one, "front", &mut frame);
    publish_until_seen(&publisher, &two, "front", &mut frame);
    one.close().unwrap();
    let before = frame;
    wait_until("a later image", || publish_until_seen(&publisher, &two, "front", &mut frame).header.frame > before);
    assert!(publisher.has_subscribers("front"));
}

#[test]
fn a_reader_that_sleeps_gets_the_newest_and_the_count_of_the_rest() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &all_views());
    let mut frame = 0;
    publish_until_seen(&publisher, &subscriber, "front", &mut frame);
    let report = || subscriber.reports().into_iter().find(|(label, _)| label == "view/front").unwrap().1;
    let before = report().replaced;
    wait_until("images that replace others", || {
        frame += 1;
        publisher.publish_view("front", view(frame, 5000)).unwrap();
        report().replaced > before + 5
    });
    // Frames go on until the newest is the one just published: what came before was replaced or lost.
    let mut wait = Duration::ZERO;
    wait_until("the newest", || {
        frame += 1;
        publisher.publish_view("front", view(frame, 5000)).unwrap();
        // A busy machine needs longer.
        wait += Duration::from_millis(20);
        std::thread::sleep(wait);
        subscriber.next_view(Duration::ZERO).unwrap().is_some_and(|received| received.header.frame == frame)
    });
    assert!(subscriber.next_view(Duration::ZERO).unwrap().is_none());
    assert!(report().replaced > before, "{:?}", report());
}

#[test]
fn a_port_in_use_is_an_error_that_says_so() {
    let publisher = open_publisher(|_| {});
    let config = TransportConfig { listen: publisher.endpoints().to_vec(), ..TransportConfig::publisher("test") };
    let error = Publisher::open(&config).unwrap_err();
    assert_eq!(error.kind, TransportErrorKind::Session);
    assert!(error.to_string().contains(&publisher.endpoints()[0]), "{error}");
    assert!(error.to_string().contains("another publisher"), "{error}");
}
