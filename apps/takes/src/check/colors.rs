//! Colours, measured on the person's surface.

use anyhow::{Context as _, Result, ensure};
use flyrig_calib::{CameraColors, color_difference, match_colors};
use flyrig_fusion::{SHAPE_SECS, SHAPE_SETS};
use flyrig_gpu::GpuContext;
use flyrig_types::{CameraId, ColorMatch, FrameSet, Image, Rig};
use serde_json::{Value, json};

use crate::{
    color_samples::ColorSampler,
    take::{Take, TakeSpan},
};

/// Part of the take that is tracked, seconds, and the interval between its frame sets.
const TRACKED_S: f64 = 3.0;
const INTERVAL_S: f64 = 0.125;
/// Fraction of the kept-back difference below which colours are adopted.
const PAYS: f64 = 0.9;
/// Least relative change of a gain for which colours are adopted.
const LEAST_GAIN: f64 = 0.03;

/// Colours that the person tells.
pub(super) struct ColorFinding {
    /// Corrections, one per slot.
    pub colors: Vec<ColorMatch>,
    pub is_adopted: bool,
    /// Kept-back difference between cameras with the old corrections and with these, as a fraction.
    pub difference: Option<(f64, f64)>,
}

impl ColorFinding {
    /// Keeps the colours of a calibration.
    pub fn none(rig: &Rig) -> Self {
        let colors = rig.cameras.iter().map(|camera| camera.color).collect();
        Self { colors, is_adopted: false, difference: None }
    }

    /// Part of `calibration.check.json`.
    pub fn report(&self, rig: &Rig) -> Value {
        let of = |(slot, color): (usize, &ColorMatch)| json!({ "camera": rig.cameras[slot].id, "color": color });
        json!({
            "cameras": self.colors.iter().enumerate().map(of).collect::<Vec<_>>(),
            "adopts_colors": self.is_adopted,
            "kept_back_difference": self.difference,
        })
    }
}

/// Matches the cameras' colours on the person of the take's beginning.
pub(super) fn match_take(rig: &Rig, plates: &[Option<Image>], take: Take, gpu: GpuContext) -> Result<ColorFinding> {
    let raw = Rig {
        cameras: rig
            .cameras
            .iter()
            .cloned()
            .map(|camera| flyrig_types::Camera { color: ColorMatch::NONE, ..camera })
            .collect(),
        world_up: rig.world_up,
    };
    let given_masks = take.given_masks;
    let started = std::time::Instant::now();
    let sets = read_sets(&raw, take)?;
    let step = sets.len().div_ceil(SHAPE_SETS).max(1);
    let in_shape = |set: &&FrameSet| {
        let first = sets.first().map_or(0, |set| set.master_nanos);
        set.master_nanos.saturating_sub(first) as f64 * 1e-9 <= 2.0 * SHAPE_SECS
    };
    let first: Vec<FrameSet> = sets.iter().filter(in_shape).step_by(step).cloned().collect();
    let mut sampler = ColorSampler::new(&raw, plates, given_masks, 1, &first, gpu)?;
    tracing::debug!(seconds = started.elapsed().as_secs_f64(), sets = sets.len(), "learned the shape for colours");
    let bar = flyrig_report::progress_bar(sets.len() as u64, "colours");
    for set in &sets {
        sampler.add(set, true)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    tracing::debug!(seconds = started.elapsed().as_secs_f64(), "sampled colours");
    let points = sampler.into_points();
    ensure!(!points.is_empty(), "no person is tracked");
    let ids: Vec<CameraId> = raw.cameras.iter().map(|camera| camera.id.clone()).collect();
    let fit = match_colors(&ids, &points)?;
    let old: Vec<ColorMatch> = rig.cameras.iter().map(|camera| camera.color).collect();
    let before = color_difference(&old, &points);
    let changes = |(old, new): (&ColorMatch, &CameraColors)| {
        (0..3).any(|k| (new.color.gain[k] / old.gain[k] - 1.0).abs() > LEAST_GAIN)
    };
    let is_adopted = fit.kept_back < PAYS * before && old.iter().zip(&fit.cameras).any(changes);
    let colors: Vec<ColorMatch> = fit.cameras.iter().map(|camera| camera.color).collect();
    let matched = Rig {
        cameras: raw
            .cameras
            .iter()
            .zip(&colors)
            .map(|(camera, color)| flyrig_types::Camera { color: *color, ..camera.clone() })
            .collect(),
        world_up: rig.world_up,
    };
    matched.validate().context("colours")?;
    Ok(ColorFinding {
        colors: if is_adopted { colors } else { old },
        is_adopted,
        difference: Some((before, fit.kept_back)),
    })
}

/// Reads frame sets of the take's beginning.
fn read_sets(rig: &Rig, take: Take) -> Result<Vec<FrameSet>> {
    let (mut sets, mut last): (Vec<FrameSet>, Option<i64>) = (Vec::new(), None);
    let span = TakeSpan { secs: [0.0, TRACKED_S], spread_nanos: 0 };
    take.for_each_set(rig, span, "colours, ms of the take", |set| {
        let is_due = |last: i64| set.master_nanos.saturating_sub(last) as f64 * 1e-9 >= INTERVAL_S - 2e-3;
        if last.is_none_or(is_due) {
            last = Some(set.master_nanos);
            sets.push(set.clone());
        }
        Ok(())
    })?;
    Ok(sets)
}
