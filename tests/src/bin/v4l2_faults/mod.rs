//! Faults, one function each.

mod disk;
mod host;
mod nokhwa;
mod rig;
mod table;
mod usb;
mod uvc;

use std::{process::ExitCode, time::Duration};

use flyrig_capture::{CameraIdentity, CaptureErrorKind, V4l2Camera};

use self::{
    host::{open_as_nobody, open_files, replug_all, set_control, threads},
    rig::{Rig, Share, options},
    table::Table,
};

/// Requested frame rate, frames per second.
const FPS: f64 = 30.0;
/// Duration of the observation of a fault.
const WATCH: Duration = Duration::from_secs(4);

/// Runs every fault, or opens one camera with `--open BUS`.
pub fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [mode, bus] = arguments.as_slice()
        && mode == "--open"
    {
        return open_once(bus);
    }
    let cycles = std::env::var("CYCLES").ok().and_then(|text| text.parse().ok()).unwrap_or(25);
    let mut table = Table::default();
    steady(&mut table);
    dropped(&mut table);
    flagged(&mut table);
    fatal(&mut table);
    silent(&mut table);
    wraps(&mut table);
    busy(&mut table);
    permissions(&mut table);
    missing(&mut table);
    refused_start(&mut table);
    replugged(&mut table, cycles);
    nokhwa::run(&mut table);
    disk::full(&mut table);
    usb::run(&mut table, cycles);
    table.print();
    if table.all_within() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Opens one camera and prints the error; the faults below start it as another user.
