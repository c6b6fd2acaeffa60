//! Recordings of many files, also on full disks.

use std::{
    fs,
    io::{self, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use super::{
    McapReplay, Recorded, Recorder, RecorderConfig, Rotation,
    disk::{Disk, part_path},
    recorded_messages, recorded_notes,
    tests::{Script, frame, note, pass, replayed, same},
};
use crate::error::CaptureErrorKind;
use crate::source::CameraSource;

const MINUTE: Duration = Duration::from_secs(60);

fn rotating(max_bytes: Option<u64>, max_time: Option<Duration>) -> RecorderConfig {
    RecorderConfig { rotation: Rotation { max_bytes, max_time }, reserve_bytes: 0, ..RecorderConfig::default() }
}

/// Records two alternating cameras.
fn record(path: &Path, frames: u64, config: &RecorderConfig) -> Recorded {
    let recorder = Recorder::create_with(path, &[note()], config).unwrap();
    let mut taps = ["a", "b"].map(|name| recorder.tap(Script(name.into(), 0, frames)).unwrap());
    for _ in 0..frames {
        taps.iter_mut().for_each(|tap| drop(tap.next_frame(Duration::ZERO).unwrap()));
    }
    recorder.finish()
}

fn summary(bytes: &[u8]) -> mcap::Summary {
    mcap::Summary::read(bytes).unwrap().expect("an index")
}

#[test]
fn every_file_is_complete_and_no_frame_is_lost_or_doubled_at_a_seam() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let state = record(&path, 300, &rotating(Some(20_000), None));
    assert_eq!((state.frames, state.problem.as_deref()), (600, None));
    assert!(state.free_bytes.is_some_and(|free| free > 0) || !cfg!(unix));
    assert!(state.elapsed > Duration::ZERO);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), state.files as usize);
    assert!(state.files >= 10, "{state:?}");
    assert_eq!(state.file, part_path(&path, state.files - 1));

    let (mut sequences, mut messages) = ([Vec::new(), Vec::new()], 0);
    for part in 0..state.files {
        let bytes = fs::read(part_path(&path, part)).unwrap();
        let index = summary(&bytes);
        assert!(bytes.len() < 22_000 + 3000, "{} bytes: the index comes on top", bytes.len());
        let names: Vec<&str> = index.schemas.values().map(|schema| schema.name.as_str()).collect();
        assert!(names.contains(&"flyrig.Test") && names.len() >= 2, "{names:?}");
        messages += index.stats.unwrap().message_count;
        // By itself, as another program reads it.
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            match message.channel.topic.as_str() {
                "camera/a" => sequences[0].push(u64::from(message.sequence)),
                "camera/b" => sequences[1].push(u64::from(message.sequence)),
                topic => assert_eq!((topic, &*message.data), ("calibration/a", &[1, 2, 3][..])),
            }
        }
        assert_eq!(recorded_notes(&part_path(&path, part)).unwrap().len(), 1);
    }
    assert_eq!(messages, 600 + u64::from(state.files));
    let sent: Vec<u64> = (0..300).map(|n| frame(&"a".into(), n).sequence).collect();
    assert_eq!(sequences, [sent.clone(), sent]);
}

#[test]
fn the_first_file_gives_the_whole_recording_and_a_later_one_itself() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let state = record(&path, 100, &rotating(Some(20_000), None));
    for camera in ["a", "b"] {
        let frames = replayed(&path, camera);
        assert_eq!(frames.len(), 100);
        for (found, n) in frames.iter().zip(0..) {
            same(found, &frame(&camera.into(), n));
        }
    }
    assert_eq!(recorded_messages(&path, "camera/b").unwrap().count(), 100);
    let by_file: Vec<usize> = (1..state.files).map(|part| replayed(&part_path(&path, part), "a").len()).collect();
    assert!(by_file.iter().all(|&frames| frames > 0) && by_file.iter().sum::<usize>() < 100, "{by_file:?}");
}

#[test]
fn a_file_ends_after_its_time() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    // No message is younger: each has a file of its own.
    let state = record(&path, 3, &rotating(None, Some(Duration::ZERO)));
    assert_eq!((state.frames, state.files, state.problem), (6, 6, None));
    assert_eq!(replayed(&path, "a").len(), 3);
    let folder = tempfile::tempdir().unwrap();
    let state = record(&folder.path().join("take.mcap"), 3, &rotating(None, Some(MINUTE * 60)));
    assert_eq!(state.files, 1);
}

