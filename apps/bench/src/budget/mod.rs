//! `flyrig-bench budget`: error in views and saved run time of each kind of work that a budget may skip.

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context, Result};
use clap::Args;
use flyrig_fusion::{BudgetSettings, Effort, Origin, Outcome, PersonId, Solver};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{CameraScore, ScoreSheet, score_view};
use flyrig_report::{
    arguments::{GaussiansArgs, OutputArgs},
    plot::{Line, Plot, Series},
    progress_bar, stop, write_whole,
};
use flyrig_takes::{Replay, frame_number};
use serde::{Deserialize, Serialize};

use crate::harness::arguments::RecordedArgs;

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-budget")))]
pub struct BenchBudgetArgs {
    /// Data set in EasyMocap layout, as `flyrig eval` reads and `flyrig sim export` writes it.
    pub dataset: PathBuf,
    #[command(flatten)]
    pub replay: RecordedArgs,
    /// Source of pose and masks.
    #[arg(long, value_enum, default_value = "estimated")]
    pub pose: Origin,
    /// Budgets, frame sets per second, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3,4,5,6,8,10,15,30")]
    pub budgets: Vec<f64>,
    /// File budget.json of another program on the same data set, whose results are plotted beside.
    #[arg(long, value_name = "FILE")]
    pub beside: Option<PathBuf>,
    #[command(flatten)]
    pub output: OutputArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Frame sets that are neither timed nor scored: the first ones always get all the work.
const WARM_UP: u64 = 12;

/// Result of one way of processing the data set.
#[derive(Debug, Serialize)]
struct Row {
    name: String,
    /// Milliseconds per frame set with one rendered view, mean and 95th percentile.
    set_ms: f64,
    p95_ms: f64,
    score: CameraScore,
    /// Level of effort after each timed frame set, with a budget.
    levels: Vec<usize>,
}

/// Settings of one way of processing.
struct Way {
    name: String,
    budget: BudgetSettings,
    solver: Solver,
}

/// Returns the ways in order: all work, the other solvers, single kinds of work skipped, levels, budgets.
fn ways(pose: Origin, budgets: &[f64]) -> Vec<Way> {
    let full = Effort::FULL;
    let way = |name: &str, budget| Way { name: name.to_owned(), budget, solver: Solver::GaussNewton };
    let fixed = |name: &str, effort| way(name, BudgetSettings { fps: 0.0, effort: Some(effort) });
    let solved = |name, solver| Way { solver, ..fixed(name, full) };
    let mut ways = vec![
        fixed("everything", full),
        solved("the paper's solver", Solver::Paper),
        solved("no deformation", Solver::None),
    ];
    let perceived = [
        fixed("two looks again", Effort { looks: 2, ..full }),
        fixed("one look again", Effort { looks: 1, ..full }),
        fixed("one round of outlines", Effort { rounds: 1, ..full }),
        fixed("no matte", Effort { mattes: false, ..full }),
    ];
    if pose == Origin::Estimated {
        ways.extend(perceived);
    }
    ways.extend([
        fixed("solve every 2nd", Effort { solve_every: 2, ..full }),
        fixed("solve every 3rd", Effort { solve_every: 3, ..full }),
        fixed("paint every 2nd", Effort { paint_every: 2, ..full }),
        fixed("paint every 3rd", Effort { paint_every: 3, ..full }),
    ]);
    let levels = Effort::LEVELS.iter().enumerate().skip(1);
    ways.extend(levels.map(|(level, effort)| fixed(&format!("level {level}"), *effort)));
    ways.extend(budgets.iter().map(|&fps| way(&format!("budget {fps}"), BudgetSettings { fps, effort: None })));
    ways
}

/// Runs the command.
pub fn budget(args: &BenchBudgetArgs, gpu: &GpuContext) -> Result<()> {
    let beside = args.beside.as_deref().map(read_points).transpose()?.unwrap_or_default();
    args.output.create()?;
    let ways = ways(args.pose, &args.budgets);
    let bar = progress_bar(ways.len() as u64, "bench budget");
    let mut rows = Vec::new();
    for way in ways {
        if stop::requested() {
            break;
        }
        bar.set_message(way.name.clone());
        rows.push(run(args, gpu, way)?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let table = table(&rows);
    write_whole(&args.output.out.join("budget.md"), table.as_bytes())?;
    write_whole(&args.output.out.join("budget.json"), &serde_json::to_vec_pretty(&rows)?)?;
    write_whole(&args.output.out.join("budget.svg"), plot(&rows, &beside).svg().as_bytes())?;
    write_whole(&args.output.out.join("levels.svg"), plot_levels(&rows).svg().as_bytes())?;
    print!("{table}");
    println!(
        "{}; budget.md, .json, .svg and levels.svg in {}",
        gpu.fastest().adapter_name(),
        args.output.out.display()
    );
    Ok(())
}

fn run(args: &BenchBudgetArgs, gpu: &GpuContext, way: Way) -> Result<Row> {
    let Way { name, budget, solver } = way;
    let mut settings = args.replay.settings(&args.dataset, args.pose, args.surface.gaussians, budget);
    settings.session.tracking.solver = solver;
    let mut replay = Replay::open(&settings, gpu)?;
    let (mut sheet, mut millis, mut levels) = (ScoreSheet::default(), Vec::new(), Vec::new());
    let holdout = replay.holdout.clone();
    let mut taken = 0;
    while let Some(set) = replay.next_set()? {
        let start = Instant::now();
        let outcome = replay.session.process(&set)?;
        let process = start.elapsed();
        if matches!(outcome, Outcome::Held(_)) {
            continue;
        }
        let mut view_time = None;
        let mut views = Vec::new();
        for camera in &holdout {
            let start = Instant::now();
            views.push(replay.session.render(camera)?);
            view_time.get_or_insert(start.elapsed());
        }
        // As if one view were watched.
        let view_time = view_time.unwrap_or_default();
        replay.session.budget.spend(view_time);
        taken += 1;
        if taken <= WARM_UP {
            continue;
        }
        millis.push(1e3 * (process + view_time).as_secs_f64());
        levels.push(replay.session.budget.level());
        for ((camera, view), truth) in holdout.iter().zip(&views).zip(replay.truth.at(set.master_nanos)?) {
            if let Some(truth) = truth {
                sheet.extend(score_view(&camera.id, frame_number(&set), view, &truth.image, truth.mask.as_ref())?);
            }
        }
    }
    anyhow::ensure!(
        replay.session.subject(PersonId::default()).is_some(),
        "no person was found in {}",
        args.dataset.display()
    );
    let score =
        sheet.mean().with_context(|| format!("nothing to compare: give more than {WARM_UP} frames, and --holdout"))?;
    let mean = millis.iter().sum::<f64>() / millis.len() as f64;
    millis.sort_by(f64::total_cmp);
    let p95_ms = millis.get(millis.len() * 95 / 100).copied().unwrap_or(f64::NAN);
    Ok(Row { name, set_ms: mean, p95_ms, score, levels })
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| effort | ms per frame set | p95 | frame sets per second | PSNR dB | SSIM | FLIP | mask IoU | dB lost | ms saved | dB lost for 100 ms |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let Some(full) = rows.first() else { return text };
    for row in rows {
        let (lost, saved) = (full.score.psnr_db - row.score.psnr_db, full.set_ms - row.set_ms);
        let price = if saved > 1.0 { format!("{:.2}", 100.0 * lost / saved) } else { "-".to_owned() };
        let _ = writeln!(
            text,
            "| {} | {:.0} | {:.0} | {:.1} | {:.2} | {:.4} | {:.4} | {:.4} | {lost:.2} | {saved:.0} | {price} |",
            row.name,
            row.set_ms,
            row.p95_ms,
            1e3 / row.set_ms,
            row.score.psnr_db,
            row.score.ssim,
            row.score.flip,
            row.score.iou.unwrap_or(f64::NAN),
        );
    }
    text
}

/// Point of a plot: milliseconds per frame set, PSNR in dB, and name.
type Point = (f64, f64, String);

/// Reads the points of a file that this command wrote.
fn read_points(path: &Path) -> Result<Vec<Point>> {
    #[derive(Deserialize)]
    struct Score {
        psnr_db: f64,
    }
    #[derive(Deserialize)]
    struct Row {
        name: String,
        set_ms: f64,
        score: Score,
    }
    let text = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let rows: Vec<Row> = serde_json::from_slice(&text)
        .with_context(|| format!("{} is not a budget.json of flyrig-bench budget", path.display()))?;
    Ok(rows.into_iter().map(|row| (row.set_ms, row.score.psnr_db, row.name)).collect())
}

/// Plots run time against error: fixed configurations, levels, budgets, and the points of another program.
fn plot(rows: &[Row], beside: &[Point]) -> Plot {
    let full = rows.first().map_or(0.0, |row| row.score.psnr_db);
    let beside = Series {
        name: "other program".to_owned(),
        points: beside.iter().map(|(ms, psnr_db, name)| (*ms, full - psnr_db, name.clone())).collect(),
        line: Line::Front,
    };
    let of = |name: &str, line, belongs: &dyn Fn(&str) -> bool| Series {
        name: name.to_owned(),
        points: rows
            .iter()
            .filter(|row| belongs(&row.name))
            .map(|row| (row.set_ms, full - row.score.psnr_db, row.name.clone()))
            .collect(),
        line,
    };
    let (level, budget) = (|name: &str| name.starts_with("level"), |name: &str| name.starts_with("budget"));
    Plot {
        title: "Run time against loss of PSNR".to_owned(),
        x_label: "milliseconds per frame set, one view drawn".to_owned(),
        y_label: "PSNR lost, dB".to_owned(),
        log_x: false,
        log_y: false,
        series: vec![
            of("fixed configurations", Line::Front, &|name| !level(name) && !budget(name)),
            of("levels", Line::Through, &level),
            of("budgets", Line::Front, &budget),
        ]
        .into_iter()
        .chain((!beside.points.is_empty()).then_some(beside))
        .collect(),
    }
}

/// Plots the level of effort over the frame sets, for each budget.
fn plot_levels(rows: &[Row]) -> Plot {
    let points = |row: &Row| {
        let levels = row.levels.iter().enumerate();
        levels.map(|(set, level)| (set as f64, *level as f64, String::new())).collect()
    };
    Plot {
        title: "Level of effort (0: everything)".to_owned(),
        x_label: "set".to_owned(),
        y_label: "level".to_owned(),
        log_x: false,
        log_y: false,
        series: rows
            .iter()
            .filter(|row| row.name.starts_with("budget"))
            .map(|row| Series { name: row.name.clone(), points: points(row), line: Line::Through })
            .collect(),
    }
}
