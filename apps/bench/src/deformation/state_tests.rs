//! Recovery of the tracking after all kinds of faults.

use std::sync::Arc;

use flyrig_fusion::{Outcome, PersonId, Session, Solver, Subject, TrackState, TrackWatch};
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_types::{Frame, FrameSet, Image, Mask, PixelFormat};

use super::case::{Case, session};
use crate::harness::sequence::{SequenceConfig, SequenceMotion, SimulatedSequence};

const SIDE: u32 = 96;
const PERIOD_NANOS: i64 = 33_333_333;

struct Stage {
    sets: Vec<FrameSet>,
    session: Session,
}

impl Stage {
    fn new(gpu: &GpuContext, sequence: &SimulatedSequence) -> Self {
        let case = Case::new(Solver::GaussNewton, 3_000, 3, sequence.config());
        Self { sets: sequence.sets(3).collect(), session: session(gpu, sequence, &case).unwrap() }
    }

    /// Processes frame sets, each changed by `change`; `later` nanoseconds are added to all times.
    fn play(&mut self, range: std::ops::Range<usize>, later: i64, change: impl Fn(usize, &Frame) -> Option<Frame>) {
        for set in &self.sets[range] {
            let frames = set
                .frames
                .iter()
                .enumerate()
                .map(|(slot, frame)| {
                    let mut frame = change(slot, frame.as_ref()?)?;
                    frame.capture_nanos += later;
                    Some(Arc::new(frame))
                })
                .collect();
            let set = FrameSet { index: set.index, master_nanos: set.master_nanos + later, frames };
            assert!(matches!(self.session.process(&set).unwrap(), Outcome::Updated | Outcome::Held(_)));
            let splats = self.session.splats(PersonId::default()).unwrap();
            assert!(
                splats.iter().all(|s| s.position.iter().chain(&s.color).all(|v| v.is_finite())),
                "no number that is not finite leaves"
            );
        }
    }

    fn watch(&self) -> &TrackWatch {
        self.session.subject(PersonId::default()).map(Subject::watch).unwrap()
    }

    fn quality(&self) -> f64 {
        self.watch().quality().unwrap_or(0.0)
    }
}

fn as_is(_: usize, frame: &Frame) -> Option<Frame> {
    with_mask(frame, frame.mask.clone().unwrap())
}

fn with_mask(frame: &Frame, mask: Mask) -> Option<Frame> {
    Some(Frame {
        camera: frame.camera.clone(),
        sequence: frame.sequence,
        capture_nanos: frame.capture_nanos,
        exposure_nanos: None,
        image: Image::new(SIDE, SIDE, frame.image.format(), frame.image.bytes().to_vec()).unwrap(),
        mask: Some(mask),
    })
}

fn filled(value: u8) -> Mask {
    Mask::new(SIDE, SIDE, vec![value; (SIDE * SIDE) as usize]).unwrap()
}

#[test]
fn the_tracking_degrades_and_comes_back_by_itself() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let config = SequenceConfig { motion: SequenceMotion::Turn, seed: 2, side: SIDE, frames: 34, fps: 30.0 };
    let sequence = SimulatedSequence::simulate_inputs(&gpu, config, 3).unwrap();
    let mut calm = Stage::new(&gpu, &sequence);
    calm.play(0..34, 0, as_is);
    let goal = calm.quality();
    assert_eq!(calm.watch().state(), TrackState::Steady);
    println!("undisturbed: quality {goal:.3}");
    assert!(goal > 0.8);

    type Change = fn(usize, &Frame) -> Option<Frame>;
    let black: Change = |slot, frame| {
        if slot != 1 {
            return as_is(slot, frame);
        }
        let mut covered = with_mask(frame, filled(0))?;
        covered.image = Image::new(SIDE, SIDE, PixelFormat::Rgb8, vec![0; (3 * SIDE * SIDE) as usize]).unwrap();
        Some(covered)
    };
    // A mask that takes the hand on the lens for the person.
    let hand: Change = |slot, frame| if slot == 1 { with_mask(frame, filled(255)) } else { as_is(slot, frame) };
    let lost: Change = |slot, frame| if slot == 2 { None } else { as_is(slot, frame) };
    let nobody: Change = |_, frame| with_mask(frame, filled(0));
    let one_left: Change = |slot, frame| if slot == 0 { as_is(slot, frame) } else { None };
    for (name, change, during) in [
        ("camera covered, empty mask", black, TrackState::Steady),
        ("camera covered, full mask", hand, TrackState::Steady),
        ("camera lost", lost, TrackState::Steady),
        ("one camera left", one_left, TrackState::Steady),
        ("nobody", nobody, TrackState::Lost),
    ] {
        let mut stage = Stage::new(&gpu, &sequence);
        stage.play(0..14, 0, as_is);
        stage.play(14..19, 0, change);
        let watch = stage.watch();
        println!("{name}: {:?}, quality {:?}, cameras {:?}", watch.state(), watch.quality(), watch.cameras());
        assert_eq!(watch.state(), during, "{name}");
        if name.starts_with("camera covered, full") {
            let covered = watch.cameras().get(&sequence.inputs(3).cameras[1].id);
            assert!(covered.is_some_and(|q| *q < 0.25), "{name}: {covered:?}");
            assert!(stage.quality() > goal - 0.1, "{name}: the others are followed on");
        }
        stage.play(19..34, 0, as_is);
        println!("{name}: after it {:?}, quality {:.3}", stage.watch().state(), stage.quality());
        assert_eq!(stage.watch().state(), TrackState::Steady, "{name}");
        assert!(stage.quality() > goal - 0.03, "{name}");
    }

    // Away for five seconds: another person may return, so all is forgotten.
    let mut stage = Stage::new(&gpu, &sequence);
    stage.play(0..14, 0, as_is);
    stage.play(14..16, 0, nobody);
    assert_eq!(stage.watch().state(), TrackState::Lost);
    let round = sequence.track.span_nanos().1 - sequence.track.span_nanos().0;
    stage.play(16..17, 3 * round, as_is);
    assert_eq!(stage.watch().state(), TrackState::First);
    stage.play(17..34, 3 * round, as_is);
    assert!(stage.watch().state() == TrackState::Steady && stage.quality() > goal - 0.03);

    // The pose leaps: a quarter of a second of the turn at once.
    let mut stage = Stage::new(&gpu, &sequence);
    stage.play(0..10, 0, as_is);
    stage.play(18..34, 0, as_is);
    println!("after a leap: {:?}, quality {:.3}", stage.watch().state(), stage.quality());
    assert!(stage.watch().state() == TrackState::Steady && stage.quality() > goal - 0.03);
    assert!(8 * PERIOD_NANOS < round);
}
