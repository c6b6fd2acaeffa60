//! `flyrig-bench appearance`: error and run time of every appearance mode on people outside of the training data.

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use clap::{Args, ValueEnum as _, builder::TypedValueParser as _};
use flyrig_fusion::{
    AppearanceMode, AppearanceOptions, BodySettings, GivenPerception, PersonId, SessionBuilder, SessionSettings,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_renderer::srgb_from_linear;
use flyrig_report::{
    arguments::GaussiansArgs,
    plot::{Line, Plot, Series},
    progress_bar, write_whole,
};
use flyrig_stfa::EMBEDDED;
use serde::Serialize;

use crate::harness::{
    arguments::SimulationArgs,
    sequence::{SequenceConfig, SequenceMotion, SimulatedSequence},
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-appearance")), mut_arg("seed", |arg| arg.default_value("101")))]
pub struct BenchAppearanceArgs {
    /// Number of people.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub people: u64,
    /// Frames of each sequence; the second half is scored.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    /// Numbers of input cameras, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "3,1", value_parser = clap::value_parser!(u8).range(1..=6).map(usize::from))]
    pub views: Vec<usize>,
    /// Weights files for the learned modes, in place of all networks that come with flyrig; may be repeated.
    #[arg(long)]
    pub weights: Vec<PathBuf>,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Result for one person, number of views and mode.
#[derive(Debug, Clone, Serialize)]
struct Row {
    person: u64,
    views: usize,
    mode: String,
    psnr_db: f64,
    ssim: f64,
    flip: f64,
    /// Mean change of a Gaussian's sRGB value from frame to frame, in units of 1/255.
    flicker: f64,
    /// Milliseconds per frame of direct appearance and of the networks.
    direct_ms: f64,
    networks_ms: f64,
}

/// Runs the command.
pub fn appearance(args: &BenchAppearanceArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let networks = networks(&args.weights);
    let modes: Vec<Mode<'_>> = AppearanceMode::value_variants()
        .iter()
        .flat_map(|&mode| {
            let learned = networks.iter().map(move |(name, networks)| Mode { mode, networks: Some((name, networks)) });
            let direct = (!mode.is_learned()).then_some(Mode { mode, networks: None });
            direct.into_iter().chain(learned.filter(move |_| mode.is_learned()))
        })
        .collect();
    let bar = progress_bar(args.people * (args.views.len() * modes.len()) as u64, "bench appearance");
    let mut rows = Vec::new();
    for person in args.simulation.seed..args.simulation.seed.saturating_add(args.people) {
        let config = SequenceConfig {
            motion: SequenceMotion::Turn,
            seed: person,
            side: args.simulation.side,
            frames: args.frames,
            fps: 30.0,
        };
        let sequence = SimulatedSequence::simulate(gpu, config)?;
        for &views in &args.views {
            for mode in &modes {
                let row = run(gpu, args, &sequence, person, views, mode)?;
                bar.set_message(format!("{} views, {}: {:.2} dB", row.views, row.mode, row.psnr_db));
                rows.push(row);
                write(&args.simulation.output.out, &rows)?;
                bar.inc(1);
            }
        }
    }
    bar.finish_and_clear();
    print!("{}", table(&rows));
    println!(
        "\n{}; appearance.csv, appearance.json and appearance.svg in {}",
        gpu.fastest().adapter_name(),
        args.simulation.output.out.display()
    );
    Ok(())
}

fn run(
    gpu: &GpuContext,
    args: &BenchAppearanceArgs,
    sequence: &SimulatedSequence,
    person: u64,
    views: usize,
    mode: &Mode<'_>,
) -> Result<Row> {
    let rig = sequence.inputs(views);
    let perception = GivenPerception::repeating(&rig, sequence.template.clone(), sequence.track.clone());
    let appearance =
        AppearanceOptions { mode: mode.mode, weights: mode.networks.map(|(_, weights)| weights.to_owned()) };
    let body = BodySettings::with_gaussians(args.surface.gaussians);
    let settings = SessionSettings { body, appearance, ..SessionSettings::default() };
    let mut session = SessionBuilder::new(gpu.clone(), rig).settings(settings).perception(perception).build()?;
    let mut sheet = ScoreSheet::default();
    let mut last: Vec<[f32; 3]> = Vec::new();
    let (mut change, mut changes) = (0.0, 0u32);
    for set in sequence.sets(views) {
        session.process(&set)?;
        // The first half is for tracking and memory to settle.
        if (set.index as usize) < sequence.config().frames / 2 {
            continue;
        }
        for (camera, truth) in sequence.held_out(set.index as usize)? {
            let view = session.render(camera)?;
            sheet.extend(score_view(&camera.id, set.index, &view, &truth.image, truth.mask.as_ref())?);
        }
        let colors: Vec<[f32; 3]> =
            session.splats(PersonId::default())?.iter().map(|splat| splat.color.map(srgb_from_linear)).collect();
        if last.len() == colors.len() && !last.is_empty() {
            let (now, before) = (colors.as_flattened(), last.as_flattened());
            let sum: f64 = now.iter().zip(before).map(|(a, b)| f64::from((a - b).abs())).sum();
            change += 255.0 * sum / now.len() as f64;
            changes += 1;
        }
        last = colors;
    }
    let mean = sheet.mean().context("nothing to compare")?;
    let stages = session.stages.summary();
    let ms = |name: &str| stages.iter().find(|stage| stage.name == name).map_or(0.0, |stage| f64::from(stage.mean_ms));
    Ok(Row {
        person,
        views,
        mode: mode.name(),
        psnr_db: mean.psnr_db,
        ssim: mean.ssim,
        flip: mean.flip,
        flicker: change / f64::from(changes.max(1)),
        direct_ms: ms("appearance"),
        networks_ms: ms("networks"),
    })
}

/// An appearance mode, with name and weights of the networks of learned modes.
#[derive(Clone, Copy)]
struct Mode<'a> {
    mode: AppearanceMode,
    networks: Option<(&'a str, &'a Path)>,
}

impl Mode<'_> {
    fn name(&self) -> String {
        let mode = self.mode.to_possible_value();
        let mode = mode.as_ref().map_or("", |value| value.get_name());
        match self.networks {
            Some((name, _)) if !name.is_empty() => format!("{mode} {name}"),
            _ => mode.to_owned(),
        }
    }
}

/// Returns name and weights of the files, or of all networks that come with the program; a single file has an empty name.
fn networks(files: &[PathBuf]) -> Vec<(String, PathBuf)> {
    if files.is_empty() {
        return EMBEDDED.iter().map(|(name, _)| ((*name).to_owned(), PathBuf::from(name))).collect();
    }
    let named = |path: &PathBuf| {
        let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).filter(|_| files.len() > 1);
        (stem.unwrap_or_default(), path.clone())
    };
    files.iter().map(named).collect()
}

