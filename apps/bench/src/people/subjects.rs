//! `flyrig-bench subjects`: views and run time with several people in one scene, compared with one person.
//!
//! Simulated people of one rig are composited by depth, so that they occlude each other as in one room. The colours of each person are
//! also compared alone and in the scene, on the pixels that show the person in the scene.

use std::{collections::BTreeMap, path::Path, time::Instant};

use anyhow::{Context, Result};
use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::{ShapeParams, default_template};
use flyrig_fusion::{
    BodySettings, EstimatedPerception, GivenPerception, GivenPerson, Origin, PerceptionSettings, PersonId, SHAPE_SECS,
    SHAPE_SETS, Session, SessionBuilder, SessionSettings, Subject, TrackState,
};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_report::{arguments::GaussiansArgs, png, progress_bar, write_whole};
use flyrig_sim::{MotionConfig, MotionKind, RingConfig, SimConfig, Simulator};
use flyrig_types::{Image, Mask, RenderedView, Rig};

use crate::harness::{
    arguments::SimulationArgs,
    images::copy,
    joints::hips,
    people::{HELD_OUT, INPUTS, capture, frame_set},
    statistics::mean,
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-subjects")), mut_arg("seed", |arg| arg.default_value("3")))]
pub struct BenchSubjectsArgs {
    /// People in the scene: one waves, the others turn or walk.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(2..=4).map(usize::from))]
    pub people: usize,
    /// Source of poses, shapes and masks. With "estimated" all people but the first walk, and track swaps are counted.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Frames of the sequence; the second half is scored.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub surface: GaussiansArgs,
}

/// Half of the distance between two people, and between a person and the middle of another one's walk, metres.
const APART_M: f64 = 0.45;
const WALK_APART_M: f64 = 0.7;
/// Smallest coverage of a pixel that shows a person.
const COVERED: u8 = 128;

/// Result of tracking some of the people.
struct Row {
    name: String,
    psnr_db: f64,
    iou: f64,
    /// PSNR by tracked person, on the pixels that show this person in the complete scene.
    own_db: Vec<f64>,
    tracks: Tracks,
    /// Milliseconds per frame set, and per rendered view.
    set_ms: f64,
    view_ms: f64,
}

/// Counts of the tracks of estimated people.
#[derive(Default)]
struct Tracks {
    /// Simulated person that each track followed last.
    on: BTreeMap<PersonId, usize>,
    /// Track changes to another simulated person.
    swaps: usize,
    /// Frame sets in which a person had no track.
    missed: usize,
    /// Errors of the hips, millimetres.
    hips_mm: Vec<f64>,
}

impl Tracks {
    /// Compares the tracked people with the simulated ones at an instant.
    fn add(&mut self, session: &Session, people: &[Simulator], chosen: &[usize], nanos: i64) {
        let mut found = Vec::new();
        for subject in session.subjects().iter().filter(|subject| subject.watch().state() != TrackState::Lost) {
            let Some(pose) = subject.pose() else { continue };
            let place = |who: usize| hips(people[who].template(), &people[who].track().at_repeated(nanos));
            let Some(own) = hips(subject.template(), pose) else { continue };
            let distance = |who: &usize| place(*who).map_or(f64::INFINITY, |place| 1e3 * place.distance(own));
            let Some(&nearest) = chosen.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))) else { continue };
            self.hips_mm.push(distance(&nearest));
            let before = self.on.insert(subject.id(), nearest);
            self.swaps += usize::from(before.is_some_and(|before| before != nearest));
            found.push(nearest);
        }
        self.missed += chosen.iter().filter(|who| !found.contains(who)).count();
    }
}

