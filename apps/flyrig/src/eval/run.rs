//! Reconstructions of all splits side by side, one frame set after the other: scores, checks and images.
//!
//! A reconstruction reads, decodes and perceives the images of its own cameras alone, exactly as if the others were not evaluated. The mask of a
//! held-out image, with which outlines are compared, comes from the take, or from the reconstruction from all cameras; it reaches no other
//! reconstruction.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result};
use flyrig_body::write_mesh_ply;
use flyrig_fusion::{Outcome, PersonId, Session};
use flyrig_metrics::{FrameScore, ScoreSheet, error_parts, score_view};
use flyrig_report::{ContactRow, contact_images, outlined_inputs, outlined_view, png, progress_bar};
use flyrig_takes::{Replay, frame_number};
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Mask, RenderedView};
use indicatif::ProgressBar;
use rayon::prelude::*;

use super::{checks::CameraCheck, shown::TakeShow};

/// Frame sets from one written surface to the next.
const SURFACE_EVERY: u64 = 10;
/// Frame sets from one comparison of the input views' outlines to the next.
const CHECK_EVERY: u64 = 4;
/// Least number of instants on the report's contact sheet, and largest number of those with input views.
const CONTACT_ROWS: u64 = 4;
/// Difference below which capture times are those of one image, nanoseconds.
const SAME_NANOS: u64 = 1_000_000;
/// Interval between lines of progress where no bar can be shown.
const PRINT_EVERY: Duration = Duration::from_secs(15);

/// Reconstruction of one split.
pub struct Run {
    /// Session of the input cameras and images of those held out.
    pub replay: Replay,
    /// Number of frame sets in which there was a person.
    pub processed: u64,
    /// Whether there are more frame sets.
    goes_on: bool,
}

impl Run {
    /// Starts with an opened replay.
    pub fn new(replay: Replay) -> Self {
        Self { replay, processed: 0, goes_on: true }
    }
}

/// Scores, checks and images of a take, collected frame set by frame set.
pub struct Evaluation {
    out: PathBuf,
    /// Number of cameras that are held out in turn, each in a run of its own after the first run; 0 if they are named.
    in_turn: u64,
    /// Number of frame sets of the take.
    total: u64,
    /// Scores of the held-out views.
    pub sheet: ScoreSheet,
    /// Comparison of each camera that is held out; of the inputs, if none is held out in turn.
    pub checks: BTreeMap<CameraId, CameraCheck>,
    /// Comparisons of the input views in the reconstruction without each camera that is held out in turn.
    pub without: BTreeMap<CameraId, CameraCheck>,
    /// Rows of the contact sheet.
    pub contact: Vec<ContactRow>,
    /// Capture time and mask of each image of the first run's last frame set, nanoseconds.
    masks: BTreeMap<CameraId, (i64, Mask)>,
}

impl Evaluation {
    /// Starts an evaluation that writes into a folder.
    pub fn new(out: &Path, runs: &[Run]) -> Self {
        let first = runs.first();
        Self {
            out: out.to_owned(),
            in_turn: runs.len().saturating_sub(1) as u64,
            total: first.map_or(0, |run| run.replay.count as u64),
            sheet: ScoreSheet::default(),
            checks: BTreeMap::new(),
            without: BTreeMap::new(),
            contact: Vec::new(),
            masks: BTreeMap::new(),
        }
    }

    /// Processes all frame sets, and writes views and surfaces. The first run is added to `shown`.
    ///
    /// # Errors
    /// Those of the take, the adapter and the disk.
    pub fn run(&mut self, runs: &mut [Run], shown: &mut TakeShow) -> Result<()> {
        self.create_folders(runs)?;
        let all = runs.iter().map(|run| run.replay.count as u64).sum();
        let mut progress =
            Progress { bar: progress_bar(all, "eval"), started: Instant::now(), printed: Instant::now() };
        while runs.iter().any(|run| run.goes_on) {
            for (index, run) in runs.iter_mut().enumerate().filter(|(_, run)| run.goes_on) {
                let Some(set) = run.replay.next_set()? else {
                    run.goes_on = false;
                    continue;
                };
                self.step(index, run, &set, shown)?;
                progress.step(&self.sheet);
            }
        }
        progress.bar.finish_and_clear();
        Ok(())
    }

