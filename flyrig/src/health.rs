//! Health of a rig for the terminal and for Prometheus.

use std::fmt::Write as _;

use flyrig_capture::Recorded;
use flyrig_fusion::{CameraHealth, Health};

/// Formats a snapshot, and the state of a recording where there is one, in Prometheus' text format 0.0.4.
pub fn prometheus(health: &Health, recorded: Option<&Recorded>) -> String {
    let mut text = String::new();
    let mut family = |name: &str, kind: &str, help: &str, samples: &mut dyn Iterator<Item = (String, f64)>| {
        let _ = writeln!(text, "# HELP flyrig_{name} {help}\n# TYPE flyrig_{name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(text, "flyrig_{name}{labels} {value}");
        }
    };
    let label = |camera: &CameraHealth| format!("{{camera=\"{}\"}}", escaped(camera.stats.camera.as_str()));
    type Field<'a> = &'a dyn Fn(&CameraHealth) -> Option<f64>;
    let per_camera: [(&str, &str, &str, Field<'_>); 21] = [
        ("frames_total", "counter", "Frames that came.", &|c| Some(c.stats.frames as f64)),
        ("frames_lost_before_us_total", "counter", "Frames that the driver numbered and nobody got.", &|c| {
            Some(c.stats.health.lost_by_driver as f64)
        }),
        ("frames_waited_too_long_total", "counter", "Frames dropped because the rig was busy.", &|c| {
            Some(c.stats.dropped as f64)
        }),
        ("frames_in_no_set_total", "counter", "Frames that fitted into no set.", &|c| Some(c.in_no_set as f64)),
        ("reconnects_total", "counter", "Times that the camera came back.", &|c| {
            Some(c.stats.health.reconnects as f64)
        }),
        ("silences_total", "counter", "Times that the camera stopped without an error.", &|c| {
            Some(c.stats.health.silences as f64)
        }),
        ("stamps_replaced_total", "counter", "Time stamps that could not be right.", &|c| {
            let of_clock = c.clock.map_or(0, |clock| clock.replaced);
            Some(c.stats.health.stamps_replaced.saturating_add(of_clock) as f64)
        }),
        ("camera_up", "gauge", "Whether frames come.", &|c| Some(f64::from(u8::from(c.is_up())))),
        ("quiet_seconds", "gauge", "Since the last frame.", &|c| c.quiet_s),
        ("interval_seconds", "gauge", "Mean time between captures.", &|c| {
            (c.is_up() && c.interval_ms > 0.0).then_some(c.interval_ms / 1e3)
        }),
        ("jitter_seconds", "gauge", "Standard deviation of the time between captures.", &|c| {
            (c.is_up() && c.interval_ms > 0.0).then_some(c.jitter_ms / 1e3)
        }),
        ("lateness_seconds", "gauge", "From capture to synchronizer.", &|c| {
            c.lateness_ms.filter(|_| c.is_up()).map(|ms| ms / 1e3)
        }),
        ("clock_drift_ppm", "gauge", "Drift against the master's clock.", &|c| c.clock.map(|clock| clock.drift_ppm)),
        ("frames_overtaken_total", "counter", "Frames overtaken before they were decoded.", &|c| {
            Some(c.stats.overtaken as f64)
        }),
        ("network_overtaken_before_total", "counter", "Frames that stayed on the camera's computer.", &|c| {
            c.stats.health.network.map(|n| n.overtaken_before as f64)
        }),
        ("network_lost_total", "counter", "Frames that left the camera's computer and never came.", &|c| {
            c.stats.health.network.map(|n| n.lost_on_the_way as f64)
        }),
        ("network_overtaken_here_total", "counter", "Frames overtaken after they had come.", &|c| {
            c.stats.health.network.map(|n| n.overtaken_here as f64)
        }),
        ("network_refused_total", "counter", "Messages that could not be used.", &|c| {
            c.stats.health.network.map(|n| n.refused.saturating_add(n.before_clock) as f64)
        }),
        ("host_clock_offset_seconds", "gauge", "Clock of the camera's computer minus ours.", &|c| {
            Some(c.stats.health.network?.clock_offset_nanos? as f64 * 1e-9)
        }),
        ("host_clock_drift_ppm", "gauge", "How much faster that clock runs.", &|c| {
            let network = c.stats.health.network?;
            network.clock_offset_nanos.map(|_| network.clock_drift_ppb as f64 * 1e-3)
        }),
        ("host_round_trip_seconds", "gauge", "Shortest round trip to that computer.", &|c| {
            let network = c.stats.health.network?;
            network.clock_offset_nanos.map(|_| network.round_trip_nanos as f64 * 1e-9)
        }),
    ];
    for (name, kind, help, field) in per_camera {
        let mut samples = health.cameras.iter().filter_map(|camera| Some((label(camera), field(camera)?)));
        family(name, kind, help, &mut samples);
    }
    let mut errors = health.cameras.iter().flat_map(|camera| {
        let name = escaped(camera.stats.camera.as_str());
        let labels = move |kind| format!("{{camera=\"{name}\",kind=\"{kind:?}\"}}");
        camera.stats.errors.iter().map(move |(kind, count)| (labels(kind), *count as f64))
    });
    family("camera_errors_total", "counter", "Errors of cameras by kind.", &mut errors);
    let labels = |thread: &str| format!("{{thread=\"{}\"}}", escaped(thread));
    let mut restarts = thread_restarts(health).into_iter().map(|(thread, count)| (labels(&thread), count as f64));
    family("thread_restarts_total", "counter", "Times that a thread's work was begun anew.", &mut restarts);
    let mut stuck = threads(health).into_iter().map(|thread| {
        let is_stuck = health.stuck.contains(&thread);
        (labels(&thread), f64::from(u8::from(is_stuck)))
    });
    family("thread_stuck", "gauge", "Whether a thread hangs.", &mut stuck);
    let sets = [("complete", health.complete_sets), ("partial", health.partial_sets), ("skipped", health.skipped_sets)];
    let mut sets = sets.into_iter().map(|(kind, count)| (format!("{{kind=\"{kind}\"}}"), count as f64));
    family("sets_total", "counter", "Sets of frames.", &mut sets);
    let mut stages = health.stages.iter().flat_map(|stage| {
        let name = escaped(&stage.name);
        [("0.5", stage.p50_ms), ("0.95", stage.p95_ms)]
            .map(|(quantile, ms)| (format!("{{stage=\"{name}\",quantile=\"{quantile}\"}}"), f64::from(ms) / 1e3))
    });
    family("stage_seconds", "gauge", "Time of a stage of the pipeline.", &mut stages);
    let mut memory = health.resident_mib.into_iter().map(|mib| (String::new(), mib * 1024.0 * 1024.0));
    let mut faults = std::iter::once((String::new(), health.device_faults as f64));
    family("device_faults_total", "counter", "Times that the graphics device was opened again.", &mut faults);
    family("resident_bytes", "gauge", "Resident memory.", &mut memory);
    if let Some(recorded) = recorded {
        let broken = f64::from(u8::from(recorded.problem.is_some()));
        for (name, kind, help, value) in [
            ("recording_frames_total", "counter", "Frames in the recording.", Some(recorded.frames as f64)),
            ("recording_bytes_total", "counter", "Their bytes.", Some(recorded.bytes as f64)),
            ("recording_files_total", "counter", "Files begun.", Some(f64::from(recorded.files))),
            ("recording_dropped_total", "counter", "Frames that were not recorded.", Some(recorded.dropped as f64)),
            ("recording_free_bytes", "gauge", "Free space of its disk.", recorded.free_bytes.map(|free| free as f64)),
            ("recording_broken", "gauge", "Whether the recording broke off.", Some(broken)),
        ] {
            family(name, kind, help, &mut value.into_iter().map(|value| (String::new(), value)));
        }
    }
    text
}

/// Returns the names of a rig's camera threads.
fn threads(health: &Health) -> Vec<String> {
    let of = |camera: &CameraHealth| ["camera", "stage", "open"].map(|what| format!("{what} {}", camera.stats.camera));
    health.cameras.iter().flat_map(of).collect()
}

/// Returns how often the work of each camera's threads was begun anew, by thread.
pub fn thread_restarts(health: &Health) -> Vec<(String, u64)> {
    let of = |camera: &CameraHealth| {
        let stats = &camera.stats;
        [("camera", stats.restarts), ("stage", stats.stage_restarts)]
            .map(|(what, count)| (format!("{what} {}", stats.camera), count))
    };
    health.cameras.iter().flat_map(of).collect()
}

/// Formats a snapshot as a table for the terminal.
pub fn table(health: &Health, recorded: Option<&Recorded>) -> String {
    let mut text = format!(
        "{:<14} {:>9} {:>7} {:>7} {:>7} {:>7} {:>7} {:>9} {:>9}  {}\n",
        "camera", "frames", "lost", "late", "no set", "errors", "back", "jitter ms", "late ms", "mode"
    );
    for camera in &health.cameras {
        let stats = &camera.stats;
        let late = camera.lateness_ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.1}"));
        let mut mode = match (&stats.last_error, stats.running, stats.opened) {
            (_, false, _) => "ended".to_owned(),
            (Some(error), true, false) => format!("not there: {}", error.message),
            (None, true, false) => "is being opened".to_owned(),
            (_, true, true) => stats.health.mode.to_string(),
        };
        if let Some(network) = stats.health.network {
            let offset = network.clock_offset_nanos.map(|nanos| nanos as f64 * 1e-9);
            let drift = network.clock_drift_ppb as f64 * 1e-3;
            let clock = offset
                .map_or_else(|| "clock not known yet".to_owned(), |secs| format!("clock {secs:+.4} s {drift:+.1} ppm"));
            let _ = write!(mode, "  network: {} lost, {clock}", network.lost_on_the_way);
        }
        let _ = writeln!(
            text,
            "{:<14} {:>9} {:>7} {:>7} {:>7} {:>7} {:>7} {:>9.2} {:>9}  {mode}",
            stats.camera,
            stats.frames,
            stats.health.lost_by_driver,
            stats.dropped,
            camera.in_no_set,
            stats.errors.values().sum::<u64>(),
            stats.health.reconnects,
            camera.jitter_ms,
            late
        );
    }
    let _ = writeln!(
        text,
        "sets: {} complete, {} partial, {} skipped",
        health.complete_sets, health.partial_sets, health.skipped_sets
    );
    for (thread, count) in thread_restarts(health).into_iter().filter(|(_, count)| *count > 0) {
        let _ = writeln!(text, "thread '{thread}': restarted {count} times");
    }
    for thread in &health.stuck {
        let _ = writeln!(text, "thread '{thread}': stuck");
    }
    if let Some(recorded) = recorded {
        let free = recorded.free_bytes.map_or_else(String::new, |free| format!(", {:.1} GB free", free as f64 / 1e9));
        let (frames, mb) = (recorded.frames, recorded.bytes as f64 / 1e6);
        let file = recorded.file.display();
        let _ = writeln!(text, "recording: {frames} frames, {mb:.1} MB, {} files, now {file}{free}", recorded.files);
        if let Some(problem) = &recorded.problem {
            let _ = writeln!(text, "the recording broke off: {problem}");
        }
    }
    text
}

