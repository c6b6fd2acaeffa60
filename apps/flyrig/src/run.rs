//! `flyrig run`: a rig that stays up.

use std::{
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use anyhow::{Context, Result, ensure};
use flyrig_calib::calibration_toml;
use flyrig_capture::{CameraStats, Recorder};
use flyrig_fusion::{
    Health, Intake, LivePublisher, LiveRig, LiveViews, Origin, Outcome, PersonId, PersonMemory, RigWatch, Session,
    SessionBuilder, resident_mib,
};
use flyrig_gpu::GpuContext;
use flyrig_monitor::{Monitor, effort, ended_by_itself};
use flyrig_report::{KnownBody, dataset, known_body, stop};
use flyrig_transport::{Publisher, TransportConfig};
use flyrig_types::Image;
use flyrig_web::WebServer;
use foxglove::messages::Log;
use signal_hook::consts::SIGUSR1;

use crate::{
    config::{Config, WatchMode},
    pose_recording::PoseRecording,
    recording,
    serve::print_fingerprint,
    source::{self, FoundBy, Source},
};

/// How long a step waits for a set before health and Ctrl-C are looked at.
const STEP: Duration = Duration::from_millis(200);
/// How often a line with rates is printed.
const PRINT_EVERY: Duration = Duration::from_secs(5);
/// How often what was learnt about the person is saved.
const SAVE_EVERY: Duration = Duration::from_secs(60);

/// Runs the command; `recording` names a file that the cameras are recorded to, `show_table` draws the cameras' health.
pub fn run(config: &Config, gpu: &GpuContext, recording: Option<&Path>, show_table: bool) -> Result<()> {
    stop::flag();
    let mut monitor = Monitor::start(&config.health.listen, show_table)?;
    let source = source::open(config, Some(gpu))?;
    dataset::require_masks(&config.perception, &source.plates)?;
    let pacing = source::pacing(config);
    let ids: Vec<_> = source.rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let recorder =
        recording.map(|path| recording::recorder(path, &ids, Some(&source.rig), &config.record, pacing)).transpose()?;
    let ended = capture_people(config, gpu, source, recorder.as_ref(), &mut monitor, show_table);
    let recorded = match (recorder, recording) {
        (Some(recorder), Some(path)) => recording::summary(&recorder.finish(), path)
            .map(|text| eprintln!("run: recorded {text}"))
            .inspect_err(|error| eprintln!("run: {error}")),
        _ => Ok(()),
    };
    ended.and(recorded)
}

/// Watches the cameras for bumps, where the configuration wants it.
fn rig_watch(mode: WatchMode, source: &Source) -> Result<Option<RigWatch>> {
    let watch = || RigWatch::new(&source.rig, &source.plates);
    let copy = |plate: &Option<Image>| {
        let copy = |plate: &Image| Image::new(plate.width(), plate.height(), plate.format(), plate.bytes().to_vec());
        plate.as_ref().map(copy).transpose()
    };
    Ok(match mode {
        WatchMode::Off => None,
        WatchMode::Warn => Some(watch()),
        WatchMode::Correct => Some(watch().correcting(source.plates.iter().map(copy).collect::<Result<_, _>>()?)),
    })
}

/// Runs the rig until its cameras end or it is asked to stop.
fn capture_people(
    config: &Config,
    gpu: &GpuContext,
    mut source: Source,
    recorder: Option<&Recorder>,
    monitor: &mut Monitor,
    show_table: bool,
) -> Result<()> {
    let mut cameras = std::mem::take(&mut source.cameras);
    if let Some(recorder) = recorder {
        cameras = recording::tap(recorder, cameras)?;
    }
    let mut poses = recorder.map(PoseRecording::new);
    let format = source::input_format(config.source.kind, &source.rig);
    let sync = config.sync.with_offsets_of(&source.rig.cameras);
    let mut intake = Intake::start_opening(cameras, format, &sync, source::pacing(config))?;
    if config.source.kind.is_live() {
        intake = intake.live();
    }
    Monitor::ready();
    let mut builder = SessionBuilder::new(gpu.clone(), source.rig.clone()).settings(config.session());
    let saved = config.body.person_file().filter(|path| path.exists()).map(PersonMemory::load).transpose()?;
    let outfit = saved.as_ref().map(PersonMemory::outfit).unwrap_or_default();
    let mut learnt = saved.as_ref().map(|memory| memory.template(&source.template)).transpose()?;
    if let Some(memory) = saved {
        builder = builder.person(PersonId::default(), memory);
        eprintln!("run: the person is resumed from {}", config.body.person.display());
    }
    let has_avatar = config.body.avatar_file().is_some();
    if let Some(KnownBody { template, memory }) = known_body(&config.body, config.output.avatar)? {
        // Poses of a track, or of the body that the configuration names, must be poses of the avatar.
        if config.perception.pose == Origin::Given || !config.body.template.as_os_str().is_empty() {
            template.check_same_joints(&source.template).context("body.avatar")?;
        }
        if let Some(memory) = memory {
            builder = builder.person(PersonId::default(), memory);
        }
        learnt = Some(template);
        eprintln!("run: the person starts from the avatar {}", config.body.avatar.display());
    }
    let threads = std::mem::take(&mut source.threads);
    let watch = rig_watch(config.calibration.watch, &source)?;
    let mut watched = recorder.map(|recorder| {
        ["watch", "corrected/calibration.toml"].map(|topic| recorder.messages(topic, recording::schema::<Log>()))
    });
    if let (Origin::Given, Some(learnt)) = (config.perception.pose, &learnt) {
        source.template = learnt.clone();
    }
    builder = match source.perception(config)? {
        FoundBy::Given(perception) if has_avatar => builder.perception(perception.dressed()),
        FoundBy::Given(perception) => builder.perception(perception),
        FoundBy::Estimated(mut perception) => {
            eprintln!("run: looking for people; each is measured for a moment, then drawn");
            if let Some(learnt) = &learnt {
                perception.know_shape(learnt, outfit)?;
            }
            builder.perception(*perception)
        }
    };
    let mut session = monitor.during(gpu, || builder.build())?;
    if config.source.real_time {
        session.use_threads();
    }
    let publisher = Publisher::open(&config.transport())?;
    publisher.set_calibration(session.rig())?;
    eprintln!(
        "run: rig '{}' on {}, {} cameras, listening on {} (Ctrl-C ends)",
        config.rig.name,
        session.gpu().adapter_name(),
        session.rig().cameras.len(),
        publisher.endpoints().join(", ")
    );
    if let Some(address) = publisher.gate() {
        eprintln!("run: holders of keys connect at {address}");
    }
    // It is a viewer like any other, beside the rig.
    let own = TransportConfig {
        connect: publisher.endpoints().first().map(|at| loopback_of(at)).into_iter().collect(),
        ..TransportConfig::subscriber(&config.rig.name)
    };
    let web = (!config.web.listen.is_empty()).then(|| WebServer::start(&config.web, own)).transpose()?;
    if let Some(web) = &web {
        eprintln!("run: people are shown at {}", web.link());
        print_fingerprint("run", web, &config.web);
    }
    let publisher = LivePublisher::start(publisher, config.output.jpeg_quality)?;
    let mut rig = LiveRig::new(session, intake, LiveViews::new(&config.output), Some(publisher))
        .with_splats(config.output.splats)
        .with_threads(threads);
    if config.source.real_time {
        rig = rig.with_ages();
    }
    if let Some(watch) = watch {
        rig = rig.with_watch(watch);
    }
    let (started, mut last_print, mut printed) = (Instant::now(), Instant::now(), 0u64);
    let mut last_save = Instant::now();
    let measure = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGUSR1, Arc::clone(&measure)).context("cannot listen for SIGUSR1")?;
    while !stop::requested() && !rig.ended() {
        if measure.swap(false, Ordering::Relaxed) {
            match rig.session.measure_again() {
                true => eprintln!("run: SIGUSR1, everybody is measured again"),
                false => eprintln!(
                    "run: SIGUSR1, but nobody is measured: perception.shape is \"given\", or there is only one camera"
                ),
            }
        }
        let step = rig.step(STEP, None)?;
        if step.is_some() {
            monitor.stepped();
        }
        monitor.report(|| (rig.health(), recorder.map(Recorder::state)));
        let Some(step) = step else { continue };
        if let (Some(event), Some([messages, calibrations])) = (&step.watched, &mut watched) {
            messages.record(event.nanos, recording::log("watch", event.to_string())?);
            if event.corrected.is_some() {
                let text = calibration_toml(rig.session.rig(), &[])?;
                calibrations.record(event.nanos, recording::log("corrected/calibration.toml", text)?);
            }
        }
        if !matches!(step.outcome, Outcome::Held(_)) {
            record_pose(poses.as_mut(), &rig.session, step.set.master_nanos);
        }
        if last_save.elapsed() >= SAVE_EVERY {
            save_person(&mut rig, config)?;
            last_save = Instant::now();
        }
        if !show_table && last_print.elapsed() >= PRINT_EVERY {
            let rate = (rig.frames() - printed) as f64 / last_print.elapsed().as_secs_f64();
            let memory = resident_mib().map_or_else(String::new, |mib| format!(", {mib:.0} MiB"));
            let lost = rig.session.counts.lost;
            let effort = rig.session.budget.stats().map_or_else(String::new, |budget| format!(", {}", effort(budget)));
            eprintln!("run: {} sets, {rate:.1} a second, {lost} lost{memory}{effort}", rig.frames());
            (last_print, printed) = (Instant::now(), rig.frames());
        }
    }
    eprintln!("run: {} sets in {:.1} s", rig.frames(), started.elapsed().as_secs_f64());
    eprint!("{}", rig.session.stages.table());
    for (place, count) in rig.drops().into_iter().filter(|(_, count)| *count > 0) {
        eprintln!("dropped: {count} {place}");
    }
    let stats = camera_stats(rig.health());
    let (frames, seen) = (rig.frames(), rig.session.has_people());
    let saved = save_person(&mut rig, config);
    rig.finish()?;
    saved?;
    ensure!(
        seen || frames == 0 || stop::requested(),
        "nobody was seen in {frames} sets: check that people stand in view of two cameras, and the calibration"
    );
    // A recording ends; live cameras do not.
    if config.source.kind.is_live() && !stop::requested() {
        return Err(ended_by_itself(&stats));
    }
    Ok(())
}

/// The endpoint as this computer reaches it: a rig that listens on all its addresses listens on loopback, too.
fn loopback_of(endpoint: &str) -> String {
    endpoint.replace("tcp/0.0.0.0:", "tcp/127.0.0.1:").replace("tcp/[::]:", "tcp/[::1]:")
}

/// Saves what was learnt about the person, where the configuration names a file.
fn save_person(rig: &mut LiveRig, config: &Config) -> Result<()> {
    let Some(path) = config.body.person_file() else { return Ok(()) };
    if let Some(memory) = rig.snapshot()?.get(&PersonId::default()) {
        memory.save(path)?;
    }
    Ok(())
}

fn camera_stats(health: Health) -> Vec<CameraStats> {
    health.cameras.into_iter().map(|camera| camera.stats).collect()
}

fn record_pose(poses: Option<&mut PoseRecording>, session: &Session, nanos: i64) {
    let subject = session.subject(PersonId::default());
    if let (Some(poses), Some(subject)) = (poses, subject)
        && let Some(pose) = subject.pose()
    {
        poses.record(&subject.template().skeleton, pose, nanos);
    }
}
