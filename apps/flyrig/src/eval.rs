//! `flyrig eval`: replays a take in order, as live, renders held-out cameras and scores the views; shows the result as report, page and film.

mod arguments;
mod checks;
mod plan;
mod report;
mod run;
mod shown;

use std::time::Instant;

use anyhow::{Context as _, Result};
use flyrig_gpu::GpuContext;
use flyrig_report::write_whole;
use flyrig_takes::{Replay, known_body};

pub use arguments::EvalArgs;
use plan::EvalPlan;
use report::Metrics;
use run::{Evaluation, Run};
use shown::TakeShow;

/// Runs the command.
pub fn eval(args: &EvalArgs, gpu: &GpuContext) -> Result<()> {
    let started = Instant::now();
    let take = args.take.resolve("eval", &args.holdout.holdout, gpu)?;
    let args = &EvalArgs { take, ..args.clone() };
    let plan = EvalPlan::new(&args.take.inputs, &args.holdout.holdout);
    eprintln!("eval: {}", plan.method);
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    // A folder that stays empty is removed again.
    let mut runs = open(args, &plan, gpu).inspect_err(|_| drop(std::fs::remove_dir(&args.out)))?;
    let first = runs.first_mut().context("no camera")?;
    let mut shown = TakeShow::new(&args.name(), first.replay.session.rig(), args.orbit.as_deref())?;
    let mut evaluation = Evaluation::new(&args.out, &runs);
    evaluation.run(&mut runs, &mut shown)?;
    let none = || format!("no frame of {} could be used; run with -v to see why", args.take.dataset.display());
    let first = runs.first_mut().filter(|run| run.processed > 0).with_context(none)?;
    let mut contact = std::mem::take(&mut evaluation.contact);
    contact.retain(|row| !row.pictures.is_empty());
    let seconds = started.elapsed().as_secs_f64();
    let metrics = Metrics::new(args, &plan, &evaluation, first, seconds);
    write_whole(&args.out.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
    let mut report = metrics.report(args, &plan, &evaluation, contact);
    report.facts.extend(first.replay.session.upright_fault().map(|fault| ("up".to_owned(), fault)));
    report.save(&args.out.join("index.html"))?;
    shown.finish(&mut first.replay.session, &args.out.join("take.html"))?;
    if !evaluation.sheet.frames().is_empty() {
        println!("{}", evaluation.sheet.table());
    }
    println!("{}", first.replay.session.stages.table());
    metrics.sentences(args, &plan, &evaluation).iter().for_each(|sentence| println!("{sentence}"));
    println!(
        "\n{} frames in {seconds:.1} s; open {} and take.html beside it in a browser",
        first.processed,
        args.out.join("index.html").display()
    );
    if let Some(film) = &args.orbit {
        println!("the film is {}", film.display());
    }
    Ok(())
}

/// Opens the reconstructions of all splits.
fn open(args: &EvalArgs, plan: &EvalPlan, gpu: &GpuContext) -> Result<Vec<Run>> {
    let known = known_body(&args.body(), false)?;
    let count = plan.splits.len();
    let open = |(index, split): (usize, &plan::Split)| {
        if count > 1 {
            let without =
                split.holdout.first().map_or_else(|| "all cameras".to_owned(), |held| format!("without {held}"));
            eprintln!("eval: reconstruction {} of {count}, {without}", index + 1);
        }
        let replay = Replay::open(&args.replay(split, known.clone()), gpu);
        let mut replay = match split.holdout.as_slice() {
            [held] if count > 1 => replay.with_context(|| format!("without camera {held}"))?,
            _ => replay?,
        };
        replay.session.set_learning_steps(args.learn_steps);
        Ok(Run::new(replay))
    };
    plan.splits.iter().enumerate().map(open).collect()
}
