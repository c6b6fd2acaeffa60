//! Training of the networks for learned appearance, from simulated people and recorded rigs.
//!
//! All files lie in one folder, and a killed training resumes from them: samples are made once and kept as files, the
//! state of the training is written every few hundred steps, whole or not at all.

mod arguments;
mod gather;
mod people;
mod recording;
mod report;

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context, Result, ensure};
use flyrig_gpu::GpuContext;
use flyrig_report::{progress_bar, stop, write_whole};
use flyrig_stfa::{Parameters, SampleErrors, TrainSettings, Trainer, TrainingSample, evaluate};

pub use self::arguments::{SizeName, TrainArgs};
use self::{
    people::TrainingPeople,
    report::{Progress, Scores},
};

/// Offset of the seed of the test people, who only measure progress.
const HELD_OUT_SEED: u64 = 1 << 40;
/// File of the checkpoint.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// Steps between two checkpoints.
const CHECKPOINT_STEPS: u64 = 250;

/// Makes samples, trains, and writes weights and curves to the folder of the arguments. `gpu` opens the graphics adapter if one is needed.
///
/// # Errors
/// Names a file or setting that is missing, damaged, or contradicts a checkpoint in the folder.
pub fn train(args: &TrainArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let started = Instant::now();
    // Wrong arguments are reported before hours of simulation.
    let begin = begin(args)?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    let people =
        TrainingPeople { seed: args.seed, instants: args.instants, side: args.side, gaussians: args.gaussians };
    let held_out = TrainingPeople { seed: args.seed.wrapping_add(HELD_OUT_SEED), ..people.clone() };
    let mut samples = simulated(args, &people, args.people, "samples", gpu)?;
    let mut folders = args.extra.clone();
    for dataset in &args.dataset {
        folders.push(recording::record(args, dataset, &args.out, &gpu()?)?);
    }
    samples.extend(read_extra(&folders)?);
    let test = simulated(args, &held_out, args.test_people, "test", gpu)?;
    if stop::requested() {
        return Ok(());
    }
    ensure!(!samples.is_empty(), "there is nothing to train on; ask for at least one person or data set");

    let mut trainer = begin_or_resume(args, begin)?;
    let mut progress = Progress::open(&args.out, trainer.step)?;
    let card = Card { args, people: &people, samples: samples.len(), started };
    train_until_end(&card, &mut trainer, &mut progress, &samples, &test)?;
    println!("{} of {} steps; {}", trainer.step, args.steps, progress.message());
    match progress.scores.last() {
        Some(scores) => println!("{scores}"),
        None => println!(
            "that is of the samples it learned from; measure with `flyrig eval --weights` on a camera that took no part, since \
             a short take is easily learned by heart"
        ),
    }
    println!("weights.safetensors, weights.json, loss.csv, loss.svg in {}", args.out.display());
    Ok(())
}

/// Resumes the training of the folder's checkpoint, or begins one.
fn begin_or_resume(args: &TrainArgs, begin: Parameters) -> Result<Trainer> {
    let checkpoint = args.out.join(CHECKPOINT);
    let settings = TrainSettings {
        seed: args.seed,
        steps: args.steps,
        rate: args.rate,
        structure: args.structure,
        contrast: args.contrast,
        ..TrainSettings::default()
    };
    if !checkpoint.exists() {
        return Ok(Trainer::new(begin, settings));
    }
    let trainer = Trainer::load(&checkpoint)?;
    ensure!(
        trainer.settings == settings && trainer.parameters.size == begin.size,
        "{} was begun with other settings ({:?}, {:?}); give the same ones, or another --out",
        checkpoint.display(),
        trainer.parameters.size,
        trainer.settings
    );
    if args.from.is_some() {
        eprintln!("train: going on with {}; --from is for a training that begins", checkpoint.display());
    }
    Ok(trainer)
}

