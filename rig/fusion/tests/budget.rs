//! A budget leaves out frame sets in which nothing moves, and the work that a level of effort does without.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use flyrig_fusion::{BudgetSettings, Effort, Outcome, Session, SessionBuilder, SessionSettings};
use flyrig_types::{FrameSet, PersonId};

use support::{frame_set, gpu, images, people, rig, settings};

const BLUE: [u8; 3] = [30, 60, 210];

fn session(budget: BudgetSettings) -> Session {
    let rig = rig();
    let person = people(&rig, &[(0, 0.0)]);
    let settings = SessionSettings { budget, ..settings(3000) };
    SessionBuilder::new(gpu(), rig).settings(settings).perception(person).build().unwrap()
}

/// Returns a frame set one millisecond after the one before it. Whatever it costs, several follow before eight times that cost has passed.
fn set(index: u64, images: &[(Vec<u8>, Vec<u8>)]) -> FrameSet {
    FrameSet { master_nanos: index as i64 * 1_000_000, ..frame_set(index, images) }
}

fn count(session: &Session, name: &str) -> u64 {
    session.stages.counts().find(|(known, _)| *known == name).map_or(0, |(_, count)| count)
}

#[test]
fn nothing_is_done_while_nothing_moves_and_everything_once_something_does() {
    let still = images(&[(0.0, BLUE)]);
    let mut moved = still.clone();
    moved[1].0[..3 * 96 * 30].fill(250);
    // A budget that any machine meets.
    let mut session = session(BudgetSettings { fps: 0.001, effort: None });
    let outcomes: Vec<Outcome> = (0..30).map(|i| session.process(&set(i, &still)).unwrap()).collect();
    assert!(outcomes[..11].iter().all(|outcome| *outcome == Outcome::Updated), "{outcomes:?}");
    assert!(outcomes[12..].contains(&Outcome::Still), "{outcomes:?}");
    let left_out = count(&session, "sets left out, nothing moved");
    assert_eq!(left_out, outcomes.iter().filter(|outcome| **outcome == Outcome::Still).count() as u64);
    assert_eq!(session.counts.updated + left_out, 30);
    assert_eq!(session.process(&set(30, &moved)).unwrap(), Outcome::Updated);
    assert_eq!(session.process(&set(31, &still)).unwrap(), Outcome::Updated);
    assert!(session.render(&rig().cameras[0]).unwrap().rgba.iter().any(|value| *value > 0));
}

#[test]
fn without_a_budget_a_still_scene_gets_all_the_work() {
    let still = images(&[(0.0, BLUE)]);
    let mut session = session(BudgetSettings::default());
    for index in 0..20 {
        assert_eq!(session.process(&set(index, &still)).unwrap(), Outcome::Updated);
    }
    assert_eq!((session.budget.level(), session.budget.effort()), (0, Effort::FULL));
    assert_eq!(session.budget.stats(), None);
}

#[test]
fn the_least_effort_still_draws_the_person_in_the_colours_of_the_clothes() {
    let still = images(&[(0.0, BLUE)]);
    let least = *Effort::LEVELS.last().unwrap();
    let mut session = session(BudgetSettings { fps: 0.0, effort: Some(least) });
    for index in 0..40 {
        assert_eq!(session.process(&set(index, &still)).unwrap(), Outcome::Updated);
    }
    // The first eleven get all the work; of the others one in three is painted.
    let unpainted = count(&session, "sets not painted");
    assert_eq!(unpainted, 19, "of 40 sets");
    let splats = session.splats(PersonId(0)).unwrap();
    let blue = splats.iter().filter(|splat| splat.color[2] > 3.0 * splat.color[0]).count();
    assert!(blue > splats.len() / 2, "{blue} of {} Gaussians are blue", splats.len());
}

#[test]
fn budgets_that_make_no_sense_are_refused_by_name() {
    for fps in [-1.0, f64::NAN, f64::INFINITY, 1e6] {
        let settings = SessionSettings { budget: BudgetSettings { fps, effort: None }, ..settings(3000) };
        let error = settings.validate().unwrap_err().to_string();
        assert!(error.contains("budget.fps"), "{error}");
    }
}
