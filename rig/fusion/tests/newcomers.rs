//! People who arrive, or change their shape, while a session runs: in place, or in threads beside it.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use std::time::{Duration, Instant};

use flyrig_body::Template;
use flyrig_fusion::{
    FusionError, GivenPerception, KnownPerson, Outcome, Perception, PersonObservation, Session, SessionBuilder,
    StageTimes,
};
use flyrig_types::{FrameSet, PersonId};

use support::{frame_set, gpu, images, people, rig, settings};

const PERSON: PersonId = PersonId(0);

/// Perception of a person who is known after a number of frame sets, and has another shape after more.
struct Late {
    inner: GivenPerception,
    seen: u64,
    known_after: u64,
    other_after: u64,
    other: Template,
}

impl Perception for Late {
    fn people(&self) -> Vec<KnownPerson<'_>> {
        let people = self.inner.people().into_iter().filter(|_| self.seen >= self.known_after);
        let is_other = self.seen >= self.other_after;
        people
            .map(|known| if is_other { KnownPerson { shape: 1, template: &self.other, ..known } } else { known })
            .collect()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        self.seen += 1;
        let observed = self.inner.observe(set, stages)?;
        Ok(if self.seen >= self.known_after { observed } else { Vec::new() })
    }
}

fn session(gaussians: usize, known_after: u64, other_after: u64) -> Session {
    let inner = people(&rig(), &[(0, 0.0)]);
    let mut other = inner.people()[0].template.clone();
    other.positions.iter_mut().for_each(|position| *position *= 1.01);
    let perception = Late { inner, seen: 0, known_after, other_after, other };
    SessionBuilder::new(gpu(), rig()).settings(settings(gaussians)).perception(perception).build().unwrap()
}

/// Processes the same frame set until a person is updated; returns the number of held ones, and the reason of the last.
fn until_updated(session: &mut Session, set: &FrameSet) -> (usize, String) {
    let (start, mut held, mut why) = (Instant::now(), 0, String::new());
    while let Outcome::Held(reason) = session.process(set).unwrap() {
        assert!(start.elapsed() < Duration::from_secs(60), "nobody is shown after a minute: {reason}");
        (held, why) = (held + 1, reason);
    }
    (held, why)
}

#[test]
fn a_person_who_arrives_is_prepared_beside_the_sets_and_is_the_same_as_otherwise() {
    let set = frame_set(0, &images(&[(0.0, [220, 40, 30])]));
    let mut waiting = session(3000, 3, u64::MAX);
    assert_eq!(until_updated(&mut waiting, &set).0, 2, "no person is known in two frame sets");
    let mut beside = session(3000, 3, u64::MAX);
    beside.use_threads();
    let (held, why) = until_updated(&mut beside, &set);
    assert!(held > 2, "the set in which the person is new does not wait");
    assert_eq!(why, "person 0 is being prepared");
    assert_eq!(beside.splats(PERSON).unwrap(), waiting.splats(PERSON).unwrap(), "bit for bit");
}

#[test]
fn a_person_of_another_shape_is_shown_as_before_until_the_new_one_is_ready() {
    let set = frame_set(0, &images(&[(0.0, [220, 40, 30])]));
    let mut session = session(3000, 0, 3);
    session.use_threads();
    let height = |session: &Session| {
        let positions = &session.subject(PERSON).unwrap().template().positions;
        positions.iter().map(|position| position.y).fold(0.0f32, f32::max)
    };
    let (first, start) = (height(&session), Instant::now());
    let mut as_before = 0;
    while (height(&session) - first).abs() < 1e-6 {
        assert!(start.elapsed() < Duration::from_secs(60), "the new shape is never ready");
        assert_eq!(session.process(&set).unwrap(), Outcome::Updated);
        as_before += 1;
    }
    assert!((height(&session) / first - 1.01).abs() < 1e-4);
    assert!(as_before > 3, "{as_before}: the set in which the shape changes does not wait");
}