/// A label's value may hold anything but these.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
pub mod tests {
    use std::collections::BTreeMap;

    use flyrig_capture::{CameraStats, CaptureErrorKind, SourceHealth};
    use flyrig_fusion::StageSummary;
    use flyrig_sync::ClockState;

    use super::*;

    pub fn health() -> Health {
        let stats = CameraStats {
            camera: "le\"ft".into(),
            frames: 900,
            dropped: 3,
            overtaken: 6,
            errors: BTreeMap::from([(CaptureErrorKind::Corrupt, 2)]),
            last_error: None,
            health: SourceHealth {
                lost_by_driver: 7,
                reconnects: 1,
                network: Some(flyrig_capture::NetworkHealth {
                    lost_on_the_way: 8,
                    clock_offset_nanos: Some(-1_500_000_000),
                    clock_drift_ppb: 2500,
                    ..Default::default()
                }),
                mode: "YUYV 640x360 at 30.00".into(),
                ..Default::default()
            },
            running: true,
            restarts: 0,
            stage_restarts: 0,
            opened: true,
        };
        let clock = Some(ClockState { drift_ppm: -12.5, ..ClockState::default() });
        let (interval_ms, jitter_ms, lateness_ms, quiet_s) = (33.3, 0.4, Some(12.0), Some(0.1));
        let camera = CameraHealth { stats, in_no_set: 5, interval_ms, jitter_ms, lateness_ms, quiet_s, clock };
        let stage = StageSummary { name: "draw".into(), frames: 1, mean_ms: 2.0, p50_ms: 2.0, p95_ms: 4.0 };
        let (complete_sets, partial_sets, skipped_sets) = (800, 10, 4);
        let resident_mib = Some(2.0);
        Health {
            cameras: vec![camera],
            stuck: Vec::new(),
            complete_sets,
            partial_sets,
            skipped_sets,
            stages: vec![stage],
            device_faults: 0,
            resident_mib,
        }
    }

