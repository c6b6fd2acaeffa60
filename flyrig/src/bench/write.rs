//! CSV, JSON and pictures of a benchmark.

use std::{fmt::Write as _, path::Path};

use anyhow::Result;
use serde::Serialize;

use super::case::Row;
use super::plot::{Plot, Series};
use crate::{cli::BenchTrackArgs, config::Solver, report::write_whole};

#[derive(Serialize)]
struct Document<'a> {
    adapter: &'a str,
    command: String,
    rows: &'a [Row],
}

/// Writes everything into a folder.
pub fn all(out: &Path, adapter: &str, args: &BenchTrackArgs, rows: &[Row]) -> Result<()> {
    let command = format!(
        "flyrig bench track --seed {} --frames {} --side {} --gaussians {}{}",
        args.seed,
        args.frames,
        args.side,
        args.gaussians,
        if args.quick { " --quick" } else { "" }
    );
    write_whole(&out.join("track.csv"), csv(rows).as_bytes())?;
    write_whole(&out.join("track.json"), &serde_json::to_vec_pretty(&Document { adapter, command, rows })?)?;
    write_whole(&out.join("track.svg"), pareto(rows).svg().as_bytes())?;
    write_whole(&out.join("energy.svg"), energy(rows).svg().as_bytes())?;
    write_whole(&out.join("views.svg"), views(rows).svg().as_bytes())
}

fn csv(rows: &[Row]) -> String {
    let mut text = "case,views,side,frames,psnr_db,ssim,iou,chamfer_mm,accuracy_mm,completeness_mm,seen_mm,\
                    deformation_ms,prepare_ms,draw_ms,derivatives_ms,solve_ms\n"
        .to_owned();
    for r in rows {
        let stage = |name: &str| r.stages_ms.iter().find(|(known, _)| known == name).map_or(0.0, |(_, ms)| *ms);
        let _ = writeln!(
            text,
            "\"{}\",{},{},{},{:.3},{:.4},{:.4},{:.3},{:.3},{:.3},{:.3},{:.2},{:.2},{:.2},{:.2},{:.2}",
            r.name,
            r.views,
            r.side,
            r.frames,
            r.psnr_db,
            r.ssim,
            r.iou,
            r.chamfer_mm,
            r.accuracy_mm,
            r.completeness_mm,
            r.seen_mm,
            r.deformation_ms,
            stage("prepare"),
            stage("draw and compare"),
            stage("derivatives"),
            stage("solve")
        );
    }
    text
}

/// For the terminal.
pub fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<44} {:>8} {:>7} {:>7} {:>11} {:>8} {:>12}\n",
        "case", "PSNR dB", "SSIM", "IoU", "chamfer mm", "seen mm", "ms a frame"
    );
    for r in rows {
        let _ = writeln!(
            text,
            "{:<44} {:>8.2} {:>7.4} {:>7.4} {:>11.2} {:>8.2} {:>12.1}",
            r.name, r.psnr_db, r.ssim, r.iou, r.chamfer_mm, r.seen_mm, r.deformation_ms
        );
    }
    text
}

/// Error over time, of the cases that deform three views at the usual size.
fn pareto(rows: &[Row]) -> Plot {
    let (side, views) = rows.first().map_or((0, 0), |r| (r.side, r.views));
    let same = |r: &&Row| r.side == side && r.views == views && r.deformation_ms > 0.0;
    let group = |name: &str, keep: &dyn Fn(&Row) -> bool| Series {
        name: name.to_owned(),
        points: rows
            .iter()
            .filter(same)
            .filter(|r| keep(r))
            .map(|r| (r.deformation_ms, r.chamfer_mm, r.name.split(',').next().unwrap_or_default().to_owned()))
            .collect(),
        joined: false,
    };
    Plot {
        title: "Tracking: error over time".to_owned(),
        x_label: "deformation, milliseconds a frame".to_owned(),
        y_label: "Chamfer distance to the clothed surface, mm".to_owned(),
        log_x: true,
        log_y: false,
        front: true,
        series: vec![
            group("paper", &|r| r.solver == Solver::Paper),
            group("Gauss-Newton", &|r| r.solver == Solver::GaussNewton),
        ],
    }
}

/// Energy of the first frame over iterations, each as a share of where it began: the solvers weigh differently.
fn energy(rows: &[Row]) -> Plot {
    let line = |r: &Row| Series {
        name: r.name.split(',').next().unwrap_or_default().to_owned(),
        points: (0u32..)
            .zip(&r.first_energy)
            .map(|(i, e)| (f64::from(i), e / r.first_energy[0].max(1e-12), String::new()))
            .collect(),
        joined: true,
    };
    let deforms = |r: &&Row| r.solver == Solver::Paper || r.iterations == Some([10, 4]);
    let mut chosen: Vec<&Row> = rows.iter().filter(deforms).collect();
    if chosen.len() < 2 {
        chosen = rows.iter().filter(|r| r.deformation_ms > 0.0).collect();
    }
    Plot {
        title: "Energy of the first frame".to_owned(),
        x_label: "iteration".to_owned(),
        y_label: "share of the energy at the start".to_owned(),
        log_x: false,
        log_y: false,
        front: false,
        series: chosen.into_iter().map(line).collect(),
    }
}

/// Error over the number of views.
fn views(rows: &[Row]) -> Plot {
    let side = rows.first().map_or(0, |r| r.side);
    let line = |name: &str, solver: Solver| {
        let plain = |r: &&Row| {
            r.solver == solver && r.side == side && r.iterations.is_none() && r.compared.is_none() && !r.full_size
        };
        let mut points: Vec<_> =
            rows.iter().filter(plain).map(|r| (r.views as f64, r.chamfer_mm, String::new())).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        Series { name: name.to_owned(), points, joined: true }
    };
    Plot {
        title: "Error over the number of views".to_owned(),
        x_label: "input views".to_owned(),
        y_label: "Chamfer distance to the clothed surface, mm".to_owned(),
        log_x: false,
        log_y: false,
        front: false,
        series: vec![line("skinned only", Solver::None), line("default solver", Solver::GaussNewton)],
    }
}