    fn create_folders(&self, runs: &[Run]) -> Result<()> {
        let create =
            |path: PathBuf| std::fs::create_dir_all(&path).with_context(|| format!("cannot create {}", path.display()));
        create(self.out.join("surface"))?;
        let mut held_out = runs.iter().flat_map(|run| &run.replay.holdout);
        held_out.try_for_each(|camera| create(self.out.join(camera.id.as_str())))
    }

    /// Processes a frame set of a run.
    fn step(&mut self, index: usize, run: &mut Run, set: &FrameSet, shown: &mut TakeShow) -> Result<()> {
        let number = frame_number(set);
        if let Outcome::Held(reason) = run.replay.session.process(set)? {
            tracing::warn!(frame = number, %reason, "frame not used");
            if !run.replay.session.has_people() {
                return Ok(());
            }
        }
        let row = self.contact_row(run.processed);
        if index == 0 {
            shown.add(&mut run.replay.session, set)?;
            self.step_first(&mut run.replay.session, set, row)?;
        }
        if let ([held], true) = (run.replay.holdout.as_slice(), self.in_turn > 0 && number.is_multiple_of(CHECK_EVERY))
        {
            let check = self.without.entry(held.id.clone()).or_default();
            check_inputs(&mut run.replay.session, |_, view, rgb, mask| {
                check.compare(set.master_nanos, view, rgb, mask);
            })?;
        }
        let is_turn = |row: &u64| self.in_turn == 0 || row % self.in_turn + 1 == index as u64;
        self.score_set(&mut run.replay, set.master_nanos, number, row.filter(is_turn))?;
        run.processed += 1;
        Ok(())
    }

    /// Returns the number of the contact sheet's instant that a run's next frame set is, if it is one.
    fn contact_row(&self, processed: u64) -> Option<u64> {
        let rows = self.in_turn.max(CONTACT_ROWS);
        let every = (self.total / rows).max(1);
        (processed % every == every / 2 && processed / every < rows).then_some(processed / every)
    }

    /// Writes and checks the reconstruction of the first run.
    fn step_first(&mut self, session: &mut Session, set: &FrameSet, row: Option<u64>) -> Result<()> {
        let number = frame_number(set);
        if number.is_multiple_of(SURFACE_EVERY) {
            self.write_surface(session, number)?;
        }
        if self.in_turn > 0 {
            self.keep_masks(session, set)?;
        } else if number.is_multiple_of(CHECK_EVERY) {
            let checks = &mut self.checks;
            check_inputs(session, |camera, view, rgb, mask| {
                checks.entry(camera).or_default().compare(set.master_nanos, view, rgb, mask);
            })?;
        }
        let every = (self.in_turn / CONTACT_ROWS).max(1);
        if row.is_some_and(|row| row.is_multiple_of(every)) {
            let pictures = outlined_inputs(session, PersonId::default())?;
            self.contact.push(ContactRow { label: format!("frame {number}, inputs"), pictures });
        }
        Ok(())
    }

    /// Keeps the masks of a frame set's images for the runs in which they are held out.
    fn keep_masks(&mut self, session: &Session, set: &FrameSet) -> Result<()> {
        let person = PersonId::default();
        let Some(subject) = session.subject(person) else { return Ok(()) };
        for (view, camera) in session.viewed(person).into_iter().enumerate() {
            let frame = set.present().find(|(_, frame)| frame.camera == camera.id);
            let alpha: Vec<u8> = subject.input(view).iter().skip(3).step_by(4).copied().collect();
            let [width, height] = camera.size();
            if let Some((_, frame)) = frame.filter(|_| alpha.len() == width as usize * height as usize) {
                self.masks.insert(camera.id.clone(), (frame.capture_nanos, Mask::new(width, height, alpha)?));
            }
        }
        Ok(())
    }