/// Trains until the last step or Ctrl-C, and writes checkpoints.
fn train_until_end(
    card: &Card<'_>,
    trainer: &mut Trainer,
    progress: &mut Progress,
    samples: &[TrainingSample],
    test: &[TrainingSample],
) -> Result<()> {
    let args = card.args;
    let bar = progress_bar(args.steps, "train");
    bar.set_position(trainer.step);
    bar.reset_eta();
    while trainer.step < args.steps && !stop::requested() {
        let sample = &samples[trainer.next_sample(samples.len())];
        if let Some(loss) = trainer.step(sample) {
            progress.losses.push(loss);
            bar.set_message(progress.message());
        }
        bar.inc(1);
        let is_last = trainer.step == args.steps;
        if is_last || trainer.step.is_multiple_of(CHECKPOINT_STEPS) {
            if is_last || trainer.step.is_multiple_of(CHECKPOINT_STEPS * args.test_every) {
                progress.scores.extend(score(trainer, test));
            }
            progress.save(&args.out)?;
            // Last: the files that belong to the checkpoint have been written.
            trainer.save(&args.out.join(CHECKPOINT))?;
            card.save_weights(trainer, progress)?;
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// Returns the initial parameters of a new training.
fn begin(args: &TrainArgs) -> Result<Parameters> {
    Ok(match &args.from {
        None => Parameters::untrained(args.size.size(), args.seed),
        Some(weights) => Parameters::named(weights)?,
    })
}

/// Measures the scores on the test people; `None` without any.
fn score(trainer: &Trainer, test: &[TrainingSample]) -> Option<Scores> {
    let errors: Vec<SampleErrors> =
        test.iter().filter_map(|sample| evaluate(&trainer.parameters, sample, true)).collect();
    (!errors.is_empty()).then(|| Scores::new(trainer.step, &errors))
}

/// Returns samples of simulated people; simulates those that the folder lacks.
fn simulated(
    args: &TrainArgs,
    people: &TrainingPeople,
    count: u64,
    folder: &str,
    gpu: &dyn Fn() -> Result<GpuContext>,
) -> Result<Vec<TrainingSample>> {
    let folder = args.out.join(folder);
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    let path = |person: u64, instant: u64| folder.join(format!("{person:05}-{instant:02}.safetensors"));
    let missing: Vec<u64> =
        (0..count).filter(|&person| (0..people.instants).any(|i| !path(person, i).exists())).collect();
    if !missing.is_empty() {
        let gpu = gpu()?;
        let bar = progress_bar(missing.len() as u64, "people");
        for person in missing {
            if stop::requested() {
                break;
            }
            for (instant, sample) in people.samples(&gpu, person)?.into_iter().enumerate() {
                sample.save(&path(person, instant as u64))?;
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
    }
    let mut samples = Vec::new();
    for person in 0..count {
        for instant in 0..people.instants {
            let path = path(person, instant);
            if path.exists() {
                samples.push(TrainingSample::load(&path)?);
            }
        }
    }
    Ok(samples)
}

/// Reads all samples of these folders.
fn read_extra(folders: &[PathBuf]) -> Result<Vec<TrainingSample>> {
    let mut samples = Vec::new();
    for folder in folders {
        let entries = std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
        let mut paths: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
        paths.sort();
        for path in paths.iter().filter(|path| path.extension().is_some_and(|e| e == "safetensors")) {
            samples.push(TrainingSample::load(path)?);
        }
    }
    Ok(samples)
}

/// Facts of a training that its weights are saved with.
struct Card<'a> {
    args: &'a TrainArgs,
    people: &'a TrainingPeople,
    /// Number of training samples.
    samples: usize,
    started: Instant,
}

impl Card<'_> {
    fn save_weights(&self, trainer: &Trainer, progress: &Progress) -> Result<()> {
        let Self { args, people, samples, started } = self;
        let card = serde_json::json!({
            "flyrig": env!("CARGO_PKG_VERSION"),
            "command": command_line(),
            "size": trainer.parameters.size,
            "parameters": trainer.parameters.count(),
            "settings": trainer.settings,
            "step": trainer.step,
            "people": { "train": people, "count": args.people, "held_out_seed": people.seed.wrapping_add(HELD_OUT_SEED) },
            "samples": samples,
            "scores": progress.scores,
            "seconds_of_this_run": started.elapsed().as_secs(),
            "machine": format!("{} threads", rayon::current_num_threads()),
        });
        trainer.parameters.save(&args.out.join("weights.safetensors"), &card)?;
        let json = serde_json::to_vec_pretty(&card)?;
        write_whole(&args.out.join("weights.json"), &json)
    }
}

/// Returns the command line, with paths shortened to their last part.
fn command_line() -> String {
    let short =
        |word: String| Path::new(&word).file_name().map_or(word.clone(), |name| name.to_string_lossy().into_owned());
    std::env::args().map(short).collect::<Vec<_>>().join(" ")
}
