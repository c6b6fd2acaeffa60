//! Colours: quality, losses, budgets and damaged messages.

#![allow(clippy::unwrap_used)] // helpers of tests

use std::{vec, vec::Vec};

use crate::{
    ColorDecoder, ColorEncoder, ColorSettings, EncodedTemplate, LAYERS, Motion, MotionEncoder, Stamp, WholeColors,
    restamp, stamp_of,
    testing::{Person, damaged},
};

const FRAME_NANOS: i64 = 33_333_333;

fn stamp(frame: u64) -> Stamp {
    Stamp { frame, capture_nanos: frame as i64 * FRAME_NANOS, ..Stamp::default() }
}

fn code(linear: f32) -> f64 {
    let linear = f64::from(linear);
    255.0 * if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Returns the root mean square error of the decoder's colours, sRGB codes.
fn rms(decoder: &mut ColorDecoder, encoded: &EncodedTemplate, truth: &[[f32; 4]]) -> f64 {
    let mut colors = Vec::new();
    decoder.colors(&mut colors);
    let mut sum = 0.0;
    for (found, &from) in colors.iter().zip(&encoded.gaussian_order) {
        sum += (0..3).map(|c| (code(found[c]) - code(truth[from as usize][c])).powi(2)).sum::<f64>();
    }
    (sum / (3 * colors.len()) as f64).sqrt()
}

#[test]
fn colours_follow_within_their_step() {
    let person = Person::tube(4000, 0);
    let encoded = person.encode();
    for step in [2.0, 8.0] {
        let settings = ColorSettings { step, ..ColorSettings::default() };
        let mut encoder = ColorEncoder::new(&encoded, settings, 1);
        let mut decoder = ColorDecoder::new(&encoded.template);
        for frame in 0..20 {
            let colors = person.colors(0.02 * frame as f32);
            for message in encoder.encode(stamp(frame), &colors) {
                assert_eq!(decoder.ingest(&message).unwrap().frame, frame);
            }
            let error = rms(&mut decoder, &encoded, &colors);
            assert!(error < 0.6 * f64::from(step), "{step} {frame}: {error}");
        }
        assert_eq!((decoder.known(0), decoder.known(2)), (1.0, 1.0));
    }
}

#[test]
fn a_scene_at_rest_costs_its_refresh_alone() {
    let person = Person::tube(4000, 0);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    let colors = person.colors(0.0);
    let bytes = |messages: [Vec<u8>; LAYERS]| messages.iter().map(Vec::len).sum::<usize>();
    let first = bytes(encoder.encode(stamp(0), &colors));
    let rest: usize = (1..31).map(|frame| bytes(encoder.encode(stamp(frame), &colors))).sum();
    // A second of frames repeats everything once; headers aside.
    let headers = 30 * LAYERS * 60;
    assert!(rest < first * 2 + headers, "{first} {rest}");
}

#[test]
fn a_loss_is_repaired_within_a_second_and_a_refresh_changes_nothing() {
    let person = Person::tube(4000, 0);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    let mut whole = ColorDecoder::new(&encoded.template);
    // One loses messages, the other comes late.
    let mut lossy = ColorDecoder::new(&encoded.template);
    let mut late = ColorDecoder::new(&encoded.template);
    let (mut a, mut b, mut c) = (Vec::new(), Vec::new(), Vec::new());
    for frame in 0..100 {
        let colors = person.colors(0.05 * (frame as f32).min(60.0));
        for message in encoder.encode(stamp(frame), &colors) {
            whole.ingest(&message).unwrap();
            if !(40..60).contains(&frame) || frame % 3 == 0 {
                lossy.ingest(&message).unwrap();
            }
            if frame >= 50 {
                late.ingest(&message).unwrap();
            }
        }
        if frame == 58 {
            whole.colors(&mut a);
            lossy.colors(&mut b);
            assert_ne!(a, b);
        }
    }
    assert!(lossy.missed(0) > 10 && whole.missed(0) == 0);
    whole.colors(&mut a);
    lossy.colors(&mut b);
    late.colors(&mut c);
    assert!(a == b && a == c);
}

#[test]
fn frames_keep_their_budget_and_catch_up() {
    let person = Person::tube(20_000, 0);
    let encoded = person.encode();
    let settings = ColorSettings { step: 2.0, max_frame_bytes: 6000, ..ColorSettings::default() };
    let mut encoder = ColorEncoder::new(&encoded, settings, 1);
    let mut decoder = ColorDecoder::new(&encoded.template);
    let colors = person.colors(0.0);
    let mut errors = Vec::new();
    for frame in 0..60 {
        let messages = encoder.encode(stamp(frame), &colors);
        let bytes: usize = messages.iter().map(Vec::len).sum();
        // The rest of a budget may be shorter than the header of an empty message.
        assert!(bytes <= 6000 + 2 * 60, "{frame}: {bytes}");
        for message in messages {
            decoder.ingest(&message).unwrap();
        }
        errors.push(rms(&mut decoder, &encoded, &colors));
    }
    assert!(errors[0] > 2.0 && errors[59] < 0.6 * 2.0, "{} {}", errors[0], errors[59]);
}

#[test]
fn an_encoder_that_begins_anew_is_followed() {
    let person = Person::tube(1000, 0);
    let encoded = person.encode();
    let mut decoder = ColorDecoder::new(&encoded.template);
    for (epoch, time) in [(1, 0.0), (2, 3.0)] {
        let colors = person.colors(time);
        let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), epoch);
        for message in encoder.encode(stamp(0), &colors) {
            decoder.ingest(&message).unwrap();
        }
        assert!(rms(&mut decoder, &encoded, &colors) < 5.0);
    }
}

