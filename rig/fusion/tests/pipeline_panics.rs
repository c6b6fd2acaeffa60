//! A panic in a thread of a live rig costs a moment; repeated panics end the rig with the thread's name.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking

mod support;

use std::time::Duration;

use flyrig_capture::Pacing;
use flyrig_fusion::{
    FusionError, GivenPerception, InputFormat, Intake, KnownPerson, LiveRig, LiveViews, Outcome, OutputSettings,
    Perception, PersonObservation, SessionBuilder, StageTimes,
};
use flyrig_sync::SyncSettings;
use flyrig_types::{FrameSet, PersonId, SupervisedThread};

use support::{frame_set, gpu, images, people, played, rig, settings};

const RED: [u8; 3] = [220, 40, 30];

/// Perception that panics at some frame sets.
struct Unlucky {
    inner: GivenPerception,
    panics_at: fn(u64) -> bool,
}

impl Perception for Unlucky {
    fn people(&self) -> Vec<KnownPerson<'_>> {
        self.inner.people()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        assert!(!(self.panics_at)(set.index), "set {}", set.index);
        self.inner.observe(set, stages)
    }
}

/// Returns a rig with eight frame sets.
fn live_rig(panics_at: fn(u64) -> bool) -> LiveRig {
    let images = images(&[(0.0, RED)]);
    let sets: Vec<FrameSet> = (0..8).map(|index| frame_set(index, &images)).collect();
    let intake = Intake::start(played(&sets), InputFormat::Rgb, &SyncSettings::default(), Pacing::Lossless).unwrap();
    let rig = rig();
    let perception = Unlucky { inner: people(&rig, &[(0, 0.0)]), panics_at };
    let builder = SessionBuilder::new(gpu().reopen().unwrap(), rig).settings(settings(3000));
    let session = builder.perception(perception).build().unwrap();
    LiveRig::new(session, intake, LiveViews::new(&OutputSettings::default()), None)
}

#[test]
fn a_live_rig_goes_on_after_a_panic_with_what_it_has_learnt() {
    let mut rig = live_rig(|index| index == 4);
    let mut outcomes = Vec::new();
    while !rig.ended() {
        outcomes.extend(rig.step(Duration::from_secs(5), None).unwrap().map(|step| step.outcome));
    }
    let held: Vec<usize> = (0..outcomes.len()).filter(|&i| outcomes[i] != Outcome::Updated).collect();
    assert_eq!((outcomes.len(), held), (8, vec![4]), "one set is lost: {outcomes:?}");
    let health = rig.health();
    let [pipeline] = health.threads.as_slice() else { panic!("{:?}", health.threads) };
    assert_eq!((pipeline.name.as_str(), pipeline.restarts, pipeline.has_failed), ("pipeline", 1, false));
    assert_eq!((pipeline.panic.as_deref(), health.device_faults), (Some("set 4"), 0));
    let red = |splats: Vec<flyrig_renderer::Splat>| splats.iter().filter(|s| s.color[0] > 4.0 * s.color[2]).count();
    assert!(red(rig.session.splats(PersonId(0)).unwrap()) > 1000);
}

#[test]
fn a_live_rig_that_panics_again_and_again_ends() {
    let mut rig = live_rig(|index| index >= 2);
    let error = loop {
        match rig.step(Duration::from_secs(5), None) {
            Ok(_) => assert!(!rig.ended(), "it went on for ever"),
            Err(error) => break error.to_string(),
        }
    };
    assert!(error.contains("the thread 'pipeline' panicked again and again: set 7"), "{error}");
    let pipeline = &rig.health().threads[0];
    assert_eq!((pipeline.restarts, pipeline.has_failed), (5, true));
}

#[test]
fn a_live_rig_ends_with_a_thread_that_it_needs() {
    let mut thread = SupervisedThread::start("clocks", || panic!("no clock")).unwrap();
    let mut rig = live_rig(|_| false).with_threads(vec![thread.watch().clone()]);
    thread.join();
    let error = rig.step(Duration::from_secs(5), None).unwrap_err().to_string();
    assert!(error.contains("the thread 'clocks' panicked again and again: no clock"), "{error}");
    let names: Vec<String> = rig.health().threads.into_iter().map(|thread| thread.name).collect();
    assert_eq!(names, ["pipeline", "clocks"]);
}
