//! Behaviour of the synchroniser, case by case.

use flyrig_types::{Image, PixelFormat};

use super::*;

const MS: i64 = 1_000_000;

pub(crate) fn frame(camera: &str, capture_nanos: i64) -> Frame {
    Frame {
        camera: camera.into(),
        sequence: 0,
        capture_nanos,
        exposure_nanos: None,
        image: Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap(),
        mask: None,
    }
}

fn synchronizer(window_ms: u64, max_wait_ms: u64) -> Synchronizer {
    let config = SyncSettings {
        window_nanos: Some(window_ms * 1_000_000),
        max_wait_nanos: Some(max_wait_ms * 1_000_000),
        ..SyncSettings::default()
    };
    Synchronizer::new(&["a".into(), "b".into(), "c".into()], &config)
}

#[test]
fn a_single_wrong_stamp_costs_its_own_frame_and_no_other() {
    let mut sync = synchronizer(8, 100);
    let mut sets = Vec::new();
    for i in 0..30 {
        for camera in ["a", "b", "c"] {
            let wild = camera == "b" && i == 10;
            sets.extend(sync.push(frame(camera, (i * 33 + if wild { 800 } else { 0 }) * MS)));
        }
    }
    sets.extend(sync.flush());
    let expected: Vec<Vec<Option<i64>>> =
        (0..30).map(|i| vec![Some(i * 33), (i != 10).then_some(i * 33), Some(i * 33)]).collect();
    assert_eq!(sets.iter().map(times).collect::<Vec<_>>(), expected);
    let dropped: Vec<u64> = sync.counts().dropped_frames.iter().map(DropCounts::total).collect();
    assert_eq!((dropped, sync.counts().dropped_frames[1].wild), (vec![0, 1, 0], 1));
}

#[test]
fn a_pause_of_all_cameras_costs_nothing() {
    let mut sync = synchronizer(8, 100);
    let mut sets = Vec::new();
    for i in (0..5).chain(100..105) {
        for camera in ["a", "b", "c"] {
            sets.extend(sync.push(frame(camera, i * 33 * MS)));
        }
    }
    sets.extend(sync.flush());
    assert_eq!((sets.len(), sync.counts().complete), (10, 10));
    // One camera alone goes on too.
    for i in 200..210 {
        sets.extend(sync.push(frame("c", i * 33 * MS)));
    }
    sets.extend(sync.flush());
    assert_eq!(sets.len(), 20);
}

#[test]
fn cameras_slower_than_the_wait_still_make_complete_sets() {
    let mut sync = synchronizer(8, 100);
    let mut sets = Vec::new();
    for i in 0..20 {
        // Whichever comes first.
        for camera in ["abc", "bca", "cab"][i as usize % 3].split_terminator("").skip(1) {
            // Uneven, too.
            sets.extend(sync.push(frame(camera, (i * 133 + i * i * 20) * MS)));
        }
    }
    sets.extend(sync.flush());
    assert_eq!((sets.len(), sync.counts().complete), (20, 20));
}

#[test]
fn a_camera_slower_than_the_wait_is_no_wild_one() {
    let mut sync =
        Synchronizer::new(&["a".into()], &SyncSettings { max_wait_nanos: Some(0), ..SyncSettings::default() });
    let mut sets = Vec::new();
    for i in 0..10 {
        sets.extend(sync.push(frame("a", i * 5000 * MS)));
        // From the second interval on without delay.
        assert!(i < 2 || sets.len() as i64 == i + 1, "{} sets after frame {i}", sets.len());
    }
    assert_eq!(sync.counts().dropped_frames[0], DropCounts::default());
}

/// Returns the times of a frame set's frames, milliseconds.
fn times(set: &FrameSet) -> Vec<Option<i64>> {
    set.frames.iter().map(|frame| frame.as_ref().map(|frame| frame.capture_nanos / MS)).collect()
}

fn push_all(sync: &mut Synchronizer, frames: &[(&str, i64)]) -> Vec<FrameSet> {
    frames.iter().flat_map(|(camera, ms)| sync.push(frame(camera, ms * MS))).collect()
}

#[test]
fn a_synchronous_rig_gives_a_set_with_its_last_frame() {
    let mut sync = synchronizer(16, 100);
    assert!(push_all(&mut sync, &[("c", 0), ("a", 0)]).is_empty());
    let sets = push_all(&mut sync, &[("b", 0)]);
    assert_eq!(sets.len(), 1);
    assert_eq!((sets[0].index, sets[0].master_nanos, times(&sets[0])), (0, 0, vec![Some(0); 3]));
    assert_eq!(sync.counts().complete, 1);
}

