//! Output files of `flyrig-bench track`: CSV, JSON, tables and plots.

use std::{fmt::Write as _, path::Path};

use anyhow::Result;
use flyrig_fusion::Solver;
use flyrig_report::{
    plot::{Line, Plot, Series},
    write_whole,
};
use serde::Serialize;

use super::{case::CaseRow, cases::ALL_VIEWS, summary::summary};

#[derive(Serialize)]
struct Document<'a> {
    adapter: &'a str,
    command: String,
    rows: &'a [CaseRow],
}

/// Writes all files into a folder.
pub fn all(out: &Path, adapter: &str, rows: &[CaseRow]) -> Result<()> {
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

fn csv(rows: &[CaseRow]) -> String {
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

/// Plots error over run time, for the first person with the default views and size.
fn pareto(rows: &[CaseRow]) -> Plot {
    let same = |r: &&CaseRow| {
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
        x_label: "deformation, milliseconds per frame".to_owned(),
        y_label: "Chamfer distance to the clothed surface, mm".to_owned(),
        log_x: true,
        log_y: false,
        series: vec![group("paper", Solver::Paper), group("Gauss-Newton", Solver::GaussNewton)],
    }
}

/// Plots the energy of the first frame over iterations, relative to its start: the solvers weigh their terms differently.
fn energy(rows: &[CaseRow]) -> Plot {
    let line = |r: &CaseRow| Series {
        name: r.variant.clone(),
        points: (0u32..)
            .zip(&r.first_energy)
            .map(|(i, e)| (f64::from(i), e / r.first_energy[0].max(1e-12), String::new()))
            .collect(),
        line: Line::Through,
    };
    let mut chosen: Vec<&CaseRow> =
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

/// Plots error over the number of views.
fn views(rows: &[CaseRow]) -> Plot {
    let line = |name: &str, variant: &str| {
        let same =
            |r: &&CaseRow| rows.first().is_some_and(|first| r.sequence == first.sequence) && r.variant == variant;
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
