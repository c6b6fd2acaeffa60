//! Metrics of a rig's health, as OpenMetrics text for Prometheus.

use std::fmt;

use flyrig_calib::WatchState;
use flyrig_capture::{NetworkHealth, Recorded};
use flyrig_fusion::{CameraHealth, Health};
use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeGaugeValue, EncodeLabelSet, EncodeMetric as _, text},
    metrics::{MetricType, counter::ConstCounter, gauge::ConstGauge},
    registry::Registry,
};

use crate::table;

/// Media type of the text.
pub const KIND: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Days until the next key and the rig's certificate end, where they are known.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct KeyDays {
    /// Days until the next of the keys ends.
    pub next_key: Option<f64>,
    /// Days until the rig's certificate ends; negative afterwards.
    pub certificate: Option<f64>,
}

/// Formats a snapshot, the state of a recording where there is one, and the ends of keys as OpenMetrics text.
pub fn prometheus(health: &Health, recorded: Option<&Recorded>, keys: KeyDays) -> String {
    let mut registry = Registry::with_prefix("flyrig");
    registry.register_collector(Box::new(Snapshot { health: health.clone(), recorded: recorded.cloned(), keys }));
    let mut page = String::new();
    match text::encode(&mut page, &registry) {
        Ok(()) => page,
        // Writing to a string does not fail; a comment keeps the page well-formed all the same.
        Err(error) => format!("# the metrics could not be written: {error}\n# EOF\n"),
    }
}

/// State that one answer shows.
#[derive(Debug)]
struct Snapshot {
    health: Health,
    recorded: Option<Recorded>,
    keys: KeyDays,
}

/// Name and help of a family of counters, and its value for a camera that has one.
type Counter = (&'static str, &'static str, fn(&CameraHealth) -> Option<u64>);
/// Name and help of a family of gauges, and its value for a camera that has one.
type Gauge = (&'static str, &'static str, fn(&CameraHealth) -> Option<f64>);

/// Returns the state of the link to a camera's computer, where there is one.
fn network(camera: &CameraHealth) -> Option<NetworkHealth> {
    camera.stats.health.network
}

/// Returns the state of the link to a camera's computer; `None` until its clock is known.
fn with_clock(camera: &CameraHealth) -> Option<NetworkHealth> {
    network(camera).filter(|network| network.clock_offset_nanos.is_some())
}

// The library adds "_total" to the name of a counter.
const CAMERA_COUNTERS: [Counter; 12] = [
    ("frames", "Frames that came.", |c| Some(c.stats.frames)),
    ("frames_lost_before_us", "Frames numbered by the driver that never arrived.", |c| {
        Some(c.stats.health.lost_by_driver)
    }),
    ("frames_waited_too_long", "Frames dropped because the rig was busy.", |c| Some(c.stats.dropped)),
    ("frames_in_no_set", "Frames that fitted into no set.", |c| Some(c.in_no_set)),
    ("reconnects", "Times that the camera came back.", |c| Some(c.stats.health.reconnects)),
    ("silences", "Times that the camera stopped without an error.", |c| Some(c.stats.health.silences)),
    ("stamps_replaced", "Time stamps that could not be right.", |c| {
        let of_clock = c.clock.map_or(0, |clock| clock.replaced);
        Some(c.stats.health.stamps_replaced.saturating_add(of_clock))
    }),
    ("frames_overtaken", "Frames overtaken before they were decoded.", |c| Some(c.stats.overtaken)),
    ("network_overtaken_before", "Frames that stayed on the camera's computer.", |c| {
        network(c).map(|n| n.overtaken_before)
    }),
    ("network_lost", "Frames that left the camera's computer and never came.", |c| {
        network(c).map(|n| n.lost_on_the_way)
    }),
    ("network_overtaken_here", "Frames overtaken after they had come.", |c| network(c).map(|n| n.overtaken_here)),
    ("network_refused", "Messages that could not be used.", |c| {
        network(c).map(|n| n.refused.saturating_add(n.before_clock))
    }),
];

