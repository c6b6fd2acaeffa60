//! The person stream: messages, templates in chunks, and what claims to belong to it.

use std::{
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use flyrig_stream::{
    ColorDecoder, ColorEncoder, ColorSettings, EncodedTemplate, LAYERS, MAX_MESSAGE_BYTES, Motion, MotionEncoder,
    Stamp, StreamJoint, StreamTemplate, TemplateSource, WholeColors,
};
use flyrig_transport::{
    Interests, MAX_PERSON_TOPICS, PersonMessage, PublishOutcome, Publisher, Received, Relay, Subscriber,
    TransportConfig,
};

use crate::support::*;

fn people() -> Interests {
    Interests { people: true, ..Interests::default() }
}

/// A template that takes several chunks.
pub fn encoded(count: usize) -> EncodedTemplate {
    let joint = StreamJoint {
        parent: None,
        translation: [0.0; 3],
        joint_from_canonical: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    };
    let hash = |i: usize, k: u32| (i as u32).wrapping_mul(2_654_435_761).rotate_left(k * 7) as f32 / u32::MAX as f32;
    let center_scale: Vec<[f32; 4]> = (0..count).map(|i| [hash(i, 1), hash(i, 2), hash(i, 3), 0.01]).collect();
    let normals: Vec<[f32; 3]> = (0..count).map(|i| [hash(i, 4) - 0.5, hash(i, 5) - 0.5, 0.7]).collect();
    let source = TemplateSource {
        joints: &[joint],
        center_scale: &center_scale,
        normals: &normals,
        skin: &vec![([0; 4], [1.0, 0.0, 0.0, 0.0]); count],
        node_weights: &[],
        nodes: &[],
    };
    source.encode().unwrap()
}

fn template(count: usize) -> Vec<u8> {
    encoded(count).bytes
}

fn next(subscriber: &Subscriber) -> Option<Received<PersonMessage>> {
    subscriber.next_person(Duration::from_millis(500)).unwrap()
}

#[test]
fn a_person_arrives_with_its_template() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &people());
    wait_until("the subscription", || publisher.has_person_subscribers());
    let bytes = template(30_000);
    assert!(bytes.len() > 3 * 60_000, "{}", bytes.len());
    let hash = flyrig_stream::template_hash(&bytes);
    publisher.offer_template(0, hash, bytes.clone().into());
    // The publisher may know of the subscriber before the subscriber knows who answers for templates: ask again, as
    // the viewers do.
    let fetched = wait_for("the template", || subscriber.template(hash, Duration::from_secs(20)).unwrap());
    assert!(fetched == bytes);
    assert_eq!(StreamTemplate::decode(&fetched).unwrap().gaussians(), 30_000);
    // No publisher has this template.
    assert_eq!(subscriber.template(hash ^ 1, Duration::from_secs(5)).unwrap(), None);

    let stamp = Stamp { template: hash, person: 0, frame: 9, capture_nanos: -3 };
    wait_until("all parts of a frame", || {
        publisher.publish_person(&stamp, None, vec![1, 2].into());
        for layer in 0..LAYERS {
            publisher.publish_person(&stamp, Some(layer), vec![layer as u8; 100].into());
        }
        let mut seen = std::collections::BTreeSet::new();
        while let Some(received) = next(&subscriber) {
            assert_eq!((received.body.person, received.header.frame, received.header.capture_nanos), (0, 9, -3));
            let expected = received.body.layer.map_or(vec![1, 2], |layer| vec![layer as u8; 100]);
            assert_eq!(received.body.bytes, expected);
            seen.insert(received.body.layer);
            if seen.len() == 1 + LAYERS {
                return true;
            }
        }
        false
    });
}

/// The programs let zenoh read and write on one thread: a publisher that answered on it had no room for more than a few chunks.
#[test]
fn a_large_template_comes_whole_with_one_network_thread() {
    let variable = "ZENOH_RUNTIME";
    if std::env::var_os(variable).is_none() {
        let inside = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "people::a_large_template_comes_whole_with_one_network_thread"])
            .env(variable, "(rx: (worker_threads: 1), tx: (handover: rx), acc: (handover: rx))")
            .status();
        assert!(inside.unwrap().success());
        return;
    }
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &people());
    wait_until("the subscription", || publisher.has_person_subscribers());
    let bytes: Vec<u8> = (0..1_500_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let hash = flyrig_stream::template_hash(&bytes);
    publisher.offer_template(0, hash, bytes.clone().into());
    // A chunk that is lost is asked for again after five seconds.
    let fetched = wait_for("the template", || subscriber.template(hash, Duration::from_secs(4)).unwrap());
    assert!(fetched == bytes);
}

