//! `flyrig run`: a rig that stays up.

use std::{
    collections::BTreeMap,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_body::{ShapeParams, Template, default_template, load_gltf};
use flyrig_calib::SyncConfig;
use flyrig_capture::{CameraSource, FolderOptions, FolderReplay, Pacing, VideoOptions, VideoReplay};
use flyrig_gpu::GpuContext;
use flyrig_sim::{SimTime, Simulator};
use flyrig_tracker::{PoseConfig, PoseEstimator, PoseNet};
use flyrig_transport::Publisher;
use flyrig_types::{CameraId, FrameSet, Image, Rig};

use crate::{
    config::{Config, Origin, SourceKind},
    dataset,
    engine::Engine,
    health::Health,
    intake::{Intake, Pictures},
    live,
    metrics_server::MetricsServer,
    network,
    notify::ServiceManager,
    outlet::Outlet,
    pipeline::{Outcome, Pipeline, PoseSource},
    pose_recording::PoseRecording,
    record,
    stats::resident_mib,
    stop, viewpoints,
};

/// Whole turns a second of the published views, so that a still viewer sees all sides.
const ORBIT_TURNS_PER_SECOND: f64 = 0.05;
/// Frame sets that the pose estimator sees before it starts, to learn the person's shape.
const SHAPE_SETS: usize = 8;
/// How often a line with rates is printed.
const PRINT_EVERY: Duration = Duration::from_secs(5);

/// How often the health is told.
const HEALTH_EVERY: Duration = Duration::from_secs(1);

/// Cameras and what is known about the person.
pub struct Scene {
    /// In the rig's order, pictures in the cameras' own formats.
    pub sources: Vec<Box<dyn CameraSource>>,
    pub rig: Rig,
    template: Template,
    track: Option<flyrig_types::PoseTrack>,
    /// Empty pictures by slot, where there are any.
    pub plates: Vec<Option<Image>>,
}

/// Runs the command; `recording` names a file that the cameras are recorded to, `show_table` draws the cameras' health.
pub fn run(config: &Config, gpu: &GpuContext, recording: Option<&Path>, show_table: bool) -> Result<()> {
    let stop = stop::flag();
    let mut scene = open(config, Some(gpu))?;
    dataset::require_masks(config.body.pose, config.body.masks, &scene.plates)?;
    let pacing = match (config.source.real_time, config.source.kind) {
        // Nobody can make a real camera wait.
        (_, SourceKind::Cameras | SourceKind::Network) => Pacing::AsDelivered,
        (false, _) => Pacing::Lossless,
        // Simulated cameras keep the time themselves, whatever their stamps say.
        (true, SourceKind::Sim) => Pacing::AsDelivered,
        (true, _) => Pacing::RealTime,
    };
    let quality = config.record.jpeg_quality;
    let recorder = recording.map(|path| record::recorder(path, &scene.rig, quality, pacing)).transpose()?;
    if let Some(recorder) = &recorder {
        scene.sources = record::tap(recorder, scene.sources)?;
    }
    let mut poses = recorder.as_ref().map(PoseRecording::new);
    let pictures = match config.source.kind {
        SourceKind::Cameras | SourceKind::Network | SourceKind::Mcap => Pictures::OfRig(&scene.rig),
        SourceKind::Folder | SourceKind::Video | SourceKind::Sim => Pictures::Rgb,
    };
    let mut intake = Intake::start(scene.sources, pictures, &sync_config(config), config.sync.clocks, pacing)?;
    if config.source.kind.is_live() {
        intake = intake.live();
    }
    let metrics = match config.health.listen.as_str() {
        "" => None,
        address => Some(MetricsServer::start(address)?),
    };

    let mut template = scene.template;
    let pose = match (config.body.pose, scene.track) {
        (Origin::Given, Some(track)) => PoseSource::Track { track, repeat: config.source.kind == SourceKind::Sim },
        (Origin::Given, None) => bail!("body.pose is \"given\" but the template holds no animation"),
        (Origin::Estimated, _) => {
            let settings = PoseConfig { masks: config.body.masks == Origin::Estimated, ..PoseConfig::default() };
            let mut estimator = PoseEstimator::new(PoseNet::embedded()?, &template, &scene.rig, settings)?;
            dataset::set_plates(&mut estimator, &scene.plates)?;
            learn_shape(&mut estimator, &mut intake)?;
            template = estimator.template().clone();
            PoseSource::Estimator(Box::new(estimator))
        }
    };
    let mut engine = Engine::new(
        gpu.clone(),
        template,
        config.body.gaussians,
        config.body.nodes,
        &scene.rig,
        config.appearance.mode.settings(),
        config.tracking.options(config.body.pose),
    )?;
    if let Some(networks) = config.appearance.networks()? {
        engine.use_networks(&networks, config.appearance.network_use())?;
    }
    let mut pipeline = Pipeline::new(engine, scene.rig, pose, config.body.masks, scene.plates);
    pipeline.per_view_time = config.tracking.per_view_time;
    let publisher = Publisher::open(&network::transport(config))?;
    publisher.set_calibration(pipeline.rig())?;
    let mut outlet = Outlet::start(publisher, config.output.jpeg_quality)?;
    let views = Views::new(config.output.views, config.output.width, config.output.height);
    eprintln!(
        "run: rig '{}' on {}, {} cameras, listening on {} (Ctrl-C ends)",
        config.rig.name,
        gpu.adapter_name(),
        pipeline.rig().cameras.len(),
        outlet.publisher().endpoints().join(", ")
    );

    if let Some(metrics) = &metrics {
        eprintln!("run: metrics at http://{}/metrics", metrics.address());
    }
    let manager = ServiceManager::from_env();
    manager.tell("READY=1");
    let mut last_health: Option<Instant> = None;
    let (started, mut last_print) = (Instant::now(), Instant::now());
    let (mut frames, mut printed, mut held) = (0u64, 0u64, 0u64);
    while !stop.load(std::sync::atomic::Ordering::Relaxed) && !intake.ended() {
        let set = intake.next_set(Duration::from_millis(200));
        if last_health.is_none_or(|at| at.elapsed() >= HEALTH_EVERY) {
            last_health = Some(Instant::now());
            manager.tell("WATCHDOG=1");
            let health = Health { stages: pipeline.stages.summary(), resident_mib: resident_mib(), ..intake.health() };
            if let Some(metrics) = &metrics {
                metrics.publish(health.prometheus());
            }
            if show_table {
                // Clears the terminal first.
                eprint!("\x1b[2J\x1b[H{}", health.table());
            }
        }
        let Some(set) = set else { continue };
        match pipeline.process(&set)? {
            Outcome::Held(reason) => {
                held += 1;
                // The 1st, 2nd, 4th ...: a room that is empty all night must not fill the disk.
                if held.is_power_of_two() {
                    tracing::warn!(set = set.index, held, %reason, "frame set not used");
                }
            }
            Outcome::Updated => record_pose(poses.as_mut(), &pipeline, set.master_nanos),
        }
        frames += 1;
        views.publish(&mut pipeline, &outlet, &set, started.elapsed())?;
        if config.output.splats && outlet.publisher().has_splat_subscribers() {
            outlet.publish_splats(&pipeline.engine().splats()?, &set);
        }
        outlet.publish_stats(&set, frames, &pipeline.stages.summary(), &intake.drops(), &pipeline.watch);
        if !show_table && last_print.elapsed() >= PRINT_EVERY {
            let rate = (frames - printed) as f64 / last_print.elapsed().as_secs_f64();
            let memory = resident_mib().map_or_else(String::new, |mib| format!(", {mib:.0} MiB"));
            eprintln!("run: {frames} sets, {rate:.1} a second, {} lost{memory}", pipeline.counts.lost);
            (last_print, printed) = (Instant::now(), frames);
        }
    }
    eprintln!("run: {frames} sets in {:.1} s", started.elapsed().as_secs_f64());
    eprint!("{}", pipeline.stages.table());
    for (place, count) in intake.drops().into_iter().chain(outlet.drops()).filter(|(_, count)| *count > 0) {
        eprintln!("dropped: {count} {place}");
    }
    manager.tell("STOPPING=1");
    drop((intake, poses));
    if let (Some(recorder), Some(path)) = (recorder, recording) {
        match record::told(&recorder.finish(), path) {
            Ok(text) => eprintln!("run: recorded {text}"),
            Err(error) => eprintln!("run: {error}"),
        }
    }
    outlet.finish()
}

fn record_pose(poses: Option<&mut PoseRecording>, pipeline: &Pipeline, nanos: i64) {
    if let (Some(poses), Some(pose)) = (poses, pipeline.drawn_pose()) {
        poses.record(&pipeline.engine().template().skeleton, &pose, nanos);
    }
}

/// The published views of a rig, and those that viewers ask for.
pub struct Views {
    names: Vec<String>,
    width: u32,
    height: u32,
}

impl Views {
    /// `count` views spread around the person: `main`, `main-1`, ...
    pub fn new(count: usize, width: u32, height: u32) -> Self {
        let name = |i: usize| if i == 0 { "main".to_owned() } else { format!("main-{i}") };
        Self { names: (0..count).map(name).collect(), width, height }
    }

    /// Renders and publishes what somebody watches; returns how many views that was.
    pub fn publish(&self, pipeline: &mut Pipeline, outlet: &Outlet, set: &FrameSet, at: Duration) -> Result<usize> {
        let mut count = 0;
        if pipeline.pose().is_none() {
            return Ok(0);
        }
        for (i, name) in self.names.iter().enumerate() {
            outlet.publisher().add_view(name)?;
            if !outlet.publisher().has_subscribers(name) {
                continue;
            }
            let turn = i as f64 / self.names.len() as f64 + at.as_secs_f64() * ORBIT_TURNS_PER_SECOND;
            if let Some(camera) = viewpoints::orbit(pipeline.rig(), turn, self.width, self.height, name) {
                outlet.publish(name, pipeline.render(&camera)?, set);
                count += 1;
            }
        }
        for viewpoint in outlet.publisher().requested_viewpoints() {
            outlet.publish(&viewpoint.view, pipeline.render(&viewpoint.camera)?, set);
            count += 1;
        }
        Ok(count)
    }
}

/// The synchronizer's settings.
pub fn sync_config(config: &Config) -> SyncConfig {
    let nanos = |millis: f64| (millis * 1e6) as u64;
    SyncConfig {
        master: (!config.sync.master.is_empty()).then(|| CameraId::from(config.sync.master.as_str())),
        window_nanos: (config.sync.window_ms > 0.0).then(|| nanos(config.sync.window_ms)),
        max_wait_nanos: (config.sync.max_wait_ms > 0.0).then(|| nanos(config.sync.max_wait_ms)),
        lags_nanos: lags_nanos(&config.sync.lags_ms),
    }
}

/// Nanoseconds of the lags by camera.
pub fn lags_nanos<'a>(lags_ms: impl IntoIterator<Item = (&'a String, &'a f64)>) -> BTreeMap<CameraId, i64> {
    lags_ms.into_iter().map(|(camera, lag)| (camera.as_str().into(), (lag * 1e6).round() as i64)).collect()
}