const CAMERA_GAUGES: [Gauge; 10] = [
    ("quiet_seconds", "Since the last frame.", |c| c.quiet_s),
    ("interval_seconds", "Mean time between captures.", |c| {
        (c.is_up() && c.interval_ms > 0.0).then_some(c.interval_ms / 1e3)
    }),
    ("rate_ratio", "Rate of captures over that of the camera's mode.", |c| {
        c.stats.rate.filter(|_| c.is_up()).map(|rate| rate.ratio())
    }),
    ("moved_pixels", "How far its image lies from where it was calibrated; 0: it was not moved.", |c| match c.watch {
        WatchState::Unknown => None,
        WatchState::Steady => Some(0.0),
        WatchState::Moved(motion) => Some(motion.pixels),
    }),
    ("jitter_seconds", "Standard deviation of the time between captures.", |c| {
        (c.is_up() && c.interval_ms > 0.0).then_some(c.jitter_ms / 1e3)
    }),
    ("lateness_seconds", "From capture to synchronizer.", |c| c.lateness_ms.filter(|_| c.is_up()).map(|ms| ms / 1e3)),
    ("clock_drift_ppm", "Drift against the master's clock.", |c| c.clock.map(|clock| clock.drift_ppm)),
    ("host_clock_offset_seconds", "Clock of the camera's computer minus ours.", |c| {
        Some(network(c)?.clock_offset_nanos? as f64 * 1e-9)
    }),
    ("host_clock_drift_ppm", "How much faster that clock runs.", |c| {
        with_clock(c).map(|n| n.clock_drift_ppb as f64 * 1e-3)
    }),
    ("host_round_trip_seconds", "Shortest round trip to that computer.", |c| {
        with_clock(c).map(|n| n.round_trip_nanos as f64 * 1e-9)
    }),
];

impl Collector for Snapshot {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let (health, mut page) = (&self.health, Page(encoder));
        let cameras = || health.cameras.iter().map(|camera| ([("camera", camera.stats.camera.as_str())], camera));
        for (name, help, field) in CAMERA_COUNTERS {
            page.counters(name, help, cameras().filter_map(|(labels, camera)| Some((labels, field(camera)?))))?;
        }
        page.gauges("camera_up", "Whether frames come.", cameras().map(|(labels, c)| (labels, i64::from(c.is_up()))))?;
        for (name, help, field) in CAMERA_GAUGES {
            page.gauges(name, help, cameras().filter_map(|(labels, camera)| Some((labels, field(camera)?))))?;
        }
        let errors = cameras().flat_map(|([(key, name)], camera)| {
            let labels = move |kind| [(key, name.to_owned()), ("kind", format!("{kind:?}"))];
            camera.stats.errors.iter().map(move |(kind, count)| (labels(kind), *count))
        });
        page.counters("camera_errors", "Errors of cameras by kind.", errors)?;
        let restarts = table::thread_restarts(health);
        let restarts = restarts.iter().map(|(thread, count)| ([("thread", thread.as_str())], *count));
        page.counters("thread_restarts", "Restarts of a thread after a panic.", restarts)?;
        let threads = table::threads(health);
        let stuck =
            threads.iter().map(|thread| ([("thread", thread.as_str())], i64::from(health.stuck.contains(thread))));
        page.gauges("thread_stuck", "Whether a thread hangs.", stuck)?;
        let sets =
            [("complete", health.complete_sets), ("partial", health.partial_sets), ("skipped", health.skipped_sets)];
        page.counters("sets", "Sets of frames.", sets.map(|(kind, count)| ([("kind", kind)], count)))?;
        let stages = health.stages.iter().flat_map(|stage| {
            [("0.5", stage.p50_ms), ("0.95", stage.p95_ms), ("0.99", stage.p99_ms)]
                .map(|(quantile, ms)| ([("stage", stage.name.as_str()), ("quantile", quantile)], f64::from(ms) / 1e3))
        });
        page.gauges("stage_seconds", "Time of a stage of the pipeline.", stages)?;
        if let Some(budget) = health.budget {
            page.gauge("effort_level", "What is left out to keep to the budget; 0: nothing.", i64::from(budget.level))?;
            page.gauge("budget_rate", "Requested frame sets per second.", budget.fps)?;
            page.gauge("set_seconds", "Smoothed cost of a set.", budget.set_secs)?;
        }
        if let Some(learning) = health.learning {
            page.gauge("learnt_version", "Version of the person in use; 0: its surface.", i64::from(learning.version))?;
            page.gauge("learning_key_sets", "Sets that the person is learnt from.", i64::from(learning.key_sets))?;
            page.counter("learning_rounds", "Rounds of fitting.", u64::from(learning.rounds))?;
            page.gauge("learning_seconds", "Time of fitting and comparing.", learning.seconds)?;
            if let Some(gain) = learning.gain {
                page.gauge(
                    "learnt_gain",
                    "Share by which the version in use reduced the error when it was adopted.",
                    gain,
                )?;
            }
        }
        page.counter("device_faults", "Times that the graphics device was opened again.", health.device_faults)?;
        if let Some(mib) = health.resident_mib {
            page.gauge("resident_bytes", "Resident memory.", (mib * 1024.0 * 1024.0) as u64)?;
        }
        if let Some(days) = self.keys.next_key {
            page.gauge("key_end_days", "Days until the next key ends.", days)?;
        }
        if let Some(days) = self.keys.certificate {
            page.gauge("certificate_end_days", "Days until the rig's certificate ends.", days)?;
        }
        let Some(recorded) = &self.recorded else { return Ok(()) };
        page.counter("recording_frames", "Frames in the recording.", recorded.frames)?;
        page.counter("recording_bytes", "Their bytes.", recorded.bytes)?;
        page.counter("recording_files", "Files begun.", u64::from(recorded.files))?;
        page.counter("recording_dropped", "Frames that were not recorded.", recorded.dropped)?;
        if let Some(free) = recorded.free_bytes {
            page.gauge("recording_free_bytes", "Free space of its disk.", free)?;
        }
        let is_broken = recorded.problem.is_some() || recorded.paused.is_some();
        page.gauge("recording_broken", "Whether the recording broke off or waits for space.", i64::from(is_broken))
    }
}