#[test]
fn the_nearest_frames_are_taken_and_keep_their_own_time() {
    let mut sync = synchronizer(16, 100);
    // b runs 5 ms behind, c 6 ms ahead of a.
    let sets = push_all(&mut sync, &[("c", -6), ("a", 0), ("b", 5), ("c", 27), ("a", 33), ("b", 38), ("c", 60)]);
    assert_eq!(
        sets.iter().map(times).collect::<Vec<_>>(),
        [vec![Some(0), Some(5), Some(-6)], vec![Some(33), Some(38), Some(27)]]
    );
    assert_eq!(sets[1].master_nanos, 33 * MS);
}

const PERIOD: i64 = 33_333_333;

/// Simulates free-running cameras, `offsets` from the master, each timestamp off by up to `jitter`; `keep` selects
/// frames.
fn free_running(
    period: i64,
    ticks: i64,
    offsets: [i64; 3],
    ppm: [i64; 3],
    jitter: u64,
    keep: impl Fn(usize, i64) -> bool,
) -> (Vec<FrameSet>, SyncCounts) {
    let mut random = flyrig_model::SplitMix64(9);
    let mut frames = Vec::new();
    for tick in 0..ticks {
        for (slot, name) in ["a", "b", "c"].into_iter().enumerate().filter(|&(slot, _)| keep(slot, tick)) {
            let time = tick * period + offsets[slot];
            let off = random.below(2 * jitter + 1) as i64 - jitter as i64;
            frames.push((time + time / 1_000_000 * ppm[slot] + off, name));
        }
    }
    frames.sort_unstable();
    let mut sync = Synchronizer::new(&["a".into(), "b".into(), "c".into()], &SyncSettings::default());
    let mut sets: Vec<FrameSet> = frames.iter().flat_map(|(time, name)| sync.push(frame(name, *time))).collect();
    sets.extend(sync.flush());
    (sets, sync.counts().clone())
}

#[test]
fn cameras_half_a_period_beside_the_master_stay_in_its_sets() {
    let half = 16_666_667;
    let (_, counts) = free_running(PERIOD, 900, [0, half, -half], [0; 3], 3_000_000, |_, _| true);
    assert!(counts.complete >= 890, "{counts:?}");
    // Clocks that drift carry a camera across a whole period in less than three minutes.
    let (_, counts) = free_running(PERIOD, 18_000, [0, 0, half], [0, 200, -150], 1_000_000, |_, _| true);
    assert!(counts.complete >= 17_950, "{counts:?}");
}

#[test]
fn the_window_follows_the_masters_period() {
    // Ten a second, and a hundred and twenty of which the master loses every seventh.
    for (period, loss) in [(100_000_000, i64::MAX), (8_333_333, 7)] {
        let keep = |slot: usize, tick: i64| slot != 0 || tick % loss != 5;
        let offsets = [0, period * 45 / 100, -period * 4 / 10];
        let (sets, counts) = free_running(period, 300, offsets, [0; 3], 500_000, keep);
        assert!(counts.complete >= 250, "period {period}: {counts:?}");
        for set in &sets {
            let far = |(_, frame): (usize, &Arc<Frame>)| frame.capture_nanos.abs_diff(set.master_nanos);
            let most = set.present().map(far).max().unwrap();
            assert!(most < period as u64 * 7 / 10 || set.index < 5, "period {period}: {most} ns beside the master");
        }
    }
}

#[test]
fn beside_a_slow_master_a_lost_frame_stays_lost() {
    let mut sync = Synchronizer::new(&["a".into(), "b".into()], &SyncSettings::default());
    let mut sets = Vec::new();
    for tick in 0..400 {
        let time = tick * PERIOD;
        // Every fourth frame of b is lost, which is every second one that the master asks for.
        if tick % 4 != 0 {
            sets.extend(sync.push(frame("b", time + 2 * MS)));
        }
        if tick % 2 == 0 {
            sets.extend(sync.push(frame("a", time)));
        }
    }
    sets.extend(sync.flush());
    let far =
        |set: &FrameSet| set.present().any(|(_, frame)| frame.capture_nanos.abs_diff(set.master_nanos) > 3_000_000);
    assert!(sets.len() >= 199 && !sets.iter().skip(5).any(far), "{:?}", sync.counts());
    assert!(sync.counts().complete >= 99, "{:?}", sync.counts());
}