fn learn_shape(estimator: &mut PoseEstimator, intake: &mut Intake) -> Result<()> {
    eprintln!("run: learning the person's shape, please stand in view of all cameras");
    let mut tries = 0u64;
    loop {
        let mut sets = Vec::new();
        while sets.len() < SHAPE_SETS {
            ensure!(!stop::requested(), "stopped before a person was seen");
            match intake.next_set(Duration::from_millis(200)) {
                Some(set) => sets.push(set),
                None if intake.ended() => bail!("the cameras ended before a person was seen"),
                None => {}
            }
        }
        match estimator.fit_shape(&sets) {
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

/// Opens the cameras of a configuration; only simulated ones need the graphics adapter.
pub fn open(config: &Config, gpu: Option<&GpuContext>) -> Result<Scene> {
    let scene = open_source(config, gpu)?;
    dataset::pick(
        &scene.rig,
        &config.sync.lags_ms.keys().cloned().collect::<Vec<_>>(),
        "the rig, but in sync.lags_ms",
    )?;
    Ok(scene)
}

fn open_source(config: &Config, gpu: Option<&GpuContext>) -> Result<Scene> {
    let source = &config.source;
    if source.kind == SourceKind::Sim {
        let gpu = gpu.context("the simulated rig needs a graphics adapter")?;
        let simulator = Simulator::new(gpu, &config.sim)?;
        let (rig, template, track) =
            (simulator.reported_rig(), simulator.template().clone(), simulator.track().clone());
        let picked = dataset::pick(&rig, &source.names(), "the simulated rig")?;
        let copy = |slot| -> Result<Image> {
            let plate = simulator.plate(slot)?;
            Ok(Image::new(plate.width(), plate.height(), plate.format(), plate.bytes().to_vec())?)
        };
        let slots = picked.cameras.iter().filter_map(|camera| rig.slot(&camera.id));
        let plates = slots.map(|slot| copy(slot).map(Some)).collect::<Result<_>>()?;
        let simulator = std::sync::Arc::new(std::sync::Mutex::new(simulator));
        let time = if source.real_time { SimTime::Real } else { SimTime::Exact };
        let sources = flyrig_sim::sources(&simulator, time)
            .into_iter()
            .filter(|source| picked.slot(source.camera()).is_some())
            .map(|source| Box::new(source) as Box<dyn CameraSource>)
            .collect();
        return Ok(Scene { sources, rig: picked, template, track: Some(track), plates });
    }
    let chosen: Vec<CameraId> = source.names().into_iter().map(CameraId::from).collect();
    let rig = match source.kind {
        SourceKind::Cameras | SourceKind::Network => live::load_rig(source)?,
        SourceKind::Mcap => record::recorded_rig(&source.path)?,
        SourceKind::Folder | SourceKind::Video | SourceKind::Sim => dataset::load_rig(&source.path, &chosen)?,
    };
    let rig = dataset::pick(&rig, &source.names(), "the calibration")?;
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let sources: Vec<Box<dyn CameraSource>> = match source.kind {
        SourceKind::Folder => {
            let with_masks = config.body.masks == Origin::Given;
            boxed(FolderReplay::open(
                &source.path,
                Some(&ids),
                &FolderOptions { fps: source.fps, with_masks, frames: None },
            )?)
        }
        SourceKind::Cameras => live::open(source)?,
        SourceKind::Network => network::open(config, &rig)?,
        SourceKind::Mcap => record::replay_sources(&source.path, &rig)?,
        SourceKind::Video | SourceKind::Sim => {
            let open = |id| VideoReplay::open(id, &dataset::video_file(&source.path, id), &VideoOptions::default());
            boxed(ids.iter().map(open).collect::<Result<_, _>>()?)
        }
    };
    let (template, track) = if config.body.template.as_os_str().is_empty() {
        (default_template(&ShapeParams::default())?, None)
    } else {
        let human = load_gltf(&config.body.template)?;
        (human.template, human.track)
    };
    let plates = match source.kind {
        SourceKind::Mcap => rig.cameras.iter().map(|_| None).collect(),
        _ => dataset::plates(&source.path, &rig)?,
    };
    Ok(Scene { sources, rig, template, track, plates })
}

/// Sources of one kind as the capture threads take them.
pub fn boxed<S: CameraSource + 'static>(sources: Vec<S>) -> Vec<Box<dyn CameraSource>> {
    sources.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect()
}
