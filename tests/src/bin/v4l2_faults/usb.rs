//! Faults of USB cameras.

use std::{
    io,
    sync::{Arc, atomic::Ordering},
    thread,
    time::{Duration, Instant},
};

use flyrig_capture::{CameraControls, CameraIdentity, CameraOptions, CaptureErrorKind, FormatChoice, camera_reports};

use super::{
    host::{open_files, threads},
    rig::{Rig, Seen, Share, options},
    table::Table,
    uvc::{Knobs, UvcCamera, pictures},
};

/// Four cameras on the virtual controller.
pub struct Bench {
    plugged: Vec<Option<UvcCamera>>,
    knobs: Vec<Arc<Knobs>>,
    pictures: Arc<Vec<Vec<u8>>>,
}

const CAMERAS: usize = 4;

fn serial(camera: usize) -> String {
    format!("FR-{camera:04}")
}

fn usb_options(camera: usize) -> CameraOptions {
    CameraOptions {
        identity: CameraIdentity::Serial(serial(camera)),
        format: FormatChoice::Mjpeg,
        controls: CameraControls { exposure_secs: Some(0.008), ..CameraControls::default() },
        ..options("")
    }
}

impl Bench {
    fn new() -> io::Result<Self> {
        let knobs = (0..CAMERAS).map(|_| Arc::default()).collect();
        let mut bench = Self { plugged: Vec::new(), knobs, pictures: Arc::new(pictures()) };
        for camera in 0..CAMERAS {
            bench.plugged.push(None);
            bench.plug(camera, camera)?;
        }
        let deadline = Instant::now() + Duration::from_secs(20);
        while found() < CAMERAS && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(100));
        }
        if found() < CAMERAS {
            return Err(io::Error::other(format!("only {} of {CAMERAS} USB cameras appeared", found())));
        }
        Ok(bench)
    }

    fn plug(&mut self, camera: usize, port: usize) -> io::Result<()> {
        let deadline = Instant::now() + Duration::from_secs(5);
        loop {
            // The port may still be in use by the camera that was just unplugged.
            match UvcCamera::plug(port, &serial(camera), Arc::clone(&self.knobs[camera]), Arc::clone(&self.pictures)) {
                Ok(plugged) => {
                    self.plugged[camera] = Some(plugged);
                    return Ok(());
                }
                Err(error) if Instant::now() > deadline => return Err(error),
                Err(_) => thread::sleep(Duration::from_millis(50)),
            }
        }
    }

    fn rig() -> Rig {
        Rig::start_with(&(0..CAMERAS).map(usb_options).collect::<Vec<_>>())
    }
}

fn found() -> usize {
    camera_reports().iter().filter(|report| report.node.serial.as_ref().is_some_and(|s| s.starts_with("FR-"))).count()
}

/// Runs every fault.
pub fn run(table: &mut Table, cycles: usize) {
    let mut bench = match Bench::new() {
        Ok(bench) => bench,
        Err(error) => return table.row("USB cameras", "plugged in", &error.to_string(), "they appear", "no", false),
    };
    steady(table);
    cut(table, &bench);
    silent(table, &bench);
    replugged(table, &mut bench, cycles);
}

fn steady(table: &mut Table) {
    let mut rig = Bench::rig();
    rig.watch(Duration::from_secs(3));
    let seen = rig.watch(Duration::from_secs(10));
    let rates: Vec<String> = seen.cameras.iter().map(|camera| format!("{:.1}", camera.rate())).collect();
    let exposed = seen.cameras.iter().all(|camera| camera.exposure_nanos == Some(8_000_000));
    table.row(
        "none (USB)",
        "4 x MJPEG 640x360 by serial number, exposure 8 ms, 10 s",
        &format!(
            "{} frames, {} errors; exposure {}",
            seen.frames(),
            seen.errors(),
            if exposed { "as set" } else { "not set" }
        ),
        "flowing without errors; exposure reads back",
        &format!("{} per second", rates.join(", ")),
        seen.errors() == 0 && exposed && seen.cameras.iter().all(|camera| camera.frames > 10),
    );
}

