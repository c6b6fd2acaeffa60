//! Table of a rig's health for the terminal.

use std::fmt::Write as _;

use flyrig_calib::WatchState;
use flyrig_capture::Recorded;
use flyrig_fusion::{CameraHealth, Health};
use flyrig_transport::{BudgetStats, LearningStats};

/// Returns the names of a rig's camera threads.
pub fn threads(health: &Health) -> Vec<String> {
    let of = |camera: &CameraHealth| ["camera", "stage", "open"].map(|what| format!("{what} {}", camera.stats.camera));
    health.cameras.iter().flat_map(of).collect()
}

/// Returns how often the work of each thread was restarted, by thread.
pub fn thread_restarts(health: &Health) -> Vec<(String, u64)> {
    let of = |camera: &CameraHealth| {
        let stats = &camera.stats;
        [("camera", stats.restarts), ("stage", stats.stage_restarts)]
            .map(|(what, count)| (format!("{what} {}", stats.camera), count))
    };
    let others = health.threads.iter().map(|thread| (thread.name.clone(), thread.restarts));
    health.cameras.iter().flat_map(of).chain(others).collect()
}

/// Least silence of a camera that is reported, seconds.
const SILENT_FROM_S: f64 = 5.0;

/// Returns the time since the last frame of an open camera, seconds; `None` while it is too short to report.
pub fn silence_s(camera: &CameraHealth) -> Option<f64> {
    let is_open = camera.stats.running && camera.stats.opened;
    camera.quiet_s.filter(|quiet| is_open && *quiet >= SILENT_FROM_S.max(5e-3 * camera.interval_ms))
}

/// Formats the progress of learning.
fn learnt(LearningStats { version, key_sets, rounds, seconds, gain }: LearningStats) -> String {
    let version = match (version, gain) {
        (0, _) => "no version yet".to_owned(),
        (version, None) => format!("version {version}"),
        (version, Some(gain)) => format!("version {version}, error {:.0} % lower", 100.0 * gain),
    };
    format!("{version}, {key_sets} key sets, {rounds} rounds in {seconds:.0} s")
}

/// Formats the level of effort with which a budget is kept.
pub fn effort(budget: BudgetStats) -> String {
    format!("effort {} of {}", budget.levels.saturating_sub(budget.level), budget.levels)
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
            (Some(error), true, true) if stats.frames == 0 => format!("no frame yet: {}", error.message),
            (_, true, true) => stats.health.mode.to_string(),
        };
        if let Some(seconds) = silence_s(camera) {
            let _ = write!(mode, "  silent for {seconds:.0} s");
        }
        if let Some(rate) = stats.rate.filter(|rate| rate.is_slow() && camera.is_up()) {
            let _ = write!(mode, "  slow: {:.1} of {:.1} per second", rate.measured_fps, rate.mode_fps);
        }
        if let WatchState::Moved(motion) = camera.watch {
            let _ = write!(mode, "  moved: {:.1} px", motion.pixels);
        }
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
    if let Some(budget) = health.budget {
        let (fps, ms) = (budget.fps, 1e3 * budget.set_secs);
        let _ = writeln!(text, "budget: {fps} frame sets per second, {}, {ms:.0} ms each", effort(budget));
    }
    if let Some(learning) = health.learning {
        let _ = writeln!(text, "learning: {}", learnt(learning));
    }
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
        if let Some(problem) = recorded.problem.as_ref().or(recorded.paused.as_ref()) {
            let _ = writeln!(text, "the recording broke off: {problem}");
        }
    }
    text
}

#[cfg(test)]
pub mod tests {
    use std::collections::BTreeMap;