#[test]
fn a_lost_frame_is_not_made_up_for_by_the_next_one() {
    let offsets = [0, -10_000_000, 12_000_000];
    let (sets, counts) =
        free_running(PERIOD, 300, offsets, [0; 3], 500_000, |slot, tick| slot == 0 || tick % 10 != slot as i64);
    assert!(counts.partial >= 59 && counts.partial <= 61, "{counts:?}");
    for set in &sets {
        for (slot, frame) in set.present() {
            let off = frame.capture_nanos - set.master_nanos - offsets[slot];
            assert!(off.abs() <= 1_000_000, "camera {slot} is {off} ns off its place");
        }
    }
}

#[test]
fn a_frame_outside_the_window_leaves_its_slot_empty() {
    let mut sync = synchronizer(10, 100);
    let sets = push_all(&mut sync, &[("a", 0), ("b", 11), ("c", 10)]);
    assert_eq!(times(&sets[0]), [Some(0), None, Some(10)]);
    assert_eq!((sync.counts().complete, sync.counts().partial), (0, 1));
    sync.flush();
    assert_eq!(sync.counts().dropped_frames[1], DropCounts { superseded: 1, ..DropCounts::default() });
}

#[test]
fn a_dead_camera_is_waited_for_once_and_then_no_more() {
    let mut sync = synchronizer(16, 100);
    let mut emitted_at = Vec::new();
    for tick in 0..8 {
        for camera in ["a", "b"] {
            for set in push_all(&mut sync, &[(camera, tick * 33)]) {
                emitted_at.push((set.master_nanos / MS, tick * 33));
            }
        }
    }
    // Nothing before c has been silent for more than 100 ms; then at once.
    assert_eq!(emitted_at, [(0, 132), (33, 132), (66, 132), (99, 132), (132, 132), (165, 165), (198, 198), (231, 231)]);
    assert_eq!(sync.counts().partial, 8);
}

#[test]
fn another_clock_takes_over_from_a_dead_master_and_gives_back() {
    let mut sync = synchronizer(16, 50);
    let mut sets = Vec::new();
    for tick in 0..12 {
        let ms = tick * 33;
        if !(3..8).contains(&tick) {
            sets.extend(push_all(&mut sync, &[("a", ms)]));
        }
        sets.extend(push_all(&mut sync, &[("b", ms + 4), ("c", ms + 7)]));
    }
    sets.extend(sync.flush());
    let master: Vec<i64> = sets.iter().map(|set| set.master_nanos / MS).collect();
    assert_eq!(master[..3], [0, 33, 66]);
    assert!(master.contains(&(4 * 33 + 4)), "{master:?}: b's clock while a is gone");
    assert_eq!(master[master.len() - 3..], [9 * 33, 10 * 33, 11 * 33], "a leads again");
    assert!(master.windows(2).all(|pair| pair[1] - pair[0] > 16), "{master:?}: no instant twice");
    assert_eq!(sets.len(), 12, "{master:?}");
}

#[test]
fn late_and_doubled_frames_are_dropped_and_counted() {
    let mut sync = synchronizer(16, 100);
    push_all(&mut sync, &[("a", 100), ("b", 100), ("b", 100), ("c", 100)]);
    assert!(push_all(&mut sync, &[("a", 100), ("b", 50), ("c", 99), ("nobody", 0)]).is_empty());
    let counts = sync.counts();
    assert_eq!(counts.dropped_frames[0].duplicate, 1);
    assert_eq!((counts.dropped_frames[1].duplicate, counts.dropped_frames[1].too_old), (1, 1));
    assert_eq!(counts.dropped_frames[2].too_old, 1);
    assert_eq!(counts.unknown_camera, 1);
}

#[test]
fn frames_of_one_camera_may_come_out_of_order() {
    let mut sync = synchronizer(16, 200);
    let mut sets = push_all(&mut sync, &[("b", 33), ("b", 0), ("a", 0), ("c", 0), ("a", 33), ("c", 33), ("b", 66)]);
    sets.extend(sync.flush());
    assert_eq!(sets.iter().map(times).collect::<Vec<_>>(), [vec![Some(0); 3], vec![Some(33); 3]]);
}

