//! Camera of the test driver through the crate nokhwa, whose reads block without a timeout.

use std::time::{Duration, Instant};

use flyrig_capture::{
    CameraSource, FormatChoice, NokhwaCamera, NokhwaDevice, NokhwaOptions, camera_reports, monotonic_nanos,
};

use super::{
    bus,
    host::{open_files, replug_all, set_control, threads},
    rig::{Rig, Share},
    table::Table,
};

/// Number of times the camera is unplugged.
const CYCLES: usize = 5;

fn open(table: &mut Table) -> Option<NokhwaCamera> {
    // Identify it by name: if a node is still open when its camera returns, the camera gets another number.
    let report = camera_reports().into_iter().find(|report| report.bus_info.as_deref() == Some(bus(0).as_str()))?;
    let (device, format) = (NokhwaDevice::Name(report.node.name), FormatChoice::Auto);
    let wanted = NokhwaOptions { device, width: 640, height: 360, fps: super::FPS, format, lag_secs: 0.0 };
    match NokhwaCamera::open(&"00".into(), &wanted) {
        Ok(camera) => Some(camera),
        Err(error) => {
            table.row("none (nokhwa)", "opened", &error.to_string(), "it opens", "refused", false);
            None
        }
    }
}

/// Runs every fault.
pub fn run(table: &mut Table) {
    let (files, running) = (open_files(), threads());
    if let Some(camera) = open(table) {
        flowing(table, camera);
    }
    if let Some(camera) = open(table) {
        lost(table, camera);
    }
    // A thread ends slightly after its camera is closed.
    let deadline = Instant::now() + Duration::from_secs(2);
    while threads() > running && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(20));
    }
    let (files_after, running_after) = (open_files(), threads());
    table.row(
        "none (nokhwa)",
        "closed",
        "nothing is left",
        "file descriptors and threads as before",
        &format!("file descriptors {files} to {files_after}, threads {running} to {running_after}"),
        files == files_after && running == running_after,
    );
}

fn flowing(table: &mut Table, mut camera: NokhwaCamera) {
    let (mut frames, mut errors, mut ages_ms) = (0u32, 0u32, Vec::new());
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(5) {
        match camera.next_frame(Duration::from_millis(200)) {
            Ok(frame) => {
                frames += 1;
                ages_ms.push((monotonic_nanos() - frame.capture_nanos) as f64 / 1e6);
            }
            Err(error) => errors += u32::from(error.kind != flyrig_capture::CaptureErrorKind::Timeout),
        }
    }
    ages_ms.sort_by(f64::total_cmp);
    let age = ages_ms.get(ages_ms.len() / 2).copied().unwrap_or(f64::NAN);
    table.row(
        "none (nokhwa)",
        "one vivid camera, 640x360, 5 s",
        &format!("{}; {errors} errors", camera.health().mode),
        "frames flow without errors, less than 300 ms old",
        &format!("{:.1} per second, timestamps {age:.1} ms before the arrival of the frame", f64::from(frames) / 5.0),
        frames > 20 && errors == 0 && (0.0..300.0).contains(&age),
    );
}

fn lost(table: &mut Table, camera: NokhwaCamera) {
    let mut rig = Rig::of(vec![Box::new(camera)]);
    rig.watch(Duration::from_secs(1));
    set_control(&bus(0), "percentage_of_dropped_buffers", 100);
    rig.until(Duration::from_secs(5), |cameras| cameras[0].health.silences > 0);
    let (noticed, running) = (rig.now()[0].silent_ms(), threads());
    rig.watch(Duration::from_secs(4));
    let grown = threads().saturating_sub(running);
    set_control(&bus(0), "percentage_of_dropped_buffers", 0);
    let back = rig.until(Duration::from_secs(20), |cameras| cameras[0].health.reconnects > 0 && cameras[0].frames > 0);
    table.row(
        "silent camera (nokhwa)",
        "it sends nothing for 4 s, so that its read hangs",
        &format!("noticed {noticed:.0} ms after its last frame, back {:.0} ms after it spoke again", back.ms()),
        "500 ms, plus the delay of a busy machine (200); at most one thread more; back within 10 s",
        &format!("{noticed:.0} ms, {grown} threads more"),
        noticed < 700.0 && grown <= 1 && back.ms() < 10_000.0,
    );
    let (mut slowest, mut failures): (f64, usize) = (0.0, 0);
    for _ in 0..CYCLES {
        let wanted = rig.now()[0].health.reconnects + 1;
        replug_all(false);
        let back = rig
            .until(Duration::from_secs(20), |cameras| cameras[0].health.reconnects >= wanted && cameras[0].frames > 0);
        slowest = slowest.max(back.ms());
        failures += usize::from(matches!(back, Share::Never(_)));
    }
    table.row(
        "unplugged, replugged (nokhwa)",
        &format!("{CYCLES} times, by its name"),
        &format!("{failures} times not back"),
        "always back within 10 s",
        &format!("slowest {slowest:.0} ms"),
        failures == 0 && slowest < 10_000.0,
    );
}
