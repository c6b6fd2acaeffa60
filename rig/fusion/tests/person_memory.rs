//! A person's memory outlives the program.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use std::sync::Arc;

use flyrig_avatar::Avatar;
use flyrig_body::{DEFAULT_SIGMA2_M2, build_graph, sample_surface};
use flyrig_fusion::{AppearanceMode, PersonId, PersonMemory, Session, SessionBuilder, TrackState};

use flyrig_renderer::HarmonicOrder;
use support::{frame_set, gpu, images, people, rig, session, settings, template};

const ME: PersonId = PersonId(0);

/// Creates an avatar of one colour.
fn avatar(color: [f32; 3]) -> Avatar {
    let surface = sample_surface(&template(), 3000, 1).unwrap();
    let graph = build_graph(&template(), &surface, 60, DEFAULT_SIGMA2_M2).unwrap();
    Avatar::new(&template(), &surface, Some(&graph), &vec![color; 3000], HarmonicOrder::One).unwrap()
}

fn colors(session: &Session) -> Vec<[f32; 3]> {
    session.splats(ME).unwrap().iter().map(|splat| splat.color).collect()
}

#[test]
fn a_session_resumes_a_saved_person_and_refuses_one_that_does_not_fit() {
    let images = images(&[(0.0, [30, 160, 60])]);
    let mut first = session(gpu(), &[(0, 0.0)]);
    for index in 0..5 {
        first.process(&frame_set(index, &images)).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("me.person");
    first.memory(ME).unwrap().save(&path).unwrap();

    let resume = |gaussians: usize| {
        let memory = PersonMemory::load(&path).unwrap();
        let builder = SessionBuilder::new(gpu(), rig()).settings(settings(gaussians));
        builder.perception(people(&rig(), &[(0, 0.0)])).person(ME, memory).build()
    };
    let mut second = resume(3000).unwrap();
    assert_eq!(colors(&second), colors(&first), "before any image the person looks as it did");
    second.process(&frame_set(0, &images)).unwrap();
    assert_eq!(second.subjects()[0].watch().state(), TrackState::Recovering, "nothing was forgotten");
    let (before, after) = (colors(&first), colors(&second));
    let kept = before.iter().zip(&after).filter(|(a, b)| (a[1] - b[1]).abs() < 0.05).count();
    assert!(kept > before.len() * 9 / 10, "{kept} of {} Gaussians kept their colour", before.len());

    let refused = resume(2000).err().unwrap().to_string();
    assert!(refused.contains("3000 Gaussians") && refused.contains("body.gaussians"), "{refused}");
}

#[test]
fn an_avatar_takes_the_colours_of_images_and_returns_after_an_absence() {
    // Blue; the only camera that delivers stands in front and sees green.
    let known = PersonMemory::of_avatar(Arc::new(avatar([0.02, 0.04, 0.6])));
    let builder = SessionBuilder::new(gpu(), rig()).settings(settings(3000));
    let mut session = builder.perception(people(&rig(), &[(0, 0.0)]).dressed()).person(ME, known).build().unwrap();
    let images = images(&[(0.0, [30, 160, 60])]);
    let front = |index: u64| {
        let mut set = frame_set(index, &images);
        set.frames[1..].fill(None);
        set
    };
    let count = |session: &Session, is: fn(&[f32; 3]) -> bool| colors(session).iter().filter(|color| is(color)).count();
    let (blue, green) = (|c: &[f32; 3]| c[2] > 3.0 * c[1], |c: &[f32; 3]| c[1] > c[2].max(c[0]));
    assert_eq!(count(&session, blue), 3000, "before any image");
    for index in 0..10 {
        session.process(&front(index)).unwrap();
    }
    let seen = count(&session, green);
    assert!(seen > 1000, "{seen} green");
    // No person is there for two seconds. Nothing is left of the green when another camera sees red.
    let mut nobody = images.clone();
    nobody.iter_mut().for_each(|(_, mask)| mask.fill(0));
    session.process(&frame_set(10, &nobody)).unwrap();
    let mut back = frame_set(71, &support::images(&[(0.0, [170, 30, 40])]));
    back.frames[..3].fill(None);
    session.process(&back).unwrap();
    assert!(count(&session, green) < 30, "{} of {seen} green", count(&session, green));
    assert_eq!(session.subjects()[0].watch().state(), TrackState::First);
}

#[test]
fn what_networks_have_seen_outlives_the_program_too() {
    const SETS: u64 = 12;
    let mut images = images(&[(0.0, [30, 160, 60])]);
    // Behind, the person is red.
    for (rgb, mask) in &mut images[2..3] {
        rgb.chunks_exact_mut(3).zip(mask).filter(|(_, mask)| **mask > 0).for_each(|(p, _)| {
            p.copy_from_slice(&[170, 30, 40]);
        });
    }
    let builder = |weights: &str| {
        let mut settings = settings(2000);
        (settings.appearance.mode, settings.appearance.weights) = (AppearanceMode::Stfa, Some(weights.into()));
        SessionBuilder::new(gpu(), rig()).settings(settings).perception(people(&rig(), &[(0, 0.0)]))
    };
    let mut first = builder("tiny").build().unwrap();
    for index in 0..SETS {
        first.process(&frame_set(index, &images)).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("me.person");
    first.memory(ME).unwrap().save(&path).unwrap();

    // Afterwards only the camera in front delivers.
    let mut front = frame_set(SETS, &images);
    front.frames[1..].fill(None);
    first.process(&front).unwrap();
    let expected = colors(&first);
    let resumed = |weights: &str| {
        let memory = PersonMemory::load(&path).unwrap();
        let mut session = builder(weights).person(ME, memory).build().unwrap();
        session.process(&front).unwrap();
        let near = |(a, b): &(&[f32; 3], &[f32; 3])| a.iter().zip(*b).all(|(a, b)| (a - b).abs() < 0.03);
        colors(&session).iter().zip(&expected).filter(near).count() as f64 / expected.len() as f64
    };
    let red = expected.iter().filter(|color| color[0] > 2.0 * color[1]).count();
    assert!(red > expected.len() / 10, "{red} of {} Gaussians are red", expected.len());
    let (same, other) = (resumed("tiny"), resumed("small"));
    println!("{red} red, {same} the same, {other} with other networks");
    assert!(same > 0.98, "{same} of the Gaussians look as if nothing had happened");
    assert!(other < same, "to other networks the features mean nothing: {other}, {same}");
}