#[test]
fn a_camera_that_alone_floods_keeps_a_bounded_queue() {
    let mut sync = synchronizer(16, u64::MAX / 1_000_000);
    for tick in 0..1000 {
        push_all(&mut sync, &[("b", tick * 33)]);
    }
    assert!(sync.cameras.iter().all(|camera| camera.pending.len() <= MAX_PENDING));
    sync.flush();
    assert_eq!(sync.counts().dropped_frames[1].superseded, 1000);
}

#[test]
fn the_ends_of_time_do_not_overflow() {
    let wild = [0, i64::MAX, i64::MIN, -1, i64::MAX - 1, i64::MIN + 1];
    let growing = [i64::MIN, i64::MIN + 1, -1, 0, i64::MAX - 1, i64::MAX];
    for (window_nanos, max_wait_nanos) in [(0, 0), (u64::MAX, u64::MAX), (5, 0), (0, 5)] {
        for times in [wild, growing] {
            let window_nanos = Some(window_nanos);
            let config = SyncSettings {
                master: Some("b".into()),
                window_nanos,
                max_wait_nanos: Some(max_wait_nanos),
                ..SyncSettings::default()
            };
            let mut sync = Synchronizer::new(&["a".into(), "b".into()], &config);
            let mut sets = Vec::new();
            for nanos in times {
                sets.extend(sync.push(frame("a", nanos)));
                sets.extend(sync.push(frame("b", nanos)));
            }
            sets.extend(sync.flush());
            let in_sets: usize = sets.iter().map(|set| set.present().count()).sum();
            let dropped: u64 = sync.counts().dropped_frames.iter().map(DropCounts::total).sum();
            assert_eq!(in_sets as u64 + dropped, 12);
            assert!(sets.windows(2).all(|pair| pair[0].master_nanos < pair[1].master_nanos));
            if times == growing && max_wait_nanos == u64::MAX {
                assert_eq!(in_sets, 12, "a sound rig loses nothing, even at the ends of time");
            }
        }
    }
}

#[test]
fn an_empty_rig_and_an_unknown_master_do_no_harm() {
    let mut none = Synchronizer::new(&[], &SyncSettings::default());
    assert!(none.push(frame("a", 0)).is_empty());
    let config = SyncSettings { master: Some("zz".into()), ..SyncSettings::default() };
    let mut sync = Synchronizer::new(&["a".into()], &config);
    assert_eq!(sync.push(frame("a", 0)).len(), 1);
}

#[test]
fn a_lag_that_is_known_is_taken_off() {
    let ids = ["a".into(), "b".into(), "c".into()];
    for lag_ms in [-1000, -150, -52, 0, 52, 150, 1000] {
        let lag = lag_ms * MS;
        let config = SyncSettings { lags_nanos: [("b".into(), lag)].into(), ..SyncSettings::default() };
        let mut sync = Synchronizer::new(&ids, &config);
        let mut sets = Vec::new();
        // Frames come when they are taken: those of the late camera at the same time as the others', with later stamps.
        for n in 0..90 {
            let nanos = n * 33_333_333;
            sets.extend(["a", "b", "c"].into_iter().flat_map(|camera| sync.push(frame(camera, nanos))));
        }
        sets.extend(sync.flush());
        let whole = sets.iter().filter(|set| set.kind() == SetKind::Complete).count();
        assert!(whole >= 88 - lag_ms.unsigned_abs() as usize * 30 / 1000, "{lag_ms} ms: {whole} of {}", sets.len());
        for set in sets {
            let near = |frame: &Arc<Frame>| frame.capture_nanos.abs_diff(set.master_nanos) <= 16_666_667;
            assert!(set.present().all(|(_, frame)| near(frame)), "{lag_ms} ms");
        }
    }
}

#[test]
fn a_slow_master_that_loses_a_frame_stays_master() {
    // Ten frames a second, 30 beside: 200 ms without the master are one lost frame, not silence.
    let ids = ["slow".into(), "fast".into()];
    let mut sync = Synchronizer::new(&ids, &SyncSettings::default());
    let mut sets = Vec::new();
    for n in 0..120i64 {
        let nanos = n * 33_333_333;
        sets.extend(sync.push(frame("fast", nanos)));
        if n % 3 == 0 && n != 60 {
            sets.extend(sync.push(frame("slow", nanos)));
        }
    }
    sets.extend(sync.flush());
    assert_eq!(sets.len(), 39, "the fast camera led");
    assert!(sets.iter().all(|set| set.kind() == SetKind::Complete));
}
