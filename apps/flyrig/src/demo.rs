//! `flyrig demo`: the whole system on a simulated rig, with a viewer in a process of its own and a report.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::{Arc, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::Args;
use flyrig_body::{ShapeParams, default_template};
use flyrig_capture::{CameraSource, Pacing};
use flyrig_fusion::{
    AppearanceMode, AppearanceOptions, BodySettings, BudgetSettings, EstimatedPerception, GivenPerception, InputFormat,
    Intake, LivePublisher, LiveRig, LiveViews, Origin, OutputSettings, PerceptionSettings, SHAPE_SECS, SHAPE_SETS,
    Session, SessionBuilder, SessionSettings, StageSummary, TrackingSettings, resident_mib,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::{
    ContactRow, Curve, Report,
    arguments::{GaussiansArgs, OutputArgs, parse_minutes},
    contact_images, png, progress_bar, stop, write_whole,
};
use flyrig_sim::{FaultScript, MotionConfig, MotionKind, SimConfig, SimFrame, SimTime, Simulator};
use flyrig_sync::SyncSettings;
use flyrig_takes::{dataset::select_cameras, simulated_plates};
use flyrig_transport::{Publisher, TransportConfig};
use flyrig_types::{Camera, Frame, FrameSet, Rig};
use indicatif::ProgressBar;
use serde::{Deserialize as _, Serialize, de::IntoDeserializer as _};

use crate::watch::WatchStats;

/// Arguments of `flyrig demo`.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/demo")))]
pub struct DemoArgs {
    /// Number of frames.
    #[arg(long, default_value_t = 60, conflicts_with = "minutes")]
    pub frames: usize,
    /// Duration in minutes instead of frames; the motion repeats.
    #[arg(long, value_parser = parse_minutes)]
    pub minutes: Option<f64>,
    /// Seed of person and room.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Motion: "turn", "walk", "wave", "squat", "reach", "sit", "lie", "jump", "cross-arms", "dance", "still", "by-seed", "bvh" (a captured
    /// walk from Debian's assimp-testmodels), or a *.bvh, *.glb or *.gltf file.
    #[arg(long, default_value = "turn")]
    pub motion: String,
    /// File with faults of cameras and clocks (TOML), such as sim/assets/faults.toml.
    #[arg(long)]
    pub faults: Option<PathBuf>,
    /// Source of the pose: the images, or the simulator.
    #[arg(long, value_enum, default_value = "estimated")]
    pub pose: Origin,
    /// Source of the masks: the images and the empty room, or the simulator.
    #[arg(long, value_enum, default_value = "estimated")]
    pub masks: Origin,
    /// Source of the body's shape: the images, or the simulator; by default that of the pose.
    #[arg(long, value_enum)]
    pub shape: Option<Origin>,
    #[command(flatten)]
    pub tracking: TrackingSettings,
    #[command(flatten)]
    pub appearance: AppearanceOptions,
    #[command(flatten)]
    pub budget: BudgetSettings,
    /// Address of the publisher; port 0 selects a free port.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
    #[command(flatten)]
    pub output: OutputArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

impl DemoArgs {
    /// Returns the settings of the perception.
    pub fn perception(&self) -> PerceptionSettings {
        let Self { pose, masks, shape, .. } = *self;
        PerceptionSettings { pose, masks, shape, ..PerceptionSettings::default() }
    }
}

/// Input cameras, and held-out cameras.
const INPUTS: [&str; 3] = ["00", "03", "05"];
const HELD_OUT: [&str; 4] = ["01", "02", "04", "06"];
/// Name of the demo's rig on the network.
const RIG_NAME: &str = "flyrig-demo";
/// Number of instants that are scored against the held-out cameras.
const SCORED: u64 = 20;
/// Number of rows of the contact sheet, spread evenly over the run.
const CONTACT_ROWS: usize = 4;
/// Interval at which memory use is measured.
const MEMORY_EVERY: Duration = Duration::from_secs(5);
/// Time that the viewer has to connect, before the demo goes on without it.
const VIEWER_DEADLINE: Duration = Duration::from_secs(15);
/// Time that the viewer has to write its last images.
const VIEWER_END: Duration = Duration::from_secs(15);

/// Results of one pass over the motion.
#[derive(Debug, Default)]
struct Pass {
    sheet: ScoreSheet,
    stages: Vec<StageSummary>,
    contact: Vec<ContactRow>,
    memory: Vec<(f64, f64)>,
    drops: Vec<(String, u64)>,
    frames: u64,
    seconds: f64,
    /// Part of `seconds` that simulating held-out cameras and scoring took.
    scoring_seconds: f64,
}

/// `metrics.json`.
#[derive(Debug, Serialize)]
struct Metrics {
    adapter: String,
    seed: u64,
    gaussians: usize,
    frames: u64,
    seconds: f64,
    frames_per_second: f64,
    modes: Vec<(AppearanceMode, Vec<CameraScore>, Option<CameraScore>)>,
    stages: Vec<StageSummary>,
    drops: Vec<(String, u64)>,
    memory_mib: Vec<(f64, f64)>,
    watch: Option<WatchStats>,
}

/// Runs the command.
pub fn demo(args: &DemoArgs, gpu: &GpuContext) -> Result<()> {
    args.output.create()?;
    let drawn_by = gpu.with_adapter()?.adapter_name();
    eprintln!("demo: simulated rig drawn by {drawn_by}, people by {}", gpu.fastest().adapter_name());
    let simulator = Arc::new(Mutex::new(Simulator::new(gpu, &sim_config(args)?)?));

    let publisher = Publisher::open(&TransportConfig {
        listen: vec![format!("tcp/{}", args.listen)],
        ..TransportConfig::publisher(RIG_NAME)
    })?;
    publisher.add_view("main")?;
    let endpoint = publisher.endpoints().first().context("the publisher listens nowhere")?.clone();
    let viewer = Viewer::start(&args.output.out, &endpoint)?;
    let deadline = Instant::now() + VIEWER_DEADLINE;
    while !publisher.has_subscribers("main") && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(50));
    }
    let publisher = LivePublisher::start(publisher, OutputSettings::default().jpeg_quality)?;

    let main = pass(args, gpu, &simulator, &args.appearance, Some(publisher))?;
    let watch = viewer.finish();
    let main_mode = args.appearance.mode;
    let modes = vec![(main_mode, main.sheet.per_camera(), main.sheet.mean())];

    let metrics = Metrics {
        adapter: gpu.fastest().adapter_name(),
        seed: args.seed,
        gaussians: args.surface.gaussians,
        frames: main.frames,
        seconds: main.seconds,
        frames_per_second: main.frames as f64 / (main.seconds - main.scoring_seconds).max(1e-9),
        modes,
        stages: main.stages.clone(),
        drops: main.drops.clone(),
        memory_mib: main.memory.clone(),
        watch,
    };
    write_whole(&args.output.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
    let summary = summary(&metrics);
    let path = args.output.out.join("index.html");
    report(&metrics, main, &summary).save(&path)?;
    for (mode, scores, mean) in &metrics.modes {
        println!("\n{mode:?}: three cameras in, four held out");
        for s in scores.iter().chain(mean) {
            println!("  {:<4} PSNR {:.2} dB  SSIM {:.4}  FLIP {:.4}", s.camera, s.psnr_db, s.ssim, s.flip);
        }
    }
    println!();
    for (name, value) in &summary {
        println!("{name:<24} {value}");
    }
    println!(
        "\nreport: {} (open it in a browser); the viewer's images: {}",
        path.display(),
        args.output.out.join("watched").display()
    );
    Ok(())
}

/// Parses a motion: a name of the configuration, or a file.
fn motion(name: &str) -> Result<MotionConfig> {
    let path = Path::new(name);
    let is = |extensions: &[&str]| {
        extensions.iter().any(|e| path.extension().is_some_and(|found| found.eq_ignore_ascii_case(e)))
    };
    if is(&["bvh"]) {
        return Ok(MotionConfig { kind: MotionKind::Bvh, bvh: Some(path.into()), ..MotionConfig::default() });
    }
    if is(&["glb", "gltf"]) {
        return Ok(MotionConfig { kind: MotionKind::Gltf, gltf: Some(path.into()), ..MotionConfig::default() });
    }
    let named: Result<MotionKind, serde::de::value::Error> = MotionKind::deserialize(name.into_deserializer());
    let kind = named.map_err(|error| anyhow!("--motion: {error}; or name a file *.bvh, *.glb or *.gltf"))?;
    Ok(MotionConfig { kind, ..MotionConfig::default() })
}

fn sim_config(args: &DemoArgs) -> Result<SimConfig> {
    let defaults = SimConfig::default();
    let motion = motion(&args.motion)?;
    // However many frames there are, they show the whole turn.
    let turn_secs =
        if args.minutes.is_some() { motion.turn_secs } else { (args.frames as f64 / defaults.fps).clamp(2.0, 60.0) };
    let faults = match &args.faults {
        None => FaultScript::default(),
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .with_context(|| format!("cannot read the fault script {}", path.display()))?;
            FaultScript::parse(&text).with_context(|| format!("in {}", path.display()))?
        }
    };
    Ok(SimConfig { seed: args.seed, motion: MotionConfig { turn_secs, ..motion }, faults, ..defaults })
}

