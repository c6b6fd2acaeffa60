use flyrig_types::{Isometry, Lens};

use super::*;
use crate::header::empty_header;

const QUOTA: u64 = 1 << 20;

fn put_bytes(inbox: &Inbox, key: &str, kind: MessageKind, len: usize) -> Result<(), TransportError> {
    let header = Header { kind, ..empty_header() };
    inbox.accept(key, &header.encode(), len, || vec![7; len].into(), Moment::now())
}

fn put(inbox: &Inbox, key: &str, header: &Header) -> Result<(), TransportError> {
    inbox.accept(key, &header.encode(), 1, || Bytes::from_static(b"x"), Moment::now())
}

fn report(inbox: &Inbox, label: &str) -> TopicReport {
    inbox.reports().into_iter().find(|(other, _)| other == label).unwrap().1
}

#[test]
fn bytes_are_bounded_over_all_topics_and_the_largest_are_dropped() {
    let inbox = Inbox::new("viewer-me".to_owned(), 1000);
    let view = |name: &str, len| put_bytes(&inbox, &format!("flyrig/v1/r/view/{name}"), MessageKind::View, len);
    view("small", 100).unwrap();
    for n in 0..50 {
        view(&format!("huge{}", n % 5), 450).unwrap();
        assert!(lock(&inbox.state).waiting <= 1000);
    }
    let dropped = |label: &str| report(&inbox, label).dropped;
    assert_eq!(dropped("view/small"), 0, "the small one made room for the large ones");
    // 50 came: two wait, the others were dropped or replaced.
    let gone: u64 = (0..5).map(|n| report(&inbox, &format!("view/huge{n}"))).map(|r| r.dropped + r.replaced).sum();
    assert_eq!(gone, 48);
    // One that fills the inbox by itself is let in; one byte more is refused by name.
    view("whole", 1000).unwrap();
    assert_eq!(dropped("view/small"), 1);
    let error = view("more", 1001).unwrap_err();
    assert!(error.to_string().contains("view/more: 1001 bytes, over the inbox of 1000 bytes"), "{error}");
    let (label, raw) = inbox.next(Duration::ZERO, |_| true).unwrap().unwrap();
    assert_eq!((label.as_str(), raw.payload.len()), ("view/whole", 1000));
    assert!(inbox.next(Duration::ZERO, |_| true).unwrap().is_none());
    assert_eq!(lock(&inbox.state).waiting, 0);
    // Replacing the own message needs no room of others.
    view("small", 600).unwrap();
    view("other", 400).unwrap();
    view("small", 600).unwrap();
    assert_eq!((dropped("view/other"), report(&inbox, "view/small").replaced), (0, 1));
}

#[test]
fn persons_come_and_go_without_end() {
    let inbox = Inbox::new("viewer-me".to_owned(), QUOTA);
    for person in 1..1000 {
        let key = format!("flyrig/v1/r/{}", keys::splats_label(person));
        put_bytes(&inbox, &key, MessageKind::Splats, 100).unwrap();
        assert!(inbox.reports().len() <= MAX_PERSON_TOPICS && lock(&inbox.state).waiting <= 1600);
    }
    let labels: Vec<String> = inbox.reports().into_iter().map(|(label, _)| label).collect();
    assert!(labels.contains(&"splats/999".to_owned()) && labels.contains(&"splats/984".to_owned()), "{labels:?}");
    for bad in ["splats/", "splats/-1", "splats/01", "splats/+1", "splats/0", "splats/4294967296", "splats/x"] {
        let error = put_bytes(&inbox, &format!("flyrig/v1/r/{bad}"), MessageKind::Splats, 1).unwrap_err();
        assert!(error.to_string().contains("names no person"), "{error}");
    }
}

#[test]
fn names_that_harm_terminals_are_refused_and_errors_hold_no_message_up() {
    let inbox = Inbox::new("viewer-me".to_owned(), QUOTA);
    for name in ["\u{1b}[2J", "a b", &"x".repeat(65)] {
        let error = put_bytes(&inbox, &format!("flyrig/v1/r/view/{name}"), MessageKind::View, 1).unwrap_err();
        assert!(error.to_string().contains("view name") && !error.to_string().contains('\u{1b}'), "{error}");
    }
    put_bytes(&inbox, "flyrig/v1/r/view/a", MessageKind::View, 1).unwrap();
    let next = || inbox.next(Duration::ZERO, |_| true);
    inbox.refuse(TransportError::malformed("x", "first"));
    assert!(next().is_err());
    for n in 0..3 {
        inbox.refuse(TransportError::malformed("x", format!("flood {n}")));
    }
    assert_eq!(next().unwrap().unwrap().0, "view/a");
    assert!(next().is_err());
}

#[test]
fn a_rig_that_cannot_be_is_reported_once() {
    let inbox = Inbox::new("viewer-me".to_owned(), QUOTA);
    let places =
        RigTransforms { camera_from_world: vec![("twice".into(), Isometry::IDENTITY); 2], world_up: glam::DVec3::Z };
    let lens = Intrinsics {
        width: 64,
        height: 48,
        focal_px: glam::DVec2::splat(50.0),
        center_px: glam::DVec2::splat(20.0),
        lens: Lens::PINHOLE,
    };
    let mut state = lock(&inbox.state);
    state.places = Some((1, places));
    state.lenses.insert("twice".into(), (1, lens));
    drop(state);
    assert_eq!(inbox.rig(Duration::ZERO).unwrap_err().kind, TransportErrorKind::Malformed);
    assert_eq!((inbox.rig(Duration::ZERO), inbox.unreadable()), (Ok(None), 1));
}

#[test]
fn views_take_turns_and_the_newest_wins() {
    let inbox = Inbox::new("viewer-me".to_owned(), QUOTA);
    for sequence in 0..3 {
        for view in ["a", "b"] {
            let header = Header { kind: MessageKind::View, sequence, ..empty_header() };
            put(&inbox, &format!("flyrig/v1/r/view/{view}"), &header).unwrap();
        }
    }
    let next = || inbox.next(Duration::ZERO, |label| inbox.view_name(label).is_some()).unwrap();
    let (first, raw) = next().unwrap();
    assert_eq!((first.as_str(), raw.header.sequence), ("view/a", 2));
    put(&inbox, "flyrig/v1/r/view/a", &Header { kind: MessageKind::View, sequence: 3, ..empty_header() }).unwrap();
    assert_eq!(next().unwrap().0, "view/b");
    assert_eq!(next().unwrap().0, "view/a");
    assert!(next().is_none());
    assert_eq!(inbox.reports()[0].1.replaced, 2);
}

#[test]
fn topics_kinds_and_errors_are_bounded() {
    let inbox = Inbox::new("viewer-me".to_owned(), QUOTA);
    let header = Header { kind: MessageKind::View, ..empty_header() };
    for i in 0..MAX_TOPICS {
        put(&inbox, &format!("flyrig/v1/r/view/{i}"), &header).unwrap();
    }
    assert!(put(&inbox, "flyrig/v1/r/view/more", &header).unwrap_err().to_string().contains("topics"));
    let error = put(&inbox, "flyrig/v1/r/splats", &header).unwrap_err();
    assert!(error.to_string().contains("holds View, expected Splats"), "{error}");
    for i in 0..100 {
        inbox.refuse(TransportError::malformed("x", i.to_string()));
    }
    assert_eq!(inbox.unreadable(), 100);
    let mut reported = 0;
    while inbox.next(Duration::ZERO, |_| false).is_err() {
        reported += 1;
    }
    assert_eq!(reported, MAX_ERRORS);
}
