//! One way of tracking, and what it gave.

use crate::harness::{
    sequence::{Motion, Sequence, SequenceConfig},
    surface::Points,
};
use anyhow::{Context, Result};
use flyrig_fusion::{
    BodySettings, DeformOptions, GivenPerception, PROCESSOR_STAGE, PersonId, Session, SessionBuilder, SessionSettings,
    Solver, Subject, TrackingSettings,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_tracker::FIRST_FRAMES;
use serde::Serialize;

/// Points on the tracked surface.
const OUR_POINTS: usize = 20_000;

/// What to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// What is special about it: a solver's name, or that and what differs from its defaults.
    pub variant: String,
    pub solver: Solver,
    /// None: skinned only.
    pub options: Option<DeformOptions>,
    /// Gaussians that are drawn.
    pub gaussians: usize,
    /// Input cameras.
    pub views: usize,
    pub sequence: SequenceConfig,
}

/// What came out.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    pub name: String,
    pub variant: String,
    pub solver: Solver,
    pub gaussians: usize,
    /// Gaussians that were compared with the images.
    pub compared: usize,
    pub views: usize,
    pub sequence: SequenceConfig,
    /// Over the second half of the sequence.
    pub psnr_db: f64,
    pub ssim: f64,
    pub iou: f64,
    /// Mean distance of our surface to the true one, of the true one to ours, and of what the cameras see of it, at the last
    /// instant; the mean of the first two is the Chamfer distance.
    pub accuracy_mm: f64,
    pub completeness_mm: f64,
    pub seen_mm: f64,
    pub chamfer_mm: f64,
    /// Mean milliseconds a frame of every stage.
    pub stages_ms: Vec<(String, f64)>,
    /// Mean milliseconds of the deformation, over all frames, the first ten, and those after them: the processor's where the
    /// graphics adapter is software, so that other programs do not count.
    pub deformation_ms: f64,
    pub first_ms: f64,
    pub later_ms: f64,
    /// What was left out, counted over all frames.
    pub skipped: Vec<(String, u64)>,
    /// Total loss of the first frame's iterations, and of the last frame's.
    pub first_energy: Vec<f64>,
    pub last_energy: Vec<f64>,
}

impl Case {
    /// A solver as it is by default.
    pub fn new(solver: Solver, gaussians: usize, views: usize, sequence: SequenceConfig) -> Self {
        let variant = match solver {
            Solver::None => "off",
            Solver::Paper => "paper",
            Solver::GaussNewton => "default",
        };
        Self { variant: variant.to_owned(), solver, options: solver.options(), gaussians, views, sequence }
    }

    /// The same but for one thing.
    pub fn but(&self, what: &str, change: impl FnOnce(&mut DeformOptions)) -> Self {
        let mut case = self.clone();
        case.variant = format!("{}, {what}", case.variant);
        if let Some(options) = &mut case.options {
            change(options);
        }
        case
    }

    /// For tables.
    pub fn name(&self) -> String {
        let SequenceConfig { seed, side, motion, .. } = self.sequence;
        let still = if motion == Motion::Still { ", still" } else { "" };
        format!("{}; {} views, {side}², seed {seed}{still}", self.variant, self.views)
    }
}

/// Builds a session for a case.
pub fn session(gpu: &GpuContext, sequence: &Sequence, case: &Case) -> Result<Session> {
    let rig = sequence.inputs(case.views);
    let perception = GivenPerception::repeating(&rig, sequence.template.clone(), sequence.track.clone());
    let settings = SessionSettings {
        body: BodySettings::with_gaussians(case.gaussians),
        tracking: TrackingSettings { solver: case.solver, replaced: case.options, ..TrackingSettings::default() },
        ..SessionSettings::default()
    };
    let builder = SessionBuilder::new(gpu.clone(), rig).settings(settings);
    Ok(builder.perception(perception).build()?)
}

