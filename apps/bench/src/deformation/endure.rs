//! `flyrig-bench endure`: stability of error and memory over thousands of frames of a person who turns back and forth.

use std::{fmt::Write as _, ops::Range};

use anyhow::{Context, Result};
use clap::Args;
use flyrig_fusion::{GivenPerception, Solver, resident_mib};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_report::{
    arguments::GaussiansArgs,
    plot::{Line, Plot, Series},
    progress_bar, stop, write_whole,
};
use flyrig_types::PoseTrack;
use serde::Serialize;

use super::{
    case::{Case, chamfer_mm, session},
    cases::VIEWS,
};
use crate::harness::{
    arguments::SimulationArgs,
    sequence::{SequenceConfig, SequenceMotion, SimulatedSequence},
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-endure")), mut_arg("side", |arg| arg.default_value("160")), mut_arg("gaussians", |arg| arg.default_value("12000")))]
pub struct BenchEndureArgs {
    /// Total number of frames.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(300..=10_000_000))]
    pub frames: u64,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Instants from one end of the motion to the other.
const INSTANTS: usize = 26;
/// Frames of the beginning; the end has as many.
const BEGINNING: Range<u64> = 100..200;

/// Measurement at the far end of the motion, always in the same pose.
#[derive(Debug, Clone, Copy, Serialize)]
struct Point {
    frame: u64,
    psnr_db: f64,
    ssim: f64,
    iou: f64,
    chamfer_mm: f64,
    memory_mib: f64,
}

/// Runs the command.
pub fn endure(args: &BenchEndureArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let config = SequenceConfig {
        motion: SequenceMotion::Turn,
        seed: args.simulation.seed,
        side: args.simulation.side,
        frames: INSTANTS,
        fps: 30.0,
    };
    let sequence = SimulatedSequence::simulate(gpu, config)?;
    let bar = progress_bar(args.frames, "bench endure");
    let points = run(args, gpu, &sequence, |frame, points| {
        bar.set_position(frame);
        if let Some(point) = points.last() {
            bar.set_message(format!("{:.2} dB, {:.2} mm", point.psnr_db, point.chamfer_mm));
        }
    })?;
    bar.finish_and_clear();
    let rows: Vec<String> = points
        .iter()
        .map(|p| {
            format!("{},{:.3},{:.5},{:.5},{:.3},{:.1}\n", p.frame, p.psnr_db, p.ssim, p.iou, p.chamfer_mm, p.memory_mib)
        })
        .collect();
    let csv = format!("frame,psnr_db,ssim,iou,chamfer_mm,memory_mib\n{}", rows.concat());
    write_whole(&args.simulation.output.out.join("endure.csv"), csv.as_bytes())?;
    for (name, title, of) in [
        ("endure.svg", "Chamfer distance, mm", (|p| p.chamfer_mm) as fn(&Point) -> f64),
        ("memory.svg", "Resident memory, MiB", |p| p.memory_mib),
    ] {
        write_whole(&args.simulation.output.out.join(name), plot(&points, title, of).svg().as_bytes())?;
    }
    print!("{}", summary(&points));
    println!("written to {}: endure.csv, endure.svg, memory.svg", args.simulation.output.out.display());
    Ok(())
}

/// Tracks the motion back and forth, and measures at every arrival at the far end.
fn run(
    args: &BenchEndureArgs,
    gpu: &GpuContext,
    sequence: &SimulatedSequence,
    mut progress: impl FnMut(u64, &[Point]),
) -> Result<Vec<Point>> {
    let case = Case::new(Solver::GaussNewton, args.surface.gaussians, VIEWS, sequence.config());
    let mut session = session(gpu, sequence, &case)?;
    let sets: Vec<_> = sequence.sets(VIEWS).collect();
    let last = sets.len().saturating_sub(1).max(1);
    let period_nanos = (1e9 / sequence.config().fps) as i64;
    // There and back: the pose follows the frames, whatever their stamps say.
    let keys = (0..=2 * last).map(|i| (i as i64 * period_nanos, sequence.track.at(sets[turned(i, last)].master_nanos)));
    let track = PoseTrack::new(keys.collect())?;
    let perception = GivenPerception::repeating(session.rig(), sequence.template.clone(), track);
    session.set_perception(perception);
    session.set_per_view_time(false);
    let mut points = Vec::new();
    for frame in 0..args.frames {
        if stop::requested() {
            break;
        }
        let at = turned((frame % (2 * last) as u64) as usize, last);
        let mut set = sets[at].clone();
        (set.index, set.master_nanos) = (frame, frame as i64 * period_nanos);
        session.process(&set)?;
        if at == last {
            let mut sheet = ScoreSheet::default();
            for (camera, truth) in sequence.held_out(at)? {
                let view = session.render(camera)?;
                sheet.extend(score_view(&camera.id, frame, &view, &truth.image, truth.mask.as_ref())?);
            }
            let mean = sheet.mean().context("nothing to compare")?;
            points.push(Point {
                frame,
                psnr_db: mean.psnr_db,
                ssim: mean.ssim,
                iou: mean.iou.unwrap_or(0.0),
                chamfer_mm: chamfer_mm(&session, sequence)?,
                memory_mib: resident_mib().unwrap_or(f64::NAN),
            });
        }
        progress(frame + 1, &points);
    }
    Ok(points)
}

/// Returns the instant of a frame of the motion there and back.
fn turned(frame: usize, last: usize) -> usize {
    if frame <= last { frame } else { 2 * last - frame }
}

fn plot(points: &[Point], title: &str, of: fn(&Point) -> f64) -> Plot {
    let points = points.iter().map(|p| (p.frame as f64, of(p), String::new())).collect();
    Plot {
        title: title.to_owned(),
        x_label: "frame".to_owned(),
        y_label: title.to_owned(),
        log_x: false,
        log_y: false,
        series: vec![Series { name: "default".to_owned(), points, line: Line::Through }],
    }
}

/// Formats the means of the beginning and of the end.
fn summary(points: &[Point]) -> String {
    let frames = points.last().map_or(0, |point| point.frame + 1);
    let end = frames.saturating_sub(BEGINNING.end - BEGINNING.start)..frames;
    let mut text =
        "| frames | PSNR dB | SSIM | mask IoU | chamfer mm | memory MiB |\n|---|---|---|---|---|---|\n".to_owned();
    let mut chamfer = Vec::new();
    for range in [BEGINNING, end] {
        let within: Vec<&Point> = points.iter().filter(|point| range.contains(&point.frame)).collect();
        let mean = |of: fn(&Point) -> f64| within.iter().map(|p| of(p)).sum::<f64>() / within.len() as f64;
        chamfer.push(mean(|p| p.chamfer_mm));
        let _ = writeln!(
            text,
            "| {} to {} | {:.2} | {:.4} | {:.4} | {:.3} | {:.1} |",
            range.start,
            range.end,
            mean(|p| p.psnr_db),
            mean(|p| p.ssim),
            mean(|p| p.iou),
            mean(|p| p.chamfer_mm),
            mean(|p| p.memory_mib)
        );
    }
    let worst = points.iter().map(|p| p.chamfer_mm).fold(0.0, f64::max);
    let _ = writeln!(
        text,
        "error at the end over error at the beginning: {:.3}; worst {worst:.3} mm",
        chamfer[1] / chamfer[0]
    );
    text
}

#[cfg(test)]
mod tests {
    use flyrig_gpu::AdapterChoice;

    use super::*;

    #[test]
    fn to_and_fro_is_measured_at_the_far_end_and_poisons_nothing() {
        assert_eq!((0..9).map(|i| turned(i % 6, 3)).collect::<Vec<_>>(), [0, 1, 2, 3, 2, 1, 0, 1, 2]);
        let gpu = GpuContext::new(&AdapterChoice::default()).unwrap();
        let config = SequenceConfig { motion: SequenceMotion::Turn, seed: 1, side: 64, frames: 3, fps: 30.0 };
        let sequence = SimulatedSequence::simulate(&gpu, config).unwrap();
        let args = BenchEndureArgs {
            frames: 15,
            simulation: SimulationArgs {
                output: flyrig_report::arguments::OutputArgs { out: "out".into() },
                seed: 1,
                side: 64,
            },
            surface: GaussiansArgs { gaussians: 2000 },
        };
        let mut last = 0;
        let points = run(&args, &gpu, &sequence, |frame, _| last = frame).unwrap();
        assert_eq!(last, 15);
        assert_eq!(points.iter().map(|p| p.frame).collect::<Vec<_>>(), [2, 6, 10, 14]);
        assert!(points.iter().all(|p| p.psnr_db > 10.0 && p.iou > 0.8 && p.chamfer_mm < 40.0), "{points:?}");
    }

    #[test]
    fn the_summary_compares_beginning_and_end() {
        let point = |frame: u64| Point {
            frame,
            psnr_db: 20.0,
            ssim: 0.9,
            iou: 0.9,
            chamfer_mm: if frame < 500 { 8.0 } else { 10.0 },
            memory_mib: 100.0,
        };
        let points: Vec<Point> = (0..1000).step_by(50).map(point).collect();
        let text = summary(&points);
        assert!(text.contains("| 100 to 200 | 20.00 | 0.9000 | 0.9000 | 8.000 | 100.0 |"), "{text}");
        assert!(text.contains("beginning: 1.250; worst 10.000 mm"), "{text}");
    }
}
