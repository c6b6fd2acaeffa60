//! The learnt person outlives the program.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use flyrig_fusion::{PersonId, PersonMemory, Session, SessionBuilder, TrackState};

use support::{frame_set, gpu, images, people, rig, session, settings};

const ME: PersonId = PersonId(0);

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
