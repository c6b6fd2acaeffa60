//! Results as a table, CSV and a diagram.

use std::fmt::Write as _;

use flyrig_fusion::Origin;
use flyrig_report::plot::{Line, Plot, Series};
use serde::Serialize;

use crate::harness::statistics::exponent;

/// Result of one data set in one encoding.
#[derive(Debug, Serialize)]
pub struct FormRow {
    pub dataset: String,
    /// Source of pose and masks.
    pub pose: Origin,
    pub form: String,
    pub gaussians: usize,
    pub template_bytes: usize,
    /// Bytes per frame: mean, 99th percentile, and mean of the motion alone.
    pub bytes: f64,
    pub p99_bytes: f64,
    pub motion_bytes: f64,
    /// PSNR against the rendering of the uncoded Gaussians in the person's box: mean and worst view.
    pub coded_db: f64,
    pub worst_db: f64,
    /// Scores against the held-out images: uncoded, and losses by coding.
    pub truth_db: Option<f64>,
    pub lost_db: Option<f64>,
    pub lost_ssim: Option<f64>,
    pub gained_flip: Option<f64>,
    /// RMS change of the coding error from frame to frame, in units of 1/255.
    pub flicker: f64,
    /// Mean milliseconds per frame on one core.
    pub encode_ms: f64,
    pub decode_ms: f64,
    pub pose_ms: f64,
}

fn pose(row: &FormRow) -> &'static str {
    match row.pose {
        Origin::Given => "given",
        Origin::Estimated => "estimated",
    }
}

/// Formats the table.
pub fn table(rows: &[FormRow]) -> String {
    let mut text = String::from(
        "| data set | pose, masks | form | Gaussians | KB per frame | p99 | motion KB | Mbit/s at 30 | template MB | dB to uncoded | worst | dB lost | SSIM lost | FLIP gained | flicker | encode ms | decode ms | pose ms |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let number = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |value| format!("{value:.digits$}"));
    for row in rows {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.2} | {:.1} | {:.1} | {} | {} | {} | {:.2} | {:.1} | {:.1} | {:.1} |",
            row.dataset,
            pose(row),
            row.form,
            row.gaussians,
            row.bytes / 1e3,
            row.p99_bytes / 1e3,
            row.motion_bytes / 1e3,
            row.bytes * 8.0 * 30.0 / 1e6,
            row.template_bytes as f64 / 1e6,
            row.coded_db,
            row.worst_db,
            number(row.lost_db, 3),
            number(row.lost_ssim, 4),
            number(row.gained_flip, 4),
            row.flicker,
            row.encode_ms,
            row.decode_ms,
            row.pose_ms,
        );
    }
    text
}

/// Groups rows that differ only in their number of Gaussians.
fn families(rows: &[FormRow]) -> Vec<Vec<&FormRow>> {
    let mut families: Vec<Vec<&FormRow>> = Vec::new();
    let same = |a: &FormRow, b: &FormRow| a.dataset == b.dataset && a.pose == b.pose && a.form == b.form;
    for row in rows {
        match families.iter_mut().find(|family| same(family[0], row)) {
            Some(family) => family.push(row),
            None => families.push(vec![row]),
        }
    }
    families
}

/// Formats the exponents with which bytes and times grow with the number of Gaussians; empty for a single number.
pub fn exponents(rows: &[FormRow]) -> String {
    let mut text = String::new();
    for family in families(rows).into_iter().filter(|family| family.len() > 1) {
        if text.is_empty() {
            text += "\n| data set | pose, masks | form | bytes grow with Gaussians to the power of | encoding | decoding |\n|---|---|---|---|---|---|\n";
        }
        let of = |value: fn(&FormRow) -> f64| {
            exponent(&family.iter().map(|row| (row.gaussians as f64, value(row))).collect::<Vec<_>>())
        };
        let [bytes, encoding, decoding] = [of(|row| row.bytes), of(|row| row.encode_ms), of(|row| row.decode_ms)];
        let FormRow { dataset, form, .. } = family[0];
        let _ =
            writeln!(text, "| {dataset} | {} | {form} | {bytes:.2} | {encoding:.2} | {decoding:.2} |", pose(family[0]));
    }
    text
}