#[test]
fn colours_stay_until_an_encoder_that_begins_anew_has_sent_others() {
    let person = Person::tube(9000, 0);
    let encoded = person.encode();
    let mut decoder = ColorDecoder::new(&encoded.template);
    let colors = person.colors(0.0);
    let messages = |step: f32, epoch: u32| {
        ColorEncoder::new(&encoded, ColorSettings { step, ..ColorSettings::default() }, epoch).encode(stamp(0), &colors)
    };
    let whole = messages(8.0, 1);
    for message in whole {
        decoder.ingest(&message).unwrap();
    }
    let before = rms(&mut decoder, &encoded, &colors);
    // A message without any segment: nothing is known of the new encoder, and nothing turns grey.
    let empty = |step: f32, epoch: u32| {
        let none = ColorSettings { step, max_frame_bytes: 0, ..ColorSettings::default() };
        ColorEncoder::new(&encoded, none, epoch).encode(stamp(1), &colors)
    };
    decoder.ingest(&empty(8.0, 2)[0]).unwrap();
    assert!(decoder.known(0) <= 0.0);
    assert!((rms(&mut decoder, &encoded, &colors) - before).abs() < 1e-9);
    for message in messages(8.0, 4) {
        decoder.ingest(&message).unwrap();
    }
    assert_eq!((decoder.known(0), decoder.known(2)), (1.0, 1.0));
    assert!((rms(&mut decoder, &encoded, &colors) - before).abs() < 1e-9);
    // Of other steps the old numbers mean something else.
    decoder.ingest(&empty(4.0, 3)[0]).unwrap();
    assert!(rms(&mut decoder, &encoded, &colors) > 3.0 * before);
}

#[test]
fn poisoned_colours_and_sizes_are_no_panic() {
    for count in [1, 2, 5, 33, 1000] {
        let person = Person::tube(count, 0);
        let encoded = person.encode();
        let mut encoder = ColorEncoder::new(&encoded, ColorSettings { step: f32::NAN, ..ColorSettings::default() }, 1);
        let mut decoder = ColorDecoder::new(&encoded.template);
        let mut found = Vec::new();
        decoder.colors(&mut found);
        assert_eq!(found.len(), count);
        for colors in [vec![[f32::NAN; 4]; count], vec![[f32::INFINITY; 4]; count], vec![[-1e30; 4]; count], Vec::new()]
        {
            for message in encoder.encode(stamp(0), &colors) {
                decoder.ingest(&message).unwrap();
            }
            decoder.colors(&mut found);
            assert!(found.iter().flatten().all(|v| (0.0..=1.0).contains(v)), "{count}");
        }
    }
}

