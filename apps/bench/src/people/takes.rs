//! `flyrig-bench takes`: track swaps in many takes of people who walk past one another.

use std::{collections::BTreeMap, time::Instant};

use anyhow::Result;
use clap::{Args, builder::TypedValueParser as _};
use flyrig_body::{ShapeParams, default_template};
use flyrig_fusion::{
    EstimatedPerception, KnownPerson, Perception as _, PerceptionSettings, PersonId, PersonObservation, StageTimes,
};
use flyrig_gpu::GpuContext;
use flyrig_report::{
    arguments::{FpsArgs, parse_seconds},
    progress_bar, write_whole,
};
use flyrig_sim::{MotionConfig, MotionKind, RingConfig, SceneConfig, SimConfig, Simulator};
use flyrig_types::{Image, Rig};
use glam::DVec3;

use crate::harness::{
    arguments::SimulationArgs,
    images::copy,
    joints::hips,
    people::{INPUTS, frame_set},
    statistics::mean,
};

/// Arguments of the command.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.default_value("out/bench-takes")), mut_arg("seed", |arg| arg.default_value("601")), mut_arg("side", |arg| arg.default_value("384")), mut_arg("fps", |arg| arg.default_value("10")))]
pub struct BenchTakesArgs {
    /// Number of takes, each with its own people and room.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub takes: u64,
    /// People in each take: one stays in the middle, the others walk around.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(2..=4).map(usize::from))]
    pub people: usize,
    /// Seconds of a take.
    #[arg(long, default_value_t = 5.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Seconds that the last person is absent, from 3 s after the start on; no person leaves otherwise.
    #[arg(long, value_parser = parse_seconds)]
    pub away_secs: Option<f64>,
    #[command(flatten)]
    pub simulation: SimulationArgs,
    #[command(flatten)]
    pub rate: FpsArgs,
}

/// Largest distance of a track from the person whom it follows, metres.
const ON_SOMEBODY_M: f64 = 0.4;
/// Time from which on every person must have a track, seconds: people are measured for 1.5 s first.
const ARRIVAL_SECS: f64 = 2.0;
/// Time at which the last person leaves, and time for the search after the return, seconds.
const LEAVES_SECS: f64 = 3.0;
const RETURN_SECS: f64 = 1.0;

/// Counts of one take.
#[derive(Debug, Default)]
struct Take {
    /// Track changes to another person.
    swaps: usize,
    /// Frame sets without a track for a person, and all pairs of person and frame set, after [`ARRIVAL_SECS`].
    missed: usize,
    all: usize,
    /// Frame sets in which a track followed no person.
    astray: usize,
    hips_mm: Vec<f64>,
    secs: f64,
    sets: usize,
    /// Person that each track followed last.
    on: BTreeMap<PersonId, usize>,
    /// Returns of the absent person to the same track, and to another one.
    same: usize,
    other: usize,
}

/// Runs the command.
pub fn takes(args: &BenchTakesArgs, gpu: &GpuContext) -> Result<()> {
    args.simulation.output.create()?;
    let sets = (args.secs * args.rate.fps).round().max(1.0) as u64;
    let bar = progress_bar(args.takes * sets, "bench takes");
    let mut table = String::from(
        "| take | changes of a track | without a track | tracks on no person | returns to the own track | to another | hips mm | ms per frame set \
         |\n|---|---|---|---|---|---|---|---|\n",
    );
    let mut total = Take::default();
    for index in 0..args.takes {
        let take = run(args, gpu, args.simulation.seed + index * args.people as u64, sets, &bar)?;
        table += &row(&(args.simulation.seed + index * args.people as u64).to_string(), &take);
        total.add(take);
        write_whole(&args.simulation.output.out.join("takes.md"), table.as_bytes())?;
    }
    bar.finish_and_clear();
    table += &row("all", &total);
    write_whole(&args.simulation.output.out.join("takes.md"), table.as_bytes())?;
    print!("{table}");
    println!(
        "{} people; {}; takes.md in {}",
        args.people,
        gpu.fastest().adapter_name(),
        args.simulation.output.out.display()
    );
    Ok(())
}

fn row(name: &str, take: &Take) -> String {
    format!(
        "| {name} | {} | {} of {} | {} | {} | {} | {:.0} | {:.0} |\n",
        take.swaps,
        take.missed,
        take.all,
        take.astray,
        take.same,
        take.other,
        mean(&take.hips_mm),
        1e3 * take.secs / take.sets.max(1) as f64
    )
}

impl Take {
    fn add(&mut self, other: Self) {
        self.swaps += other.swaps;
        self.missed += other.missed;
        self.all += other.all;
        self.astray += other.astray;
        self.same += other.same;
        self.other += other.other;
        self.hips_mm.extend(other.hips_mm);
        self.secs += other.secs;
        self.sets += other.sets;
    }

