//! `flyrig capture`: publishes the cameras of this computer for a rig on another one.

use std::{
    path::Path,
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use anyhow::{Result, ensure};
use flyrig_access::{KeyFile, Role};
use flyrig_capture::{
    CameraStats, CaptureThreads, FrameStage, JpegEncoding, Pacing, PopError, SourceOpener, ThreadsConfig,
};
use flyrig_fusion::{Health, check_threads};
use flyrig_gpu::GpuContext;
use flyrig_monitor::{Arrivals, Monitor, ended_by_itself};
use flyrig_report::stop;
use flyrig_takes::{Needs, SourceKind, host_clock};
use flyrig_transport::{CameraPublisher, CameraStatus, TransportConfig};
use flyrig_types::{CameraId, Frame};

use crate::{
    config::Config,
    opening::{image_origin, open_cameras},
};

/// Interval at which the state of cameras is published.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// Interval between lines with counts.
const PRINT_EVERY: Duration = Duration::from_secs(5);
/// Silence of a camera after which its last error is published.
const SILENT: Duration = Duration::from_secs(1);

/// Runs the command until it is stopped or every recorded camera has ended. With a key, the cameras go to the key's rig.
pub fn capture(config: &Config, key: Option<&Path>, gpu: Option<&GpuContext>) -> Result<()> {
    let key = key.map(|path| KeyFile::read(path, &[Role::Cameras])).transpose()?;
    let stop = stop::flag();
    let kind = config.source.kind;
    ensure!(kind != SourceKind::Network, "source.kind is \"network\": these cameras are on the network already");
    let mut monitor = Monitor::start(&config.health.listen, false)?.with_origin(image_origin(kind));
    // Cameras of this computer need no calibration here.
    let needs = if kind == SourceKind::Cameras { Needs::Frames } else { Needs::Calibration };
    let sources = open_cameras(config, needs, gpu)?.sources;
    let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
    let threads = start(config, sources)?;
    let clock = host_clock();
    let transport = key.map_or_else(|| config.transport(), TransportConfig::with_key);
    let publisher = CameraPublisher::open(&transport, &cameras, clock.clone())?;
    let place = match transport.connect.as_slice() {
        [] => format!("listening on {}", publisher.endpoints().join(", ")),
        connect => format!("connecting to {}", connect.join(", ")),
    };
    eprintln!("capture: {} cameras of rig '{}', {place} (Ctrl-C ends)", cameras.len(), transport.rig);
    Monitor::ready();
    let host = host_name();
    // Stamps of what was recorded or simulated are of another time; played now, it is taken now.
    let mut shift = (kind == SourceKind::Cameras).then_some(0i64);
    let mut arrivals = Arrivals::new(&cameras);
    let mut has_ended = false;
    let (mut sent, mut printed): (Option<Instant>, _) = (None, Instant::now());
    while !stop.load(Ordering::Relaxed) {
        match threads.queue().pop(Duration::from_millis(100)) {
            Ok(frame) => {
                let shift = *shift.get_or_insert_with(|| clock.now_nanos().saturating_sub(frame.capture_nanos));
                arrivals.add(&frame.camera);
                let capture_nanos = frame.capture_nanos.saturating_add(shift);
                publisher.publish(Frame { capture_nanos, mask: None, ..frame })?;
                monitor.stepped();
            }
            Err(PopError::Timeout) => {}
            Err(PopError::Closed) => {
                has_ended = true;
                break;
            }
        }
        let publishing = publisher.thread();
        check_threads([publishing.clone()])?;
        monitor.report(|| (Health { threads: vec![publishing], ..arrivals.health(&threads) }, None));
        if sent.is_none_or(|at| at.elapsed() >= STATUS_EVERY) {
            sent = Some(Instant::now());
            for camera in threads.stats() {
                let is_silent = arrivals.is_silent(&camera.camera, SILENT);
                publisher.publish_status(&camera.camera, &status(&host, &camera, is_silent))?;
            }
        }
        if printed.elapsed() >= PRINT_EVERY {
            printed = Instant::now();
            let counts = publisher.counts();
            let line: Vec<String> = counts
                .iter()
                .map(|(camera, counts)| {
                    let watched = if counts.watched { "" } else { ", not received" };
                    format!("{camera}: {} sent, {} overtaken{watched}", counts.sent, counts.replaced)
                })
                .collect();
            eprintln!("capture: {}", line.join("; "));
            if let Some(trouble) = publisher.trouble() {
                eprintln!("capture: {trouble}");
            }
        }
    }
    let stats = threads.stats();
    for camera in &stats {
        let error = camera.last_error.as_ref().map_or_else(String::new, |error| format!("; last error: {error}"));
        eprintln!("capture: camera {}: {} frames{error}", camera.camera, camera.frames);
    }
    drop(threads);
    publisher.close()?;
    ensure!(!has_ended || kind != SourceKind::Cameras, ended_by_itself(&stats));
    Ok(())
}

fn start(config: &Config, sources: Vec<SourceOpener>) -> Result<CaptureThreads> {
    let pacing = match config.source.kind {
        SourceKind::Cameras | SourceKind::Sim => Pacing::AsDelivered,
        _ => Pacing::RealTime,
    };
    let threads = ThreadsConfig { queue_capacity: 4 * sources.len().max(1), pacing };
    let quality = config.capture.jpeg_quality;
    if quality == 0 {
        return Ok(CaptureThreads::start_opening(sources, threads)?);
    }
    let stage = move |_: &CameraId| Box::new(JpegEncoding::new(quality)) as Box<dyn FrameStage>;
    Ok(CaptureThreads::start_opening_staged(sources, stage, threads)?)
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

/// Returns the name of this computer.
fn host_name() -> String {
    let read = |path: &str| std::fs::read_to_string(Path::new(path)).ok().map(|name| name.trim().to_owned());
    read("/proc/sys/kernel/hostname").or_else(|| std::env::var("COMPUTERNAME").ok()).unwrap_or_default()
}