#[test]
fn damaged_messages_are_no_panic() {
    let person = Person::tube(2000, 0);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    let mut decoder = ColorDecoder::new(&encoded.template);
    let mut found = Vec::new();
    for message in encoder.encode(stamp(0), &person.colors(0.0)) {
        damaged(&message, 1500, |bytes| {
            // Refused or not: it goes on.
            let _ = decoder.ingest(bytes);
            decoder.colors(&mut found);
            assert!(found.iter().flatten().all(|v| (0.0..=1.0).contains(v)));
        });
    }
}

#[test]
fn what_is_played_again_is_as_new() {
    let person = Person::tube(1000, 10);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 7);
    let mut decoder = ColorDecoder::new(&encoded.template);
    let colors = person.colors(0.0);
    let messages = encoder.encode(stamp(3), &colors);
    for round in 0..3 {
        for message in &messages {
            let mut message = message.clone();
            restamp(&mut message, -5 - i64::from(round), round).unwrap();
            let taken = decoder.ingest(&message).unwrap();
            assert_eq!((taken.capture_nanos, taken.frame), (-5 - i64::from(round), 3));
            assert_eq!(stamp_of(&message).unwrap(), taken);
        }
        assert!(rms(&mut decoder, &encoded, &colors) < 5.0);
        assert_eq!(decoder.missed(0), 0);
    }
    let mut motion = MotionEncoder::new(&encoded).encode(&person.motion(2)).unwrap();
    restamp(&mut motion, 99, 1).unwrap();
    let back = Motion::decode(&motion, &encoded.template).unwrap();
    assert_eq!(back.stamp, Stamp { capture_nanos: 99, ..stamp_of(&motion).unwrap() });
    assert!(restamp(&mut motion[..20], 1, 0).is_err() && restamp(&mut [], 1, 0).is_err());
}

#[test]
fn a_viewer_that_joins_gets_all_layers_whole_whatever_the_budget() {
    let person = Person::tube(20_000, 0);
    let encoded = person.encode();
    // The budget of a frame holds a small part of a new person.
    let settings = ColorSettings { step: 2.0, max_frame_bytes: 3000, ..ColorSettings::default() };
    let mut encoder = ColorEncoder::new(&encoded, settings, 1);
    assert!(encoder.whole(0).is_empty());
    let colors = person.colors(0.0);
    let first = encoder.encode(stamp(0), &colors);
    let mut follower = ColorDecoder::new(&encoded.template);
    for message in &first {
        follower.ingest(message).unwrap();
    }
    assert!(follower.known(2) < 0.5 && follower.whole(LAYERS).is_empty());
    let mut joins = ColorDecoder::new(&encoded.template);
    for (layer, message) in encoder.whole(0) {
        assert!(message.len() <= crate::MAX_MESSAGE_BYTES);
        assert_eq!(joins.ingest(&message).unwrap(), stamp_of(&first[layer]).unwrap());
    }
    assert!([0, 1, 2].into_iter().all(|layer| joins.known(layer) >= 1.0));
    assert!(rms(&mut joins, &encoded, &colors) < 0.6 * 2.0);
    // Who joins at a relay gets the relay's state.
    let mut second = ColorDecoder::new(&encoded.template);
    for (_, message) in joins.whole(0) {
        second.ingest(&message).unwrap();
    }
    let (mut a, mut b) = (Vec::new(), Vec::new());
    joins.colors(&mut a);
    second.colors(&mut b);
    assert!(a == b);
    // All of them follow, and none has missed anything.
    for frame in 1..40 {
        for message in encoder.encode(stamp(frame), &person.colors(0.01 * frame as f32)) {
            for decoder in [&mut follower, &mut joins, &mut second] {
                decoder.ingest(&message).unwrap();
            }
        }
    }
    for decoder in [&mut joins, &mut second] {
        decoder.colors(&mut b);
        follower.colors(&mut a);
        assert!(a == b && decoder.missed(0) + decoder.missed(2) == 0);
    }
}