#[test]
fn any_number_of_people_come_and_go() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &people());
    wait_until("the subscription", || publisher.has_person_subscribers());
    for person in 1..200 {
        let stamp = Stamp { person, ..Stamp::default() };
        publisher.publish_person(&stamp, None, vec![3; 10].into());
        publisher.offer_template(person, u64::from(person), vec![0; 10].into());
    }
    let topics = publisher.counts().into_iter().filter(|(label, _)| label.starts_with("person/")).count();
    assert_eq!(topics, (1 + MAX_PERSON_TOPICS) * (1 + LAYERS));
    wait_until("a person who came late", || {
        let stamp = Stamp { person: 199, ..Stamp::default() };
        publisher.publish_person(&stamp, None, vec![7; 10].into()) != PublishOutcome::Unwatched
            && next(&subscriber).is_some_and(|received| received.body.person == 199)
    });
    assert!(subscriber.template(150, Duration::from_secs(5)).unwrap().is_none());
}

#[test]
fn what_is_too_large_or_names_no_part_is_refused_in_words() {
    let publisher = open_publisher(|_| {});
    let subscriber = open_subscriber(&publisher, &people());
    wait_until("the subscription", || publisher.has_person_subscribers());
    let error = loop {
        publisher.publish_person(&Stamp::default(), None, vec![0; MAX_MESSAGE_BYTES + 1].into());
        if let Err(error) = subscriber.next_person(Duration::from_millis(100)) {
            break error;
        }
    };
    assert!(error.to_string().contains("65001 bytes, at most 65000"), "{error}");
    // A layer that does not exist is not sent.
    assert_eq!(publisher.publish_person(&Stamp::default(), Some(LAYERS), vec![0].into()), PublishOutcome::Unwatched);
}

/// Person who was published once and does not move since: a rig between two of its rare frame sets.
struct Standing {
    encoded: EncodedTemplate,
    colors: Arc<Shared>,
}

#[derive(Debug)]
struct Shared(Mutex<ColorEncoder>);

impl WholeColors for Shared {
    fn whole(&self, first_layer: usize) -> Vec<(usize, Vec<u8>)> {
        self.0.lock().unwrap().whole(first_layer)
    }
}

const GAUSSIANS: usize = 30_000;

fn paint(second: f32) -> Vec<[f32; 4]> {
    (0..GAUSSIANS).map(|i| [(i % 97) as f32 / 97.0, second, (i % 13) as f32 / 13.0, 1.0]).collect()
}

impl Standing {
    /// Publishes a frame set. The byte budget holds a small part of the colours.
    fn new(publisher: &Publisher) -> Self {
        let encoded = encoded(GAUSSIANS);
        let settings = ColorSettings { max_frame_bytes: 4000, ..ColorSettings::default() };
        let colors = Arc::new(Shared(Mutex::new(ColorEncoder::new(&encoded, settings, 1))));
        let hash = encoded.template.hash;
        publisher.offer_template_with(5, hash, encoded.bytes.clone().into(), colors.clone());
        let standing = Self { encoded, colors };
        standing.publish(publisher, 0);
        standing
    }

    fn publish(&self, publisher: &Publisher, frame: u64) {
        let template = self.encoded.template.hash;
        let stamp = Stamp { template, person: 5, frame, capture_nanos: 5_000_000_000 * frame as i64 };
        let joint_rotations = vec![[0.0, 0.0, 0.0, 1.0]];
        let motion = Motion { stamp, root_translation: [0.0, 1.0, 0.0], joint_rotations, nodes: Vec::new() };
        let bytes = MotionEncoder::new(&self.encoded).encode(&motion).unwrap();
        publisher.publish_person(&stamp, None, bytes.into());
        let layers = self.colors.0.lock().unwrap().encode(stamp, &paint(0.1 * frame as f32));
        for (layer, bytes) in layers.into_iter().enumerate() {
            publisher.publish_person(&stamp, Some(layer), bytes.into());
        }
    }