/// Runs the command.
pub fn subjects(args: &BenchSubjectsArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let mut people = (0..args.people).map(|who| simulator(gpu, args, who)).collect::<Result<Vec<_>>>()?;
    let rig = people[0].rig().clone();
    let bar = progress_bar((args.frames * (args.people + 1)) as u64, "bench subjects");
    let all: Vec<usize> = (0..args.people).collect();
    let mut rows = Vec::new();
    for who in &all {
        rows.push(run(args, gpu, &rig, &mut people, format!("person {} alone", who + 1), &[*who], &bar)?);
    }
    rows.push(run(args, gpu, &rig, &mut people, format!("all {}", args.people), &all, &bar)?);
    bar.finish_and_clear();
    let mut table = String::from(
        "| people | PSNR dB | on own pixels dB | mask IoU | hips mm | tracks that changed places | sets without a track | ms per frame set | ms per view |\n\
         |---|---|---|---|---|---|---|---|---|\n",
    );
    for row in &rows {
        let own: Vec<String> = row.own_db.iter().map(|db| format!("{db:.2}")).collect();
        table += &format!(
            "| {} | {:.2} | {} | {:.4} | {:.0} | {} | {} | {:.0} | {:.1} |\n",
            row.name,
            row.psnr_db,
            own.join(", "),
            row.iou,
            mean(&row.tracks.hips_mm),
            row.tracks.swaps,
            row.tracks.missed,
            row.set_ms,
            row.view_ms
        );
    }
    if let Some((together, alone)) = rows.split_last() {
        let one_ms = alone.iter().map(|row| row.set_ms).sum::<f64>() / alone.len() as f64;
        table += &format!("\nall take {:.2} times as long as one person\n", together.set_ms / one_ms);
    }
    write_whole(&args.simulation.output.out.join("subjects.md"), table.as_bytes())?;
    print!("{table}");
    println!("{}; subjects.md and views in {}", gpu.fastest().adapter_name(), args.simulation.output.out.display());
    Ok(())
}

/// Simulates one of the people: two stand side by side, more stand or walk at equal distances around the middle.
fn simulator(gpu: &GpuContext, args: &BenchSubjectsArgs, who: usize) -> Result<Simulator> {
    let apart = if args.pose == Origin::Given { APART_M } else { WALK_APART_M };
    let turn = std::f64::consts::PI + std::f64::consts::TAU * who as f64 / args.people as f64;
    // As far from each other as two are.
    let radius = apart / (std::f64::consts::PI / args.people as f64).sin();
    let motion = MotionConfig {
        kind: match (who, args.pose) {
            (0, _) => MotionKind::Wave,
            (_, Origin::Given) => MotionKind::Turn,
            (_, Origin::Estimated) => MotionKind::Walk,
        },
        at_m: [radius * turn.cos(), radius * turn.sin()],
        ..MotionConfig::default()
    };
    let mut config = SimConfig {
        seed: args.simulation.seed + who as u64,
        motion,
        cameras: RingConfig { count: 7, radius_m: 3.4, ..RingConfig::default() },
        width: args.simulation.side,
        height: args.simulation.side,
        ..SimConfig::default()
    };
    // One room for all.
    config.scene.seed = Some(args.simulation.seed);
    Ok(Simulator::new(gpu, &config)?)
}

/// Sum of squared differences of colours, 0 to 1, and their number.
#[derive(Default, Clone, Copy)]
struct Squares(f64, usize);

impl Squares {
    /// Adds the pixels of a view over black that show `who` in the complete scene.
    fn add(&mut self, view: &RenderedView, truth: &Image, (everybody, shown): (&Mask, &[usize]), who: usize) {
        let pixels = view.rgba.chunks_exact(4).zip(truth.bytes().chunks_exact(3));
        for ((ours, theirs), (cover, shown)) in pixels.zip(everybody.coverage().iter().zip(shown)) {
            if *cover < COVERED || *shown != who {
                continue;
            }
            let alpha = f64::from(ours[3]) / 255.0;
            for c in 0..3 {
                self.0 += ((alpha * f64::from(ours[c]) - f64::from(theirs[c])) / 255.0).powi(2);
            }
            self.1 += 3;
        }
    }

    fn db(self) -> f64 {
        -10.0 * (self.0 / self.1 as f64).log10()
    }
}

