//! `flyrig-bench receive`: rates, age and errors of the received people of a rig, or of a take that `flyrig play --repeat` publishes.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread::Builder,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_access::{KeyFile, Role};
use flyrig_capture::recorded_messages;
use flyrig_gpu::GpuContext;
use flyrig_metrics::{Picture, person_box, psnr};
use flyrig_report::{arguments::parse_seconds, progress_bar, stop, write_whole};
use flyrig_stream::{Posed, StreamTemplate, stamp_of};
use flyrig_transport::{FetchedTemplate, Interests, PersonMessage, Subscriber, TemplateFetcher, TransportConfig};
use flyrig_types::{Camera, Mask, RenderedView};
use flyrig_viewer::{PeopleScene, age_secs, clock_secs};
use flyrig_viewing::{Ingested, People};
use serde::Serialize;

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchReceiveArgs {
    /// The played recording (`flyrig watch --record`): views are compared with those of a lossless reception. Without it every motion is
    /// rendered on arrival, and its age after that is measured as well.
    pub take: Option<PathBuf>,
    /// Key file for the rig.
    #[arg(long, conflicts_with_all = ["rig", "connect"])]
    pub key: Option<PathBuf>,
    /// Name of the rig.
    #[arg(long, default_value = "flyrig")]
    pub rig: String,
    /// Address of `flyrig play` (zenoh endpoint).
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub connect: String,
    /// Duration, seconds.
    #[arg(long, default_value_t = 30.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// Name of the network line in the results.
    #[arg(long, default_value = "loopback")]
    pub label: String,
    /// File of the results (JSON).
    #[arg(long)]
    pub out: Option<PathBuf>,
}

/// Topic of `flyrig watch --record`, and its message kinds.
const TOPIC: &str = "person-stream";
const MOTION: u8 = 255;
const TEMPLATE: u8 = 254;
/// Time after the arrival of a person that is not measured.
const SETTLING: Duration = Duration::from_secs(2);
/// Interval of comparisons of the displayed view.
const COMPARE_EVERY: Duration = Duration::from_secs(1);
/// Interval of samples of the displayed motion's age.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Interval of the take's frames that are kept for comparison: the colours of a frame take 2 MB.
const KEPT_EVERY: u64 = 8;

type Colors = Arc<Vec<[f32; 4]>>;

/// Results of one run.
#[derive(Debug, Default, Serialize)]
struct Row {
    line: String,
    /// Seconds from the start to the first message, to a person, and to complete colours.
    message_after_secs: Option<f64>,
    motion_after_secs: Option<f64>,
    complete_after_secs: Option<f64>,
    /// Rates from [`SETTLING`] after the arrival of the person on.
    motions_per_second: f64,
    colors_per_second: f64,
    kilobytes_per_second: f64,
    /// Age of the newest motion over all samples, milliseconds.
    age_p50_ms: f64,
    age_p99_ms: f64,
    /// Age of motions after rendering and reading back, milliseconds; only without a take to compare with.
    drawn_p50_ms: Option<f64>,
    drawn_p99_ms: Option<f64>,
    /// Mean number of colour layers over all samples.
    color_layers: f64,
    longest_gap_secs: f64,
    /// PSNR of displayed views against those of the same frame received without loss, decibels.
    mean_db: Option<f64>,
    worst_db: Option<f64>,
}

/// A view to render.
struct Job {
    posed: Posed,
    colors: Colors,
    camera: Camera,
    wanted: Wanted,
}

enum Wanted {
    /// PSNR against a view with these colours.
    Comparison(Colors),
    /// Age of this capture time (nanoseconds) after rendering, and the offset of its clock, nanoseconds.
    Age(i64, Option<i64>),
}

#[derive(Default)]
struct Results {
    decibels: Vec<f64>,
    ages_ms: Vec<f64>,
}