    use flyrig_calib::CameraMotion;
    use flyrig_capture::{CameraStats, CaptureErrorKind, FrameRate, SourceHealth};
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
            rate: Some(FrameRate { mode_fps: 30.0, measured_fps: 15.0 }),
            running: true,
            restarts: 0,
            stage_restarts: 0,
            opened: true,
        };
        let clock = Some(ClockState { drift_ppm: -12.5, ..ClockState::default() });
        let rotation = glam::DVec3::new(0.0, 0.01, 0.0);
        let watch = WatchState::Moved(CameraMotion { rotation, pixels: 9.5, agreeing: (80, 96) });
        let (interval_ms, jitter_ms, lateness_ms, quiet_s) = (33.3, 0.4, Some(12.0), Some(0.1));
        let camera = CameraHealth { stats, in_no_set: 5, interval_ms, jitter_ms, lateness_ms, quiet_s, clock, watch };
        let stage =
            StageSummary { name: "draw".into(), frames: 1, mean_ms: 2.0, p50_ms: 2.0, p95_ms: 4.0, p99_ms: 4.0 };
        let (complete_sets, partial_sets, skipped_sets) = (800, 10, 4);
        let resident_mib = Some(2.0);
        Health {
            cameras: vec![camera],
            stuck: Vec::new(),
            threads: Vec::new(),
            complete_sets,
            partial_sets,
            skipped_sets,
            stages: vec![stage],
            budget: Some(BudgetStats { fps: 5.0, level: 2, levels: 7, set_secs: 0.15 }),
            learning: Some(LearningStats { version: 2, key_sets: 24, rounds: 4, seconds: 81.4, gain: Some(0.123) }),
            device_faults: 0,
            resident_mib,
        }
    }

    #[test]
    fn the_table_names_threads_and_recordings() {
        let mut health = health();
        (health.cameras[0].stats.restarts, health.stuck) = (2, vec!["stage le\"ft".to_owned()]);
        let problem = Some("disk full".to_owned());
        let recorded =
            Recorded { frames: 7, bytes: 2_000_000, files: 2, free_bytes: Some(9), problem, ..Recorded::default() };
        let text = table(&health, Some(&recorded));
        for part in [
            "moved: 9.5 px",
            "'camera le\"ft': restarted 2 times",
            "'stage le\"ft': stuck",
            "7 frames, 2.0 MB, 2 files",
            "disk full",
        ] {
            assert!(text.contains(part), "{part} in\n{text}");
        }
        assert!(!text.contains("silent"));
        health.cameras[0].quiet_s = Some(12.0);
        assert!(table(&health, None).contains("  silent for 12 s"));
        // A slow camera is silent later, one that is gone says so itself.
        health.cameras[0].interval_ms = 5000.0;
        assert!(!table(&health, None).contains("silent"));
        (health.cameras[0].interval_ms, health.cameras[0].stats.opened) = (33.3, false);
        assert!(!table(&health, None).contains("silent"));
    }

    #[test]
    fn learning_without_a_version_is_told() {
        let none = LearningStats { key_sets: 3, ..LearningStats::default() };
        assert_eq!(learnt(none), "no version yet, 3 key sets, 0 rounds in 0 s");
        assert_eq!(learnt(LearningStats { version: 1, ..none }), "version 1, 3 key sets, 0 rounds in 0 s");
    }

    #[test]
    fn the_table_has_a_row_a_camera() {
        let table = table(&health(), None);
        let row = table.lines().nth(1).unwrap();
        let cells: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(cells[..9], ["le\"ft", "900", "7", "3", "5", "2", "1", "0.40", "12.0"]);
        assert!(
            row.ends_with("  YUYV 640x360 at 30.00  slow: 15.0 of 30.0 per second  moved: 9.5 px  network: 8 lost, clock -1.5000 s +2.5 ppm"),
            "{row}"
        );
        let last: Vec<&str> = table.lines().skip(2).collect();
        assert_eq!(
            last,
            [
                "sets: 800 complete, 10 partial, 4 skipped",
                "budget: 5 frame sets per second, effort 5 of 7, 150 ms each",
                "learning: version 2, error 12 % lower, 24 key sets, 4 rounds in 81 s"
            ]
        );
    }
}
