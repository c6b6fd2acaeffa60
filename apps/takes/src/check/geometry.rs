//! Time offsets and poses, measured on the person.

use anyhow::{Context as _, Result, bail};
use flyrig_calib::{Agreement, PersonCamera, PersonFit, PersonOptions, PersonTracks};
use flyrig_types::{Image, Rig};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::stretches::Stretches;
use crate::{
    person_tracks::{PersonFinder, ensure_same_person, fit_person},
    take::{Take, TakeSpan},
};

/// Fraction of the kept-back disagreement below which time offsets are adopted, and poses after them.
const LAGS_PAY: f64 = 0.95;
const POSES_PAY: f64 = 0.85;
/// Least time offset that is adopted, seconds, and as a multiple of its standard deviation.
const LEAST_LAG_S: f64 = 0.004;
const CLEAR_LAG: f64 = 3.0;
/// Least displacement of the person in one camera's image for which poses are adopted, as a fraction of the image's longer side.
const LEAST_MOVED: f64 = 0.002;
/// Standard deviations of poses that stay: radians and metres.
const FIXED: f64 = 1e-5;

/// Time offsets and poses that the person tells.
pub(super) struct Finding {
    /// The chosen calibration with what was adopted.
    pub rig: Rig,
    /// Number of the chosen calibration.
    pub choice: usize,
    /// Whether time offsets changed.
    pub adopts_lags: bool,
    /// Whether poses changed.
    pub adopts_poses: bool,
    /// The fit that was adopted, or that of poses and offsets.
    pub fit: PersonFit,
    /// Time offsets that were adopted, seconds, one per slot; 0 otherwise.
    pub lags_s: Vec<f64>,
    /// Kept-back disagreement with the old calibration, with new time offsets (`None` where none are clear), and with new poses too.
    pub disagreement: [Option<f64>; 3],
}

impl Finding {
    /// Part of `calibration.check.json`.
    pub fn report(&self) -> Value {
        let of = |(slot, camera): (usize, &PersonCamera)| {
            json!({
                "camera": self.rig.cameras[slot].id,
                "time_offset_ms": 1e3 * camera.lag_s.0,
                "time_offset_deviation_ms": 1e3 * camera.lag_s.1,
                "moved_deg_mm": camera.moved,
                "moved_px": camera.moved_px,
                "halves_px": camera.halves_px,
                "error_px": camera.error_px,
            })
        };
        json!({
            "cameras": self.fit.cameras.iter().enumerate().map(of).collect::<Vec<_>>(),
            "adopts_time_offsets": self.adopts_lags,
            "adopts_poses": self.adopts_poses,
            "kept_back_disagreement": self.disagreement,
            "instants": self.fit.instants,
        })
    }
}

/// Measures time offsets and poses. `rigs` are the possible calibrations.
pub(super) fn measure(rigs: &[Rig], plates: Vec<Option<Image>>, take: Take, instants: &Stretches) -> Result<Finding> {
    let first = rigs.first().context("no calibration")?;
    let mut finder = PersonFinder::new(rigs, plates)?;
    let (mut chosen, mut begin) = (instants.clone(), None);
    let span = TakeSpan { secs: [0.0, instants.end()], spread_nanos: 0 };
    let started = std::time::Instant::now();
    take.for_each_set(first, span, "the person, ms of the take", |set| {
        let begin = *begin.get_or_insert(set.master_nanos);
        let secs = set.master_nanos.saturating_sub(begin) as f64 * 1e-9;
        if chosen.is_chosen(secs) { finder.add(set) } else { Ok(()) }
    })?;
    tracing::debug!(seconds = started.elapsed().as_secs_f64(), "found the person");
    let tracked = finder.into_tracks()?;
    let fit = |(rig, tracks): &(Rig, PersonTracks)| fit_person(rig, tracks, PersonOptions::default());
    let fits = tracked.par_iter().map(fit).collect::<Result<Vec<PersonFit>, _>>()?;
    let after = |fit: &PersonFit| fit.planes_rad.map_or(f64::INFINITY, |(_, after)| after);
    let Some((choice, fit)) = fits.into_iter().enumerate().min_by(|(_, a), (_, b)| after(a).total_cmp(&after(b)))
    else {
        bail!("no calibration");
    };
    let (rig, tracks) = &tracked[choice];
    ensure_same_person(rig, &fit)?;
    let finding = adopt(rig, tracks, choice, fit);
    tracing::debug!(seconds = started.elapsed().as_secs_f64(), "found the person and solved for the cameras");
    finding
}

