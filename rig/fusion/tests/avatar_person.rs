//! A person made of an avatar's Gaussians: rendered and corrected, beside others, on another device, and on another body.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use std::{collections::BTreeMap, sync::Arc};

use flyrig_avatar::Avatar;
use flyrig_body::{DEFAULT_SIGMA2_M2, Template, build_graph, sample_surface};
use flyrig_fusion::{Outcome, PersonId, PersonMemory, Session, SessionBuilder};
use flyrig_gpu::{GpuContext, testing::device};
use flyrig_renderer::HarmonicOrder;

use support::{SIZE, camera, frame_set, gpu, images, people, rig, settings, template};

const ME: PersonId = PersonId(0);
const GREEN: [u8; 3] = [30, 160, 60];
const RED: [u8; 3] = [220, 40, 30];

/// Creates a blue avatar of a body.
fn avatar(body: &Template) -> Avatar {
    let surface = sample_surface(body, 3000, 1).unwrap();
    let graph = build_graph(body, &surface, 60, DEFAULT_SIGMA2_M2).unwrap();
    Avatar::new(body, &surface, Some(&graph), &[[0.02, 0.04, 0.6]; 3000], HarmonicOrder::One).unwrap()
}

/// Creates a session in which the first of the people at these places is made of an avatar.
fn session(gpu: GpuContext, avatar: Avatar, at: &[(u32, f64)]) -> Session {
    let builder = SessionBuilder::new(gpu, rig()).settings(settings(2000));
    let known = PersonMemory::of_avatar(Arc::new(avatar));
    builder.perception(people(&rig(), at).dressed()).person(ME, known).build().unwrap()
}

/// Returns the mean colour of the opaque pixels in the left or right half of a view from 20 degrees, and their number.
fn seen(session: &mut Session, left: bool) -> ([f64; 3], usize) {
    let view = session.render(&camera("a", 20.0)).unwrap();
    let (mut sum, mut count) = ([0.0; 3], 0);
    for (i, pixel) in view.rgba.chunks_exact(4).enumerate() {
        if pixel[3] > 200 && (i % SIZE as usize <= SIZE as usize / 2) == left {
            sum.iter_mut().zip(pixel).for_each(|(sum, value)| *sum += f64::from(*value));
            count += 1;
        }
    }
    (sum.map(|sum| sum / f64::from(count.max(1))), count as usize)
}

#[test]
fn images_correct_an_avatar_and_another_device_goes_on_with_it() {
    for gpu in [gpu().on_processor(), device()] {
        let mut session = session(gpu, avatar(&template()), &[(0, 0.0)]);
        assert_eq!(session.subjects()[0].template().positions, template().positions);
        let images = images(&[(0.0, GREEN)]);
        for index in 0..8 {
            assert_eq!(session.process(&frame_set(index, &images)).unwrap(), Outcome::Updated);
        }
        let ([red, green, blue], count) = seen(&mut session, true);
        assert!(count > 50 && green > 1.3 * blue && green > 1.5 * red, "{count} pixels of {red} {green} {blue}");
        let colors = |session: &Session| session.splats(ME).unwrap();
        assert!(colors(&session).iter().all(|splat| splat.color.iter().all(|value| value.is_finite())));

        let memory = session.memory(ME).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("me.person");
        memory.save(&path).unwrap();
        assert_eq!(PersonMemory::load(&path).unwrap(), memory);
        let whole = std::fs::read(&path).unwrap();
        let at = whole.windows(9).rposition(|window| window == b"flyavatar").unwrap();
        let broken = [&whole[..at], b"flyAvatar", &whole[at + 9..]].concat();
        std::fs::write(&path, broken).unwrap();
        let refused = PersonMemory::load(&path).unwrap_err().to_string();
        assert!(refused.contains("its avatar") && refused.contains("delete it"), "{refused}");
        if session.gpu().is_on_processor() {
            continue;
        }
        session.gpu().simulate_loss();
        assert!(session.process(&frame_set(8, &images)).unwrap_err().is_device_fault());
        let reopened = session.gpu().reopen().unwrap();
        session.rebuild(&reopened, &BTreeMap::from([(ME, memory.clone())])).unwrap();
        assert_eq!(session.memory(ME).unwrap(), memory);
        assert_eq!(session.process(&frame_set(9, &images)).unwrap(), Outcome::Updated);
        let ([_, after, _], _) = seen(&mut session, true);
        assert!((after - green).abs() < 12.0, "{after}, {green} before the loss");
    }
}

#[test]
fn an_avatar_and_another_person_are_rendered_together() {
    for gpu in [gpu().on_processor(), device()] {
        let mut session = session(gpu, avatar(&template()), &[(0, -0.4), (1, 0.4)]);
        let both = images(&[(-0.4, GREEN), (0.4, RED)]);
        for index in 0..6 {
            assert_eq!(session.process(&frame_set(index, &both)).unwrap(), Outcome::Updated);
        }
        let sides = [seen(&mut session, true), seen(&mut session, false)];
        let is = |color: usize, ([r, g, b], count): ([f64; 3], usize)| {
            let rest = [r, g, b].iter().sum::<f64>() - [r, g, b][color];
            count > 50 && [r, g, b][color] > 0.8 * rest
        };
        let (green, red) =
            (sides.iter().filter(|side| is(1, **side)).count(), sides.iter().filter(|side| is(0, **side)).count());
        assert_eq!((green, red), (1, 1), "one green, one red: {sides:?}");
    }
}

#[test]
fn an_avatar_of_another_body_is_left_out() {
    let mut other = template();
    other.positions.iter_mut().for_each(|position| *position *= 0.9);
    let mut session = session(gpu(), avatar(&other), &[(0, 0.0)]);
    let images = images(&[(0.0, GREEN)]);
    assert_eq!(session.process(&frame_set(0, &images)).unwrap(), Outcome::Updated);
    assert_eq!(session.splats(ME).unwrap().len(), 2000, "its own surface");
}
