//! Losing the graphics device costs a moment, but not the person's memory.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use std::{collections::BTreeMap, time::Duration};

use flyrig_capture::Pacing;
use flyrig_fusion::{InputFormat, Intake, LiveRig, LiveViews, Outcome, OutputSettings, Session, resident_mib};
use flyrig_gpu::testing::device;
use flyrig_sync::SyncSettings;
use flyrig_types::{FrameSet, PersonId};

use support::{frame_set, images, played, session};

const RED: [u8; 3] = [220, 40, 30];
const ME: PersonId = PersonId(0);

fn colors(session: &Session) -> Vec<[f32; 3]> {
    session.splats(ME).unwrap().iter().map(|splat| splat.color).collect()
}

#[test]
fn a_session_resumes_on_another_device_with_shape_and_colours() {
    let images = images(&[(0.0, RED)]);
    let mut session = session(device(), &[(0, 0.0)]);
    for index in 0..4 {
        assert_eq!(session.process(&frame_set(index, &images)).unwrap(), Outcome::Updated);
    }
    let (memory, before) = (session.memory(ME).unwrap(), colors(&session));
    let red = before.iter().filter(|c| c[0] > 4.0 * c[2]).count();
    assert!(red > before.len() / 2, "{red} of {} Gaussians were painted", before.len());

    session.gpu().simulate_loss();
    let fault = session.process(&frame_set(4, &images)).unwrap_err();
    assert!(fault.is_device_fault(), "{fault}");
    assert!(session.render(&support::camera("a", 20.0)).unwrap_err().is_device_fault());

    let reopened = session.gpu().reopen().unwrap();
    session.rebuild(&reopened, &BTreeMap::from([(ME, memory.clone())])).unwrap();
    assert_eq!(colors(&session), before, "the colours are those of the snapshot");
    assert_eq!(session.memory(ME).unwrap(), memory);
    assert_eq!(session.process(&frame_set(5, &images)).unwrap(), Outcome::Updated);
    let after = colors(&session);
    let kept = before.iter().zip(&after).filter(|(a, b)| (a[0] - b[0]).abs() < 0.1).count();
    assert!(kept > before.len() * 9 / 10, "{kept} of {} Gaussians kept their colour", before.len());
}

#[test]
fn a_session_without_a_snapshot_starts_afresh_on_another_device() {
    let images = images(&[(0.0, RED)]);
    let mut session = session(device(), &[(0, 0.0)]);
    session.process(&frame_set(0, &images)).unwrap();
    session.gpu().simulate_loss();
    assert!(session.process(&frame_set(1, &images)).is_err());
    let reopened = session.gpu().reopen().unwrap();
    session.rebuild(&reopened, &BTreeMap::new()).unwrap();
    assert_eq!(session.process(&frame_set(2, &images)).unwrap(), Outcome::Updated);
    assert!(colors(&session).iter().filter(|c| c[0] > 4.0 * c[2]).count() > 1000);
}

#[test]
fn a_live_rig_goes_on_by_itself_after_the_loss_of_its_device() {
    let images = images(&[(0.0, RED)]);
    let sets: Vec<FrameSet> = (0..8).map(|index| frame_set(index, &images)).collect();
    let intake = Intake::start(played(&sets), InputFormat::Rgb, &SyncSettings::default(), Pacing::Lossless).unwrap();
    let session = session(device(), &[(0, 0.0)]);
    let mut rig = LiveRig::new(session, intake, LiveViews::new(&OutputSettings::default()), None);
    let mut outcomes = Vec::new();
    while !rig.ended() {
        if let Some(step) = rig.step(Duration::from_secs(5), None).unwrap() {
            outcomes.push(step.outcome);
            if outcomes.len() == 4 {
                rig.session.gpu().simulate_loss();
            }
        }
    }
    let held: Vec<usize> = (0..outcomes.len()).filter(|&i| outcomes[i] != Outcome::Updated).collect();
    assert_eq!((outcomes.len(), held), (8, vec![4]), "one set is lost: {outcomes:?}");
    assert_eq!((rig.rebuilt(), rig.health().device_faults), (1, 1));
    assert!(colors(&rig.session).iter().filter(|c| c[0] > 4.0 * c[2]).count() > 1000);
}

#[test]
fn a_live_rig_goes_on_by_itself_after_a_rejected_command() {
    let images = images(&[(0.0, RED)]);
    let sets: Vec<FrameSet> = (0..6).map(|index| frame_set(index, &images)).collect();
    let intake = Intake::start(played(&sets), InputFormat::Rgb, &SyncSettings::default(), Pacing::Lossless).unwrap();
    let mut rig =
        LiveRig::new(session(device(), &[(0, 0.0)]), intake, LiveViews::new(&OutputSettings::default()), None);
    let mut held = 0;
    while !rig.ended() {
        if let Some(step) = rig.step(Duration::from_secs(5), None).unwrap() {
            held += usize::from(step.outcome != Outcome::Updated);
            if step.set.index == 2 {
                // Buffers of this usage cannot be mapped.
                let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::STORAGE;
                let wrong = wgpu::BufferDescriptor { label: None, size: 16, usage, mapped_at_creation: false };
                let _ = rig.session.gpu().device.create_buffer(&wrong);
            }
        }
    }
    assert_eq!((held, rig.frames(), rig.rebuilt()), (1, 6, 1), "one set is lost");
    assert!(colors(&rig.session).iter().filter(|c| c[0] > 4.0 * c[2]).count() > 1000);
}

#[test]
#[ignore = "a minute or more: make test-long"]
fn a_hundred_losses_leave_the_memory_flat() {
    let images = images(&[(0.0, RED)]);
    let mut session = session(device(), &[(0, 0.0)]);
    let (mut memory, mut seconds) = (Vec::new(), Vec::new());
    for loss in 0..100 {
        session.process(&frame_set(2 * loss, &images)).unwrap();
        let learnt = BTreeMap::from([(ME, session.memory(ME).unwrap())]);
        session.gpu().simulate_loss();
        assert!(session.process(&frame_set(2 * loss + 1, &images)).unwrap_err().is_device_fault());
        let start = std::time::Instant::now();
        let reopened = session.gpu().reopen().unwrap();
        session.rebuild(&reopened, &learnt).unwrap();
        session.process(&frame_set(2 * loss + 1, &images)).unwrap();
        seconds.push(start.elapsed().as_secs_f64());
        memory.extend(resident_mib());
    }
    seconds.sort_by(f64::total_cmp);
    println!("to the next set after a loss: median {:.2} s, longest {:.2} s", seconds[50], seconds[99]);
    println!("MiB after losses 1, 10, 20, ... 100: {:?}", memory.iter().step_by(10).collect::<Vec<_>>());
    let (early, late) = (memory[19], memory[99]);
    assert!(late < early * 1.1 + 20.0, "{early:.0} MiB after 20 losses, {late:.0} MiB after 100");
}