/// Renders the jobs until their sender is dropped.
fn draw(gpu: &GpuContext, jobs: Receiver<Job>) -> Result<Results> {
    let mut scene = PeopleScene::new(gpu)?;
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

/// Returns the colours after the kept frames, for a lossless reception.
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
                    people.set_template(person, Arc::new(StreamTemplate::decode(bytes)?));
                }
                continue;
            }
            let frame = stamp_of(bytes)?.frame;
            people.ingest(person, kind == MOTION, bytes, 0.0)?;
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
///
/// # Errors
/// Names what cannot be read, or says why nothing was received.
pub fn receive(args: &BenchReceiveArgs, gpu: &GpuContext) -> Result<()> {
    let known = args.take.as_deref().map(reference).transpose()?;
    let config = match &args.key {
        Some(path) => TransportConfig::with_key(KeyFile::read(path, &[Role::Viewer, Role::Relay])?),
        None => TransportConfig { connect: vec![args.connect.clone()], ..TransportConfig::subscriber(&args.rig) },
    };
    let start = Instant::now();
    let subscriber = Subscriber::open(&config, &Interests { people: true, stats: true, ..Interests::default() })?;
    // Rendering must not delay messages: only the newest message of a topic waits.
    let (views, jobs) = sync_channel::<Job>(if known.is_some() { 4 } else { 1 });
    let drawing = Builder::new().name("draw".to_owned()).spawn({
        let gpu = gpu.fastest();
        move || draw(&gpu, jobs)
    })?;
    let row = Row { line: args.label.clone(), ..Row::default() };
    let mut reception = Reception::new(&subscriber, known, row, start)?;
    let bar = progress_bar(args.seconds as u64, "bench receive");
    while start.elapsed().as_secs_f64() < args.seconds && !stop::requested() {
        bar.set_position(start.elapsed().as_secs());
        reception.step(&views)?;
    }
    bar.finish_and_clear();
    drop(views);
    let results = drawing.join().map_err(|_| anyhow::anyhow!("the rendering thread failed"))??;
    let row = reception.into_row(results);
    println!("{}", text(&row));
    if let Some(out) = &args.out {
        write_whole(out, &serde_json::to_vec_pretty(&row)?)?;
    }
    let nothing =
        || subscriber.trouble().unwrap_or_else(|| "nothing was received; is the rig, or `flyrig play`, up?".to_owned());
    row.motion_after_secs.map(drop).with_context(nothing)
}

/// People while they are received, and the sums of the measurement.
struct Reception<'a> {
    subscriber: &'a Subscriber,
    templates: TemplateFetcher,
    people: People,
    /// Colours of the take by frame, to compare with.
    known: Option<BTreeMap<u64, Colors>>,
    row: Row,
    start: Instant,
    /// Ages of the newest motion, milliseconds.
    ages: Vec<f64>,
    layers: usize,
    bytes: usize,
    motions: u64,
    colors: u64,
    /// Capture time of the newest motion, nanoseconds.
    newest: Option<i64>,
    last_motion: Option<Instant>,
    looked: Instant,
    compared: Instant,
    /// Offset of the rig's clock, nanoseconds.
    offset: Option<i64>,
}

impl<'a> Reception<'a> {
    fn new(subscriber: &'a Subscriber, known: Option<BTreeMap<u64, Colors>>, row: Row, start: Instant) -> Result<Self> {
        Ok(Self {
            subscriber,
            templates: subscriber.template_fetcher()?,
            people: People::default(),
            known,
            row,
            start,
            ages: Vec::new(),
            layers: 0,
            bytes: 0,
            motions: 0,
            colors: 0,
            newest: None,
            last_motion: None,
            looked: start,
            compared: start,
            offset: None,
        })
    }

    /// Receives at most one message, measures, and passes a due view to the rendering thread.
    fn step(&mut self, views: &SyncSender<Job>) -> Result<()> {
        if let Some(FetchedTemplate { people: of, bytes, .. }) = self.templates.take().unwrap_or_default() {
            let template = Arc::new(StreamTemplate::decode(&bytes)?);
            of.into_iter().for_each(|person| self.people.set_template(person, Arc::clone(&template)));
        }
        if let Some(stats) = self.subscriber.next_stats(Duration::ZERO)? {
            self.offset = stats.body.clock_offset_nanos;
        }
        let received = self.subscriber.next_person(Duration::from_millis(5))?;
        let now = Instant::now();
        let elapsed = self.start.elapsed().as_secs_f64();
        let is_counted = self.row.motion_after_secs.is_some_and(|after| elapsed >= after + SETTLING.as_secs_f64());
        let mut is_new = false;
        if let Some(received) = received {
            ensure!(received.latency_is_exact, "both ends must be on one computer, whose clock gives the ages");
            is_new = self.ingest(&received.body, received.header.capture_nanos, (now, elapsed), is_counted);
        }
        let Some((number, person)) = self.people.iter().next() else { return Ok(()) };
        if person.is_complete() {
            self.row.complete_after_secs.get_or_insert(elapsed);
        }
        if let Some(newest) = self.newest.filter(|_| is_counted && self.looked.elapsed() >= LOOK_EVERY) {
            self.looked = now;
            self.ages.extend(age_secs(newest, self.offset).map(|secs| 1e3 * secs));
            self.layers += self.subscriber.color_layers();
        }
        let is_due = if self.known.is_some() { self.compared.elapsed() >= COMPARE_EVERY } else { is_new };
        if is_counted && is_due { self.send_view(number, now, views) } else { Ok(()) }
    }