fn lock(simulator: &Mutex<Simulator>) -> Result<MutexGuard<'_, Simulator>> {
    simulator.lock().map_err(|_| anyhow::anyhow!("the simulator's thread failed; see the log above"))
}

fn pass(
    args: &DemoArgs,
    gpu: &GpuContext,
    simulator: &Arc<Mutex<Simulator>>,
    appearance: &AppearanceOptions,
    publisher: Option<LivePublisher>,
) -> Result<Pass> {
    let rig = lock(simulator)?.rig().clone();
    let inputs = select_cameras(&rig, &INPUTS.map(str::to_owned), "the simulated rig")?;
    let held_out = select_cameras(&rig, &HELD_OUT.map(str::to_owned), "the simulated rig")?.cameras;
    let sources: Vec<Box<dyn CameraSource>> = flyrig_sim::sources(simulator, SimTime::Exact)
        .into_iter()
        .filter(|source| inputs.slot(source.camera()).is_some())
        .map(|source| Box::new(source) as Box<dyn CameraSource>)
        .collect();
    let settings = SessionSettings {
        perception: args.perception(),
        body: BodySettings { gaussians: args.surface.gaussians, ..BodySettings::default() },
        tracking: args.tracking.clone(),
        appearance: appearance.clone(),
        budget: args.budget,
    };
    let builder = SessionBuilder::new(gpu.clone(), inputs.clone()).settings(settings);
    let session = match args.pose {
        Origin::Given => {
            let mut simulator = lock(simulator)?;
            let given = GivenPerception::repeating(&inputs, simulator.template().clone(), simulator.track().clone());
            let mut given = given.with_masks(&args.perception(), &simulated_plates(&simulator, &inputs)?)?;
            given.find_outfits(&first_sets(&mut simulator, &inputs)?)?;
            builder.perception(given).build()?
        }
        Origin::Estimated => builder.perception(find_person(args, simulator, &inputs)?).build()?,
    };
    if let Some(publisher) = &publisher {
        publisher.publisher().set_calibration(session.rig())?;
    }
    let intake = Intake::start(sources, InputFormat::Rgb, &SyncSettings::default(), Pacing::Lossless)?;
    let views = LiveViews::new(&OutputSettings::default());
    let mut live = LiveRig::new(session, intake, views, publisher).with_splats(false);

    let limit = args.minutes.map(|minutes| flyrig_types::saturating_secs(minutes * 60.0));
    let total = limit.map_or(args.frames as u64, |limit| limit.as_secs());
    let bar = progress_bar(total, if limit.is_some() { "seconds" } else { "frames" });
    let score_every = if limit.is_some() { 50 } else { (args.frames as u64 / SCORED).max(1) };
    let started = Instant::now();
    let mut pass = Pass::default();
    let mut last_memory: Option<Instant> = None;
    while !stop::requested() {
        let done = limit.map_or(pass.frames >= args.frames as u64, |limit| started.elapsed() >= limit);
        if done {
            break;
        }
        let turn_time = flyrig_types::saturating_secs(pass.frames as f64 / 12.0);
        let Some(step) = live.step(Duration::from_secs(10), Some(turn_time))? else {
            if live.ended() {
                break;
            }
            bail!("the simulated cameras gave nothing for 10 s; run with -v to see why");
        };
        let set = step.set;
        if pass.frames % score_every == score_every / 2 {
            let start = Instant::now();
            let done = limit.map_or(pass.frames as f64 / args.frames as f64, |limit| {
                started.elapsed().as_secs_f64() / limit.as_secs_f64()
            });
            let row_due = done * CONTACT_ROWS as f64 >= pass.contact.len() as f64;
            let wants_row = pass.contact.len() < CONTACT_ROWS && row_due;
            score(&mut pass, &mut live.session, simulator, &rig.cameras, &held_out, &set, wants_row)?;
            pass.scoring_seconds += start.elapsed().as_secs_f64();
        }
        pass.frames += 1;
        if last_memory.is_none_or(|at| at.elapsed() >= MEMORY_EVERY) {
            last_memory = Some(Instant::now());
            pass.memory.extend(resident_mib().map(|mib| (started.elapsed().as_secs_f64(), mib)));
        }
        advance(&bar, limit.map_or(pass.frames, |_| started.elapsed().as_secs()), &pass.sheet);
    }
    bar.finish_and_clear();
    ensure!(pass.frames > 0 || stop::requested(), "the simulated cameras gave no frame; the warnings above say why");
    pass.memory.extend(resident_mib().map(|mib| (started.elapsed().as_secs_f64(), mib)));
    pass.seconds = started.elapsed().as_secs_f64();
    pass.stages = live.session.stages.summary();
    pass.drops = live.drops();
    live.finish()?;
    Ok(pass)
}

