//! Report and numbers of an evaluation.

use flyrig_fusion::{AppearanceMode, Counts, Origin, Solver, StageSummary};
use flyrig_metrics::{CameraScore, FrameScore};
use flyrig_report::{ContactRow, Curve, Report};
use flyrig_transport::LearningStats;
use flyrig_types::CameraId;
use serde::Serialize;

use super::{
    arguments::EvalArgs,
    checks::{Culprit, Verdict},
    plan::EvalPlan,
    run::{Evaluation, Run},
};

/// Meaning of the numbers in the table.
const FLIP: &str = "FLIP is the share of the picture that seems to change when one flips between the camera's image and ours, 0 to 1: below \
    0.1 one has to look for it. PSNR (dB) and SSIM compare the pixels: higher is better.";

/// `metrics.json`.
#[derive(Debug, Serialize)]
pub struct Metrics<'a> {
    dataset: String,
    inputs: &'a [String],
    holdout: Vec<String>,
    /// Whether each camera of `holdout` was left out alone, in a reconstruction from all other inputs.
    in_turn: bool,
    pose: Origin,
    masks: Origin,
    shape: Origin,
    solver: Solver,
    appearance: AppearanceMode,
    gaussians: usize,
    nodes: usize,
    /// Avatar that initialized tracking and colours.
    avatar: Option<String>,
    adapter: String,
    frames: usize,
    seconds: f64,
    /// "mask": scored on black inside the box of the held-out mask; "own silhouette": composited over the held-out image
    /// inside the box of the rendered silhouette, because the data set has no mask of that camera.
    reference: &'static str,
    mean: Option<CameraScore>,
    cameras: Vec<CameraScore>,
    verdicts: Vec<Verdict>,
    per_frame: &'a [FrameScore],
    counts: Counts,
    /// Progress of `--learn`.
    learning: Option<LearningStats>,
    sync: serde_json::Value,
    stages: Vec<StageSummary>,
}

/// Describes in words how far the person was learnt.
fn learnt(LearningStats { version, key_sets, rounds, seconds, gain }: LearningStats) -> String {
    let known = match (version, gain) {
        (0, _) => "the person was made of its surface at the end".to_owned(),
        (version, None) => format!("the person was version {version} at the end, as it was saved"),
        (version, Some(gain)) => format!(
            "the person was version {version} at the end, with an error {:.0} % lower than before on images it was not fitted to",
            100.0 * gain
        ),
    };
    format!("Learning: {known}; {rounds} rounds on {key_sets} key sets took {seconds:.0} s.")
}

impl<'a> Metrics<'a> {
    /// Collects the numbers. Counts and run times are those of the first run.
    pub fn new(args: &'a EvalArgs, plan: &EvalPlan, evaluation: &'a Evaluation, first: &Run, seconds: f64) -> Self {
        let perception = &args.take.perception.settings;
        let cameras = evaluation.sheet.per_camera();
        Self {
            dataset: args.name(),
            inputs: &args.take.inputs,
            holdout: plan.held_out(),
            in_turn: plan.splits.len() > 1,
            pose: perception.pose,
            masks: perception.masks,
            shape: perception.shape(),
            solver: args.take.tracking.solver,
            appearance: args.appearance.mode,
            gaussians: args.body.gaussians,
            nodes: args.body.nodes,
            avatar: args.avatar.as_ref().map(|path| path.display().to_string()),
            adapter: first.replay.session.gpu().adapter_name(),
            frames: first.processed as usize,
            seconds,
            reference: evaluation.sheet.reference(),
            mean: evaluation.sheet.mean(),
            verdicts: verdicts(evaluation, &cameras),
            cameras,
            per_frame: evaluation.sheet.frames(),
            counts: first.replay.session.counts.clone(),
            learning: first.replay.session.learning(),
            sync: first.replay.sync_summary(),
            stages: first.replay.session.stages.summary(),
        }
    }

