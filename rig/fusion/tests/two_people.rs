//! Two people in one scene: each is painted from its own pixels, they hide each other, and neither loses its shape to the
//! other's silhouette.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use flyrig_fusion::{Outcome, Session};
use flyrig_types::PersonId;

use support::{SIZE, camera, frame_set, gpu, images, session};

const RED: [u8; 3] = [220, 40, 30];
const BLUE: [u8; 3] = [30, 50, 220];

fn share(session: &Session, person: u32, is: impl Fn(&[f32; 3]) -> bool) -> f64 {
    let splats = session.splats(PersonId(person)).unwrap();
    splats.iter().filter(|splat| is(&splat.color)).count() as f64 / splats.len() as f64
}

fn red(c: &[f32; 3]) -> bool {
    c[0] > 2.0 * c[2]
}

fn blue(c: &[f32; 3]) -> bool {
    c[2] > 2.0 * c[0]
}

/// Returns the mean distance between the Gaussians of two sessions' people, metres.
fn apart(a: &Session, person: u32, b: &Session, other: u32) -> f64 {
    let (a, b) = (a.splats(PersonId(person)).unwrap(), b.splats(PersonId(other)).unwrap());
    let distance =
        |(a, b): (&[f32; 3], &[f32; 3])| a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt();
    a.iter().zip(&b).map(|(a, b)| distance((&a.position, &b.position))).sum::<f64>() / a.len() as f64
}

#[test]
fn each_person_is_painted_and_shaped_by_its_own_pixels() {
    // From the sides at 90 and 270 degrees one stands behind the other.
    let places = [(0, -0.4), (1, 0.4)];
    let both = images(&[(-0.4, RED), (0.4, BLUE)]);
    let mut together = session(gpu(), &places);
    let mut alone = session(gpu(), &[(0, -0.4)]);
    let only = images(&[(-0.4, RED)]);
    for index in 0..6 {
        assert_eq!(together.process(&frame_set(index, &both)).unwrap(), Outcome::Updated);
        alone.process(&frame_set(index, &only)).unwrap();
    }
    assert_eq!(together.subjects().iter().map(|s| s.id().0).collect::<Vec<_>>(), [0, 1]);
    let (own, others) = (share(&together, 0, red), share(&together, 0, blue));
    assert!(own > 0.8 && others < 0.03, "the first is red: {own:.3}, blue: {others:.3}");
    let (own, others) = (share(&together, 1, blue), share(&together, 1, red));
    assert!(own > 0.8 && others < 0.03, "the second is blue: {own:.3}, red: {others:.3}");
    // Beside a twin who hides it from two sides, the shape is nearly that of the person alone.
    let moved = apart(&together, 0, &alone, 0);
    println!("the first person's Gaussians are {:.1} mm from those of the person alone", moved * 1e3);
    assert!(moved < 0.01, "{moved}");
    for subject in together.subjects() {
        assert!(subject.watch().quality().is_some_and(|quality| quality > 0.7), "{:?}", subject.watch());
    }

    // Seen along their line, the nearer one hides the other.
    for (degrees, front, behind) in [(90.0, 2, 0), (270.0, 0, 2)] {
        let view = together.render(&camera("along", degrees)).unwrap();
        let centre = (SIZE / 2 * SIZE + SIZE / 2) as usize * 4;
        let pixel = &view.rgba[centre..centre + 4];
        assert!(pixel[front] > 2 * pixel[behind].max(1) && pixel[3] > 200, "from {degrees}: {pixel:?}");
    }
    // From the front both are there.
    let view = together.render(&camera("front", 0.0)).unwrap();
    let covered = |columns: std::ops::Range<u32>| {
        let at = |i: &usize| columns.contains(&(*i as u32 % SIZE)) && view.rgba[4 * i + 3] > 128;
        (0..(SIZE * SIZE) as usize).filter(at).count()
    };
    assert!(covered(0..SIZE / 2) > 200 && covered(SIZE / 2..SIZE) > 200);
}

#[test]
fn people_come_to_no_harm_when_one_of_them_is_not_seen() {
    let mut both = session(gpu(), &[(0, -0.4), (1, 0.4)]);
    let only_first = images(&[(-0.4, RED)]);
    for index in 0..3 {
        both.process(&frame_set(index, &only_first)).unwrap();
    }
    assert!(share(&both, 0, red) > 0.8);
    assert_eq!(both.splats(PersonId(1)).unwrap().len(), 3000);
    assert!(both.splats(PersonId(7)).unwrap_err().to_string().contains("person 7"));
    for person in [0, 1] {
        let splats = both.splats(PersonId(person)).unwrap();
        assert!(splats.iter().all(|s| s.position.iter().chain(&s.color).all(|v| v.is_finite())));
    }
}
