//! `flyrig capture`: the cameras of this computer, for a rig that runs on another one.

use std::{
    path::Path,
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use anyhow::{Result, ensure};
use flyrig_capture::{
    CameraSource, CameraStats, CaptureThreads, FrameStage, JpegEncoding, Pacing, PopError, ThreadsConfig,
};
use flyrig_fusion::{CameraHealth, Health, resident_mib};
use flyrig_gpu::GpuContext;
use flyrig_report::stop;
use flyrig_transport::{CameraPublisher, CameraStatus};
use flyrig_types::{CameraId, Frame};

use crate::{
    config::{Config, SourceKind},
    health, live,
    metrics_server::MetricsServer,
    network,
    notify::ServiceManager,
    source,
};

/// How often cameras tell how they are.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// How often a line with counts is printed.
const PRINT_EVERY: Duration = Duration::from_secs(5);
/// A camera without frames for so long has a problem to tell.
const SILENT: Duration = Duration::from_secs(1);

/// Runs the command until it is stopped or every recorded camera has ended.
pub fn capture(config: &Config, gpu: Option<&GpuContext>) -> Result<()> {
    let stop = stop::flag();
    let kind = config.source.kind;
    ensure!(kind != SourceKind::Network, "source.kind is \"network\": these cameras are on the network already");
    let sources =
        if kind == SourceKind::Cameras { live::open(&config.source)? } else { source::open(config, gpu)?.cameras };
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    let threads = start(config, sources)?;
    let clock = network::host_clock();
    let publisher = CameraPublisher::open(&config.transport(), &cameras, clock.clone())?;
    let metrics = match config.health.listen.as_str() {
        "" => None,
        address => Some(MetricsServer::start(address)?),
    };
    eprintln!(
        "capture: {} cameras of rig '{}', listening on {} (Ctrl-C ends)",
        cameras.len(),
        config.rig.name,
        publisher.endpoints().join(", ")
    );
    let manager = ServiceManager::from_env();
    manager.tell("READY=1");
    let host = host_name();
    // Stamps of what was recorded or simulated are of another time; played now, it is taken now.
    let mut shift = (kind == SourceKind::Cameras).then_some(0i64);
    let mut last_frame: Vec<Option<Instant>> = vec![None; cameras.len()];
    let (mut told, mut printed): (Option<Instant>, _) = (None, Instant::now());
    while !stop.load(Ordering::Relaxed) {
        match threads.queue().pop(Duration::from_millis(100)) {
            Ok(frame) => {
                let shift = *shift.get_or_insert_with(|| clock.now_nanos().saturating_sub(frame.capture_nanos));
                if let Some(slot) = cameras.iter().position(|camera| *camera == frame.camera) {
                    last_frame[slot] = Some(Instant::now());
                }
                let capture_nanos = frame.capture_nanos.saturating_add(shift);
                publisher.publish(Frame { capture_nanos, mask: None, ..frame })?;
            }
            Err(PopError::Timeout) => {}
            Err(PopError::Closed) => break,
        }
        if told.is_none_or(|at| at.elapsed() >= STATUS_EVERY) {
            told = Some(Instant::now());
            manager.tell("WATCHDOG=1");
            let stats = threads.stats();
            for (camera, last) in stats.iter().zip(&last_frame) {
                let is_silent = last.is_none_or(|at| at.elapsed() >= SILENT);
                publisher.publish_status(&camera.camera, &status(&host, camera, is_silent))?;
            }
            if let Some(metrics) = &metrics {
                metrics.publish(health::prometheus(&snapshot(stats, &last_frame)));
            }
        }
        if printed.elapsed() >= PRINT_EVERY {
            printed = Instant::now();
            let counts = publisher.counts();
            let line: Vec<String> = counts
                .iter()
                .map(|(camera, counts)| {
                    let watched = if counts.watched { "" } else { ", nobody listens" };
                    format!("{camera}: {} sent, {} overtaken{watched}", counts.sent, counts.replaced)
                })
                .collect();
            eprintln!("capture: {}", line.join("; "));
        }
    }
    manager.tell("STOPPING=1");
    for camera in threads.stats() {
        let error = camera.last_error.map_or_else(String::new, |error| format!("; last error: {error}"));
        eprintln!("capture: camera {}: {} frames{error}", camera.camera, camera.frames);
    }
    drop(threads);
    Ok(publisher.close()?)
}

fn start(config: &Config, sources: Vec<Box<dyn CameraSource>>) -> Result<CaptureThreads> {
    let pacing = match config.source.kind {
        SourceKind::Cameras | SourceKind::Sim => Pacing::AsDelivered,
        _ => Pacing::RealTime,
    };
    let threads = ThreadsConfig { queue_capacity: 4 * sources.len().max(1), pacing };
    let quality = config.capture.jpeg_quality;
    if quality == 0 {
        return Ok(CaptureThreads::start(sources, threads)?);
    }
    let stage = |_: &CameraId| Box::new(JpegEncoding::new(quality)) as Box<dyn FrameStage>;
    Ok(CaptureThreads::start_staged(sources, stage, threads)?)
}

fn status(host: &str, stats: &CameraStats, is_silent: bool) -> CameraStatus {
    let problem = match &stats.last_error {
        Some(error) if is_silent => error.message.clone(),
        _ if is_silent => "no frame for a second".to_owned(),
        _ => String::new(),
    };
    let health = &stats.health;
    CameraStatus {
        host: host.to_owned(),
        mode: health.mode.to_string(),
        problem,
        frames: stats.frames,
        errors: stats.errors.values().sum(),
        lost_by_driver: health.lost_by_driver,
        reconnects: health.reconnects,
        silences: health.silences,
        stamps_replaced: health.stamps_replaced,
        overtaken: stats.dropped.saturating_add(stats.overtaken),
    }
}

/// There are no sets here.
fn snapshot(stats: Vec<CameraStats>, last_frame: &[Option<Instant>]) -> Health {
    let camera = |(stats, last): (CameraStats, &Option<Instant>)| CameraHealth {
        stats,
        in_no_set: 0,
        interval_ms: 0.0,
        jitter_ms: 0.0,
        lateness_ms: None,
        quiet_s: last.map(|at| at.elapsed().as_secs_f64()),
        clock: None,
    };
    Health {
        cameras: stats.into_iter().zip(last_frame).map(camera).collect(),
        resident_mib: resident_mib(),
        ..Health::default()
    }
}

/// What people call this computer.
fn host_name() -> String {
    let read = |path: &str| std::fs::read_to_string(Path::new(path)).ok().map(|name| name.trim().to_owned());
    read("/proc/sys/kernel/hostname").or_else(|| std::env::var("COMPUTERNAME").ok()).unwrap_or_default()
}
