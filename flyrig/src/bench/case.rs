//! One way of tracking, and what it gave.

use anyhow::{Context, Result};
use flyrig_body::DEFAULT_NODE_COUNT;
use flyrig_gpu::GpuContext;
use flyrig_renderer::WantedPicture;
use flyrig_tracker::DeformSolver;
use serde::Serialize;

use super::sequence::Sequence;
use super::surface::Points;
use crate::{
    config::{AppearanceMode, Origin, Solver},
    deformation::DeformOptions,
    engine::Engine,
    pipeline::{Pipeline, PoseSource},
    score::{ScoreSheet, score_view},
};

/// Points on the tracked surface.
const OUR_POINTS: usize = 20_000;

/// What to run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Case {
    pub solver: Solver,
    /// Of the first frames and of later ones, where not the default.
    pub iterations: Option<[usize; 2]>,
    /// Gaussians that are drawn.
    pub gaussians: usize,
    /// Gaussians that are compared, where not the default.
    pub compared: Option<usize>,
    /// Pictures are not halved.
    pub full_size: bool,
    pub views: usize,
    pub side: u32,
}

/// What came out.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    pub name: String,
    pub solver: Solver,
    pub iterations: Option<[usize; 2]>,
    pub gaussians: usize,
    pub compared: Option<usize>,
    pub full_size: bool,
    pub views: usize,
    pub side: u32,
    pub frames: usize,
    /// Over the second half of the sequence.
    pub psnr_db: f64,
    pub ssim: f64,
    pub iou: f64,
    /// Mean distance of our surface to the true one, of the true one to ours, and of what the cameras see of it, at the last
    /// instant; their mean is the Chamfer distance.
    pub accuracy_mm: f64,
    pub completeness_mm: f64,
    pub seen_mm: f64,
    pub chamfer_mm: f64,
    /// Mean milliseconds a frame of every stage.
    pub stages_ms: Vec<(String, f64)>,
    pub deformation_ms: f64,
    /// Total loss of the first frame's iterations, and of the last frame's.
    pub first_energy: Vec<f64>,
    pub last_energy: Vec<f64>,
}

impl Case {
    /// For tables.
    pub fn name(&self) -> String {
        let mut name = match self.solver {
            Solver::None => "off".to_owned(),
            Solver::Paper => "paper".to_owned(),
            Solver::GaussNewton => "default".to_owned(),
        };
        if let Some([first, later]) = self.iterations {
            name += &format!(" {first}/{later} iterations");
        }
        if let Some(compared) = self.compared {
            name +=
                &if compared == usize::MAX { " all Gaussians".to_owned() } else { format!(" {compared} Gaussians") };
        }
        if self.full_size {
            name += " full size";
        }
        format!("{name}, {} views, {}²", self.views, self.side)
    }

    fn options(&self) -> Option<DeformOptions> {
        let mut options = self.solver.options(Origin::Given)?;
        if let (Some([first_iterations, iterations]), DeformSolver::GaussNewton { .. }) =
            (self.iterations, options.solver.solver)
        {
            options.solver.solver = DeformSolver::GaussNewton { first_iterations, iterations };
        }
        if let Some(compared) = self.compared {
            options.gaussians = compared;
        }
        if self.full_size {
            options.max_level = 0;
        }
        options.max_level = options.max_level.min(WantedPicture::MAX_LEVEL);
        Some(options)
    }
}

/// A pipeline for a case.
pub fn pipeline(gpu: &GpuContext, sequence: &Sequence, case: &Case) -> Result<Pipeline> {
    let engine = Engine::new(
        gpu.clone(),
        sequence.template.clone(),
        case.gaussians,
        DEFAULT_NODE_COUNT.min(case.gaussians / 12),
        case.views,
        AppearanceMode::Direct.settings(),
        case.options(),
    )?;
    let rig = sequence.inputs(case.views);
    let plates = rig.cameras.iter().map(|_| None).collect();
    let track = PoseSource::Track { track: sequence.track.clone(), repeat: true };
    Ok(Pipeline::new(engine, rig, track, Origin::Given, plates))
}

/// Tracks the whole sequence.
pub fn run_case(gpu: &GpuContext, sequence: &Sequence, case: &Case) -> Result<Row> {
    run_pipeline(pipeline(gpu, sequence, case)?, sequence, case)
}

/// Tracks the whole sequence with this pipeline.
pub fn run_pipeline(mut pipeline: Pipeline, sequence: &Sequence, case: &Case) -> Result<Row> {
    let mut sheet = ScoreSheet::default();
    let (mut first_energy, mut last_energy) = (Vec::new(), Vec::new());
    let frames = sequence.config().frames;
    for set in sequence.sets(case.views) {
        pipeline.process(&set)?;
        if let Some(report) = pipeline.engine().deform_report() {
            last_energy.clone_from(&report.losses);
            if first_energy.is_empty() {
                first_energy.clone_from(&report.losses);
            }
        }
        if set.index as usize >= frames / 2 {
            for (camera, truth) in sequence.held_out(set.index as usize)? {
                let view = pipeline.render(camera)?;
                sheet.extend(score_view(&camera.id, set.index, &view, &truth.image, truth.mask.as_ref())?);
            }
        }
    }
    let mean = sheet.mean().context("nothing to compare")?;
    let pose = pipeline.pose().cloned().context("no frame was used")?;
    let (positions, _) = pipeline.engine().surface(&pose);
    let ours = Points::on(&positions, &pipeline.engine().template().triangles, OUR_POINTS);
    let accuracy_mm = sequence.truth.mean_distance(&ours.points) * 1e3;
    let completeness_mm = ours.mean_distance(&sequence.truth.points) * 1e3;
    let seen_mm = ours.mean_distance(&sequence.truth.filter(|p| sequence.seen(p, case.views))) * 1e3;
    let stages_ms: Vec<(String, f64)> =
        pipeline.stages.summary().into_iter().map(|s| (s.name.trim().to_owned(), f64::from(s.mean_ms))).collect();
    let deformation_ms = stages_ms.iter().find(|(name, _)| name == "deformation").map_or(0.0, |(_, ms)| *ms);
    Ok(Row {
        name: case.name(),
        solver: case.solver,
        iterations: case.iterations,
        gaussians: case.gaussians,
        compared: case.compared.filter(|&n| n < usize::MAX),
        full_size: case.full_size,
        views: case.views,
        side: case.side,
        frames,
        psnr_db: mean.psnr_db,
        ssim: mean.ssim,
        iou: mean.iou.unwrap_or(0.0),
        accuracy_mm,
        completeness_mm,
        seen_mm,
        chamfer_mm: 0.5 * (accuracy_mm + completeness_mm),
        stages_ms,
        deformation_ms,
        first_energy,
        last_energy,
    })
}
