//! A variant of the tracking, and its result.

use anyhow::{Context, Result};
use flyrig_fusion::{
    BodySettings, DeformOptions, GivenPerception, PROCESSOR_STAGE, PersonId, Session, SessionBuilder, SessionSettings,
    Solver, Subject, TrackingSettings,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_tracker::FIRST_FRAMES;
use serde::Serialize;

use crate::harness::{
    sequence::{SequenceConfig, SequenceMotion, SimulatedSequence},
    surface::Points,
};

/// Number of points on the tracked surface.
const OUR_POINTS: usize = 20_000;

/// A variant of the tracking on one sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// Name of the solver, followed by the difference from its defaults if there is one.
    pub variant: String,
    pub solver: Solver,
    /// Options of the deformation; `None` for skinning alone.
    pub options: Option<DeformOptions>,
    /// Number of rendered Gaussians.
    pub gaussians: usize,
    /// Number of input cameras.
    pub views: usize,
    pub sequence: SequenceConfig,
}

/// Result of a case.
#[derive(Debug, Clone, Serialize)]
pub struct CaseRow {
    pub name: String,
    pub variant: String,
    pub solver: Solver,
    pub gaussians: usize,
    /// Number of Gaussians that were compared with the images.
    pub compared: usize,
    pub views: usize,
    pub sequence: SequenceConfig,
    /// Scores over the second half of the sequence.
    pub psnr_db: f64,
    pub ssim: f64,
    pub iou: f64,
    /// Mean distances at the last instant: of the tracked surface to the true one, of the true one to the tracked one, and of its part
    /// that the cameras see. The Chamfer distance is the mean of the first two.
    pub accuracy_mm: f64,
    pub completeness_mm: f64,
    pub seen_mm: f64,
    pub chamfer_mm: f64,
    /// Mean milliseconds per frame of every stage.
    pub stages_ms: Vec<(String, f64)>,
    /// Mean milliseconds of the deformation over all frames, the first ten, and the others; processor time where the graphics adapter
    /// is software, so that other programs do not count.
    pub deformation_ms: f64,
    pub first_ms: f64,
    pub later_ms: f64,
    /// Counters of skipped work over all frames.
    pub skipped: Vec<(String, u64)>,
    /// Total loss by iteration, of the first and of the last frame.
    pub first_energy: Vec<f64>,
    pub last_energy: Vec<f64>,
}

impl Case {
    /// Creates a case of a solver with its defaults.
    pub fn new(solver: Solver, gaussians: usize, views: usize, sequence: SequenceConfig) -> Self {
        let variant = match solver {
            Solver::None => "off",
            Solver::Paper => "paper",
            Solver::GaussNewton => "default",
        };
        Self { variant: variant.to_owned(), solver, options: solver.options(), gaussians, views, sequence }
    }

    /// Returns the case with one change of its options, which is named in its variant.
    pub fn but(&self, what: &str, change: impl FnOnce(&mut DeformOptions)) -> Self {
        let mut case = self.clone();
        case.variant = format!("{}, {what}", case.variant);
        if let Some(options) = &mut case.options {
            change(options);
        }
        case
    }

    /// Returns the name for tables.
    pub fn name(&self) -> String {
        let SequenceConfig { seed, side, motion, .. } = self.sequence;
        let still = if motion == SequenceMotion::Still { ", still" } else { "" };
        format!("{}; {} views, {side}², seed {seed}{still}", self.variant, self.views)
    }
}

/// Builds a session for a case.
pub fn session(gpu: &GpuContext, sequence: &SimulatedSequence, case: &Case) -> Result<Session> {
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

/// Spreads points over the surface of the last update.
fn tracked_surface(session: &Session) -> Result<Points> {
    let subject = session.subject(PersonId::default()).context("no person is tracked")?;
    let (positions, _) = subject.surface(subject.pose().context("no frame was used")?);
    Ok(Points::on(&positions, &subject.template().triangles, OUR_POINTS))
}

/// Returns the mean distances of the tracked surface to the true one at the last instant and vice versa, millimetres.
fn distances_mm(ours: &Points, sequence: &SimulatedSequence) -> [f64; 2] {
    let to_truth = sequence.truth.mean_distance(&ours.points);
    [to_truth, ours.mean_distance(&sequence.truth.points)].map(|metres| metres * 1e3)
}

/// Returns the Chamfer distance of the last update's surface to the truth of the last instant, millimetres.
pub fn chamfer_mm(session: &Session, sequence: &SimulatedSequence) -> Result<f64> {
    Ok(0.5 * distances_mm(&tracked_surface(session)?, sequence).iter().sum::<f64>())
}

/// Tracks a sequence in a new session.
pub fn run_case(gpu: &GpuContext, sequence: &SimulatedSequence, case: &Case) -> Result<CaseRow> {
    run_session(session(gpu, sequence, case)?, sequence, case)
}

/// Tracks a sequence in an existing session.
pub fn run_session(mut session: Session, sequence: &SimulatedSequence, case: &Case) -> Result<CaseRow> {
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
    Ok(CaseRow {
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
