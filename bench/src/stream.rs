//! `flyrig-bench stream`: bytes and run times of the person stream against what it loses, beside formats without prediction.

use std::{fmt::Write as _, io::Write as _, path::Path, sync::Arc, time::Instant};

use anyhow::{Context, Result, ensure};
use flate2::{Compression, write::DeflateEncoder};
use flyrig_fusion::{BudgetSettings, Outcome, PersonEncoder, PersonFrame, PersonId, PersonMessages, Session};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{Picture, ScoreSheet, person_box, psnr, score_view};
use flyrig_report::{
    Replay, frame_number,
    plot::{Line, Plot, Series},
    progress_bar, stop, write_whole,
};
use flyrig_stream::{ColorSettings, Posed};
use flyrig_transport::SplatState;
use flyrig_types::{Mask, RenderedView};
use flyrig_viewer::Scene;
use flyrig_viewing::StreamPerson;
use serde::Serialize;

use crate::cli::BenchStreamArgs;

/// Sets that are neither counted nor scored: colours are sent for the first time.
const WARM_UP: u64 = 12;

/// One data set in one form.
#[derive(Debug, Default, Serialize)]
struct Row {
    dataset: String,
    form: String,
    gaussians: usize,
    template_bytes: usize,
    /// Bytes of a frame: mean, 99th percentile, and of the motion alone.
    bytes: f64,
    p99_bytes: f64,
    motion_bytes: f64,
    /// Against the rendering of the same Gaussians uncoded, in the person's box: mean and worst frame.
    coded_db: f64,
    worst_db: f64,
    /// Against the held-out images: uncoded, and lost by coding.
    truth_db: Option<f64>,
    lost_db: Option<f64>,
    lost_ssim: Option<f64>,
    gained_flip: Option<f64>,
    /// Change from frame to frame of the error of coding, RMS, codes of 255.
    flicker: f64,
    /// Mean milliseconds a frame on one core.
    encode_ms: f64,
    decode_ms: f64,
    pose_ms: f64,
}

/// A form of the stream with what it gave so far.
struct Chain {
    form: Form,
    sizes: Vec<usize>,
    motion: usize,
    times: [f64; 3],
    coded: Vec<f64>,
    sheet: ScoreSheet,
    template_bytes: usize,
    /// Error images of the frame before, by camera.
    before: Vec<Option<Vec<f32>>>,
    flicker: (f64, u64),
}

enum Form {
    /// The person stream with a quantisation step.
    Stream { settings: ColorSettings, coder: Option<Box<(PersonEncoder, StreamPerson)>> },
    /// Every Gaussian of every frame, quantised; deflated where asked.
    Splats { deflate: bool },
}

impl Form {
    fn name(&self) -> String {
        match self {
            Self::Stream { settings, .. } => format!("stream, step {}", settings.step),
            Self::Splats { deflate: false } => "splats".to_owned(),
            Self::Splats { deflate: true } => "splats, deflated".to_owned(),
        }
    }
}

/// Runs the command.
pub fn stream(args: &BenchStreamArgs, gpu: &GpuContext) -> Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let mut rows = Vec::new();
    for dataset in &args.datasets {
        if stop::requested() {
            break;
        }
        rows.extend(run(args, gpu, dataset)?);
        print!("{}", table(&rows));
    }
    let (text, csv) = (table(&rows), csv(&rows));
    write_whole(&args.out.join("stream.md"), text.as_bytes())?;
    write_whole(&args.out.join("stream.csv"), csv.as_bytes())?;
    write_whole(&args.out.join("stream.json"), &serde_json::to_vec_pretty(&rows)?)?;
    write_whole(&args.out.join("stream.svg"), plot(&rows).svg().as_bytes())?;
    println!("{}; stream.md, .csv, .json and .svg in {}", gpu.fastest().adapter_name(), args.out.display());
    Ok(())
}

