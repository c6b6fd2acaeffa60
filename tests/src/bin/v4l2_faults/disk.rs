//! Disk that fills up during a recording.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use flyrig_capture::{CameraSource, McapReplay, Recorder, RecorderConfig, V4l2Camera};

use super::{
    bus,
    rig::{Rig, options},
    table::Table,
};

/// Mount point of a file system of a few megabytes; the virtual machine's start script mounts it.
const DISK: &str = "/small";

/// Records until the disk is full.
pub fn full(table: &mut Table) {
    let path = Path::new(DISK).join("take.mcap");
    let mut sources: Vec<Box<dyn CameraSource>> = Vec::new();
    let recorder =
        match Recorder::create_with(&path, &[], &RecorderConfig { reserve_bytes: 0, ..RecorderConfig::default() }) {
            Ok(recorder) => recorder,
            Err(error) => return table.row("full disk", "recording", &error.to_string(), "it starts", "no", false),
        };
    for (camera, name) in ["00", "01"].into_iter().enumerate() {
        let tapped = V4l2Camera::open(&name.into(), &options(&bus(camera))).and_then(|source| recorder.tap(source));
        match tapped {
            Ok(source) => sources.push(Box::new(source)),
            Err(error) => println!("{error}"),
        }
    }
    let mut rig = Rig::of(sources);
    let start = Instant::now();
    while recorder.state().problem.is_none() && start.elapsed() < Duration::from_secs(30) {
        rig.watch(Duration::from_millis(200));
    }
    let after = rig.watch(Duration::from_secs(2));
    drop(rig);
    let recorded = recorder.finish();
    let problem = recorded.problem.unwrap_or_default();
    let readable: usize = ["00", "01"]
        .iter()
        .filter_map(|name| McapReplay::open(&(*name).into(), &path).ok())
        .map(|mut replay| std::iter::from_fn(|| replay.next_frame(Duration::ZERO).ok()).count())
        .sum();
    let _ = std::fs::remove_file(&path);
    let sound = after.cameras.iter().all(super::rig::Seen::is_sound);
    table.row(
        "full disk",
        "2 cameras recorded, uncompressed, into a file system of 8 MB",
        &problem,
        "the recording stops and says why, what was written is readable, the cameras go on",
        &format!(
            "{readable} frames readable; cameras {} and {} frames in the next 2 s",
            after.cameras.first().map_or(0, |camera| camera.frames),
            after.cameras.get(1).map_or(0, |camera| camera.frames)
        ),
        problem.contains("No space left on device") && readable > 0 && sound,
    );
}
