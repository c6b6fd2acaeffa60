//! `flyrig run`: a rig that stays up.

use std::{
    path::Path,
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use anyhow::{Result, bail, ensure};
use flyrig_fusion::{
    EstimatedPerception, Intake, LivePublisher, LiveRig, LiveViews, Outcome, PersonId, SHAPE_SETS, Session,
    SessionBuilder, resident_mib,
};
use flyrig_gpu::GpuContext;
use flyrig_report::stop;
use flyrig_transport::Publisher;

use crate::{
    config::Config,
    dataset, health,
    metrics_server::MetricsServer,
    notify::ServiceManager,
    pose_recording::PoseRecording,
    recording,
    source::{self, FoundBy},
};

/// How long a step waits for a set before health and Ctrl-C are looked at.
const STEP: Duration = Duration::from_millis(200);
/// How often a line with rates is printed.
const PRINT_EVERY: Duration = Duration::from_secs(5);
/// How often the health is reported.
const HEALTH_EVERY: Duration = Duration::from_secs(1);

/// Runs the command; `recording` names a file that the cameras are recorded to, `show_table` draws the cameras' health.
pub fn run(config: &Config, gpu: &GpuContext, recording: Option<&Path>, show_table: bool) -> Result<()> {
    let stop = stop::flag();
    let mut source = source::open(config, Some(gpu))?;
    dataset::require_masks(config.body.pose, config.body.masks, &source.plates)?;
    let pacing = source::pacing(config);
    let quality = config.record.jpeg_quality;
    let recorder = recording.map(|path| recording::recorder(path, &source.rig, quality, pacing)).transpose()?;
    let mut cameras = std::mem::take(&mut source.cameras);
    if let Some(recorder) = &recorder {
        cameras = recording::tap(recorder, cameras)?;
    }
    let mut poses = recorder.as_ref().map(PoseRecording::new);
    let format = source::input_format(config.source.kind, &source.rig);
    let mut intake = Intake::start(cameras, format, &config.sync, pacing)?;
    if config.source.kind.is_live() {
        intake = intake.live();
    }
    let metrics = match config.health.listen.as_str() {
        "" => None,
        address => Some(MetricsServer::start(address)?),
    };
    let builder = SessionBuilder::new(gpu.clone(), source.rig.clone()).settings(config.session());
    let session = match source.perception(config)? {
        FoundBy::Given(perception) => builder.perception(perception).build()?,
        FoundBy::Estimated(mut perception) => {
            learn_shape(&mut perception, &mut intake)?;
            builder.perception(perception).build()?
        }
    };
    let publisher = Publisher::open(&config.transport())?;
    publisher.set_calibration(session.rig())?;
    eprintln!(
        "run: rig '{}' on {}, {} cameras, listening on {} (Ctrl-C ends)",
        config.rig.name,
        gpu.adapter_name(),
        session.rig().cameras.len(),
        publisher.endpoints().join(", ")
    );
    let publisher = LivePublisher::start(publisher, config.output.jpeg_quality)?;
    let mut rig = LiveRig::new(session, intake, LiveViews::new(&config.output), Some(publisher))
        .with_splats(config.output.splats);
    if let Some(metrics) = &metrics {
        eprintln!("run: metrics at http://{}/metrics", metrics.address());
    }
    let manager = ServiceManager::from_env();
    manager.tell("READY=1");
    let mut last_health: Option<Instant> = None;
    let (started, mut last_print, mut printed) = (Instant::now(), Instant::now(), 0u64);
    while !stop.load(Ordering::Relaxed) && !rig.intake.ended() {
        let step = rig.step(STEP, None)?;
        if last_health.is_none_or(|at| at.elapsed() >= HEALTH_EVERY) {
            last_health = Some(Instant::now());
            manager.tell("WATCHDOG=1");
            let snapshot = rig.health();
            if let Some(metrics) = &metrics {
                metrics.publish(health::prometheus(&snapshot));
            }
            if show_table {
                // Clears the terminal first.
                eprint!("\x1b[2J\x1b[H{}", health::table(&snapshot));
            }
        }
        let Some(step) = step else { continue };
        if step.outcome == Outcome::Updated {
            record_pose(poses.as_mut(), &rig.session, step.set.master_nanos);
        }
        if !show_table && last_print.elapsed() >= PRINT_EVERY {
            let rate = (rig.frames() - printed) as f64 / last_print.elapsed().as_secs_f64();
            let memory = resident_mib().map_or_else(String::new, |mib| format!(", {mib:.0} MiB"));
            let lost = rig.session.counts.lost;
            eprintln!("run: {} sets, {rate:.1} a second, {lost} lost{memory}", rig.frames());
            (last_print, printed) = (Instant::now(), rig.frames());
        }
    }
    eprintln!("run: {} sets in {:.1} s", rig.frames(), started.elapsed().as_secs_f64());
    eprint!("{}", rig.session.stages.table());
    for (place, count) in rig.drops().into_iter().filter(|(_, count)| *count > 0) {
        eprintln!("dropped: {count} {place}");
    }
    manager.tell("STOPPING=1");
    drop(poses);
    let finished = rig.finish();
    if let (Some(recorder), Some(path)) = (recorder, recording) {
        match recording::summary(&recorder.finish(), path) {
            Ok(text) => eprintln!("run: recorded {text}"),
            Err(error) => eprintln!("run: {error}"),
        }
    }
    finished?;
    Ok(())
}

fn record_pose(poses: Option<&mut PoseRecording>, session: &Session, nanos: i64) {
    let subject = session.subject(PersonId::default());
    if let (Some(poses), Some(subject)) = (poses, subject)
        && let Some(pose) = subject.drawn_pose()
    {
        poses.record(&subject.template().skeleton, &pose, nanos);
    }
}

fn learn_shape(perception: &mut EstimatedPerception, intake: &mut Intake) -> Result<()> {
    eprintln!("run: learning the person's shape, please stand in view of all cameras");
    let mut tries = 0u64;
    loop {
        let mut sets = Vec::new();
        while sets.len() < SHAPE_SETS {
            ensure!(!stop::requested(), "stopped before a person was seen");
            match intake.next_set(STEP) {
                Some(set) => sets.push(set),
                None if intake.ended() => bail!("the cameras ended before a person was seen"),
                None => {}
            }
        }
        match perception.learn_shape(&sets) {
            Ok(fit) => {
                eprintln!("run: the person is {:.2} m tall", fit.height_m);
                return Ok(());
            }
            Err(error) => {
                tries += 1;
                if tries.is_power_of_two() {
                    tracing::warn!(%error, tries, "nobody seen, trying again");
                }
            }
        }
    }
}