/// Returns the means over people, in the order of the first row of each kind.
fn means(rows: &[Row]) -> Vec<Row> {
    let mut kinds: Vec<(usize, &str)> = Vec::new();
    for row in rows {
        if !kinds.contains(&(row.views, row.mode.as_str())) {
            kinds.push((row.views, &row.mode));
        }
    }
    let of_kind = |(views, mode): (usize, &str)| {
        let same: Vec<&Row> = rows.iter().filter(|row| row.views == views && row.mode == mode).collect();
        let mean = |of: fn(&Row) -> f64| same.iter().map(|row| of(row)).sum::<f64>() / same.len().max(1) as f64;
        Row {
            person: 0,
            views,
            mode: mode.to_owned(),
            psnr_db: mean(|r| r.psnr_db),
            ssim: mean(|r| r.ssim),
            flip: mean(|r| r.flip),
            flicker: mean(|r| r.flicker),
            direct_ms: mean(|r| r.direct_ms),
            networks_ms: mean(|r| r.networks_ms),
        }
    };
    kinds.into_iter().map(of_kind).collect()
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| views | appearance | PSNR dB | SSIM | FLIP | flicker | direct ms | networks ms |\n|---|---|---|---|---|---|---|---|\n",
    );
    for row in means(rows) {
        let Row { views, mode, psnr_db, ssim, flip, flicker, direct_ms, networks_ms, .. } = row;
        let _ = writeln!(
            out,
            "| {views} | {mode} | {psnr_db:.2} | {ssim:.4} | {flip:.4} | {flicker:.2} | {direct_ms:.0} | {networks_ms:.0} |"
        );
    }
    out
}

fn write(folder: &Path, rows: &[Row]) -> Result<()> {
    write_whole(&folder.join("appearance.json"), &serde_json::to_vec_pretty(rows)?)?;
    let mut csv = String::from("person,views,mode,psnr_db,ssim,flip,flicker,direct_ms,networks_ms\n");
    for row in rows {
        let Row { person, views, mode, psnr_db, ssim, flip, flicker, direct_ms, networks_ms } = row;
        let _ = writeln!(
            csv,
            "{person},{views},{mode},{psnr_db:.3},{ssim:.5},{flip:.5},{flicker:.4},{direct_ms:.2},{networks_ms:.2}"
        );
    }
    write_whole(&folder.join("appearance.csv"), csv.as_bytes())?;
    let means = means(rows);
    let mut views: Vec<usize> = means.iter().map(|row| row.views).collect();
    views.dedup();
    let series = views.into_iter().map(|views| {
        let point = |row: &&Row| (row.direct_ms + row.networks_ms, -row.psnr_db, row.mode.clone());
        let points = means.iter().filter(|row| row.views == views).collect::<Vec<_>>();
        Series {
            name: if views == 1 { "1 view".to_owned() } else { format!("{views} views") },
            points: points.iter().map(point).collect(),
            line: Line::Front,
        }
    });
    let plot = Plot {
        title: "Run time against error, people never trained on".to_owned(),
        x_label: "ms per frame, direct appearance and networks".to_owned(),
        y_label: "-PSNR, dB".to_owned(),
        log_x: true,
        log_y: false,
        series: series.collect(),
    };
    write_whole(&folder.join("appearance.svg"), plot.svg().as_bytes())
}
