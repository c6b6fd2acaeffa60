//! CSV, JSON, tables and images of a benchmark.

use std::{fmt::Write as _, path::Path};

use super::{case::Row, cases::ALL_VIEWS, summary::summary};
use anyhow::Result;
use flyrig_fusion::Solver;
use flyrig_report::{
    plot::{Line, Plot, Series},
    write_whole,
};
use serde::Serialize;

#[derive(Serialize)]
struct Document<'a> {
    adapter: &'a str,
    command: String,
    rows: &'a [Row],
}

/// Writes everything into a folder.
pub fn all(out: &Path, adapter: &str, rows: &[Row]) -> Result<()> {
    // Without the program's own place.
    let command =
        std::iter::once("flyrig-bench".to_owned()).chain(std::env::args().skip(1)).collect::<Vec<_>>().join(" ");
    write_whole(&out.join("track.csv"), csv(rows).as_bytes())?;
    write_whole(&out.join("track.txt"), summary(rows).as_bytes())?;
    write_whole(&out.join("track.json"), &serde_json::to_vec_pretty(&Document { adapter, command, rows })?)?;
    write_whole(&out.join("track.svg"), pareto(rows).svg().as_bytes())?;
    write_whole(&out.join("energy.svg"), energy(rows).svg().as_bytes())?;
    write_whole(&out.join("views.svg"), views(rows).svg().as_bytes())
}

fn csv(rows: &[Row]) -> String {
    let mut text = "case,views,side,frames,psnr_db,ssim,iou,chamfer_mm,accuracy_mm,completeness_mm,seen_mm,\
                    deformation_ms,first_ms,later_ms,prepare_ms,draw_ms,derivatives_ms,solve_ms\n"
        .to_owned();
    for r in rows {
        let stage = |name: &str| r.stages_ms.iter().find(|(known, _)| known == name).map_or(0.0, |(_, ms)| *ms);
        let _ = writeln!(
            text,
            "\"{}\",{},{},{},{:.3},{:.4},{:.4},{:.3},{:.3},{:.3},{:.3},{:.2},{:.2},{:.2},{:.2},{:.2},{:.2},{:.2}",
            r.name,
            r.views,
            r.sequence.side,
            r.sequence.frames,
            r.psnr_db,
            r.ssim,
            r.iou,
            r.chamfer_mm,
            r.accuracy_mm,
            r.completeness_mm,
            r.seen_mm,
            r.deformation_ms,
            r.first_ms,
            r.later_ms,
            stage("prepare"),
            stage("draw and compare"),
            stage("derivatives"),
            stage("solve")
        );
    }
    text
}

/// Error over time, of the cases that deform the first person before the usual views at the usual size.
fn pareto(rows: &[Row]) -> Plot {
    let same = |r: &&Row| {
        rows.first().is_some_and(|first| (r.sequence, r.views) == (first.sequence, first.views))
            && r.solver != Solver::None
    };
    let group = |name: &str, solver: Solver| Series {
        name: name.to_owned(),
        points: rows
            .iter()
            .filter(same)
            .filter(|r| r.solver == solver)
            .map(|r| (r.deformation_ms, r.chamfer_mm, r.variant.trim_start_matches("default, ").to_owned()))
            .collect(),
        line: Line::Front,
    };
    Plot {
        title: "Tracking: error over time".to_owned(),
        x_label: "deformation, milliseconds a frame".to_owned(),
        y_label: "Chamfer distance to the clothed surface, mm".to_owned(),
        log_x: true,
        log_y: false,
        series: vec![group("paper", Solver::Paper), group("Gauss-Newton", Solver::GaussNewton)],
    }
}

/// Energy of the first frame over iterations, each as a share of where it began: the solvers weigh differently.
fn energy(rows: &[Row]) -> Plot {
    let line = |r: &Row| Series {
        name: r.variant.clone(),
        points: (0u32..)
            .zip(&r.first_energy)
            .map(|(i, e)| (f64::from(i), e / r.first_energy[0].max(1e-12), String::new()))
            .collect(),
        line: Line::Through,
    };
    let mut chosen: Vec<&Row> =
        rows.iter().filter(|r| r.solver == Solver::Paper || r.variant.contains("10/4 iterations")).collect();
    if chosen.len() < 2 {
        chosen = rows.iter().filter(|r| r.solver != Solver::None).collect();
    }
    chosen.truncate(4);
    Plot {
        title: "Energy of the first frame".to_owned(),
        x_label: "iteration".to_owned(),
        y_label: "share of the energy at the start".to_owned(),
        log_x: false,
        log_y: false,
        series: chosen.into_iter().map(line).collect(),
    }
}

/// Error over the number of views.
fn views(rows: &[Row]) -> Plot {
    let line = |name: &str, variant: &str| {
        let same = |r: &&Row| rows.first().is_some_and(|first| r.sequence == first.sequence) && r.variant == variant;
        let mut points: Vec<_> =
            rows.iter().filter(same).map(|r| (r.views as f64, r.chamfer_mm, format!("{:.1} dB", r.psnr_db))).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        Series { name: name.to_owned(), points, line: Line::Through }
    };
    Plot {
        title: "Error over the number of views".to_owned(),
        x_label: "input views".to_owned(),
        y_label: "Chamfer distance to the clothed surface, mm".to_owned(),
        log_x: false,
        log_y: false,
        series: vec![line("skinned only", "off"), line("default solver", &format!("default, {ALL_VIEWS}"))],
    }
}