#[test]
fn what_is_in_the_way_is_never_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let third = part_path(&path, 2);
    fs::write(&third, "precious").unwrap();
    let state = record(&path, 100, &rotating(Some(5000), None));
    let problem = state.problem.unwrap();
    assert!(problem.contains("take-0002.mcap cannot be created") && !problem.contains("free space"), "{problem}");
    assert_eq!(fs::read(&third).unwrap(), b"precious");
    assert_eq!(replayed(&path, "a").len() + replayed(&path, "b").len(), state.frames as usize);
    // A second recording of the same name would run into the files of the first.
    fs::remove_file(&path).unwrap();
    let error = Recorder::create_with(&path, &[], &rotating(Some(5000), None)).unwrap_err();
    assert!(error.message.contains("take-0001.mcap is there already; name another file"), "{error}");
    assert!(!path.exists());
}

#[test]
fn files_of_other_recordings_are_not_joined() {
    let folder = tempfile::tempdir().unwrap();
    let (path, other) = (folder.path().join("take.mcap"), folder.path().join("other.mcap"));
    let files = record(&path, 30, &rotating(Some(5000), None)).files;
    assert!(files > 3);
    record(&other, 30, &rotating(Some(5000), None));
    fs::copy(part_path(&other, 1), part_path(&path, 1)).unwrap();
    let own = replayed(&path, "a").len();
    assert!(own < 10, "{own} frames");
    // A recording without rotation has no other files.
    fs::remove_file(&path).unwrap();
    record(&path, 2, &RecorderConfig { reserve_bytes: 0, ..RecorderConfig::default() });
    assert_eq!(replayed(&path, "a").len(), 2);
}

#[test]
fn a_file_that_breaks_off_does_not_hide_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let files = record(&path, 60, &rotating(Some(10_000), None)).files;
    let second = part_path(&path, 1);
    let bytes = fs::read(&second).unwrap();
    fs::write(&second, &bytes[..bytes.len() / 2]).unwrap();
    let found: Vec<u64> = replayed(&path, "a").iter().map(|frame| frame.sequence).collect();
    assert!(files > 3 && found.len() < 60 && found.last() == Some(&118), "{found:?}");
    assert!(found.is_sorted());
}

#[test]
fn sequence_numbers_of_a_camera_that_was_opened_anew_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let recorder = Recorder::create(&path, &[], None).unwrap();
    let tap = recorder.source_tap();
    for _ in 0..2 {
        assert_eq!(pass(&mut tap.tap(Script("a".into(), 0, 3)).unwrap()), 3);
    }
    assert_eq!(recorder.finish().frames, 6);
    let found: Vec<u64> = replayed(&path, "a").iter().map(|frame| frame.sequence).collect();
    assert_eq!(found, [0, 2, 4, 5, 7, 9]);
}

/// Files in memory that count the durable bytes.
#[derive(Debug, Default)]
struct Files {
    files: Vec<Vec<u8>>,
    /// Per file, bytes at the last sync.
    durable: Vec<usize>,
    syncs: usize,
    free: Option<u64>,
    /// Whether writes fail for want of space.
    is_full: bool,
}

#[derive(Clone, Default)]
struct Memory(Arc<Mutex<Files>>);
struct MemoryFile(Arc<Mutex<Files>>, usize);

impl Memory {
    fn with<T>(&self, look: impl FnOnce(&mut Files) -> T) -> T {
        look(&mut self.0.lock().unwrap())
    }