/// Finds the person as with real cameras; estimates the shape unless it is given.
fn find_person(args: &DemoArgs, simulator: &Mutex<Simulator>, inputs: &Rig) -> Result<EstimatedPerception> {
    let mut simulator = lock(simulator)?;
    let plates = simulated_plates(&simulator, inputs)?;
    let sets = first_sets(&mut simulator, inputs)?;
    if args.perception().shape() == Origin::Given {
        let mut perception = EstimatedPerception::new(inputs, simulator.template(), &args.perception(), &plates)?;
        perception.find_outfits(&sets)?;
        return Ok(perception);
    }
    let template = default_template(&ShapeParams::default())?;
    let mut perception = EstimatedPerception::new(inputs, &template, &args.perception(), &plates)?;
    eprintln!("demo: learning the person's shape from {SHAPE_SETS} frames of the first {SHAPE_SECS} seconds");
    for fit in perception.learn_shapes(&sets)? {
        eprintln!("demo: the person is {fit}");
    }
    Ok(perception)
}

/// Simulates frame sets of the first seconds, from which shape and clothes are estimated.
fn first_sets(simulator: &mut Simulator, inputs: &Rig) -> Result<Vec<FrameSet>> {
    let mut sets = Vec::new();
    for index in 0..SHAPE_SETS {
        let master_nanos = (SHAPE_SECS * 1e9 * index as f64 / SHAPE_SETS as f64) as i64;
        let mut frames = Vec::new();
        for camera in &inputs.cameras {
            let slot = simulator.rig().slot(&camera.id).context("the input cameras are the simulator's")?;
            let (image, mask) = simulator.capture(master_nanos, slot)?;
            frames.push(Some(Arc::new(Frame {
                camera: camera.id.clone(),
                sequence: index as u64,
                capture_nanos: master_nanos,
                exposure_nanos: None,
                image,
                mask: Some(mask),
            })));
        }
        sets.push(FrameSet { index: index as u64, master_nanos, frames });
    }
    Ok(sets)
}