#[test]
fn changes_that_overtake_a_whole_state_are_applied_on_top_and_late_ones_are_not() {
    let person = Person::tube(6000, 0);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    let mut follower = ColorDecoder::new(&encoded.template);
    let (mut early, mut late) = (follower.clone(), follower.clone());
    let mut held = Vec::new();
    for frame in 0..12 {
        let messages = encoder.encode(stamp(frame), &person.colors(0.1 * frame as f32));
        for message in &messages {
            follower.ingest(message).unwrap();
            // Subscribed in time, but asked for the state at frame 5, which arrives after frame 11.
            if frame >= 4 {
                early.ingest(message).unwrap();
            }
        }
        if frame == 5 {
            held = encoder.whole(0);
        }
        if frame >= 8 {
            late.ingest(&messages[0]).unwrap();
        }
    }
    assert!(held.iter().any(|(layer, _)| *layer == 2));
    for (_, message) in &held {
        early.ingest(message).unwrap();
    }
    let (mut a, mut b) = (Vec::new(), Vec::new());
    follower.colors(&mut a);
    early.colors(&mut b);
    assert!(a == b && early.missed(0) == 0);
    // A state overtakes changes that it contains: these are left out.
    let mut next = encoder.clone();
    let messages = next.encode(stamp(12), &person.colors(1.5));
    for (_, message) in next.whole(0) {
        early.ingest(&message).unwrap();
    }
    for message in &messages {
        early.ingest(message).unwrap();
        follower.ingest(message).unwrap();
    }
    follower.colors(&mut a);
    early.colors(&mut b);
    assert!(a == b);
    // Without kept messages back to the state, refreshes repair the rest.
    for (_, message) in &held {
        late.ingest(message).unwrap();
    }
    assert!(late.known(2) >= 1.0);
}

#[test]
fn a_slow_rig_sends_whole_changes_with_each_set() {
    let person = Person::tube(20_000, 0);
    let encoded = person.encode();
    let settings = ColorSettings { max_frame_bytes: 6000, ..ColorSettings::default() };
    for (period_nanos, is_slow) in [(33_000_000, false), (5_000_000_000i64, true)] {
        let mut encoder = ColorEncoder::new(&encoded, settings, 1);
        let mut decoder = ColorDecoder::new(&encoded.template);
        let mut bytes = 0;
        for frame in 0..3 {
            let stamp = Stamp { frame, capture_nanos: period_nanos * frame as i64, ..Stamp::default() };
            let messages = encoder.encode(stamp, &person.colors(0.5 * frame as f32));
            bytes = messages.iter().map(Vec::len).sum();
            for message in &messages {
                decoder.ingest(message).unwrap();
            }
        }
        assert_eq!(bytes > 6000 + 2 * 60, is_slow, "{bytes}");
        assert!(bytes <= 8 * 6000 + 2 * 60);
        assert_eq!(decoder.known(2) >= 1.0, is_slow);
    }
}

#[test]
fn damaged_whole_states_are_no_panic() {
    let person = Person::tube(2000, 0);
    let encoded = person.encode();
    let mut encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    let mut decoder = ColorDecoder::new(&encoded.template);
    for message in encoder.encode(stamp(0), &person.colors(0.0)) {
        decoder.ingest(&message).unwrap();
    }
    let mut found = Vec::new();
    for (_, message) in encoder.whole(0) {
        damaged(&message, 800, |bytes| {
            let _ = decoder.ingest(bytes);
            decoder.colors(&mut found);
            assert!(found.iter().flatten().all(|v| (0.0..=1.0).contains(v)));
        });
    }
    // Whatever it has learned, it can be passed on.
    assert!(decoder.whole(0).iter().all(|(_, message)| message.len() <= crate::MAX_MESSAGE_BYTES));
}