fn run(
    args: &BenchSubjectsArgs,
    gpu: &GpuContext,
    rig: &Rig,
    people: &mut [Simulator],
    name: String,
    chosen: &[usize],
    bar: &indicatif::ProgressBar,
) -> Result<Row> {
    let inputs = Rig { cameras: INPUTS.map(|slot| rig.cameras[slot].clone()).into(), world_up: rig.world_up };
    let given = |&who: &usize| GivenPerson {
        person: PersonId(who as u32),
        template: people[who].template().clone(),
        track: people[who].track().clone(),
        repeat: true,
    };
    let settings =
        SessionSettings { body: BodySettings::with_gaussians(args.surface.gaussians), ..SessionSettings::default() };
    let builder = SessionBuilder::new(gpu.clone(), inputs.clone()).settings(settings);
    let mut session = match args.pose {
        Origin::Given => builder.perception(GivenPerception::new(&inputs, chosen.iter().map(given).collect())),
        Origin::Estimated => builder.perception(find_people(people, chosen, rig, &inputs)?),
    }
    .build()?;
    let everybody: Vec<usize> = (0..people.len()).collect();
    let mut sheet = ScoreSheet::default();
    let mut own = vec![Squares::default(); chosen.len()];
    let mut tracks = Tracks::default();
    let (mut set_secs, mut view_secs, mut views) = (0.0, 0.0, 0u32);
    for index in 0..args.frames as u64 {
        let nanos = people[0].frame_nanos(index);
        let set = frame_set(people, chosen, rig, index, nanos)?;
        let start = Instant::now();
        session.process(&set)?;
        tracks.add(&session, people, chosen, nanos);
        // The first set compiles and starts from nothing.
        set_secs += if index > 0 { start.elapsed().as_secs_f64() } else { 0.0 };
        if index as usize >= args.frames / 2 {
            for slot in HELD_OUT {
                let camera = &rig.cameras[slot];
                let (image, mask, _) = capture(people, chosen, nanos, slot)?;
                let start = Instant::now();
                let view = session.render(camera)?;
                view_secs += start.elapsed().as_secs_f64();
                views += 1;
                sheet.extend(score_view(&camera.id, index, &view, &image, Some(&mask))?);
                let (_, cover, shown) = capture(people, &everybody, nanos, slot)?;
                for (squares, who) in own.iter_mut().zip(chosen) {
                    squares.add(&view, &image, (&cover, &shown), *who);
                }
                if index as usize + 1 == args.frames {
                    let file = format!("{}-{}", name.replace(' ', "-"), camera.id);
                    png::write_view(&args.simulation.output.out.join(format!("{file}.png")), &view)?;
                    let truth = png::encode_rgb(image.bytes(), image.width(), image.height())?;
                    write_whole(&args.simulation.output.out.join(format!("{file}-truth.png")), &truth)?;
                }
            }
        }
        bar.inc(1);
    }
    write_subjects(&args.simulation.output.out, &name, &session)?;
    let mean = sheet.mean().context("nothing to compare")?;
    Ok(Row {
        name,
        psnr_db: mean.psnr_db,
        iou: mean.iou.unwrap_or(0.0),
        own_db: own.into_iter().map(Squares::db).collect(),
        tracks,
        set_ms: set_secs * 1e3 / (args.frames - 1).max(1) as f64,
        view_ms: view_secs * 1e3 / f64::from(views.max(1)),
    })
}

/// Creates a perception that knows the empty room, and measures the chosen people in the first seconds.
fn find_people(people: &mut [Simulator], chosen: &[usize], rig: &Rig, inputs: &Rig) -> Result<EstimatedPerception> {
    let settings = PerceptionSettings { people: chosen.len(), ..PerceptionSettings::default() };
    let plate = |&slot: &usize| -> Result<Option<Image>> { Ok(Some(copy(people[0].plate(slot)?)?)) };
    let plates = INPUTS.iter().map(plate).collect::<Result<Vec<_>>>()?;
    let mut perception =
        EstimatedPerception::new(inputs, &default_template(&ShapeParams::default())?, &settings, &plates)?;
    let every_nanos = (SHAPE_SECS * 1e9 / SHAPE_SETS as f64) as i64;
    let sets = (0..SHAPE_SETS as u64).map(|index| frame_set(people, chosen, rig, index, index as i64 * every_nanos));
    let fits = perception.learn_shapes(&sets.collect::<Result<Vec<_>>>()?)?;
    fits.iter().for_each(|fit| eprintln!("a person is {fit}"));
    Ok(perception)
}

/// Writes state and quality of every person.
fn write_subjects(out: &Path, name: &str, session: &Session) -> Result<()> {
    let line = |subject: &Subject| {
        let watch = subject.watch();
        format!("person {}: {}, quality {:?}\n", subject.id(), watch.state().name(), watch.quality())
    };
    let lines: String = session.subjects().iter().map(line).collect();
    write_whole(&out.join(format!("{}.txt", name.replace(' ', "-"))), lines.as_bytes())
}