fn advance(bar: &ProgressBar, position: u64, sheet: &ScoreSheet) {
    bar.set_position(position);
    bar.set_message(sheet.progress());
}

fn score(
    pass: &mut Pass,
    session: &mut Session,
    simulator: &Mutex<Simulator>,
    all: &[Camera],
    held_out: &[Camera],
    set: &FrameSet,
    wants_row: bool,
) -> Result<()> {
    let row = pass.contact.len();
    for (i, camera) in held_out.iter().enumerate() {
        let slot = all.iter().position(|c| c.id == camera.id).context("a held-out camera is not in the rig")?;
        let truth: SimFrame = lock(simulator)?.render(set.master_nanos, slot)?;
        let ours = session.render(camera)?;
        pass.sheet.extend(score_view(&camera.id, set.index, &ours, &truth.color, Some(&truth.mask))?);
        if wants_row && i == row % held_out.len() {
            let mut pictures = Vec::new();
            if let Some((_, frame)) = set.present().next() {
                let image = &frame.image;
                pictures.push((
                    format!("input {}", frame.camera),
                    png::encode_rgb(image.bytes(), image.width(), image.height())?,
                ));
            }
            pictures.extend(contact_images(&camera.id, &ours, &truth.color, Some(&truth.mask))?);
            pass.contact.push(ContactRow { label: format!("frame {}", set.index), pictures });
        }
    }
    Ok(())
}