fn open_once(bus: &str) -> ExitCode {
    match V4l2Camera::open(&"other".into(), &options(bus)) {
        Ok(_) => ExitCode::SUCCESS,
        Err(error) => {
            println!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn bus(camera: usize) -> String {
    format!("platform:vivid-{camera:03}")
}

fn steady(table: &mut Table) {
    let mut rig = Rig::start(4);
    rig.watch(Duration::from_secs(2));
    let seen = rig.watch(Duration::from_secs(12));
    let rates: Vec<String> = seen.cameras.iter().map(|camera| format!("{:.1}", camera.rate())).collect();
    let lost: u64 = seen.cameras.iter().map(|camera| camera.lost).sum();
    let is_fast = seen.cameras.iter().all(|camera| camera.lost_share() < 0.02);
    table.row(
        "none",
        "4 x 640x360 YUYV at 30 per second, 12 s",
        &format!("{} frames, {lost} missing in the drivers' numbers, {} errors", seen.frames(), seen.errors()),
        if is_fast {
            "within 15 % of 30 per second; no errors"
        } else {
            "no errors; this machine is too slow for four cameras"
        },
        &format!("{} per second", rates.join(", ")),
        seen.errors() == 0
            && seen.cameras.iter().all(|camera| camera.frames > 10)
            && (!is_fast || seen.cameras.iter().all(|camera| (camera.rate() / FPS - 1.0).abs() < 0.15)),
    );
    table.row(
        "none",
        "frame sets, window 16.7 ms",
        &format!("{} complete, {} partial", seen.complete, seen.partial),
        if is_fast { "9 of 10 complete" } else { "none: this machine is too slow for four cameras" },
        &format!(
            "capture to set p50 {:.1} ms, p99 {:.1} ms; CPU {:.1} % of a core a camera",
            seen.latency_ms(0.5),
            seen.latency_ms(0.99),
            seen.cpu_percent / 4.0
        ),
        !is_fast || seen.complete > 9 * seen.partial,
    );
}

fn dropped(table: &mut Table) {
    let mut rig = Rig::start(2);
    rig.watch(Duration::from_secs(1));
    set_control(&bus(0), "percentage_of_dropped_buffers", 10);
    let seen = rig.watch(Duration::from_secs(10));
    set_control(&bus(0), "percentage_of_dropped_buffers", 0);
    let hit = &seen.cameras[0];
    // A slow machine loses some of each.
    let is_fast = seen.cameras[1].lost_share() < 0.02;
    let percent = 100.0 * (1.0 - (1.0 - hit.lost_share()) / (1.0 - seen.cameras[1].lost_share()));
    table.row(
        "driver loses frames",
        "10 % of one camera's frames, 10 s",
        &format!("{} frames counted as lost", hit.lost),
        if is_fast {
            "5 to 16 % counted (random by the driver)"
        } else {
            "counted; this machine is too slow to say how many"
        },
        &format!(
            "{percent:.1} % more than the other, which lost {} of {}",
            seen.cameras[1].lost,
            seen.cameras[1].frames + seen.cameras[1].lost
        ),
        if is_fast {
            (5.0..16.0).contains(&percent) && seen.cameras[1].is_sound()
        } else {
            hit.lost > 0 && seen.errors() == 0
        },
    );
}

fn flagged(table: &mut Table) {
    let mut rig = Rig::start(2);
    rig.watch(Duration::from_secs(1));
    let mut other_is_sound = true;
    for wanted in 1..=5 {
        set_control(&bus(0), "inject_v4l2_buf_flag_error", 1);
        rig.until(Duration::from_secs(3), |cameras| cameras[0].errors_of(CaptureErrorKind::Corrupt) >= wanted);
        other_is_sound &= rig.watch(Duration::from_millis(200)).cameras[1].is_sound();
    }
    let hit = &rig.now()[0];
    let corrupt = hit.errors_of(CaptureErrorKind::Corrupt);
    table.row(
        "damaged frames",
        "the driver flags 5 frames of one camera",
        &format!("{corrupt} frames refused as corrupt"),
        "5, none given on; no restart",
        &corrupt.to_string(),
        corrupt == 5 && hit.health.reconnects == 0 && other_is_sound,
    );
}

fn fatal(table: &mut Table) {
    let mut rig = Rig::start(2);
    rig.watch(Duration::from_secs(1));
    set_control(&bus(0), "inject_fatal_streaming_error", 1);
    let seen = rig.watch(WATCH);
    let hit = &seen.cameras[0];
    table.row(
        "stream breaks",
        "fatal streaming error of one camera",
        &format!("{} reconnect, back after {:.0} ms", hit.health.reconnects, hit.longest_gap_ms),
        "back within 600 ms; the other camera unharmed",
        &format!("{:.0} ms; the other's longest gap {:.0} ms", hit.longest_gap_ms, seen.cameras[1].longest_gap_ms),
        hit.health.reconnects == 1 && hit.longest_gap_ms < 600.0 && seen.cameras[1].is_sound(),
    );
}

fn silent(table: &mut Table) {
    let mut rig = Rig::start(2);
    rig.watch(Duration::from_secs(1));
    set_control(&bus(0), "percentage_of_dropped_buffers", 100);
    rig.until(Duration::from_secs(3), |cameras| cameras[0].health.silences > 0);
    let noticed = rig.now()[0].silent_ms();
    let other = rig.watch(Duration::from_secs(1));
    set_control(&bus(0), "percentage_of_dropped_buffers", 0);
    let back = rig.until(Duration::from_secs(10), |cameras| cameras[0].health.reconnects > 0 && cameras[0].frames > 0);
    table.row(
        "silent camera",
        "one camera sends nothing for a while",
        &format!("noticed {noticed:.0} ms after its last frame, back {:.0} ms after it spoke again", back.ms()),
        "500 ms, plus the delay of a busy machine (200); back within 2 s; the other camera unaffected",
        &format!("{noticed:.0} ms"),
        noticed < 700.0 && back.ms() < 2000.0 && other.cameras[1].is_sound(),
    );
}

fn wraps(table: &mut Table) {
    let mut rig = Rig::start(2);
    for control in ["wrap_sequence_number", "wrap_timestamp"] {
        set_control(&bus(0), control, 1);
    }
    // The driver starts near the largest sequence number at the next STREAMON.
    rig = rig.restarted();
    let seen = rig.watch(Duration::from_secs(10));
    for control in ["wrap_sequence_number", "wrap_timestamp"] {
        set_control(&bus(0), control, 0);
    }
    let hit = &seen.cameras[0];
    table.row(
        "sequence numbers and timestamps wrap",
        "the driver's counters run over while streaming",
        &format!(
            "{} frames, {} lost, {} timestamps replaced, {} backwards",
            hit.frames, hit.lost, hit.health.stamps_replaced, hit.backwards
        ),
        "timestamps increase; at most 40 replaced until the driver's clock is learnt; no other error",
        &format!("{} complete frame sets, {} partial", seen.complete, seen.partial),
        hit.backwards == 0 && hit.health.stamps_replaced <= 40 && hit.is_sound() && hit.health.reconnects == 0,
    );
}

fn busy(table: &mut Table) {
    let _rig = Rig::start(1);
    let (succeeded, text) = open_as_nobody(&bus(0), 0);
    table.row(
        "camera in use",
        "another process opens it while the rig streams",
        &text,
        "refused, with the process that has it",
        if succeeded { "opened" } else { "refused" },
        !succeeded && text.contains("in use by v4l2-faults (process"),
    );
}

fn permissions(table: &mut Table) {
    let (succeeded, text) = open_as_nobody(&bus(1), 65534);
    table.row(
        "wrong permissions",
        "another user opens the camera",
        &text,
        "refused, with cause and mend",
        if succeeded { "opened" } else { "refused" },
        !succeeded && text.contains("permission denied") && text.contains("usermod"),
    );
}

fn missing(table: &mut Table) {
    let mut wanted = options("platform:vivid-009");
    let error = V4l2Camera::open(&"front".into(), &wanted).err();
    let text = error.as_ref().map_or_else(String::new, ToString::to_string);
    table.row(
        "camera not there",
        "a configuration names vivid-009",
        &text,
        "refused, with those there are",
        "refused",
        error.is_some_and(|e| e.kind == CaptureErrorKind::NotFound) && text.contains("vivid-003"),
    );
    wanted.identity = CameraIdentity::Bus(bus(0));
    wanted.width = 641;
    let text = V4l2Camera::open(&"front".into(), &wanted).err().map_or_else(String::new, |error| error.to_string());
    table.row(
        "size that it has not",
        "641x360 is asked for",
        &text,
        "refused, with what is wrong",
        "refused",
        text.contains("641x360"),
    );
}

fn refused_start(table: &mut Table) {
    for control in ["inject_vidioc_streamon_error", "inject_vidioc_reqbufs_error"] {
        set_control(&bus(0), control, 1);
        let before = open_files();
        let first = V4l2Camera::open(&"front".into(), &options(&bus(0)));
        let text = first.as_ref().err().map_or_else(String::new, ToString::to_string);
        drop(first);
        let second = V4l2Camera::open(&"front".into(), &options(&bus(0)));
        let healed = second.is_ok();
        drop(second);
        let left = open_files() - before;
        table.row(
            "start fails once",
            control,
            &text,
            "an error, then a start without leftovers",
            &format!("second start {}, {left} file descriptors left over", if healed { "works" } else { "fails" }),
            !text.is_empty() && healed && left == 0,
        );
    }
}

fn replugged(table: &mut Table, cycles: usize) {
    let mut rig = Rig::start(4);
    rig.watch(Duration::from_secs(1));
    let (files, running) = (open_files(), threads());
    let mut slowest: f64 = 0.0;
    let mut failures = 0;
    let mut numbers = std::collections::BTreeSet::new();
    for cycle in 0..cycles {
        // Hold the old nodes open every other time, so that the driver assigns new numbers.
        let wanted: Vec<u64> = rig.now().iter().map(|camera| camera.health.reconnects + 1).collect();
        numbers.extend(replug_all(cycle % 2 == 1));
        let back = rig.until(Duration::from_secs(10), |cameras| {
            cameras.iter().zip(&wanted).all(|(camera, wanted)| camera.health.reconnects >= *wanted && camera.frames > 0)
        });
        slowest = slowest.max(back.ms());
        failures += usize::from(matches!(back, Share::Never(_)));
    }
    rig.watch(Duration::from_secs(1));
    let (files_after, running_after) = (open_files(), threads());
    table.row(
        "unplugged, replugged",
        &format!("4 cameras, {cycles} times, under {} numbers", numbers.len()),
        &format!("{failures} times not all back; slowest {slowest:.0} ms after the replug"),
        "always back within 2 s; file descriptors and threads as before",
        &format!("file descriptors {files} to {files_after}, threads {running} to {running_after}"),
        failures == 0 && slowest < 2000.0 && files == files_after && running == running_after,
    );
}