    fn until(&self, what: &str, is_so: impl Fn(&Files) -> bool) {
        let start = Instant::now();
        while !self.with(|files| is_so(files)) {
            assert!(start.elapsed() < MINUTE, "{what}: {:?}", self.with(|files| (files.durable.clone(), files.syncs)));
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Disk for Memory {
    type File = MemoryFile;

    fn path(&self, part: u32) -> PathBuf {
        part_path(Path::new("take.mcap"), part)
    }

    fn create(&mut self, part: u32) -> io::Result<MemoryFile> {
        self.with(|files| {
            files.files.push(Vec::new());
            files.durable.push(0);
        });
        Ok(MemoryFile(Arc::clone(&self.0), part as usize))
    }

    fn sync(&mut self) -> io::Result<()> {
        self.with(|files| {
            files.syncs += 1;
            if let (Some(file), Some(durable)) = (files.files.last(), files.durable.last_mut()) {
                *durable = file.len();
            }
        });
        Ok(())
    }

    fn free_bytes(&self) -> Option<u64> {
        self.with(|files| files.free)
    }
}

impl Write for MemoryFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut files = self.0.lock().unwrap();
        if files.is_full {
            return Err(io::ErrorKind::StorageFull.into());
        }
        files.files[self.1].extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Accepts seeks to the end only.
impl Seek for MemoryFile {
    fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
        Ok(self.0.lock().unwrap().files[self.1].len() as u64)
    }
}

#[test]
fn what_is_written_becomes_durable_while_it_runs_and_at_the_end_of_every_file() {
    let memory = Memory::default();
    let config = rotating(Some(20_000), None);
    let recorder = Recorder::start(memory.clone(), &[note()], &config).unwrap();
    let head = memory.with(|files| files.durable[0]);
    assert!(head > 0, "the notes are durable before the first frame");
    assert_eq!(memory.with(|files| files.files[0].len()), head);
    let mut tap = recorder.tap(Script("a".into(), 0, 1000)).unwrap();
    assert!(tap.next_frame(Duration::ZERO).is_ok());
    // Nothing else comes: time alone makes it durable.
    memory.until("a frame becomes durable", |files| files.durable[0] > head);
    assert_eq!(recorder.state().frames, 1);
    assert_eq!(pass(&mut tap), 999);
    drop(tap);
    let state = recorder.finish();
    assert_eq!((state.frames, state.problem), (1000, None));
    memory.with(|files| {
        assert!(files.files.len() > 3);
        assert_eq!(files.files.iter().map(Vec::len).collect::<Vec<_>>(), files.durable);
        files.files.iter().for_each(|file| drop(summary(file)));
    });
}

/// A killed process loses what is not in the file.
#[test]
fn a_frame_is_in_the_file_within_half_a_second() {
    let memory = Memory::default();
    let recorder = Recorder::start(memory.clone(), &[note()], &RecorderConfig::default()).unwrap();
    let mut tap = recorder.tap(Script("a".into(), 0, 1000)).unwrap();
    let mut delay = |pause_ms: u64| {
        std::thread::sleep(Duration::from_millis(pause_ms));
        let (before, start) = (memory.with(|files| files.files[0].len()), Instant::now());
        assert!(tap.next_frame(Duration::ZERO).is_ok());
        memory.until("a frame is written", |files| files.files[0].len() > before);
        start.elapsed()
    };
    // The median, since the machine may be busy.
    let mut delays: Vec<Duration> = [10, 120, 230, 340, 450, 560, 670].map(&mut delay).into();
    delays.sort();
    assert!(delays[3] < Duration::from_millis(450), "{delays:?}");
}

#[test]
fn nothing_is_recorded_without_the_reserve() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take.mcap");
    let config = RecorderConfig { reserve_bytes: u64::MAX, ..RecorderConfig::default() };
    if cfg!(unix) {
        let error = Recorder::create_with(&path, &[], &config).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::Io);
        assert!(error.message.contains("take.mcap cannot be recorded to: only "), "{error}");
        assert!(error.message.contains("free space or record to another disk"), "{error}");
        assert!(!path.exists());
    }
    let error = McapReplay::open(&"a".into(), &path).unwrap_err();
    assert_eq!(error.kind, CaptureErrorKind::NotFound);
}

