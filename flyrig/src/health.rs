//! How the rig is: one snapshot for the terminal and for Prometheus.

use std::{
    fmt::Write as _,
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::{Builder, JoinHandle},
    time::Duration,
};

use anyhow::{Context as _, Result};
use flyrig_calib::ClockState;
use flyrig_capture::CameraStats;

use crate::stats::StageSummary;

/// Longest that a client may take to ask or to read.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest request that is read.
const REQUEST_BYTES: usize = 8192;
/// How often the server looks whether it shall stop.
const LOOK: Duration = Duration::from_millis(100);

/// One camera.
#[derive(Debug, Clone)]
pub struct CameraHealth {
    pub stats: CameraStats,
    /// Frames that came into no set.
    pub in_no_set: u64,
    /// Capture times: mean interval and its standard deviation, milliseconds.
    pub interval_ms: f64,
    pub jitter_ms: f64,
    /// From the capture to the synchronizer, milliseconds; known for cameras of this computer.
    pub lateness_ms: Option<f64>,
    /// For cameras with clocks of their own.
    pub clock: Option<ClockState>,
}

/// The rig.
#[derive(Debug, Clone)]
pub struct Health {
    pub cameras: Vec<CameraHealth>,
    pub complete_sets: u64,
    pub partial_sets: u64,
    /// Sets that were older than the newest when the pipeline could take one.
    pub skipped_sets: u64,
    pub stages: Vec<StageSummary>,
    pub resident_mib: Option<f64>,
}

impl Health {
    /// In Prometheus' text format 0.0.4.
    pub fn prometheus(&self) -> String {
        let mut text = String::new();
        let mut family = |name: &str, kind: &str, help: &str, samples: &mut dyn Iterator<Item = (String, f64)>| {
            let _ = writeln!(text, "# HELP flyrig_{name} {help}\n# TYPE flyrig_{name} {kind}");
            for (labels, value) in samples {
                let _ = writeln!(text, "flyrig_{name}{labels} {value}");
            }
        };
        let label = |camera: &CameraHealth| format!("{{camera=\"{}\"}}", escaped(camera.stats.camera.as_str()));
        type Field<'a> = &'a dyn Fn(&CameraHealth) -> Option<f64>;
        let per_camera: [(&str, &str, &str, Field<'_>); 20] = [
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
                Some((c.stats.health.stamps_replaced + c.clock.map_or(0, |clock| clock.replaced)) as f64)
            }),
            ("camera_up", "gauge", "Whether the camera's thread reads.", &|c| {
                Some(f64::from(u8::from(c.stats.running)))
            }),
            ("interval_seconds", "gauge", "Mean time between captures.", &|c| Some(c.interval_ms / 1e3)),
            ("jitter_seconds", "gauge", "Standard deviation of the time between captures.", &|c| {
                Some(c.jitter_ms / 1e3)
            }),
            ("lateness_seconds", "gauge", "From capture to synchronizer.", &|c| c.lateness_ms.map(|ms| ms / 1e3)),
            ("clock_drift_ppm", "gauge", "Drift against the master's clock.", &|c| {
                c.clock.map(|clock| clock.drift_ppm)
            }),
            ("frames_overtaken_total", "counter", "Frames overtaken before they were decoded.", &|c| {
                Some(c.stats.overtaken as f64)
            }),
            ("network_overtaken_before_total", "counter", "Frames overtaken on the camera's computer.", &|c| {
                c.stats.health.network.map(|n| n.overtaken_before as f64)
            }),
            ("network_lost_total", "counter", "Frames that left the camera's computer and never came.", &|c| {
                c.stats.health.network.map(|n| n.lost_on_the_way as f64)
            }),
            ("network_overtaken_here_total", "counter", "Frames overtaken after they had come.", &|c| {
                c.stats.health.network.map(|n| n.overtaken_here as f64)
            }),
            ("network_refused_total", "counter", "Messages that could not be used.", &|c| {
                c.stats.health.network.map(|n| (n.refused + n.before_clock) as f64)
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
            let mut samples = self.cameras.iter().filter_map(|camera| Some((label(camera), field(camera)?)));
            family(name, kind, help, &mut samples);
        }
        let mut errors = self.cameras.iter().flat_map(|camera| {
            let name = escaped(camera.stats.camera.as_str());
            let labels = move |kind| format!("{{camera=\"{name}\",kind=\"{kind:?}\"}}");
            camera.stats.errors.iter().map(move |(kind, count)| (labels(kind), *count as f64))
        });
        family("camera_errors_total", "counter", "Errors of cameras by kind.", &mut errors);
        let sets = [("complete", self.complete_sets), ("partial", self.partial_sets), ("skipped", self.skipped_sets)];
        let mut sets = sets.into_iter().map(|(kind, count)| (format!("{{kind=\"{kind}\"}}"), count as f64));
        family("sets_total", "counter", "Sets of frames.", &mut sets);
        let mut stages = self.stages.iter().flat_map(|stage| {
            let name = escaped(&stage.name);
            [("0.5", stage.p50_ms), ("0.95", stage.p95_ms)]
                .map(|(quantile, ms)| (format!("{{stage=\"{name}\",quantile=\"{quantile}\"}}"), f64::from(ms) / 1e3))
        });
        family("stage_seconds", "gauge", "Time of a stage of the pipeline.", &mut stages);
        let mut memory = self.resident_mib.into_iter().map(|mib| (String::new(), mib * 1024.0 * 1024.0));
        family("resident_bytes", "gauge", "Resident memory.", &mut memory);
        text
    }

    /// As a table for the terminal.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{:<14} {:>9} {:>7} {:>7} {:>7} {:>7} {:>7} {:>9} {:>9}  {}\n",
            "camera", "frames", "lost", "late", "no set", "errors", "back", "jitter ms", "late ms", "mode"
        );
        for camera in &self.cameras {
            let stats = &camera.stats;
            let late = camera.lateness_ms.map_or_else(|| "-".to_owned(), |ms| format!("{ms:.1}"));
            let mut mode = if stats.running { stats.health.mode.to_string() } else { "ended".to_owned() };
            if let Some(network) = stats.health.network {
                let offset = network.clock_offset_nanos.map(|nanos| nanos as f64 * 1e-9);
                let drift = network.clock_drift_ppb as f64 * 1e-3;
                let clock = offset.map_or_else(
                    || "clock not known yet".to_owned(),
                    |secs| format!("clock {secs:+.4} s {drift:+.1} ppm"),
                );
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
            self.complete_sets, self.partial_sets, self.skipped_sets
        );
        text
    }
}

