//! Summary of the rows of `flyrig-bench track`: tables, growth of the run time, savings and costs of skipped work.

use std::fmt::Write as _;

use super::{
    case::CaseRow,
    cases::{ALL_DETAIL, ALL_GAUSSIANS, ALL_VIEWS, FULL_SIZE, NO_REST, VIEWS, small},
};
use crate::harness::{sequence::SequenceMotion, statistics::exponent};

/// Formats the summary for the terminal.
pub fn summary(rows: &[CaseRow]) -> String {
    let parts = [table(rows), skips(rows), growth(rows), people(rows)];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("\n")
}

fn table(rows: &[CaseRow]) -> String {
    let mut text = format!(
        "{:<52} {:>7} {:>6} {:>6} {:>10} {:>7} {:>9} {:>9}\n",
        "case", "PSNR dB", "SSIM", "IoU", "chamfer mm", "seen mm", "first ms", "later ms"
    );
    for r in rows {
        let _ = writeln!(
            text,
            "{:<52} {:>7.2} {:>6.4} {:>6.4} {:>10.2} {:>7.2} {:>9.0} {:>9.0}",
            r.name, r.psnr_db, r.ssim, r.iou, r.chamfer_mm, r.seen_mm, r.first_ms, r.later_ms
        );
        for (what, count) in &r.skipped {
            let _ = writeln!(text, "    {what}: {count}");
        }
    }
    text
}

/// Finds the row of a variant for the person of the first row.
fn find<'a>(
    rows: &'a [CaseRow],
    variant: &str,
    views: usize,
    side: u32,
    motion: SequenceMotion,
) -> Option<&'a CaseRow> {
    let seed = rows.first()?.sequence.seed;
    rows.iter().find(|r| {
        let s = r.sequence;
        r.variant == variant && r.views == views && (s.side, s.motion, s.seed) == (side, motion, seed)
    })
}

/// Formats the saved time and the cost in error of each kind of skipped work.
fn skips(rows: &[CaseRow]) -> String {
    let Some(side) = rows.first().map(|r| r.sequence.side) else { return String::new() };
    let but = |what: &str| format!("default, {what}");
    let low = small(side);
    let pairs = [
        ("Gaussians: fewer are compared", "default", but(ALL_GAUSSIANS), VIEWS, side, SequenceMotion::Turn),
        ("Gaussians: two a pixel (small images)", "default", but(ALL_DETAIL), VIEWS, low, SequenceMotion::Turn),
        ("pixels: images are halved", "default", but(FULL_SIZE), VIEWS, side, SequenceMotion::Turn),
        ("iterations: none at rest (person stands)", "default", but(NO_REST), VIEWS, side, SequenceMotion::Still),
        ("views: 4 of 6", "default, 4 compared", but(ALL_VIEWS), 6, side, SequenceMotion::Turn),
        ("views: 3 of 6", "default, 3 compared", but(ALL_VIEWS), 6, side, SequenceMotion::Turn),
        ("views: 2 of 6", "default, 2 compared", but(ALL_VIEWS), 6, side, SequenceMotion::Turn),
    ];
    let mut text = String::new();
    for (name, with, without, views, side, motion) in pairs {
        let of = |variant: &str| find(rows, variant, views, side, motion);
        let (Some(with), Some(without)) = (of(with), of(&without)) else { continue };
        if text.is_empty() {
            text = format!(
                "{:<42} {:>9} {:>9} {:>7} {:>11} {:>9} {:>9}\n",
                "left out", "ms with", "without", "saved", "chamfer mm", "PSNR dB", "IoU"
            );
        }
        let _ = writeln!(
            text,
            "{name:<42} {:>9.0} {:>9.0} {:>6.0}% {:>+11.2} {:>+9.2} {:>+9.4}",
            with.deformation_ms,
            without.deformation_ms,
            100.0 * (1.0 - with.deformation_ms / without.deformation_ms),
            with.chamfer_mm - without.chamfer_mm,
            with.psnr_db - without.psnr_db,
            with.iou - without.iou
        );
    }
    text
}

/// Formats the exponents of the growth of the run time.
fn growth(rows: &[CaseRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let side = first.sequence.side;
    let full = |what: &str| {
        if what.is_empty() { format!("default, {FULL_SIZE}") } else { format!("default, {FULL_SIZE}, {what}") }
    };
    let of = |variant: &str, views, side| find(rows, variant, views, side, SequenceMotion::Turn);
    let gaussians: Vec<(f64, f64)> = ["8000 Gaussians", "", ALL_GAUSSIANS]
        .iter()
        .filter_map(|what| of(&full(what), VIEWS, side))
        .map(|r| (r.compared as f64, r.deformation_ms))
        .collect();
    let pixels: Vec<(f64, f64)> = [side / 2, side, side * 3 / 2]
        .iter()
        .filter_map(|&side| of(&full(""), VIEWS, side))
        .map(|r| (f64::from(r.sequence.side).powi(2), r.deformation_ms))
        .collect();
    let views: Vec<(f64, f64)> = [2, 3, 4, 6]
        .iter()
        .filter_map(|&views| of(&format!("default, {ALL_VIEWS}"), views, side))
        .map(|r| (r.views as f64, r.deformation_ms))
        .collect();
    let mut text = String::new();
    for (name, points) in [("Gaussians", gaussians), ("pixels", pixels), ("views", views)] {
        let power = exponent(&points);
        if power.is_finite() {
            let _ = writeln!(text, "time of the deformation grows with the {power:.2}th power of the {name}");
        }
    }
    text
}

/// Formats the means over people, of skinning alone and of tracking.
fn people(rows: &[CaseRow]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let usual = |r: &&CaseRow| {
        let s = r.sequence;
        r.views == VIEWS && s.side == first.sequence.side && s.motion == SequenceMotion::Turn
    };
    let mut text = String::new();
    for variant in ["off", "default"] {
        let of: Vec<&CaseRow> = rows.iter().filter(usual).filter(|r| r.variant == variant).collect();
        if of.len() < 2 {
            continue;
        }
        let mean = |value: &dyn Fn(&CaseRow) -> f64| of.iter().map(|r| value(r)).sum::<f64>() / of.len() as f64;
        let _ = writeln!(
            text,
            "mean of {} people, {variant}: {:.2} dB, SSIM {:.4}, IoU {:.4}, chamfer {:.2} mm, {:.2} mm of what is seen",
            of.len(),
            mean(&|r| r.psnr_db),
            mean(&|r| r.ssim),
            mean(&|r| r.iou),
            mean(&|r| r.chamfer_mm),
            mean(&|r| r.seen_mm)
        );
    }
    text
}