#[test]
fn a_recording_ends_with_its_index_before_the_disk_is_full() {
    // In the middle of a file, and at a seam.
    for config in [RecorderConfig::default(), rotating(Some(20_000), None)] {
        let memory = Memory::default();
        memory.with(|files| files.free = Some(5000));
        let config = RecorderConfig { reserve_bytes: 1000, ..config };
        let recorder = Recorder::start(memory.clone(), &[note()], &config).unwrap();
        let mut tap = recorder.tap(Script("a".into(), 0, 100_000)).unwrap();
        assert!(tap.next_frame(Duration::ZERO).is_ok());
        memory.with(|files| files.free = Some(999));
        let start = Instant::now();
        while recorder.state().paused.is_none() {
            assert!(start.elapsed() < MINUTE, "it goes on: {:?}", recorder.state());
            assert!(tap.next_frame(Duration::ZERO).is_ok(), "the camera goes on");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(tap.next_frame(Duration::ZERO).is_ok(), "the camera goes on");
        let state = recorder.finish();
        let problem = state.problem.unwrap();
        assert!(problem.starts_with("only 0 MB are free") && problem.contains("another disk"), "{problem}");
        assert_eq!(state.free_bytes, Some(999));
        memory.with(|files| {
            let counts = files.files.iter().map(|file| summary(file).stats.unwrap().message_count);
            assert_eq!(counts.sum::<u64>(), state.frames + u64::from(state.files), "frames, and a note in each file");
        });
    }
}

/// Passes frames until the recording's state is so, and returns their number.
fn pass_until(recorder: &Recorder, tap: &mut impl CameraSource, is_so: impl Fn(&Recorded) -> bool) -> u64 {
    let (start, mut passed) = (Instant::now(), 0);
    while !is_so(&recorder.state()) {
        assert!(start.elapsed() < MINUTE, "{:?}", recorder.state());
        assert!(tap.next_frame(Duration::ZERO).is_ok(), "the camera goes on");
        passed += 1;
        std::thread::sleep(Duration::from_millis(1));
    }
    passed
}

#[test]
fn a_recording_goes_on_in_a_new_file_once_the_disk_has_space_again() {
    const GIB: u64 = 1 << 30;
    for config in [RecorderConfig::default(), RecorderConfig { reserve_bytes: GIB, ..rotating(Some(20_000), None) }] {
        let memory = Memory::default();
        memory.with(|files| files.free = Some(2 * GIB));
        let recorder = Recorder::start(memory.clone(), &[note()], &config).unwrap();
        let mut tap = recorder.tap(Script("a".into(), 0, 1_000_000)).unwrap();
        let mut passed = pass_until(&recorder, &mut tap, |state| state.frames > 0);
        // A byte too little, twice in turn: each time the recording waits, and goes on.
        for _ in 0..2 {
            memory.with(|files| files.free = Some(GIB - 1));
            passed += pass_until(&recorder, &mut tap, |state| state.paused.is_some());
            let full = recorder.state();
            assert_eq!(full.problem, None, "it waits");
            passed += pass_until(&recorder, &mut tap, |state| state.dropped > full.dropped + 5);
            memory.with(|files| files.files.iter().for_each(|file| drop(summary(file))));
            assert_eq!(recorder.state().files, full.files, "nothing is written to the full disk");
            memory.with(|files| files.free = Some(GIB));
            passed += pass_until(&recorder, &mut tap, |state| state.frames > full.frames);
            assert!(recorder.state().paused.is_none() && recorder.state().files > full.files);
        }
        drop(tap);
        let state = recorder.finish();
        assert_eq!(state.problem, None);
        assert_eq!(state.frames + state.dropped, passed, "every frame is in a file or counted");
        memory.with(|files| {
            let counts = files.files.iter().map(|file| summary(file).stats.unwrap().message_count);
            assert_eq!(counts.sum::<u64>(), state.frames + u64::from(state.files), "frames, and a note in each file");
        });
    }
}

#[test]
fn a_write_that_does_not_fit_is_followed_by_a_new_file_too() {
    let memory = Memory::default();
    memory.with(|files| files.free = Some(1 << 30));
    let recorder = Recorder::start(memory.clone(), &[note()], &RecorderConfig::default()).unwrap();
    let mut tap = recorder.tap(Script("a".into(), 0, 1_000_000)).unwrap();
    let mut passed = pass_until(&recorder, &mut tap, |state| state.frames > 0);
    memory.with(|files| (files.free, files.is_full) = (Some(0), true));
    passed += pass_until(&recorder, &mut tap, |state| state.dropped > 0);
    memory.with(|files| (files.free, files.is_full) = (Some(1 << 30), false));
    let before = recorder.state().frames;
    passed += pass_until(&recorder, &mut tap, |state| state.frames > before + 10);
    drop(tap);
    let state = recorder.finish();
    assert_eq!(state.frames + state.dropped, passed, "every frame is in a file or counted");
    assert_eq!((state.files, state.problem), (2, None));
    memory.with(|files| drop(summary(&files.files[1])));
}