/// A label's value may hold anything but these.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

/// Answers every HTTP request with the text published last, one client at a time.
pub struct MetricsServer {
    text: Arc<Mutex<String>>,
    stop: Arc<AtomicBool>,
    address: SocketAddr,
    thread: Option<JoinHandle<()>>,
}

impl MetricsServer {
    /// Listens on an address; port 0 takes a free one.
    ///
    /// # Errors
    /// Names the address when it is taken.
    pub fn start(address: &str) -> Result<Self> {
        let listener =
            TcpListener::bind(address).with_context(|| format!("health.listen: cannot listen on {address}"))?;
        listener.set_nonblocking(true)?;
        let (text, stop) = (Arc::new(Mutex::new(String::new())), Arc::new(AtomicBool::new(false)));
        let address = listener.local_addr()?;
        let (of_thread, stopped) = (Arc::clone(&text), Arc::clone(&stop));
        let serve = move || {
            while !stopped.load(Ordering::Relaxed) {
                match listener.accept() {
                    Ok((client, _)) => {
                        let text = lock(&of_thread).clone();
                        // A client that asks badly is its own loss.
                        let _ = answer(client, &text);
                    }
                    Err(_) => std::thread::sleep(LOOK),
                }
            }
        };
        let thread = Some(Builder::new().name("metrics".to_owned()).spawn(serve)?);
        Ok(Self { text, stop, address, thread })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What is answered from now on.
    pub fn publish(&self, text: String) {
        *lock(&self.text) = text;
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn answer(mut client: TcpStream, text: &str) -> std::io::Result<()> {
    client.set_nonblocking(false)?;
    client.set_read_timeout(Some(PATIENCE))?;
    client.set_write_timeout(Some(PATIENCE))?;
    let mut request = Vec::new();
    let mut piece = [0; 512];
    while !request.windows(4).any(|window| window == b"\r\n\r\n") && request.len() < REQUEST_BYTES {
        match client.read(&mut piece)? {
            0 => break,
            read => request.extend_from_slice(&piece[..read]),
        }
    }
    let (status, body) = if request.starts_with(b"GET /metrics ") || request.starts_with(b"GET / ") {
        ("200 OK", text)
    } else {
        ("404 Not Found", "the metrics are at /metrics\n")
    };
    write!(
        client,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n{body}",
        body.len()
    )
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use flyrig_capture::{CaptureErrorKind, SourceHealth};

    use super::*;

    fn health() -> Health {
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
        };
        let clock = Some(ClockState { drift_ppm: -12.5, ..ClockState::default() });
        let (interval_ms, jitter_ms, lateness_ms) = (33.3, 0.4, Some(12.0));
        let camera = CameraHealth { stats, in_no_set: 5, interval_ms, jitter_ms, lateness_ms, clock };
        let stage = StageSummary { name: "draw".into(), frames: 1, mean_ms: 2.0, p50_ms: 2.0, p95_ms: 4.0 };
        let (complete_sets, partial_sets, skipped_sets) = (800, 10, 4);
        let resident_mib = Some(2.0);
        Health { cameras: vec![camera], complete_sets, partial_sets, skipped_sets, stages: vec![stage], resident_mib }
    }

    #[test]
    fn every_line_of_the_metrics_is_well_formed() {
        let text = health().prometheus();
        for line in [
            "flyrig_frames_total{camera=\"le\\\"ft\"} 900",
            "flyrig_camera_errors_total{camera=\"le\\\"ft\",kind=\"Corrupt\"} 2",
            "flyrig_sets_total{kind=\"partial\"} 10",
            "flyrig_lateness_seconds{camera=\"le\\\"ft\"} 0.012",
            "flyrig_clock_drift_ppm{camera=\"le\\\"ft\"} -12.5",
            "flyrig_stage_seconds{stage=\"draw\",quantile=\"0.95\"} 0.004",
            "flyrig_resident_bytes 2097152",
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
    fn the_table_has_a_row_a_camera() {
        let table = health().table();
        let row = table.lines().nth(1).unwrap();
        let cells: Vec<&str> = row.split_whitespace().collect();
        assert_eq!(cells[..9], ["le\"ft", "900", "7", "3", "5", "2", "1", "0.40", "12.0"]);
        assert!(row.ends_with("  YUYV 640x360 at 30.00  network: 8 lost, clock -1.5000 s +2.5 ppm"), "{row}");
        assert_eq!(table.lines().last(), Some("sets: 800 complete, 10 partial, 4 skipped"));
    }

    fn ask(server: &MetricsServer, request: &str) -> String {
        let mut client = TcpStream::connect(server.address()).unwrap();
        client.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn clients_get_the_newest_text_and_bad_ones_do_no_harm() {
        let server = MetricsServer::start("127.0.0.1:0").unwrap();
        server.publish("flyrig_frames_total 1\n".to_owned());
        // Gone before the answer.
        drop(TcpStream::connect(server.address()).unwrap());
        let answer = ask(&server, "GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n");
        assert!(
            answer.starts_with("HTTP/1.1 200 OK\r\n") && answer.ends_with("\r\n\r\nflyrig_frames_total 1\n"),
            "{answer}"
        );
        assert!(ask(&server, "GET /secrets HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 404"));
        server.publish("flyrig_frames_total 2\n".to_owned());
        assert!(ask(&server, "GET / HTTP/1.0\r\n\r\n").ends_with("flyrig_frames_total 2\n"));
        let taken = MetricsServer::start(&server.address().to_string()).err().unwrap();
        assert!(format!("{taken:#}").contains("health.listen: cannot listen on 127.0.0.1"), "{taken:#}");
    }
}