    #[test]
    fn every_line_of_the_metrics_is_well_formed() {
        let text = prometheus(&health(), None);
        for line in [
            "flyrig_frames_total{camera=\"le\\\"ft\"} 900",
            "flyrig_camera_errors_total{camera=\"le\\\"ft\",kind=\"Corrupt\"} 2",
            "flyrig_sets_total{kind=\"partial\"} 10",
            "flyrig_lateness_seconds{camera=\"le\\\"ft\"} 0.012",
            "flyrig_clock_drift_ppm{camera=\"le\\\"ft\"} -12.5",
            "flyrig_stage_seconds{stage=\"draw\",quantile=\"0.95\"} 0.004",
            "flyrig_resident_bytes 2097152",
            "flyrig_device_faults_total 0",
            "flyrig_frames_overtaken_total{camera=\"le\\\"ft\"} 6",
            "flyrig_network_lost_total{camera=\"le\\\"ft\"} 8",
            "flyrig_host_clock_offset_seconds{camera=\"le\\\"ft\"} -1.5",
            "flyrig_host_clock_drift_ppm{camera=\"le\\\"ft\"} 2.5",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
        }
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let (name, value) = line.rsplit_once(' ').unwrap();
            assert!(name.starts_with("flyrig_") && value.parse::<f64>().is_ok(), "{line}");
            let family = name.split('{').next().unwrap();
            assert!(text.contains(&format!("# TYPE {family} ")), "{line}");
        }
    }

    #[test]
    fn threads_and_recordings_are_named() {
        let mut health = health();
        (health.cameras[0].stats.restarts, health.stuck) = (2, vec!["stage le\"ft".to_owned()]);
        let problem = Some("disk full".to_owned());
        let recorded =
            Recorded { frames: 7, bytes: 2_000_000, files: 2, free_bytes: Some(9), problem, ..Recorded::default() };
        let text = prometheus(&health, Some(&recorded));
        for line in [
            "flyrig_thread_restarts_total{thread=\"camera le\\\"ft\"} 2",
            "flyrig_thread_restarts_total{thread=\"stage le\\\"ft\"} 0",
            "flyrig_thread_stuck{thread=\"stage le\\\"ft\"} 1",
            "flyrig_thread_stuck{thread=\"camera le\\\"ft\"} 0",
            "flyrig_recording_frames_total 7",
            "flyrig_recording_bytes_total 2000000",
            "flyrig_recording_files_total 2",
            "flyrig_recording_free_bytes 9",
            "flyrig_recording_broken 1",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
        }
        let text = table(&health, Some(&recorded));
        for part in
            ["'camera le\"ft': restarted 2 times", "'stage le\"ft': stuck", "7 frames, 2.0 MB, 2 files", "disk full"]
        {
            assert!(text.contains(part), "{part} in\n{text}");
        }
    }

    #[test]
    fn a_camera_without_frames_is_down_and_tells_nothing_old() {
        let mut health = health();
        let has = |health: &Health, start: &str| prometheus(health, None).lines().any(|line| line.starts_with(start));
        assert!(has(&health, "flyrig_camera_up{camera=\"le\\\"ft\"} 1"));
        for quiet_s in [Some(60.0), None] {
            health.cameras[0].quiet_s = quiet_s;
            assert!(has(&health, "flyrig_camera_up{camera=\"le\\\"ft\"} 0"));
            assert!(!has(&health, "flyrig_lateness_seconds{") && !has(&health, "flyrig_interval_seconds{"));
        }
        // A status of another computer may hold any number.
        health.cameras[0].stats.health.stamps_replaced = u64::MAX;
        health.cameras[0].clock = Some(ClockState { replaced: 7, ..ClockState::default() });
        assert!(has(&health, "flyrig_stamps_replaced_total{"));
    }

    #[test]
    fn the_table_has_a_row_a_camera() {
        let table = table(&health(), None);
        let row = table.lines().nth(1).unwrap();
        let cells: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(cells[..9], ["le\"ft", "900", "7", "3", "5", "2", "1", "0.40", "12.0"]);
        assert!(row.ends_with("  YUYV 640x360 at 30.00  network: 8 lost, clock -1.5000 s +2.5 ppm"), "{row}");
        assert_eq!(table.lines().last(), Some("sets: 800 complete, 10 partial, 4 skipped"));
    }
}