/// `flyrig watch` in a child process.
struct Viewer {
    child: Child,
    stats: PathBuf,
}

impl Viewer {
    fn start(out: &Path, endpoint: &str) -> Result<Self> {
        let stats = out.join("watch.json");
        let _ = std::fs::remove_file(&stats);
        let program = std::env::current_exe().context("finding our own program file")?;
        let child = Command::new(program)
            .args(["watch", "--until-end", "--rig", RIG_NAME, "--connect", endpoint, "--view", "main", "--out"])
            .arg(out.join("watched"))
            .arg("--stats")
            .arg(&stats)
            .stderr(std::process::Stdio::null())
            .spawn()
            .context("starting the viewer process")?;
        Ok(Self { child, stats })
    }

    /// Waits until the viewer has seen the end, then reads its statistics.
    fn finish(mut self) -> Option<WatchStats> {
        let deadline = Instant::now() + VIEWER_END;
        while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(50));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        serde_json::from_slice(&std::fs::read(&self.stats).ok()?).ok()
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn summary(metrics: &Metrics) -> Vec<(String, String)> {
    let mut facts = vec![
        ("adapter".to_owned(), metrics.adapter.clone()),
        ("Gaussians".to_owned(), metrics.gaussians.to_string()),
        (
            "end to end".to_owned(),
            format!(
                "{} frames, {:.2} per second without scoring (simulating the three input cameras included)",
                metrics.frames, metrics.frames_per_second
            ),
        ),
    ];
    if let Some(w) = &metrics.watch {
        let latency = w.latency_p50_ms.map_or_else(String::new, |p50| format!(", latency {p50:.1} ms median"));
        facts.push(("viewer process".to_owned(), format!("{} images, {} missed{latency}", w.received, w.missed)));
    } else {
        facts.push(("viewer process".to_owned(), "gave no statistics".to_owned()));
    }
    let lost: Vec<String> =
        metrics.drops.iter().filter(|(_, count)| *count > 0).map(|(place, count)| format!("{count} {place}")).collect();
    facts.push(("dropped".to_owned(), if lost.is_empty() { "nothing".to_owned() } else { lost.join(", ") }));
    if let (Some(first), Some(last)) = (metrics.memory_mib.first(), metrics.memory_mib.last()) {
        facts.push((
            "memory".to_owned(),
            format!("{:.0} MiB at the start, {:.0} MiB after {:.0} s", first.1, last.1, last.0),
        ));
    }
    facts
}

fn report(metrics: &Metrics, main: Pass, summary: &[(String, String)]) -> Report {
    Report {
        title: "flyrig demo: three simulated cameras in, a walk-around human out".to_owned(),
        facts: summary.to_vec(),
        scores: metrics
            .modes
            .iter()
            .map(|(mode, cameras, mean)| {
                (format!("Held-out cameras, appearance {mode:?}"), cameras.iter().chain(mean).cloned().collect())
            })
            .collect(),
        stages: metrics.stages.clone(),
        curves: vec![
            Curve {
                title: "PSNR of the held-out cameras".to_owned(),
                x_label: "frame".to_owned(),
                y_label: "dB".to_owned(),
                lines: main.sheet.curves(),
            },
            Curve {
                title: "Memory".to_owned(),
                x_label: "seconds".to_owned(),
                y_label: "MiB".to_owned(),
                lines: vec![("resident".to_owned(), main.memory)],
            },
        ],
        contact: main.contact,
        ..Report::default()
    }
}
