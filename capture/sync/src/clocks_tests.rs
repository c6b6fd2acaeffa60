//! Properties of the aligner on simulated clocks, and of frame sets formed in corrected time.

use flyrig_types::{CameraId, Frame, FrameSet, Image, PixelFormat};

use crate::clocks::ClockAligner;
use crate::settings::SyncSettings;
use crate::sync::Synchronizer;
use flyrig_model::SplitMix64;

const PERIOD: i64 = 33_333_333;
const SECOND: i64 = 1_000_000_000;
const HOUR_FRAMES: i64 = 3600 * 30;

/// Arriving frame: camera, tick, timestamp of the camera's clock.
type Arrival = (usize, i64, i64);

/// Simulates cameras that are triggered together; `stamp` maps a true time to the camera's timestamp, `None` loses the
/// frame.
fn arrivals(
    random: &mut SplitMix64,
    cameras: usize,
    ticks: i64,
    mut stamp: impl FnMut(&mut SplitMix64, usize, i64, i64) -> Option<i64>,
) -> Vec<Arrival> {
    let mut frames = Vec::new();
    for tick in 0..ticks {
        let truth = tick * PERIOD;
        for camera in 0..cameras {
            if let Some(stamp) = stamp(random, camera, tick, truth) {
                let arrival = truth + 8_000_000 + random.jitter(5_000_000);
                frames.push((arrival, camera, tick, stamp));
            }
        }
        // A few periods at a time are enough to sort.
        if tick % 1000 == 999 {
            let from = frames.len().saturating_sub(1100 * cameras);
            frames[from..].sort_unstable();
        }
    }
    frames.sort_unstable();
    frames.into_iter().map(|(_, camera, tick, stamp)| (camera, tick, stamp)).collect()
}

fn ids(cameras: usize) -> Vec<CameraId> {
    (0..cameras).map(|i| format!("cam{i}").into()).collect()
}

fn frame(id: &CameraId, sequence: u64, capture_nanos: i64) -> Frame {
    let image = Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap();
    Frame { camera: id.clone(), sequence, capture_nanos, exposure_nanos: None, image, mask: None }
}

struct Run {
    aligner: ClockAligner,
    sync: Synchronizer,
    sets: Vec<FrameSet>,
    /// Camera, tick, corrected time.
    times: Vec<Arrival>,
}

/// Runs the aligner on frames whose sequence number is their tick.
fn run(cameras: usize, arrivals: &[Arrival]) -> Run {
    run_waiting(cameras, arrivals, None)
}

fn run_waiting(cameras: usize, arrivals: &[Arrival], max_wait_nanos: Option<u64>) -> Run {
    let ids = ids(cameras);
    let mut aligner = ClockAligner::new(&ids, None);
    let mut sync = Synchronizer::new(
        &ids,
        &SyncSettings { window_nanos: Some(8_000_000), max_wait_nanos, ..SyncSettings::default() },
    );
    let (mut sets, mut times) = (Vec::new(), Vec::new());
    for &(camera, tick, stamp) in arrivals {
        let aligned = aligner.align(frame(&ids[camera], tick as u64, stamp));
        times.push((camera, tick, aligned.capture_nanos));
        sets.extend(sync.push(aligned));
    }
    sets.extend(sync.flush());
    Run { aligner, sync, sets, times }
}

/// Returns the largest deviation of a corrected time from the master's own reading of that instant, from a tick on.
fn worst(run: &Run, from: i64, master: impl Fn(i64) -> i64) -> i64 {
    let late = run.times.iter().filter(|(_, tick, _)| *tick >= from);
    late.map(|(_, tick, time)| (time - master(*tick)).abs()).max().unwrap()
}

