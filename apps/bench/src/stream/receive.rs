//! `flyrig-bench receive`: receives the people of a rig or of a take that `flyrig play --repeat` publishes, and measures rates, age and
//! errors of views.

use std::{
    collections::BTreeMap,
    path::Path,
    sync::{
        Arc,
        mpsc::{Receiver, sync_channel},
    },
    thread::Builder,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use flyrig_access::{KeyFile, Role};
use flyrig_capture::recorded_messages;
use flyrig_gpu::GpuContext;
use flyrig_metrics::{Picture, person_box, psnr};
use flyrig_report::{progress_bar, stop, write_whole};
use flyrig_stream::{Posed, StreamTemplate, stamp_of};
use flyrig_transport::{FetchedTemplate, Interests, Subscriber, TransportConfig};
use flyrig_types::{Camera, Mask, RenderedView};
use flyrig_viewer::{Scene, age_secs, clock_secs};
use flyrig_viewing::{People, Taken};
use serde::Serialize;

use crate::cli::BenchReceiveArgs;

/// Topic of `flyrig watch --record`, and its kinds of messages.
const TOPIC: &str = "person-stream";
const MOTION: u8 = 255;
const TEMPLATE: u8 = 254;
/// Time after a person is there that does not count.
const SETTLING: Duration = Duration::from_secs(2);
/// How often what is displayed is compared.
const COMPARE_EVERY: Duration = Duration::from_secs(1);
/// How often the age of what is displayed is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Of the take's frames every so many are kept to compare with: a frame's colours take 2 MB.
const KEPT_EVERY: u64 = 8;

type Colors = Arc<Vec<[f32; 4]>>;

/// Results of one run.
#[derive(Debug, Default, Serialize)]
struct Row {
    line: String,
    /// From the start to the first message, to a person, and to all colours, seconds.
    message_after_secs: Option<f64>,
    motion_after_secs: Option<f64>,
    complete_after_secs: Option<f64>,
    /// Of the time from [`SETTLING`] after the person was there.
    motions_per_second: f64,
    colors_per_second: f64,
    kilobytes_per_second: f64,
    /// Age of the newest motion, over all instants, milliseconds.
    age_p50_ms: f64,
    age_p99_ms: f64,
    /// Age of motions when they were drawn and read back, milliseconds; without a take to compare with.
    drawn_p50_ms: Option<f64>,
    drawn_p99_ms: Option<f64>,
    /// Layers of colours, a mean over all instants.
    color_layers: f64,
    longest_gap_secs: f64,
    /// Views of what is displayed against views of the same frame received without a line.
    mean_db: Option<f64>,
    worst_db: Option<f64>,
}

/// A view to draw.
struct Job {
    posed: Posed,
    colors: Colors,
    camera: Camera,
    wanted: Wanted,
}

enum Wanted {
    /// Decibels to a view of these colours.
    Comparison(Colors),
    /// The age of this capture time when it is drawn, by a clock that is so many nanoseconds behind ours.
    Age(i64, Option<i64>),
}

#[derive(Default)]
struct Results {
    decibels: Vec<f64>,
    ages_ms: Vec<f64>,
}

/// Draws what comes.
fn draw(gpu: &GpuContext, jobs: Receiver<Job>) -> Result<Results> {
    let mut scene = Scene::new(gpu)?;
    let mut results = Results::default();
    for Job { posed, colors, camera, wanted } in jobs {
        let mut draw = |colors: &Colors| -> Result<RenderedView> {
            scene.set_people([(&posed, colors.as_slice())])?;
            Ok(scene.draw(&camera)?)
        };
        let view = draw(&colors)?;
        match wanted {
            Wanted::Comparison(wanted) => results.decibels.extend(compare(&view, &draw(&wanted)?)?),
            Wanted::Age(capture_nanos, offset) => {
                results.ages_ms.extend(age_secs(capture_nanos, offset).map(|secs| 1e3 * secs));
            }
        }
    }
    Ok(results)
}

/// Colours after the frames that are kept, for somebody who misses nothing.
fn reference(take: &Path) -> Result<BTreeMap<u64, Colors>> {
    let mut people = People::default();
    let mut known = BTreeMap::new();
    // Colours of the first frames are complete in the second round.
    for round in 0..2 {
        for (_, message) in recorded_messages(take, TOPIC)? {
            let Some((&[kind, ref person @ ..], bytes)) = message.split_first_chunk::<5>() else { continue };
            let person = u32::from_le_bytes(*person);
            if kind == TEMPLATE {
                if round == 0 {
                    people.meet(person, Arc::new(StreamTemplate::decode(bytes)?));
                }
                continue;
            }
            let frame = stamp_of(bytes)?.frame;
            people.take(person, kind == MOTION, bytes, 0.0)?;
            if let Some(person) = people.get_mut(person).filter(|_| round == 1 && frame % KEPT_EVERY == 0)
                && let Some(motion) = person.motion_at(0.0, false)
            {
                known.insert(frame, person.pose(&motion, &mut Posed::default()));
            }
        }
    }
    ensure!(!known.is_empty(), "{} has no person stream; record one with flyrig watch --record", take.display());
    Ok(known)
}

/// Runs the command.
pub fn receive(args: &BenchReceiveArgs, gpu: &GpuContext) -> Result<()> {
    let known = args.take.as_deref().map(reference).transpose()?;
    let config = match &args.key {
        Some(path) => TransportConfig::with_key(KeyFile::read(path, &[Role::Viewer, Role::Relay])?),
        None => TransportConfig { connect: vec![args.connect.clone()], ..TransportConfig::subscriber(&args.rig) },
    };
    // With a take both ends are on one computer: it would bypass the line.
    let config = TransportConfig { shared_memory: known.is_none(), ..config };
    let start = Instant::now();
    let subscriber = Subscriber::open(&config, &Interests { people: true, stats: true, ..Interests::default() })?;
    let mut templates = subscriber.template_fetcher()?;
    let mut people = People::default();
    let mut row = Row { line: args.label.clone(), ..Row::default() };
    let (mut ages, mut layers, mut bytes, mut motions, mut colors) = (Vec::new(), 0, 0, 0u64, 0u64);
    let (mut newest, mut last_motion): (Option<i64>, Option<Instant>) = (None, None);
    let (mut looked, mut compared) = (start, start);
    let mut offset = None;
    // Drawing must not keep messages waiting: only the newest of a topic waits.
    let (views, jobs) = sync_channel::<Job>(if known.is_some() { 4 } else { 1 });
    let drawing = Builder::new().name("draw".to_owned()).spawn({
        let gpu = gpu.fastest();
        move || draw(&gpu, jobs)
    })?;
    let bar = progress_bar(args.seconds as u64, "bench receive");
    while start.elapsed().as_secs_f64() < args.seconds && !stop::requested() {
        bar.set_position(start.elapsed().as_secs());
        if let Some(FetchedTemplate { people: of, bytes, .. }) = templates.take().unwrap_or_default() {
            let template = Arc::new(StreamTemplate::decode(&bytes)?);
            of.into_iter().for_each(|person| people.meet(person, Arc::clone(&template)));
        }
        if let Some(stats) = subscriber.next_stats(Duration::ZERO)? {
            offset = stats.body.clock_offset_nanos;
        }
        let received = subscriber.next_person(Duration::from_millis(5))?;
        let now = Instant::now();
        let elapsed = start.elapsed().as_secs_f64();
        let is_counted = row.motion_after_secs.is_some_and(|after| elapsed >= after + SETTLING.as_secs_f64());
        let mut is_new = false;
        if let Some(received) = received {
            let message = received.body;
            let is_motion = message.layer.is_none();
            row.message_after_secs.get_or_insert(elapsed);
            ensure!(received.latency_is_exact, "both ends must be on one computer, whose clock ages are read from");
            let taken = people.take(message.person, is_motion, &message.bytes, clock_secs());
            if let Ok(Taken::Needs(hash)) = taken {
                templates.ask(message.person, hash);
            }
            if is_counted {
                bytes += message.bytes.len();
                motions += u64::from(is_motion);
                colors += u64::from(!is_motion);
            }
            if is_motion && matches!(taken, Ok(Taken::Applied)) {
                row.motion_after_secs.get_or_insert(elapsed);
                if let Some(last) = last_motion.replace(now).filter(|_| is_counted) {
                    row.longest_gap_secs = row.longest_gap_secs.max((now - last).as_secs_f64());
                }
                newest = newest.max(Some(received.header.capture_nanos));
                is_new = true;
            }
        }
        let Some((number, person)) = people.iter().next() else { continue };
        if person.is_complete() {
            row.complete_after_secs.get_or_insert(elapsed);
        }
        if let Some(newest) = newest.filter(|_| is_counted && looked.elapsed() >= LOOK_EVERY) {
            looked = now;
            ages.extend(age_secs(newest, offset).map(|secs| 1e3 * secs));
            layers += subscriber.color_layers();
        }
        let is_due = if known.is_some() { compared.elapsed() >= COMPARE_EVERY } else { is_new };
        if is_counted
            && is_due
            && let Some(camera) = subscriber.rig(Duration::ZERO)?.and_then(|rig| rig.cameras.into_iter().next())
            && let Some(person) = people.get_mut(number)
            && let Some(motion) = person.motion_at(clock_secs(), false)
        {
            let wanted = match &known {
                None => Some(Wanted::Age(motion.stamp.capture_nanos, offset)),
                Some(known) => known.get(&motion.stamp.frame).map(|colors| Wanted::Comparison(Arc::clone(colors))),
            };
            if let Some(wanted) = wanted {
                compared = now;
                let mut posed = Posed::default();
                let colors = person.pose(&motion, &mut posed);
                // One that is not drawn in time is left out.
                drop(views.try_send(Job { posed, colors, camera, wanted }));
            }
        }
    }
    bar.finish_and_clear();
    drop(views);
    let results = drawing.join().map_err(|_| anyhow::anyhow!("drawing broke off"))??;
    let counted =
        row.motion_after_secs.map_or(0.0, |after| start.elapsed().as_secs_f64() - after) - SETTLING.as_secs_f64();
    if counted > 0.0 {
        row.motions_per_second = motions as f64 / counted;
        row.colors_per_second = colors as f64 / counted;
        row.kilobytes_per_second = bytes as f64 / counted / 1e3;
        row.color_layers = layers as f64 / ages.len().max(1) as f64;
    }
    let [p50, p99] = ranks(ages);
    (row.age_p50_ms, row.age_p99_ms) = (p50.unwrap_or(0.0), p99.unwrap_or(0.0));
    [row.drawn_p50_ms, row.drawn_p99_ms] = ranks(results.ages_ms);
    let scores = results.decibels;
    row.mean_db = (!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64);
    row.worst_db = scores.iter().copied().min_by(f64::total_cmp);
    println!("{}", text(&row));
    if let Some(out) = &args.out {
        write_whole(out, &serde_json::to_vec_pretty(&row)?)?;
    }
    let nothing =
        || subscriber.trouble().unwrap_or_else(|| "nothing came; is the rig, or `flyrig play`, up?".to_owned());
    row.motion_after_secs.map(drop).with_context(nothing)
}

/// Median and 99th percentile.
fn ranks(mut values: Vec<f64>) -> [Option<f64>; 2] {
    values.sort_by(f64::total_cmp);
    [0.5, 0.99]
        .map(|share| values.get(((values.len() as f64 * share) as usize).min(values.len().saturating_sub(1))).copied())
}

/// Decibels within the person's box; None where nobody is seen or nothing differs.
fn compare(ours: &RenderedView, wanted: &RenderedView) -> Result<Option<f64>> {
    let (width, height) = (wanted.width, wanted.height);
    let mask = Mask::new(width, height, wanted.rgba.chunks_exact(4).map(|p| p[3]).collect())?;
    let Ok(area) = person_box(&mask, 8) else { return Ok(None) };
    let score =
        psnr(&Picture::on_black(width, height, &ours.rgba)?, &Picture::on_black(width, height, &wanted.rgba)?, area)?;
    // Bytes without a difference: as good as a whole view can be.
    Ok(Some(score.min(99.0)))
}

fn text(row: &Row) -> String {
    let number = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |value| format!("{value:.digits$}"));
    format!(
        "| line | first message s | person s | complete s | motions/s | colours/s | KB/s | layers | age p50 ms | p99 | drawn p50 ms | p99 | longest gap s | displayed dB | worst |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n\
         | {} | {} | {} | {} | {:.1} | {:.1} | {:.0} | {:.1} | {:.0} | {:.0} | {} | {} | {:.2} | {} | {} |",
        row.line,
        number(row.message_after_secs, 2),
        number(row.motion_after_secs, 2),
        number(row.complete_after_secs, 2),
        row.motions_per_second,
        row.colors_per_second,
        row.kilobytes_per_second,
        row.color_layers,
        row.age_p50_ms,
        row.age_p99_ms,
        number(row.drawn_p50_ms, 0),
        number(row.drawn_p99_ms, 0),
        row.longest_gap_secs,
        number(row.mean_db, 1),
        number(row.worst_db, 1),
    )
}