fn run(args: &BenchStreamArgs, gpu: &GpuContext, dataset: &Path) -> Result<Vec<Row>> {
    let settings = args.replay.settings(dataset, args.pose, BudgetSettings::default());
    let mut replay = Replay::open(&settings, gpu)?;
    let holdout = replay.holdout.clone();
    let forms = args
        .steps
        .iter()
        .map(|&step| Form::Stream { settings: ColorSettings { step, ..ColorSettings::default() }, coder: None });
    let others = [Form::Splats { deflate: false }, Form::Splats { deflate: true }];
    let mut chains: Vec<Chain> = forms
        .chain(others)
        .map(|form| Chain {
            form,
            sizes: Vec::new(),
            motion: 0,
            times: [0.0; 3],
            coded: Vec::new(),
            sheet: ScoreSheet::default(),
            template_bytes: 0,
            before: vec![None; holdout.len()],
            flicker: (0.0, 0),
        })
        .collect();
    let mut scene = Scene::new(&gpu.fastest())?;
    let mut uncoded_sheet = ScoreSheet::default();
    let (mut taken, mut gaussians) = (0, 0);
    let bar = progress_bar(replay.count as u64, "bench stream");
    while let Some(set) = replay.next_set()? {
        bar.inc(1);
        if stop::requested() || matches!(replay.session.process(&set)?, Outcome::Held(_)) {
            continue;
        }
        let Some(frame) = replay.session.person_frame(PersonId::default(), &set)? else { continue };
        taken += 1;
        let is_scored = taken > WARM_UP;
        let mut uncoded = Vec::new();
        if is_scored {
            for camera in &holdout {
                uncoded.push(replay.session.render(camera)?);
            }
        }
        let truth = replay.truth.at(set.master_nanos)?;
        for ((camera, view), truth) in holdout.iter().zip(&uncoded).zip(&truth) {
            if let Some(truth) = truth {
                let number = frame_number(&set);
                uncoded_sheet.extend(score_view(&camera.id, number, view, &truth.image, truth.mask.as_ref())?);
            }
        }
        for chain in &mut chains {
            let (posed, colors) = chain.code(&frame, is_scored, &replay.session)?;
            gaussians = posed.center_scale.len();
            if !is_scored {
                continue;
            }
            scene.set_people([(&posed, colors.as_slice())])?;
            for (i, (camera, uncoded)) in holdout.iter().zip(&uncoded).enumerate() {
                let view = scene.draw(camera)?;
                chain.compare(i, &view, uncoded)?;
                if let Some(truth) = &truth[i] {
                    let number = frame_number(&set);
                    chain.sheet.extend(score_view(&camera.id, number, &view, &truth.image, truth.mask.as_ref())?);
                }
            }
        }
    }
    bar.finish_and_clear();
    ensure!(taken > WARM_UP, "{}: a person in more than {WARM_UP} frames is needed, found {taken}", dataset.display());
    let name = dataset.file_name().map_or_else(|| dataset.display().to_string(), |name| name.to_string_lossy().into());
    Ok(chains.into_iter().map(|chain| chain.row(&name, gaussians, &uncoded_sheet)).collect())
}