/// Writer of families of metrics.
struct Page<'a>(DescriptorEncoder<'a>);

impl Page<'_> {
    fn counters<L: EncodeLabelSet>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (L, u64)>,
    ) -> fmt::Result {
        let mut family = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        samples
            .into_iter()
            .try_for_each(|(labels, value)| ConstCounter::new(value).encode(family.encode_family(&labels)?))
    }

    fn counter(&mut self, name: &str, help: &str, value: u64) -> fmt::Result {
        ConstCounter::new(value).encode(self.0.encode_descriptor(name, help, None, MetricType::Counter)?)
    }

    fn gauges<L: EncodeLabelSet, V: EncodeGaugeValue>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (L, V)>,
    ) -> fmt::Result {
        let mut family = self.0.encode_descriptor(name, help, None, MetricType::Gauge)?;
        samples
            .into_iter()
            .try_for_each(|(labels, value)| ConstGauge::new(value).encode(family.encode_family(&labels)?))
    }

    fn gauge<V: EncodeGaugeValue>(&mut self, name: &str, help: &str, value: V) -> fmt::Result {
        ConstGauge::new(value).encode(self.0.encode_descriptor(name, help, None, MetricType::Gauge)?)
    }
}

#[cfg(test)]
mod tests {
    use flyrig_sync::ClockState;
    use flyrig_types::ThreadHealth;

    use super::*;
    use crate::table::tests::health;