    /// Renders, writes, scores and checks the held-out views at this time and number.
    fn score_set(&mut self, replay: &mut Replay, nanos: i64, number: u64, row: Option<u64>) -> Result<()> {
        let holdout = replay.holdout.clone();
        let views: Vec<RenderedView> =
            holdout.iter().map(|camera| replay.session.render(camera)).collect::<Result<_, _>>()?;
        let truths = replay.truth.at(nanos)?;
        let jobs: Vec<_> = holdout.iter().zip(&views).zip(&truths).collect();
        let out = &self.out;
        let scores: Vec<Option<FrameScore>> = jobs
            .into_par_iter()
            .map(|((camera, view), truth)| write_and_score(out, number, camera, view, *truth))
            .collect::<Result<_>>()?;
        self.sheet.extend(scores.into_iter().flatten());
        let Self { masks, checks, .. } = self;
        let mask_of = |truth: &Frame| -> Option<Mask> {
            let kept = || masks.get(&truth.camera).filter(|(at, _)| at.abs_diff(truth.capture_nanos) < SAME_NANOS);
            truth.mask.clone().or_else(|| kept().map(|(_, mask)| mask.clone()))
        };
        for (view, truth) in views.iter().zip(truths.iter()).filter_map(|(view, truth)| Some((view, (*truth)?))) {
            if let Some(mask) = mask_of(truth) {
                checks.entry(truth.camera.clone()).or_default().add(nanos, view, &truth.image, &mask)?;
            }
        }
        if row.is_some() && !holdout.is_empty() {
            // Another camera in every row.
            let best = truths.iter().position(Option::is_some).unwrap_or(0);
            let shown = (best + number as usize) % holdout.len();
            let mut pictures = Vec::new();
            if let (Some(view), Some(Some(truth))) = (views.get(shown), truths.get(shown)) {
                pictures.extend(contact_images(&truth.camera, view, &truth.image, truth.mask.as_ref())?);
                pictures.extend(outlined_view(view, truth, mask_of(truth).as_ref())?);
            }
            self.contact.push(ContactRow { label: format!("frame {number}"), pictures });
        }
        Ok(())
    }

    fn write_surface(&self, session: &Session, number: u64) -> Result<()> {
        let Some(subject) = session.subject(PersonId::default()) else { return Ok(()) };
        let Some(pose) = subject.pose() else { return Ok(()) };
        let (positions, normals) = subject.surface(pose);
        let path = self.out.join(format!("surface/{number:06}.ply"));
        Ok(write_mesh_ply(&path, &positions, &normals, &subject.template().triangles, &[])?)
    }
}

/// Compares the outlines of the input views with their masks: `compare` gets camera, view, sRGB pixels and coverage.
fn check_inputs(session: &mut Session, mut compare: impl FnMut(CameraId, &RenderedView, &[u8], &[u8])) -> Result<()> {
    let person = PersonId::default();
    for (view, camera) in session.viewed(person).into_iter().enumerate() {
        let drawn = session.render(&camera)?;
        let Some(seen) = session.subject(person).map(|subject| subject.input(view)) else { continue };
        let rgb: Vec<u8> = seen.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        let mask: Vec<u8> = seen.chunks_exact(4).map(|pixel| pixel[3]).collect();
        compare(camera.id, &drawn, &rgb, &mask);
    }
    Ok(())
}

/// Bar of progress, or lines where there is no terminal.
struct Progress {
    bar: ProgressBar,
    started: Instant,
    printed: Instant,
}

impl Progress {
    fn step(&mut self, sheet: &ScoreSheet) {
        let words = sheet.progress();
        self.bar.inc(1);
        let (done, all) = (self.bar.position(), self.bar.length().unwrap_or(0));
        if self.bar.is_hidden() && self.printed.elapsed() >= PRINT_EVERY {
            self.printed = Instant::now();
            let left = self.started.elapsed().as_secs_f64() / done.max(1) as f64 * all.saturating_sub(done) as f64;
            eprintln!("eval: {done} of {all} frame sets, about {left:.0} s left {words}");
        }
        self.bar.set_message(words);
    }
}

/// Writes a rendered view and scores it against the held-out image, if there is one.
fn write_and_score(
    out: &Path,
    number: u64,
    camera: &Camera,
    view: &RenderedView,
    truth: Option<&Frame>,
) -> Result<Option<FrameScore>> {
    png::write_view(&out.join(camera.id.as_str()).join(format!("{number:06}.png")), view)?;
    let Some(truth) = truth else { return Ok(None) };
    let mut score = score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?;
    if let (Some(score), Some(mask)) = (&mut score, &truth.mask) {
        score.parts = error_parts(view, &truth.image, mask)?;
    }
    Ok(score)
}