/// Points on the surface of the last update.
fn tracked_surface(session: &Session) -> Result<Points> {
    let subject = session.subject(PersonId::default()).context("there is nobody")?;
    let (positions, _) = subject.surface(subject.pose().context("no frame was used")?);
    Ok(Points::on(&positions, &subject.template().triangles, OUR_POINTS))
}

/// Mean distance of our surface to the true one at the last instant, and of the true one to ours, millimetres.
fn distances_mm(ours: &Points, sequence: &Sequence) -> [f64; 2] {
    let to_truth = sequence.truth.mean_distance(&ours.points);
    [to_truth, ours.mean_distance(&sequence.truth.points)].map(|metres| metres * 1e3)
}

/// Chamfer distance of the last update's surface, to the truth of the last instant.
pub fn chamfer_mm(session: &Session, sequence: &Sequence) -> Result<f64> {
    Ok(0.5 * distances_mm(&tracked_surface(session)?, sequence).iter().sum::<f64>())
}

/// Tracks the whole sequence.
pub fn run_case(gpu: &GpuContext, sequence: &Sequence, case: &Case) -> Result<Row> {
    run_session(session(gpu, sequence, case)?, sequence, case)
}

/// Tracks the whole sequence with this session.
pub fn run_session(mut session: Session, sequence: &Sequence, case: &Case) -> Result<Row> {
    let person = PersonId::default();
    let mut sheet = ScoreSheet::default();
    let (mut first_energy, mut last_energy) = (Vec::new(), Vec::new());
    let mut times_ms = Vec::new();
    let frames = sequence.config().frames;
    let cost_stage = if session.gpu().is_software() { PROCESSOR_STAGE } else { "deformation" };
    for set in sequence.sets(case.views) {
        let before = session.stages.total_ms(cost_stage);
        session.process(&set)?;
        times_ms.push(session.stages.total_ms(cost_stage) - before);
        if let Some(report) = session.subject(person).and_then(Subject::deform_report) {
            last_energy.clone_from(&report.losses);
            if first_energy.is_empty() {
                first_energy.clone_from(&report.losses);
            }
        }
        if set.index as usize >= frames / 2 {
            for (camera, truth) in sequence.held_out(set.index as usize)? {
                let view = session.render(camera)?;
                sheet.extend(score_view(&camera.id, set.index, &view, &truth.image, truth.mask.as_ref())?);
            }
        }
    }
    let mean = sheet.mean().context("nothing to compare")?;
    let ours = tracked_surface(&session)?;
    let [accuracy_mm, completeness_mm] = distances_mm(&ours, sequence);
    let seen_mm = ours.mean_distance(&sequence.truth.filter(|p| sequence.seen(p, case.views))) * 1e3;
    let stages_ms: Vec<(String, f64)> =
        session.stages.summary().into_iter().map(|s| (s.name.trim().to_owned(), f64::from(s.mean_ms))).collect();
    let mean_ms = |times: &[f64]| times.iter().sum::<f64>() / times.len().max(1) as f64;
    let (first, later) = times_ms.split_at(times_ms.len().min(FIRST_FRAMES as usize));
    Ok(Row {
        name: case.name(),
        variant: case.variant.clone(),
        solver: case.solver,
        gaussians: case.gaussians,
        compared: session.subject(person).map_or(0, Subject::compared_gaussians),
        views: case.views,
        sequence: sequence.config(),
        psnr_db: mean.psnr_db,
        ssim: mean.ssim,
        iou: mean.iou.unwrap_or(0.0),
        accuracy_mm,
        completeness_mm,
        seen_mm,
        chamfer_mm: 0.5 * (accuracy_mm + completeness_mm),
        stages_ms,
        deformation_ms: mean_ms(&times_ms),
        first_ms: mean_ms(first),
        later_ms: mean_ms(later),
        skipped: session.stages.counts().map(|(name, count)| (name.to_owned(), count)).collect(),
        first_energy,
        last_energy,
    })
}