/// Formats the rows as CSV, with more digits.
pub fn csv(rows: &[FormRow]) -> String {
    let mut text = String::from(
        "dataset,pose,form,gaussians,template_bytes,bytes,p99_bytes,motion_bytes,coded_db,worst_db,truth_db,lost_db,lost_ssim,gained_flip,flicker,encode_ms,decode_ms,pose_ms\n",
    );
    for row in rows {
        let optional = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:.5}"));
        let _ = writeln!(
            text,
            "{},{},\"{}\",{},{},{:.1},{:.1},{:.1},{:.3},{:.3},{},{},{},{},{:.4},{:.3},{:.3},{:.3}",
            row.dataset,
            pose(row),
            row.form,
            row.gaussians,
            row.template_bytes,
            row.bytes,
            row.p99_bytes,
            row.motion_bytes,
            row.coded_db,
            row.worst_db,
            optional(row.truth_db),
            optional(row.lost_db),
            optional(row.lost_ssim),
            optional(row.gained_flip),
            row.flicker,
            row.encode_ms,
            row.decode_ms,
            row.pose_ms,
        );
    }
    text
}

/// Plots bytes against quality: a line for each data set, pose, number of Gaussians and kind of encoding.
pub fn plot(rows: &[FormRow]) -> Plot {
    let mut series: Vec<Series> = Vec::new();
    for row in rows {
        let (kind, setting) = row.form.split_once(", ").unwrap_or((&row.form, ""));
        let estimated = if row.pose == Origin::Estimated { ", estimated" } else { "" };
        let many = rows.iter().any(|other| other.dataset == row.dataset && other.gaussians != row.gaussians);
        let count = if many { format!(", {}", row.gaussians) } else { String::new() };
        let name = format!("{}{estimated}{count}, {kind}", row.dataset);
        let point = (row.bytes / 1e3, row.coded_db, setting.to_owned());
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(point),
            None => series.push(Series { name, points: vec![point], line: Line::Through }),
        }
    }
    Plot {
        title: "Bytes per frame against quality".to_owned(),
        x_label: "KB per frame".to_owned(),
        y_label: "PSNR against the uncoded rendering, dB".to_owned(),
        log_x: true,
        log_y: false,
        series,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(form: &str, gaussians: usize, bytes: f64) -> FormRow {
        FormRow {
            dataset: "d".to_owned(),
            pose: Origin::Given,
            form: form.to_owned(),
            gaussians,
            template_bytes: 1,
            bytes,
            p99_bytes: bytes,
            motion_bytes: 0.0,
            coded_db: 50.0,
            worst_db: 49.0,
            truth_db: None,
            lost_db: None,
            lost_ssim: None,
            gained_flip: None,
            flicker: 0.0,
            encode_ms: bytes,
            decode_ms: bytes.sqrt(),
            pose_ms: 0.0,
        }
    }

    #[test]
    fn exponents_are_of_one_form_and_data_set() {
        let rows = [row("a, 1", 10, 100.0), row("b", 10, 5.0), row("a, 1", 1000, 10_000.0)];
        let text = exponents(&rows);
        assert!(text.contains("| d | given | a, 1 | 1.00 | 1.00 | 0.50 |"), "{text}");
        assert!(!text.contains("| b |"), "{text}");
        assert!(exponents(&rows[..2]).is_empty());
    }

    #[test]
    fn tables_have_a_cell_for_every_heading() {
        let rows = [row("a, 1", 10, 100.0)];
        for line in table(&rows).lines() {
            assert_eq!(line.matches('|').count(), 19, "{line}");
        }
        let csv = csv(&rows).replace("\"a, 1\"", "a");
        assert!(csv.lines().all(|line| line.matches(',').count() == 17), "{csv}");
        let names: Vec<String> = plot(&rows).series.into_iter().map(|series| series.name).collect();
        assert_eq!(names, ["d, a"]);
    }
}