/// Adopts what pays on the frames that were kept back.
fn adopt(rig: &Rig, tracks: &PersonTracks, choice: usize, both: PersonFit) -> Result<Finding> {
    // Offsets that are not clear beside free poses are not adopted without them either, which saves a solve.
    let timed = if clear_lags(&both).is_some() {
        let fixed = PersonOptions { turn_sigma: FIXED, place_sigma_m: FIXED, ..PersonOptions::default() };
        Some(fit_person(rig, tracks, fixed)?)
    } else {
        None
    };
    let before = both.kept_back.map(|(before, _)| before);
    let score = |fit: &PersonFit| Some(disagreement(fit.kept_back?.1, before?));
    let base = before.map(|before| disagreement(before, before));
    let [of_timed, of_both] = [timed.as_ref().and_then(score), score(&both)];
    let mut finding = Finding {
        rig: rig.clone(),
        choice,
        adopts_lags: false,
        adopts_poses: false,
        lags_s: vec![0.0; rig.cameras.len()],
        disagreement: [base, of_timed, of_both],
        fit: both,
    };
    let Some(mut best) = base else { return Ok(finding) };
    if let (Some(timed), Some(score)) = (&timed, of_timed.filter(|score| *score < LAGS_PAY * best))
        && let Some(lags_s) = clear_lags(timed).filter(|_| are_same_lags(timed, &finding.fit))
    {
        (best, finding.adopts_lags, finding.lags_s) = (score, true, lags_s);
    }
    let moved = |(slot, camera): (usize, &PersonCamera)| {
        let intrinsics = &rig.cameras[slot].intrinsics;
        camera.moved_px > LEAST_MOVED * f64::from(intrinsics.width.max(intrinsics.height))
    };
    if of_both.is_some_and(|score| score < POSES_PAY * best) && finding.fit.cameras.iter().enumerate().any(moved) {
        finding.adopts_poses = true;
        finding.rig = finding.fit.rig.clone();
        let lags_s = clear_lags(&finding.fit);
        finding.adopts_lags = lags_s.is_some();
        finding.lags_s = lags_s.unwrap_or_else(|| vec![0.0; rig.cameras.len()]);
    } else if let Some(timed) = timed.filter(|_| finding.adopts_lags) {
        finding.fit = timed;
    }
    for (camera, lag_s) in finding.rig.cameras.iter_mut().zip(&finding.lags_s) {
        camera.time_offset_nanos += (1e9 * lag_s).round() as i64;
    }
    Ok(finding)
}

/// Returns the disagreement of the cameras relative to that with the old calibration; silhouettes count where there are some.
fn disagreement(found: Agreement, before: Agreement) -> f64 {
    match (found.planes_rad, before.planes_rad) {
        (Some(found), Some(before)) => found / before.max(f64::MIN_POSITIVE),
        _ => found.error_px / before.error_px.max(f64::MIN_POSITIVE),
    }
}

/// Returns whether time offsets do not depend on whether poses may move too: wrong poses look like wrong times.
fn are_same_lags(timed: &PersonFit, both: &PersonFit) -> bool {
    let same = |(a, b): (&PersonCamera, &PersonCamera)| {
        (a.lag_s.0 - b.lag_s.0).abs() < (2.0 * LEAST_LAG_S).max(CLEAR_LAG * a.lag_s.1)
    };
    timed.cameras.iter().zip(&both.cameras).all(same)
}

/// Returns the time offsets, seconds, so that most cameras keep theirs; `None` where none is clear.
fn clear_lags(fit: &PersonFit) -> Option<Vec<f64>> {
    let mut sorted: Vec<f64> = fit.cameras.iter().map(|camera| camera.lag_s.0).collect();
    sorted.sort_by(f64::total_cmp);
    let common = sorted.get(sorted.len().saturating_sub(1) / 2)?;
    let clear = |camera: &PersonCamera| {
        let lag = camera.lag_s.0 - common;
        if lag.abs() > LEAST_LAG_S.max(CLEAR_LAG * camera.lag_s.1) { lag } else { 0.0 }
    };
    let lags: Vec<f64> = fit.cameras.iter().map(clear).collect();
    lags.iter().any(|lag| *lag != 0.0).then_some(lags)
}
