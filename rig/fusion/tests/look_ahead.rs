//! A live rig observes the next frame set while it reconstructs the one before, with the results of strictly sequential processing.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use flyrig_capture::Pacing;
use flyrig_fusion::{
    FusionError, GivenPerception, InputFormat, Intake, KnownPerson, LiveRig, LiveViews, Outcome, OutputSettings,
    Perception, PersonObservation, SessionBuilder, StageTimes,
};
use flyrig_sync::SyncSettings;
use flyrig_types::{FrameSet, PersonId};

use support::{frame_set, gpu, images, people, played, rig, settings};

/// Index of each observed frame set, and name of the thread that observed it.
type Log = Arc<Mutex<Vec<(u64, String)>>>;

/// Perception of known people with a log of its calls.
struct Logged {
    inner: GivenPerception,
    log: Log,
}

impl Perception for Logged {
    fn people(&self) -> Vec<KnownPerson<'_>> {
        self.inner.people()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        let thread = std::thread::current().name().unwrap_or_default().to_owned();
        self.log.lock().unwrap().push((set.index, thread));
        self.inner.observe(set, stages)
    }
}

#[test]
fn the_next_set_is_observed_meanwhile_and_nothing_changes() {
    let sets: Vec<FrameSet> = [[220, 40, 30], [40, 220, 30]]
        .iter()
        .enumerate()
        .flat_map(|(half, color)| {
            let images = images(&[(0.0, *color)]);
            (0..4).map(move |index| frame_set(4 * half as u64 + index, &images))
        })
        .collect();
    let log = Log::default();
    let session = || {
        let perception = Logged { inner: people(&rig(), &[(0, 0.0)]), log: Arc::clone(&log) };
        SessionBuilder::new(gpu(), rig()).settings(settings(3000)).perception(perception).build().unwrap()
    };

    let mut one_by_one = session();
    for set in &sets {
        assert_eq!(one_by_one.process(set).unwrap(), Outcome::Updated);
    }
    log.lock().unwrap().clear();

    let intake = Intake::start(played(&sets), InputFormat::Rgb, &SyncSettings::default(), Pacing::Lossless).unwrap();
    let mut rig = LiveRig::new(session(), intake, LiveViews::new(&OutputSettings::default()), None);
    let mut taken = Vec::new();
    while !rig.ended() {
        if let Some(step) = rig.step(Duration::from_secs(5), None).unwrap() {
            assert_eq!(step.outcome, Outcome::Updated);
            taken.push(step.set.index);
        }
    }
    assert_eq!(taken, (0..8).collect::<Vec<_>>(), "every set, in order, the last one too");
    let log = log.lock().unwrap();
    assert_eq!(log.iter().map(|(index, _)| *index).collect::<Vec<_>>(), taken, "each was observed once");
    let beside = log.iter().filter(|(_, thread)| thread == "perception").count();
    assert!(beside > 0, "none was observed beside another's reconstruction: {log:?}");
    assert_eq!((rig.frames(), rig.session.counts.updated), (8, 8));
    let splats = |session: &flyrig_fusion::Session| session.splats(PersonId(0)).unwrap();
    assert_eq!(splats(&rig.session), splats(&one_by_one), "bit for bit");
}
