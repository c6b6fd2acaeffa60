//! Properties of the synchroniser under random drops, jitter, reordering and duplicate frames.

use std::collections::HashMap;

use flyrig_types::{CameraId, Frame, FrameSet, Image, PixelFormat};

use crate::settings::SyncSettings;
use crate::sync::{DropCounts, Synchronizer};
use flyrig_model::SplitMix64;

const PERIOD: i64 = 33_333_333;

/// Simulates a rig's frames in the order of arrival: `(camera, time, serial number)`.
fn arrivals(random: &mut SplitMix64, cameras: usize) -> Vec<(usize, i64, u64)> {
    let (drop, twice, jitter) = (random.below(40), random.below(10), 1 + random.below(15_000_000));
    let late = random.below(4) * 40_000_000;
    let mut frames = Vec::new();
    for camera in 0..cameras {
        let phase = random.below(PERIOD as u64) as i64;
        let gone = random.below(100)..random.below(200);
        for tick in 0..100u64 {
            if random.chance(drop) || gone.contains(&tick) {
                continue;
            }
            let nanos = tick as i64 * PERIOD + phase + random.below(jitter) as i64;
            for _ in 0..=u64::from(random.chance(twice)) {
                let arrival = nanos + random.below(late + 1) as i64;
                frames.push((arrival, camera, nanos));
            }
        }
    }
    frames.sort_unstable();
    frames.into_iter().zip(0..).map(|((_, camera, nanos), serial)| (camera, nanos, serial)).collect()
}

fn run(ids: &[CameraId], config: &SyncSettings, arrivals: &[(usize, i64, u64)]) -> (Vec<FrameSet>, Synchronizer) {
    let mut sync = Synchronizer::new(ids, config);
    let mut sets = Vec::new();
    for &(camera, capture_nanos, sequence) in arrivals {
        sets.extend(sync.push(Frame {
            camera: ids[camera].clone(),
            sequence,
            capture_nanos,
            exposure_nanos: None,
            image: Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap(),
            mask: None,
        }));
    }
    sets.extend(sync.flush());
    (sets, sync)
}

#[test]
fn random_rigs_keep_every_promise() {
    let mut complete = 0;
    for seed in 0..300 {
        let mut random = SplitMix64(seed);
        let ids: Vec<CameraId> = (0..1 + random.below(6)).map(|i| format!("cam{i}").into()).collect();
        let config = SyncSettings {
            master: random.chance(50).then(|| ids[random.below(ids.len() as u64) as usize].clone()),
            window_nanos: Some(random.below(40_000_000)),
            max_wait_nanos: random.chance(70).then(|| random.below(200_000_000)),
            ..SyncSettings::default()
        };
        let arrivals = arrivals(&mut random, ids.len());
        let (sets, sync) = run(&ids, &config, &arrivals);

        let mut seen: HashMap<u64, u64> = HashMap::new();
        for (index, set) in sets.iter().enumerate() {
            assert_eq!(set.index, index as u64);
            assert_eq!(set.frames.len(), ids.len());
            assert!(index == 0 || sets[index - 1].master_nanos < set.master_nanos, "seed {seed}: time must grow");
            assert!(set.present().any(|(_, frame)| frame.capture_nanos == set.master_nanos), "seed {seed}: no master");
            for (slot, frame) in set.present() {
                assert_eq!(frame.camera, ids[slot]);
                let distance = frame.capture_nanos.abs_diff(set.master_nanos);
                let most = config.window_nanos.map(|window| window + window / 2).unwrap();
                assert!(distance <= most, "seed {seed}: {distance} ns off");
                assert_eq!(seen.insert(frame.sequence, set.index), None, "seed {seed}: a frame in two sets");
            }
        }
        for slot in 0..ids.len() {
            let times: Vec<i64> =
                sets.iter().filter_map(|set| set.frames[slot].as_ref().map(|frame| frame.capture_nanos)).collect();
            assert!(times.windows(2).all(|pair| pair[0] < pair[1]), "seed {seed}: camera {slot} runs backwards");
        }
        let counts = sync.counts();
        let dropped: u64 = counts.dropped_frames.iter().map(DropCounts::total).sum();
        assert_eq!(seen.len() as u64 + dropped, arrivals.len() as u64, "seed {seed}: a frame is unaccounted for");
        assert_eq!(counts.complete + counts.partial, sets.len() as u64);
        complete += counts.complete;

        let (again, _) = run(&ids, &config, &arrivals);
        let summary = |sets: &[FrameSet]| -> Vec<(i64, Vec<Option<u64>>)> {
            let slots = |set: &FrameSet| set.frames.iter().map(|f| f.as_ref().map(|f| f.sequence)).collect();
            sets.iter().map(|set| (set.master_nanos, slots(set))).collect()
        };
        assert_eq!(summary(&sets), summary(&again), "seed {seed}: not deterministic");
    }
    assert!(complete > 1000, "the random rigs are too broken to test anything: {complete} complete sets");
}

/// Compares with a brute-force search: without loss, lateness or silence every frame set holds the nearest frames.
#[test]
fn a_sound_rig_gets_the_nearest_frame_of_every_camera() {
    for seed in 0..50 {
        let mut random = SplitMix64(1000 + seed);
        let ids: Vec<CameraId> = (0..4).map(|i| format!("cam{i}").into()).collect();
        let mut frames = Vec::new();
        for camera in 0..ids.len() {
            // Within a quarter period of the master, so that the nearest frame is nobody else's.
            let phase = random.below(PERIOD as u64 / 4) as i64;
            for tick in 0..60 {
                let nanos = tick * PERIOD + phase + random.below(1_000_000) as i64;
                frames.push((nanos, camera));
            }
        }
        frames.sort_unstable();
        let arrivals: Vec<(usize, i64, u64)> =
            frames.into_iter().zip(0..).map(|((nanos, camera), serial)| (camera, nanos, serial)).collect();
        let config = SyncSettings {
            window_nanos: Some(PERIOD as u64 / 2),
            max_wait_nanos: Some(4 * PERIOD as u64),
            ..SyncSettings::default()
        };
        let (sets, sync) = run(&ids, &config, &arrivals);
        assert_eq!((sync.counts().complete, sync.counts().partial), (60, 0), "seed {seed}");
        for set in &sets {
            for (slot, frame) in set.present() {
                let nearest = arrivals
                    .iter()
                    .filter(|(camera, ..)| *camera == slot)
                    .min_by_key(|(_, nanos, _)| nanos.abs_diff(set.master_nanos))
                    .unwrap();
                assert_eq!(frame.capture_nanos, nearest.1, "seed {seed}");
            }
        }
    }
}