    /// Returns the sentences about the take: what was done, each camera, and the next step.
    pub fn sentences(&self, args: &EvalArgs, plan: &EvalPlan, evaluation: &Evaluation) -> Vec<String> {
        let mut sentences = Vec::new();
        if let Some(mean) = &self.mean {
            sentences.push(format!(
                "Mean of the held-out views: {:.1} dB over {} images. 22 to 26 dB is what real takes with a right calibration reach.",
                mean.psnr_db, mean.frames
            ));
        }
        sentences.push(plan.method.clone());
        sentences.extend(self.learning.map(learnt));
        sentences.extend(self.verdicts.iter().map(|verdict| verdict.words.clone()));
        let culprit = Culprit::find(&evaluation.without);
        sentences.extend(culprit.as_ref().map(Culprit::words));
        sentences.extend(Verdict::next_step(
            &self.verdicts,
            culprit.as_ref(),
            &args.take.dataset.display().to_string(),
        ));
        sentences
    }

    /// Builds the report.
    pub fn report(
        &self,
        args: &EvalArgs,
        plan: &EvalPlan,
        evaluation: &Evaluation,
        contact: Vec<ContactRow>,
    ) -> Report {
        let held_out = if self.holdout.is_empty() { "none".to_owned() } else { self.holdout.join(" ") };
        let turn = if self.in_turn { ", in turn" } else { "" };
        let facts = [
            ("adapter", self.adapter.clone()),
            ("inputs, held out", format!("{} → {held_out}{turn}", self.inputs.join(" "))),
            (
                "pose, masks, shape, deformation, appearance",
                format!(
                    "{:?}, {:?}, {:?}, {:?}, {:?}",
                    self.pose, self.masks, self.shape, self.solver, self.appearance
                ),
            ),
            ("Gaussians, nodes", format!("{}, {}", self.gaussians, self.nodes)),
            ("time offsets subtracted, ms", listed(&args.take.lags.by_camera)),
            ("frames", format!("{} in {:.1} s, writing and scoring included", self.frames, self.seconds)),
            ("scored against", self.reference.to_owned()),
        ];
        let mut sentences = self.sentences(args, plan, evaluation);
        let mut links = vec![("Play the take in 3D".to_owned(), "take.html".to_owned())];
        if let Some(film) = args.orbit.as_ref().filter(|film| film.parent() == Some(&args.out)) {
            let name = film.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
            links.push(("Film of a camera that walks around".to_owned(), name));
        }
        let mut scores = Vec::new();
        let mut curves = Vec::new();
        if self.mean.is_some() {
            sentences.push(FLIP.to_owned());
            let rows = self.cameras.iter().chain(&self.mean).cloned().collect();
            scores.push(("Held-out cameras".to_owned(), rows));
            curves.push(Curve {
                title: "PSNR over frames".to_owned(),
                x_label: "frame".to_owned(),
                y_label: "dB".to_owned(),
                lines: evaluation.sheet.curves(),
            });
        }
        Report {
            title: format!("flyrig eval: {}", self.dataset),
            sentences,
            links,
            facts: facts.map(|(name, value)| (name.to_owned(), value)).to_vec(),
            scores,
            stages: self.stages.clone(),
            curves,
            contact,
            ..Report::default()
        }
    }
}

/// Forms the verdicts about all cameras that were compared or scored.
fn verdicts(evaluation: &Evaluation, scores: &[CameraScore]) -> Vec<Verdict> {
    let mut names: Vec<CameraId> = evaluation.checks.keys().cloned().collect();
    names.extend(scores.iter().map(|score| score.camera.as_str().into()));
    names.sort();
    names.dedup();
    let verdict = |id: &CameraId| {
        let score = scores.iter().find(|score| score.camera == id.as_str());
        evaluation.checks.get(id).unwrap_or(&Default::default()).verdict(id.as_str(), score)
    };
    names.iter().map(verdict).collect()
}

/// Formats time offsets for the report, milliseconds.
fn listed(lags: &[(String, f64)]) -> String {
    let each: Vec<String> = lags.iter().map(|(camera, lag)| format!("{camera} {lag}")).collect();
    if each.is_empty() { "none".to_owned() } else { each.join(", ") }
}
