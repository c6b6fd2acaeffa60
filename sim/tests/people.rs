//! A seed determines a person, other seeds give other people; all of them consist of valid surfaces.

#![allow(clippy::unwrap_used)]

mod common;

use std::collections::HashSet;

use common::{simulator, small_config};
use flyrig_sim::{SimConfig, describe_person};

fn of_seed(seed: u64) -> SimConfig {
    SimConfig { seed, ..SimConfig::default() }
}

#[test]
fn most_of_a_thousand_people_differ_in_words() {
    let words: HashSet<String> = (0..1000).map(|seed| describe_person(&of_seed(seed))).collect();
    println!("{} different lines of words", words.len());
    assert!(words.len() > 900, "only {} of 1000 people differ in words", words.len());
}

#[test]
fn a_thousand_people_wear_everything_there_is() {
    let all: String = (0..1000).map(|seed| describe_person(&of_seed(seed)) + "\n").collect();
    for word in [
        "girl",
        "boy",
        "old woman",
        "old man",
        "tshirt",
        "shirt",
        "jumper",
        "turtleneck",
        "hoodie",
        "jacket",
        "coat",
        "trousers",
        "shorts",
        "skirt",
        "dress",
        "overalls",
        "beanie",
        "cap",
        "brimmed hat",
        "moustache",
        "goatee",
        "full beard",
        "long beard",
        "bald",
        "crop",
        "curls",
        "bob",
        "long hair",
        "bun",
        "ponytail",
        "weave",
        "denim",
        "knit",
        "leather",
        "stripes",
        "pinstripes",
        "checks",
        "plaid",
        "dots",
        "camouflage",
        "gradient",
        "text",
        "logo",
        "trainers",
        "boots",
        "leather shoes",
    ] {
        assert!(all.contains(word), "nobody of a thousand has: {word}");
    }
}

#[test]
fn every_garment_stands_on_the_floor_around_the_body_without_stray_points() {
    // Among these are dresses, coats, overalls, hats and children.
    for seed in [5, 7, 13, 16, 22, 31] {
        let mut simulator = simulator(&small_config(seed));
        let mesh = simulator.clothed_surface(0);
        let body = simulator.template();
        let count = mesh.positions.len();
        assert!(mesh.triangles.iter().flatten().all(|&v| (v as usize) < count));
        let (low, high) = body.positions.iter().fold((f32::MAX, f32::MIN), |(l, h), p| (l.min(p.y), h.max(p.y)));
        for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
            assert!(position.is_finite() && (normal.length() - 1.0).abs() < 1e-3, "seed {seed}: {position} {normal}");
            assert!(position.z > -0.06 && position.z < high - low + 0.25, "seed {seed}: {position}");
            assert!(position.truncate().length() < 1.0, "seed {seed}: {position}");
        }
        // Carriers are points of the body: vertices, or between vertices a few centimetres apart.
        let farthest = (mesh.canonical.iter())
            .map(|c| body.positions.iter().map(|p| p.distance(*c)).fold(f32::MAX, f32::min))
            .fold(0.0, f32::max);
        assert!(farthest < 0.05, "seed {seed}: a carrier lies {farthest} m off the body");
    }
}