#[test]
fn an_hour_of_drift_with_lost_frames_leaves_less_than_a_millisecond() {
    let ppm = [0, 100, -100, 60];
    let start = [0, 4_000_000, -9_000_000, 12_000_000];
    let mut random = SplitMix64(1);
    let frames = arrivals(&mut random, 4, HOUR_FRAMES, |random, camera, _, truth| {
        let lost = random.chance(2);
        let drifted = truth + truth / 1_000_000 * ppm[camera] + start[camera];
        (!lost).then(|| drifted + random.jitter(200_000))
    });
    let run = run(4, &frames);
    let worst = worst(&run, 60, |tick| tick * PERIOD);
    assert!(worst <= 1_000_000, "{worst} ns after an hour of ±100 ppm");
    println!("an hour of ±100 ppm, 2 % lost, ±0.2 ms jitter: worst residual {:.3} ms", worst as f64 * 1e-6);
    for ((id, clock), ppm) in run.aligner.clocks().zip(ppm) {
        assert!((clock.drift_ppm + ppm as f64).abs() < 15.0, "{id}: {clock:?} for {ppm}");
        assert_eq!((clock.steps, clock.replaced), (0, 0), "{id}");
    }
    // Without the correction 360 ms of drift would have torn every set.
    let wrong = run.sets.iter().flat_map(|set| set.present().map(move |(_, f)| (set, f.sequence)));
    let master = |set: &FrameSet| (set.master_nanos as f64 / PERIOD as f64).round() as u64;
    assert_eq!(wrong.filter(|(set, tick)| master(set) != *tick).count(), 0, "a frame in the set of another instant");
}

#[test]
fn clocks_with_nothing_in_common_are_matched_by_arrival() {
    let start = [5_000 * SECOND, -7_777_777_777_777, 123, i64::MAX / 2];
    let mut random = SplitMix64(2);
    let frames =
        arrivals(&mut random, 4, 3000, |random, camera, _, truth| Some(truth + start[camera] + random.jitter(100_000)));
    let run = run(4, &frames);
    for &(camera, tick, time) in run.times.iter().filter(|(_, tick, _)| *tick > 60) {
        let off = time - (tick * PERIOD + start[0]);
        let beat = off.rem_euclid(PERIOD).min((-off).rem_euclid(PERIOD));
        assert!(beat < 1_000_000 && off.abs() <= PERIOD + 1_000_000, "camera {camera} tick {tick}: {off} ns");
    }
}

#[test]
fn a_step_of_any_clock_costs_no_set() {
    for (stepped, step) in [(1, 10 * SECOND), (1, -10 * SECOND), (2, 190_000_000), (0, 10 * SECOND), (0, -10 * SECOND)]
    {
        let mut random = SplitMix64(3);
        let frames = arrivals(&mut random, 3, 1500, |random, camera, tick, truth| {
            let stepped = if camera == stepped && tick >= 700 { step } else { 0 };
            Some(truth + stepped + random.jitter(100_000))
        });
        let run = run(3, &frames);
        let worst = worst(&run, 60, |tick| tick * PERIOD);
        assert!(worst <= 1_000_000, "camera {stepped} stepped by {step}: {worst} ns off");
        assert_eq!(run.sync.counts().partial, 0, "camera {stepped} stepped by {step}");
        let state = run.aligner.clocks().nth(stepped).unwrap().1;
        assert_eq!((state.steps, state.replaced), (1, 3), "camera {stepped} stepped by {step}");
    }
}

#[test]
fn stamps_that_jump_or_wrap_for_a_moment_are_replaced() {
    for wild in [i64::MIN, i64::MAX, 0, -1, 3 * PERIOD / 2] {
        let mut random = SplitMix64(4);
        let frames = arrivals(&mut random, 3, 900, |random, camera, tick, truth| {
            let jump = camera == 1 && tick % 100 == 99;
            Some(if jump { wild } else { truth + random.jitter(100_000) })
        });
        let run = run(3, &frames);
        // One of them may hit the truth by chance: stamp 0 of tick 0 does.
        assert!(worst(&run, 60, |tick| tick * PERIOD) <= 1_000_000, "stamp {wild}");
        assert_eq!(run.sync.counts().partial, 0, "stamp {wild}");
    }
}

#[test]
fn the_others_go_on_while_the_master_is_away() {
    for cameras in 2..=4 {
        let mut random = SplitMix64(9);
        // The master is away for half a minute.
        let frames = arrivals(&mut random, cameras, 1800, |random, camera, tick, truth| {
            let away = camera == 0 && (300..1200).contains(&tick);
            (!away).then(|| truth + 3_000_000 * camera as i64 + random.jitter(100_000))
        });
        let run = run(cameras, &frames);
        let worst = worst(&run, 60, |tick| tick * PERIOD);
        assert!(worst <= 1_000_000, "{cameras} cameras: {worst} ns off");
        for (id, state) in run.aligner.clocks() {
            assert_eq!((state.steps, state.replaced), (0, 0), "{cameras} cameras: {id}");
        }
    }
}