    #[test]
    fn every_line_of_the_metrics_is_well_formed() {
        let text = prometheus(&health(), None, KeyDays { next_key: Some(6.5), certificate: Some(3649.0) });
        for line in [
            "flyrig_frames_total{camera=\"le\\\"ft\"} 900",
            "flyrig_camera_errors_total{camera=\"le\\\"ft\",kind=\"Corrupt\"} 2",
            "flyrig_sets_total{kind=\"partial\"} 10",
            "flyrig_lateness_seconds{camera=\"le\\\"ft\"} 0.012",
            "flyrig_rate_ratio{camera=\"le\\\"ft\"} 0.5",
            "flyrig_clock_drift_ppm{camera=\"le\\\"ft\"} -12.5",
            "flyrig_stage_seconds{stage=\"draw\",quantile=\"0.95\"} 0.004",
            "flyrig_resident_bytes 2097152",
            "flyrig_device_faults_total 0",
            "flyrig_effort_level 2",
            "flyrig_budget_rate 5.0",
            "flyrig_set_seconds 0.15",
            "flyrig_learnt_version 2",
            "flyrig_learning_key_sets 24",
            "flyrig_learning_rounds_total 4",
            "flyrig_learning_seconds 81.4",
            "flyrig_learnt_gain 0.123",
            "flyrig_frames_overtaken_total{camera=\"le\\\"ft\"} 6",
            "flyrig_network_lost_total{camera=\"le\\\"ft\"} 8",
            "flyrig_host_clock_offset_seconds{camera=\"le\\\"ft\"} -1.5",
            "flyrig_host_clock_drift_ppm{camera=\"le\\\"ft\"} 2.5",
            "flyrig_key_end_days 6.5",
            "flyrig_certificate_end_days 3649.0",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
        }
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let (name, value) = line.rsplit_once(' ').unwrap();
            assert!(name.starts_with("flyrig_") && value.parse::<f64>().is_ok(), "{line}");
            let family = name.split('{').next().unwrap();
            // OpenMetrics names the family of a counter without the suffix of its samples.
            let (family, kind) = family.strip_suffix("_total").map_or((family, "gauge"), |family| (family, "counter"));
            assert!(text.contains(&format!("\n# TYPE {family} {kind}\n")), "{line}");
        }
        assert!(text.ends_with("\n# EOF\n"), "{text}");
        let types = || text.lines().filter(|line| line.starts_with("# TYPE "));
        assert_eq!(types().count(), types().collect::<std::collections::BTreeSet<_>>().len(), "{text}");
    }

    #[test]
    fn threads_and_recordings_are_named() {
        let mut health = health();
        (health.cameras[0].stats.restarts, health.stuck) = (2, vec!["stage le\"ft".to_owned()]);
        health.threads = vec![ThreadHealth { name: "encode".to_owned(), restarts: 3, ..ThreadHealth::default() }];
        let problem = Some("disk full".to_owned());
        let recorded =
            Recorded { frames: 7, bytes: 2_000_000, files: 2, free_bytes: Some(9), problem, ..Recorded::default() };
        let text = prometheus(&health, Some(&recorded), KeyDays::default());
        for line in [
            "flyrig_thread_restarts_total{thread=\"camera le\\\"ft\"} 2",
            "flyrig_thread_restarts_total{thread=\"stage le\\\"ft\"} 0",
            "flyrig_thread_restarts_total{thread=\"encode\"} 3",
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
    }

    #[test]
    fn a_camera_without_frames_is_down_and_tells_nothing_old() {
        let mut health = health();
        let has = |health: &Health, start: &str| {
            prometheus(health, None, KeyDays::default()).lines().any(|line| line.starts_with(start))
        };
        assert!(has(&health, "flyrig_camera_up{camera=\"le\\\"ft\"} 1"));
        for quiet_s in [Some(60.0), None] {
            health.cameras[0].quiet_s = quiet_s;
            assert!(has(&health, "flyrig_camera_up{camera=\"le\\\"ft\"} 0"));
            assert!(!has(&health, "flyrig_rate_ratio{"));
            assert!(!has(&health, "flyrig_lateness_seconds{") && !has(&health, "flyrig_interval_seconds{"));
        }
        // A status of another computer may hold any number.
        health.cameras[0].stats.health.stamps_replaced = u64::MAX;
        health.cameras[0].clock = Some(ClockState { replaced: 7, ..ClockState::default() });
        assert!(has(&health, "flyrig_stamps_replaced_total{"));
    }

    #[test]
    fn no_name_of_a_camera_breaks_the_page() {
        let mut health = health();
        health.cameras[0].stats.camera = "a\\b\"} 1\nflyrig_frames_total 7\r".into();
        let text = prometheus(&health, None, KeyDays::default());
        assert!(
            text.contains("flyrig_frames_total{camera=\"a\\\\b\\\"} 1\\nflyrig_frames_total 7\r\"} 900\n"),
            "{text}"
        );
        assert!(!text.split('\n').any(|line| line.starts_with("flyrig_frames_total 7")), "{text}");
    }
}