impl Chain {
    /// Sends a frame through and returns what a viewer has of it.
    fn code(&mut self, frame: &PersonFrame, counts: bool, session: &Session) -> Result<(Posed, Arc<Vec<[f32; 4]>>)> {
        let start = Instant::now();
        match &mut self.form {
            Form::Stream { settings, coder } => {
                let same = |known: &&mut Box<(PersonEncoder, StreamPerson)>| {
                    known.1.template().hash == frame.template().template.hash
                };
                if coder.as_mut().filter(same).is_none() {
                    let person = StreamPerson::new(Arc::new(frame.template().template.clone()));
                    *coder = Some(Box::new((PersonEncoder::new(frame, *settings, 1), person)));
                }
                let Some(coder) = coder else { anyhow::bail!("no coder") };
                let (encoder, person) = &mut **coder;
                self.template_bytes = frame.template().bytes.len();
                let start = Instant::now(); // without making the encoder
                let PersonMessages { motion, colors, .. } = encoder.encode(frame)?;
                let encoded = Instant::now();
                person.take_motion(&motion, 0.0)?;
                for layer in &colors {
                    person.take_colors(layer)?;
                }
                let Some(received) = person.motion_at(0.0, false) else { anyhow::bail!("no motion was received") };
                let decoded_motion = Instant::now();
                let mut posed = Posed::default();
                let known = person.pose(&received, &mut posed);
                let decoded = Instant::now();
                // The inverse transform belongs to decoding, posing is timed by itself.
                let mut again = Posed::default();
                person.template().pose(&received, &mut again);
                let pose = decoded.elapsed();
                if counts {
                    self.sizes.push(motion.len() + colors.iter().map(Vec::len).sum::<usize>());
                    self.motion += motion.len();
                    let decode = (decoded_motion - encoded) + (decoded - decoded_motion).saturating_sub(pose);
                    for (sum, time) in self.times.iter_mut().zip([encoded - start, decode, pose]) {
                        *sum += 1e3 * time.as_secs_f64();
                    }
                }
                Ok((posed, known))
            }
            Form::Splats { deflate } => {
                let splats = session.splats(PersonId::default())?;
                let state = SplatState {
                    center_scale: splats
                        .iter()
                        .map(|s| [s.position[0], s.position[1], s.position[2], s.scale_m[0]])
                        .collect(),
                    color: splats.iter().map(|s| [s.color[0], s.color[1], s.color[2], s.opacity]).collect(),
                    ..SplatState::default()
                };
                let bytes = state.encode()?;
                let mut size = bytes.len();
                if *deflate {
                    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::fast());
                    encoder.write_all(&bytes)?;
                    size = encoder.finish()?.len();
                }
                let encoded = Instant::now();
                let back = SplatState::decode(&bytes)?;
                if counts {
                    self.sizes.push(size);
                    self.times[0] += 1e3 * (encoded - start).as_secs_f64();
                    self.times[1] += 1e3 * encoded.elapsed().as_secs_f64();
                }
                let normal = splats.iter().map(|s| [s.normal[0], s.normal[1], s.normal[2], 0.0]).collect();
                Ok((Posed { center_scale: back.center_scale, normal }, Arc::new(back.color)))
            }
        }
    }

    /// Compares a view with that of the uncoded Gaussians.
    fn compare(&mut self, camera: usize, view: &RenderedView, uncoded: &RenderedView) -> Result<()> {
        let (width, height) = (view.width, view.height);
        let mask = Mask::new(width, height, uncoded.rgba.chunks_exact(4).map(|p| p[3]).collect())?;
        let Ok(area) = person_box(&mask, 8) else { return Ok(()) };
        let ours = Picture::on_black(width, height, &view.rgba)?;
        let wanted = Picture::on_black(width, height, &uncoded.rgba)?;
        self.coded.push(psnr(&ours, &wanted, area)?);
        let pixels = ours.pixels().iter().zip(wanted.pixels());
        let errors: Vec<f32> = pixels.flat_map(|(a, b)| [0, 1, 2].map(|c| 255.0 * (a[c] - b[c]))).collect();
        if let Some(before) = &self.before[camera] {
            let coverage = mask.coverage();
            for (i, (a, b)) in errors.iter().zip(before).enumerate() {
                if coverage[i / 3] > 127 {
                    self.flicker.0 += f64::from(a - b).powi(2);
                    self.flicker.1 += 1;
                }
            }
        }
        self.before[camera] = Some(errors);
        Ok(())
    }

    fn row(mut self, dataset: &str, gaussians: usize, uncoded: &ScoreSheet) -> Row {
        let frames = self.sizes.len().max(1) as f64;
        let bytes = self.sizes.iter().sum::<usize>() as f64 / frames;
        self.sizes.sort_unstable();
        let p99 = self.sizes.get((self.sizes.len() * 99).div_ceil(100).saturating_sub(1)).copied().unwrap_or(0);
        let (truth, ours) = (uncoded.mean(), self.sheet.mean());
        let lost = |of: &dyn Fn(&flyrig_metrics::CameraScore) -> f64| Some(of(truth.as_ref()?) - of(ours.as_ref()?));
        // Decibels of the mean error: frames without any would dominate a mean of decibels.
        let mean_square =
            self.coded.iter().map(|db| 10f64.powf(-db / 10.0)).sum::<f64>() / self.coded.len().max(1) as f64;
        Row {
            dataset: dataset.to_owned(),
            form: self.form.name(),
            gaussians,
            template_bytes: self.template_bytes,
            bytes,
            p99_bytes: p99 as f64,
            motion_bytes: self.motion as f64 / frames,
            coded_db: -10.0 * mean_square.log10(),
            worst_db: self.coded.iter().copied().fold(f64::INFINITY, f64::min),
            truth_db: truth.as_ref().map(|score| score.psnr_db),
            lost_db: lost(&|score| score.psnr_db),
            lost_ssim: lost(&|score| score.ssim),
            gained_flip: lost(&|score| -score.flip),
            flicker: (self.flicker.0 / self.flicker.1.max(1) as f64).sqrt(),
            encode_ms: self.times[0] / frames,
            decode_ms: self.times[1] / frames,
            pose_ms: self.times[2] / frames,
        }
    }
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "| data set | form | Gaussians | KB a frame | p99 | motion KB | Mbit/s at 30 | template MB | dB to uncoded | worst | dB lost | SSIM lost | FLIP gained | flicker | encode ms | decode ms | pose ms |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let number = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |value| format!("{value:.digits$}"));
    for row in rows {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.2} | {:.1} | {:.1} | {} | {} | {} | {:.2} | {:.1} | {:.1} | {:.1} |",
            row.dataset,
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

fn csv(rows: &[Row]) -> String {
    let mut text = String::from(
        "dataset,form,gaussians,template_bytes,bytes,p99_bytes,motion_bytes,coded_db,worst_db,truth_db,lost_db,lost_ssim,gained_flip,flicker,encode_ms,decode_ms,pose_ms\n",
    );
    for row in rows {
        let optional = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:.5}"));
        let _ = writeln!(
            text,
            "{},\"{}\",{},{},{:.1},{:.1},{:.1},{:.3},{:.3},{},{},{},{},{:.4},{:.3},{:.3},{:.3}",
            row.dataset,
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

/// Bytes against quality.
fn plot(rows: &[Row]) -> Plot {
    let mut datasets: Vec<&str> = rows.iter().map(|row| row.dataset.as_str()).collect();
    datasets.dedup();
    let series = |dataset: &&str| Series {
        name: (*dataset).to_owned(),
        points: rows
            .iter()
            .filter(|row| row.dataset == **dataset && row.form.starts_with("stream"))
            .map(|row| (row.bytes / 1e3, row.coded_db, row.form.clone()))
            .collect(),
        line: Line::Through,
    };
    Plot {
        title: "Bytes of a frame against quality".to_owned(),
        x_label: "KB a frame".to_owned(),
        y_label: "PSNR against the uncoded rendering, dB".to_owned(),
        log_x: true,
        log_y: false,
        series: datasets.iter().map(series).collect(),
    }
}