#[test]
fn a_clock_that_wraps_goes_on() {
    let mut random = SplitMix64(5);
    let frames = arrivals(&mut random, 2, 1500, |random, camera, _, truth| {
        let base = if camera == 1 { i64::MAX - 800 * PERIOD } else { 0 };
        Some(base.wrapping_add(truth + random.jitter(100_000)))
    });
    let run = run(2, &frames);
    for &(_, tick, time) in run.times.iter().filter(|(_, tick, _)| *tick > 60) {
        let off = (time - tick * PERIOD).abs();
        assert!(off <= PERIOD + 1_000_000, "tick {tick}: {off} ns");
    }
    let beat = |time: i64| time.rem_euclid(PERIOD).min((-time).rem_euclid(PERIOD));
    assert!(run.times.iter().filter(|(_, tick, _)| *tick > 60).all(|(_, _, time)| beat(*time) < 1_000_000));
}

#[test]
fn ten_percent_loss_is_counted_frame_by_frame() {
    let mut random = SplitMix64(6);
    let mut lost = [0u64; 4];
    let mut lost_instants = 0;
    let mut dropped = [false; 4];
    let frames = arrivals(&mut random, 4, 3000, |random, camera, tick, truth| {
        if camera == 0 {
            dropped = [0, 1, 2, 3].map(|_| tick > 60 && random.chance(10));
            // The master's loss makes another camera's frame the set's clock only when it goes silent: no set then.
            lost_instants += u64::from(dropped[0]);
        }
        if dropped[camera] {
            lost[camera] += u64::from(!dropped[0] || camera == 0);
            return None;
        }
        Some(truth + truth / 1_000_000 * [0, 80, -80, 40][camera] + random.jitter(100_000))
    });
    // Longer than any camera loses frames in a row: one that is given up for silent may miss a set more.
    let run = run_waiting(4, &frames, Some(300_000_000));
    let missing: Vec<u64> =
        (1..4).map(|slot| run.sets.iter().filter(|set| set.frames[slot].is_none()).count() as u64).collect();
    assert_eq!(missing, lost[1..], "sets without a camera are the frames that it lost");
    assert_eq!(run.sets.len() as u64, 3000 - lost_instants);
}

#[test]
fn a_camera_that_halves_its_rate_stays_in_every_second_set() {
    for halved in [0, 1] {
        let mut random = SplitMix64(7);
        let mut numbers = [0u64; 3];
        let ids = ids(3);
        let mut aligner = ClockAligner::new(&ids, None);
        let mut worst = 0;
        let frames = arrivals(&mut random, 3, 2000, |random, camera, tick, truth| {
            let skipped = camera == halved && tick >= 800 && tick % 2 == 1;
            (!skipped).then(|| truth + truth / 1_000_000 * [0, 90, -90][camera] + random.jitter(100_000))
        });
        for (camera, tick, stamp) in frames {
            // Its numbers go on by one: the camera does not know what it leaves out.
            let aligned = aligner.align(frame(&ids[camera], numbers[camera], stamp));
            numbers[camera] += 1;
            if tick > 60 {
                worst = worst.max((aligned.capture_nanos - tick * PERIOD).abs());
            }
        }
        assert!(worst <= 1_000_000, "camera {halved}: {worst} ns");
        assert!(aligner.clocks().all(|(_, clock)| clock.steps == 0), "camera {halved}");
    }
}

#[test]
fn what_makes_no_sense_does_no_harm() {
    let ids = ids(2);
    let mut aligner = ClockAligner::new(&ids, Some(&"nobody".into()));
    let mut random = SplitMix64(8);
    for n in 0..20_000u64 {
        let nanos = match n % 7 {
            0 => i64::MAX,
            1 => i64::MIN,
            2 => 0,
            _ => random.next_u64() as i64,
        };
        let sequence = if n % 3 == 0 { u64::MAX } else { random.next_u64() };
        let _ = aligner.align(frame(&ids[(n % 2) as usize], sequence, nanos));
    }
    assert!(aligner.clocks().all(|(_, clock)| clock.drift_ppm.is_finite() && clock.residual_nanos.is_finite()));
    let stranger = aligner.align(frame(&"stranger".into(), 0, 7));
    assert_eq!(stranger.capture_nanos, 7);
    let _ = ClockAligner::new(&[], None).align(frame(&"x".into(), 0, 0));
}