    /// Compares the tracks of a frame set with the true positions of the people. Returns the track by person.
    fn compare(
        &mut self,
        tracks: &[(PersonId, DVec3)],
        truth: &[(usize, DVec3)],
        counts: bool,
    ) -> BTreeMap<usize, PersonId> {
        let mut found = BTreeMap::new();
        for (id, hips) in tracks {
            let nearest = truth.iter().min_by(|a, b| a.1.distance(*hips).total_cmp(&b.1.distance(*hips)));
            let Some((nearest, place)) = nearest.copied().filter(|(_, place)| place.distance(*hips) < ON_SOMEBODY_M)
            else {
                self.astray += 1;
                continue;
            };
            self.hips_mm.push(1e3 * place.distance(*hips));
            found.insert(nearest, *id);
            let before = self.on.insert(*id, nearest);
            self.swaps += usize::from(before.is_some_and(|before| before != nearest));
        }
        if counts {
            self.all += truth.len();
            self.missed += truth.iter().filter(|(who, _)| !found.contains_key(who)).count();
        }
        found
    }
}

fn run(args: &BenchTakesArgs, gpu: &GpuContext, seed: u64, sets: u64, bar: &indicatif::ProgressBar) -> Result<Take> {
    let mut people = (0..args.people).map(|who| simulator(gpu, args, seed, who)).collect::<Result<Vec<_>>>()?;
    let rig = people[0].rig().clone();
    let inputs = Rig { cameras: INPUTS.map(|slot| rig.cameras[slot].clone()).into(), world_up: rig.world_up };
    let plates: Vec<Option<Image>> =
        INPUTS.iter().map(|&slot| Ok(Some(copy(people[0].plate(slot)?)?))).collect::<Result<_>>()?;
    let settings = PerceptionSettings { people: args.people, ..PerceptionSettings::default() };
    let template = default_template(&ShapeParams::default())?;
    let mut perception = EstimatedPerception::new(&inputs, &template, &settings, &plates)?;
    let (everybody, last) = ((0..args.people).collect::<Vec<_>>(), args.people - 1);
    let mut take = Take::default();
    // The last person's track, and whether it left and was not found since.
    let (mut own, mut has_left) = (None, false);
    for index in 0..sets {
        let secs = index as f64 / args.rate.fps;
        let nanos = (secs * 1e9) as i64;
        let back_secs = LEAVES_SECS + args.away_secs.unwrap_or(0.0);
        let is_away = (LEAVES_SECS..back_secs).contains(&secs);
        let chosen = &everybody[..args.people - usize::from(is_away)];
        let set = frame_set(&mut people, chosen, &rig, index, nanos)?;
        let start = Instant::now();
        let observations = perception.observe(&set, &mut StageTimes::default())?;
        take.secs += start.elapsed().as_secs_f64();
        take.sets += 1;
        let known = perception.people();
        let tracks: Vec<(PersonId, DVec3)> = observations
            .iter()
            .filter_map(|observation| {
                let PersonObservation::Seen(seen) = observation else { return None };
                let template = |known: &&KnownPerson| known.person == seen.person;
                Some((seen.person, hips(known.iter().find(template)?.template, &seen.pose)?))
            })
            .collect();
        let place = |who: &usize| hips(people[*who].template(), &people[*who].track().at_repeated(nanos));
        let truth: Vec<(usize, DVec3)> = chosen.iter().filter_map(|who| Some((*who, place(who)?))).collect();
        let is_arriving = args.away_secs.is_some() && (back_secs..back_secs + RETURN_SECS).contains(&secs);
        let found = take.compare(&tracks, &truth, secs >= ARRIVAL_SECS && !is_arriving);
        if let Some(now) = found.get(&last) {
            if std::mem::take(&mut has_left) {
                take.same += usize::from(own == Some(*now));
                take.other += usize::from(own != Some(*now));
            }
            own = Some(*now);
        }
        has_left |= is_away;
        bar.inc(1);
    }
    Ok(take)
}

/// Simulates one of the people: the first waves in the middle, the others walk around on a circle at equal distances.
fn simulator(gpu: &GpuContext, args: &BenchTakesArgs, seed: u64, who: usize) -> Result<Simulator> {
    let motion = MotionConfig {
        kind: if who == 0 { MotionKind::Wave } else { MotionKind::Walk },
        phase: (seed as f64 * 0.37 + who as f64 / (args.people - 1) as f64).fract(),
        ..MotionConfig::default()
    };
    let config = SimConfig {
        seed: seed + who as u64,
        motion,
        cameras: RingConfig { count: 7, radius_m: 3.4, ..RingConfig::default() },
        width: args.simulation.side,
        height: args.simulation.side,
        // One room for all.
        scene: SceneConfig { seed: Some(seed), ..SceneConfig::default() },
        ..SimConfig::default()
    };
    Ok(Simulator::new(gpu, &config)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_absences_and_strays_are_counted() {
        let truth = [(0, DVec3::ZERO), (1, DVec3::X)];
        let (a, b) = (PersonId(0), PersonId(1));
        let mut take = Take::default();
        take.compare(&[(a, DVec3::ZERO), (b, DVec3::X * 0.9)], &truth, true);
        assert_eq!((take.swaps, take.missed, take.all, take.astray), (0, 0, 2, 0));
        let found = take.compare(&[(a, DVec3::X)], &truth, true);
        assert_eq!(found, BTreeMap::from([(1, a)]));
        assert_eq!((take.swaps, take.missed, take.all, take.astray), (1, 1, 4, 0), "a changed over, one is missing");
        take.compare(&[(a, DVec3::X), (b, DVec3::Z * 5.0)], &truth, false);
        assert_eq!((take.swaps, take.missed, take.all, take.astray), (1, 1, 4, 1));
        assert!((mean(&take.hips_mm) - 25.0).abs() < 1e-9, "{:?}", take.hips_mm);
    }
}