    /// Returns the colours that a decoder ought to have.
    fn expected(&self) -> Vec<[f32; 4]> {
        let mut decoder = ColorDecoder::new(&self.encoded.template);
        for (_, message) in self.colors.whole(0) {
            decoder.ingest(&message).unwrap();
        }
        let mut colors = Vec::new();
        decoder.colors(&mut colors);
        colors
    }
}

/// Reads as viewers do until all colours are those of `standing`.
fn watch_until_whole(subscriber: &Subscriber, standing: &Standing) -> u64 {
    let mut templates = subscriber.template_fetcher().unwrap();
    let (mut decoder, mut motions) = (None, 0);
    let end = Instant::now() + PATIENCE;
    loop {
        assert!(Instant::now() < end, "waited in vain for colours, {motions} motions came");
        if let Some(fetched) = templates.take().unwrap() {
            decoder = Some(ColorDecoder::new(&StreamTemplate::decode(&fetched.bytes).unwrap()));
        }
        let Some(received) = subscriber.next_person(Duration::from_millis(20)).unwrap() else { continue };
        if received.body.layer.is_none() {
            motions += 1;
            if decoder.is_none() {
                templates.ask(received.body.person, standing.encoded.template.hash);
            }
        } else if let Some(decoder) = &mut decoder {
            decoder.ingest(&received.body.bytes).unwrap();
            if (0..LAYERS).all(|layer| decoder.known(layer) >= 1.0) {
                let mut colors = Vec::new();
                decoder.colors(&mut colors);
                assert!(colors == standing.expected());
                return motions;
            }
        }
    }
}

#[test]
fn a_viewer_that_joins_between_two_rare_frame_sets_gets_the_person_whole() {
    let publisher = open_publisher(|_| {});
    let standing = Standing::new(&publisher);
    // Nothing is published from here on, and nobody was subscribed before.
    for _ in 0..2 {
        let subscriber = open_subscriber(&publisher, &people());
        assert!(watch_until_whole(&subscriber, &standing) >= 1);
        assert!(!subscriber.is_line_slow());
    }
}

#[test]
fn a_viewer_of_a_relay_gets_the_person_whole_as_well() {
    let publisher = open_publisher(|_| {});
    publisher.set_calibration(&rig()).unwrap();
    let standing = Standing::new(&publisher);
    let from = subscriber_config(publisher.endpoints());
    let to = TransportConfig { listen: vec![free_endpoint()], ..TransportConfig::publisher("test") };
    let relay = Relay::start(&from, &to).unwrap();
    let subscriber = Subscriber::open(&subscriber_config(&to.listen), &people()).unwrap();
    watch_until_whole(&subscriber, &standing);
    assert!(relay.trouble().is_none());
}

#[test]
fn a_viewer_that_misses_changes_of_a_slow_rig_gets_the_present_colours() {
    let publisher = open_publisher(|_| {});
    let standing = Standing::new(&publisher);
    let subscriber = open_subscriber(&publisher, &people());
    watch_until_whole(&subscriber, &standing);
    wait_until("all layers", || {
        let _ = subscriber.next_person(Duration::from_millis(20));
        subscriber.color_layers() == LAYERS
    });
    // Sets that are replaced in the inbox, because nobody reads, are missed.
    let mut decoder = ColorDecoder::new(&standing.encoded.template);
    let mut frame = 0;
    let read = |decoder: &mut ColorDecoder, wait: u64| {
        while let Some(received) = subscriber.next_person(Duration::from_millis(wait)).unwrap() {
            if received.body.layer.is_some() {
                decoder.ingest(&received.body.bytes).unwrap();
            }
        }
    };
    wait_until("the present colours", || {
        for _ in 0..2 {
            frame += 1;
            standing.publish(&publisher, frame);
            std::thread::sleep(Duration::from_millis(300));
        }
        read(&mut decoder, 500);
        (0..LAYERS).all(|layer| decoder.known(layer) >= 1.0)
    });
    wait_until("the last changes", || {
        read(&mut decoder, 20);
        let mut colors = Vec::new();
        decoder.colors(&mut colors);
        colors == standing.expected()
    });
}