    /// Applies a message. Returns whether it was a new motion.
    fn ingest(
        &mut self,
        message: &PersonMessage,
        capture_nanos: i64,
        (now, elapsed): (Instant, f64),
        is_counted: bool,
    ) -> bool {
        let is_motion = message.layer.is_none();
        self.row.message_after_secs.get_or_insert(elapsed);
        let taken = self.people.ingest(message.person, is_motion, &message.bytes, clock_secs());
        if let Ok(Ingested::Needs(hash)) = taken {
            self.templates.ask(message.person, hash);
        }
        if is_counted {
            self.bytes += message.bytes.len();
            self.motions += u64::from(is_motion);
            self.colors += u64::from(!is_motion);
        }
        let is_new = is_motion && matches!(taken, Ok(Ingested::Applied));
        if is_new {
            self.row.motion_after_secs.get_or_insert(elapsed);
            if let Some(last) = self.last_motion.replace(now).filter(|_| is_counted) {
                self.row.longest_gap_secs = self.row.longest_gap_secs.max((now - last).as_secs_f64());
            }
            self.newest = self.newest.max(Some(capture_nanos));
        }
        is_new
    }

    /// Passes the displayed state of a person to the rendering thread, which skips it while it is busy.
    fn send_view(&mut self, number: u32, now: Instant, views: &SyncSender<Job>) -> Result<()> {
        if let Some(camera) = self.subscriber.rig(Duration::ZERO)?.and_then(|rig| rig.cameras.into_iter().next())
            && let Some(person) = self.people.get_mut(number)
            && let Some(motion) = person.motion_at(clock_secs(), false)
        {
            let wanted = match &self.known {
                None => Some(Wanted::Age(motion.stamp.capture_nanos, self.offset)),
                Some(known) => known.get(&motion.stamp.frame).map(|colors| Wanted::Comparison(Arc::clone(colors))),
            };
            if let Some(wanted) = wanted {
                self.compared = now;
                let mut posed = Posed::default();
                let colors = person.pose(&motion, &mut posed);
                drop(views.try_send(Job { posed, colors, camera, wanted }));
            }
        }
        Ok(())
    }

    /// Returns the row with rates and percentiles.
    fn into_row(self, results: Results) -> Row {
        let mut row = self.row;
        let counted = row.motion_after_secs.map_or(0.0, |after| self.start.elapsed().as_secs_f64() - after)
            - SETTLING.as_secs_f64();
        if counted > 0.0 {
            row.motions_per_second = self.motions as f64 / counted;
            row.colors_per_second = self.colors as f64 / counted;
            row.kilobytes_per_second = self.bytes as f64 / counted / 1e3;
            row.color_layers = self.layers as f64 / self.ages.len().max(1) as f64;
        }
        let [p50, p99] = ranks(self.ages);
        (row.age_p50_ms, row.age_p99_ms) = (p50.unwrap_or(0.0), p99.unwrap_or(0.0));
        [row.drawn_p50_ms, row.drawn_p99_ms] = ranks(results.ages_ms);
        let scores = results.decibels;
        row.mean_db = (!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64);
        row.worst_db = scores.iter().copied().min_by(f64::total_cmp);
        row
    }
}

/// Returns the median and the 99th percentile; `None` without values.
fn ranks(mut values: Vec<f64>) -> [Option<f64>; 2] {
    values.sort_by(f64::total_cmp);
    [0.5, 0.99]
        .map(|share| values.get(((values.len() as f64 * share) as usize).min(values.len().saturating_sub(1))).copied())
}

/// Returns the PSNR within the person's box, decibels; `None` where no person is visible.
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