fn cut(table: &mut Table, bench: &Bench) {
    let mut rig = Bench::rig();
    rig.watch(Duration::from_secs(2));
    // Cut every image: a slow machine receives only a few.
    bench.knobs[0].cut.store(u64::MAX, Ordering::Relaxed);
    let refused = |cameras: &[Seen]| cameras[0].errors_of(CaptureErrorKind::Corrupt) >= 5;
    let in_time = matches!(rig.until(Duration::from_secs(30), refused), Share::After(_));
    bench.knobs[0].cut.store(0, Ordering::Relaxed);
    let back = rig.until(Duration::from_secs(10), |cameras| cameras[0].frames > 3);
    let hit = &rig.now()[0];
    table.row(
        "cut off images (USB)",
        "JPEG images of one camera end in the middle for a while",
        &format!("{} frames refused, none given on", hit.errors_of(CaptureErrorKind::Corrupt)),
        "each costs itself; no restart; flowing again",
        &format!("flowing {:.0} ms after the last one", back.ms()),
        in_time && matches!(back, Share::After(_)) && hit.health.reconnects == 0,
    );
}

fn silent(table: &mut Table, bench: &Bench) {
    let mut rig = Bench::rig();
    rig.watch(Duration::from_secs(2));
    bench.knobs[0].silent.store(true, Ordering::Relaxed);
    // A slow machine first drains the driver's buffers.
    rig.until(Duration::from_secs(15), |cameras| cameras[0].health.silences > 0);
    let noticed = rig.now()[0].silent_ms();
    bench.knobs[0].silent.store(false, Ordering::Relaxed);
    let back = rig.until(Duration::from_secs(10), |cameras| cameras[0].health.reconnects > 0 && cameras[0].frames > 0);
    table.row(
        "silent camera (USB)",
        "one camera stalls without an error",
        &format!("noticed {noticed:.0} ms after its last frame, back {:.0} ms after the stall", back.ms()),
        "500 ms, plus the delay of a busy machine (200)",
        &format!("{noticed:.0} ms"),
        noticed < 700.0 && matches!(back, Share::After(_)),
    );
}

fn replugged(table: &mut Table, bench: &mut Bench, cycles: usize) {
    let mut rig = Bench::rig();
    rig.watch(Duration::from_secs(2));
    // Measure the other cameras undisturbed, for comparison: the emulated bus pauses occasionally.
    let usual = rig.watch(Duration::from_secs(10)).cameras[1].longest_gap_ms;
    let (files, running) = (open_files(), threads());
    let (mut slowest, mut failures, mut others): (f64, usize, f64) = (0.0, 0, 0.0);
    let mut numbers = std::collections::BTreeSet::new();
    for cycle in 0..cycles {
        let wanted = rig.now()[0].health.reconnects + 1;
        bench.plugged[0] = None;
        rig.watch(Duration::from_millis(700));
        // Use another port each time.
        if let Err(error) = bench.plug(0, CAMERAS + cycle % 3) {
            println!("plug: {error}");
        }
        let back = rig
            .until(Duration::from_secs(15), |cameras| cameras[0].health.reconnects >= wanted && cameras[0].frames > 0);
        let nodes = camera_reports().into_iter().filter(|report| report.node.serial == Some(serial(0)));
        numbers.extend(nodes.map(|report| report.node.node));
        others = others.max(rig.now()[1].longest_gap_ms);
        slowest = slowest.max(back.ms());
        failures += usize::from(matches!(back, Share::Never(_)));
    }
    rig.watch(Duration::from_secs(1));
    let exposed = rig.now()[0].exposure_nanos == Some(8_000_000);
    let (files_after, running_after) = (open_files(), threads());
    table.row(
        "unplugged, replugged (USB)",
        &format!("one of 4 cameras, {cycles} times, other ports, {} numbers", numbers.len()),
        &format!(
            "{failures} times not back; slowest {slowest:.0} ms after the plug; exposure {}",
            if exposed { "set again" } else { "lost" }
        ),
        "always back within 6 s with its settings; file descriptors and threads as before; others pause at most 500 ms longer than undisturbed",
        &format!(
            "file descriptors {files} to {files_after}, threads {running} to {running_after}; others' longest gap {others:.0} ms, {usual:.0} ms undisturbed"
        ),
        failures == 0 && exposed && slowest < 6000.0 && files == files_after && running == running_after && others < usual + 500.0,
    );
}
