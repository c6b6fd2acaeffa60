//! Person stream in a recording: `flyrig watch --record` writes it, `flyrig play` publishes it again.
//!
//! Topic `person-stream` holds the messages in order of arrival. A message is one byte (the layer of colours, or
//! [`MOTION`] or [`TEMPLATE`]), the person's number (u32, little-endian) and the message's own bytes. A template comes before
//! the first motion that needs it.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use flyrig_capture::{MessageTap, Pacing, monotonic_nanos, recorded_messages};
use flyrig_report::{arguments::parse_speed, stop};
use flyrig_stream::{Stamp, restamp, stamp_of, template_hash};
use flyrig_takes::recorded::recorded_cameras;
use flyrig_transport::{Interests, PersonMessage, Publisher, Subscriber, TransportConfig};

use crate::{
    config::RecordSection, config_check::check_endpoint, opening::require_recording, recording, watch::WatchArgs,
};

/// Arguments of `flyrig play`.
#[derive(Debug, Args)]
pub struct PlayArgs {
    /// Recording of `flyrig watch --record`.
    pub recording: PathBuf,
    /// Name of the published rig.
    #[arg(long, default_value = "flyrig")]
    pub rig: String,
    /// Address for viewers of this computer (zenoh endpoint).
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub listen: String,
    /// Folder of the rig's keys, whose holders connect from other computers.
    #[arg(long)]
    pub keys: Option<PathBuf>,
    /// Allow addresses that other computers reach without keys: in trusted networks only.
    #[arg(long)]
    pub insecure: bool,
    /// Repeat until Ctrl-C.
    #[arg(long)]
    pub repeat: bool,
    /// Wait for the first viewer.
    #[arg(long)]
    pub wait: bool,
    /// Pace relative to that of the recording.
    #[arg(long, default_value_t = 1.0, value_parser = parse_speed)]
    pub speed: f64,
    /// Write a film of a camera that walks around the person (*.mp4 or *.avi), and publish nothing.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["rig", "listen", "keys", "insecure", "repeat", "wait", "speed"])]
    pub orbit: Option<PathBuf>,
}

/// Topic of the messages in a recording.
pub(crate) const TOPIC: &str = "person-stream";
const SCHEMA: &str = "flyrig.PersonStream";
/// First byte of a motion, and of a template.
pub(crate) const MOTION: u8 = 255;
pub(crate) const TEMPLATE: u8 = 254;
/// Longest wait for a template.
const TEMPLATE_PATIENCE: Duration = Duration::from_secs(10);
/// Interval between lines with counts.
const PRINT_EVERY: Duration = Duration::from_secs(5);
/// Longest pause between two messages, seconds; longer ones are shortened.
const MOST_PAUSE_SECS: f64 = 5.0;

/// Writer of the persons' messages.
struct Writer<'a> {
    subscriber: &'a Subscriber,
    tap: MessageTap,
    templates: BTreeSet<u64>,
    motions: u64,
    bytes: u64,
}

impl Writer<'_> {
    fn write(&mut self, PersonMessage { person, layer, bytes }: &PersonMessage) -> Result<()> {
        let stamp = stamp_of(bytes)?;
        if !self.templates.contains(&stamp.template) {
            // Colours whose template is unknown cannot be shown; the motion beside them asks for it.
            if layer.is_some() {
                return Ok(());
            }
            let Some(template) = self.subscriber.template(stamp.template, TEMPLATE_PATIENCE)? else { return Ok(()) };
            self.put(TEMPLATE, *person, stamp.capture_nanos, &template);
            self.templates.insert(stamp.template);
            // A recording that begins in the middle of the stream has all colours from the start.
            self.subscriber.fetch_colors(*person);
        }
        self.motions += u64::from(layer.is_none());
        let kind = layer.and_then(|layer| u8::try_from(layer).ok()).unwrap_or(MOTION);
        self.put(kind, *person, stamp.capture_nanos, bytes);
        Ok(())
    }

    fn put(&mut self, kind: u8, person: u32, nanos: i64, bytes: &[u8]) {
        let mut message = vec![kind];
        message.extend(person.to_le_bytes());
        message.extend(bytes);
        self.bytes += message.len() as u64;
        self.tap.record(nanos, message);
    }
}

/// Runs `flyrig watch --record`.
pub fn record(args: &WatchArgs, path: &Path) -> Result<()> {
    let stop = stop::flag();
    ensure!(!path.exists(), "{} is there already; name a new file", path.display());
    let config = args.rig.transport()?;
    let subscriber = Subscriber::open(&config, &Interests { people: true, ..Interests::default() })?;
    let started = Instant::now();
    let is_over = || {
        stop.load(std::sync::atomic::Ordering::Relaxed)
            || args.stop.seconds.is_some_and(|limit| started.elapsed().as_secs_f64() >= limit)
    };
    eprintln!(
        "watch: rig '{}' at {}, waiting for its calibration (Ctrl-C ends)",
        config.rig,
        config.connect.join(", ")
    );
    let rig = loop {
        if let Some(rig) = subscriber.rig(Duration::from_millis(200))? {
            break rig;
        }
        if is_over() {
            let none =
                || format!("no rig '{}' at {}; check --rig and --connect", config.rig, config.connect.join(", "));
            anyhow::bail!(subscriber.trouble().unwrap_or_else(none));
        }
    };
    let ids: Vec<_> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let recorder = recording::recorder(path, &ids, Some(&rig), &RecordSection::default(), Pacing::AsDelivered)?;
    let tap = recorder.messages(TOPIC, (SCHEMA.to_owned(), String::new(), Vec::new()));
    let mut writer = Writer { subscriber: &subscriber, tap, templates: BTreeSet::new(), motions: 0, bytes: 0 };
    let mut last_print = Instant::now();
    let mut was_up = false;
    while !is_over() {
        was_up |= subscriber.publishers() > 0;
        if args.until_end && was_up && subscriber.publishers() == 0 {
            break;
        }
        match subscriber.next_person(Duration::from_millis(100)) {
            Ok(Some(received)) => {
                if let Err(error) = writer.write(&received.body) {
                    tracing::warn!("a message was not recorded: {error:#}");
                }
            }
            Ok(None) => {}
            Err(error) => tracing::warn!(%error, "a message was not recorded"),
        }
        if last_print.elapsed() >= PRINT_EVERY {
            last_print = Instant::now();
            eprintln!("watch: {} frames, {:.1} MB", writer.motions, writer.bytes as f64 / 1e6);
        }
    }
    let (motions, bytes) = (writer.motions, writer.bytes);
    drop(writer);
    let recorded = recorder.finish();
    subscriber.close()?;
    if let Some(problem) = recorded.problem {
        anyhow::bail!("the recording broke off after {motions} frames: {problem}");
    }
    ensure!(
        motions > 0,
        "nobody was received in {:.0} s, so {} holds no frame of people: wait until the rig has tracked a person",
        started.elapsed().as_secs_f64(),
        path.display()
    );
    eprintln!("watch: recorded {motions} frames of people, {:.1} MB in {}", bytes as f64 / 1e6, path.display());
    Ok(())
}

/// Runs `flyrig play`.
pub fn play(args: &PlayArgs) -> Result<()> {
    let stop = stop::flag();
    require_recording(
        &args.recording,
        "flyrig play reads a recording of `flyrig watch --record`",
        "Run the rig on a folder: source.kind = \"folder\" and `flyrig run`",
    )?;
    let rig = recorded_cameras(&args.recording)?.rig.with_context(|| {
        format!("{} has no calibration; record it with flyrig watch --record", args.recording.display())
    })?;
    let first = recorded_messages(&args.recording, TOPIC)?.next();
    ensure!(
        first.is_some(),
        "{} has no person stream; record one with flyrig watch --record",
        args.recording.display()
    );
    check_endpoint("--listen", &args.listen)?;
    let config = TransportConfig {
        listen: vec![args.listen.clone()],
        keys: args.keys.clone().unwrap_or_default(),
        insecure: args.insecure,
        ..TransportConfig::publisher(&args.rig)
    };
    let publisher = Publisher::open(&config)?;
    publisher.set_calibration(&rig)?;
    let endpoint = publisher.endpoints().join(", ");
    eprintln!("play: rig '{}' on {endpoint}; flyrig view --rig {0} --connect {endpoint} shows it", args.rig);
    if let Some(address) = publisher.gate() {
        eprintln!("play: holders of keys connect at {address}");
    }
    let stopped = || stop.load(std::sync::atomic::Ordering::Relaxed);
    if args.wait {
        eprintln!("play: waiting for a viewer");
        while !stopped() && !publisher.has_person_subscribers() {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    let mut player = Player { publisher: &publisher, clock: None, speed: args.speed, round: 0, motions: 0, damaged: 0 };
    while !stopped() {
        for (_, message) in recorded_messages(&args.recording, TOPIC)? {
            if stopped() {
                break;
            }
            player.play(&message);
        }
        player.round = player.round.wrapping_add(1);
        if !args.repeat {
            break;
        }
        // The next round goes on a frame later.
        player.clock = None;
    }
    eprintln!("play: {} frames played, {} messages damaged", player.motions, player.damaged);
    // The last messages still have to leave.
    std::thread::sleep(Duration::from_millis(200));
    Ok(publisher.close()?)
}

struct Player<'a> {
    publisher: &'a Publisher,
    /// Reference of the pace: instant, own clock and recorded capture time of a message, nanoseconds.
    clock: Option<(Instant, i64, i64)>,
    speed: f64,
    round: u32,
    motions: u64,
    damaged: u64,
}

impl Player<'_> {
    /// Publishes a message at its capture time.
    fn play(&mut self, message: &[u8]) {
        let Some((head, bytes)) = message.split_first_chunk::<5>() else {
            self.damaged += 1;
            return;
        };
        let [kind, person @ ..] = *head;
        let person = u32::from_le_bytes(person);
        if kind == TEMPLATE {
            // A damaged one has another hash, which no motion names.
            self.publisher.offer_template(person, template_hash(bytes), bytes.to_vec().into());
            return;
        }
        let mut bytes = bytes.to_vec();
        let Ok(stamp) = stamp_of(&bytes) else {
            self.damaged += 1;
            return;
        };
        let nanos = self.wait_for(stamp.capture_nanos);
        if restamp(&mut bytes, nanos, self.round).is_err() {
            self.damaged += 1;
            return;
        }
        let stamp = Stamp { capture_nanos: nanos, ..stamp };
        let layer = (kind != MOTION).then_some(usize::from(kind));
        self.motions += u64::from(layer.is_none());
        self.publisher.publish_person(&stamp, layer, bytes.into());
    }

    /// Waits until a recorded capture time, and returns it on this host's clock.
    fn wait_for(&mut self, capture_nanos: i64) -> i64 {
        let restart = |recorded: i64| (Instant::now(), monotonic_nanos(), recorded);
        let (began, own, recorded) = *self.clock.get_or_insert_with(|| restart(capture_nanos));
        let ahead = capture_nanos.saturating_sub(recorded) as f64 / self.speed;
        let wait = ahead / 1e9 - began.elapsed().as_secs_f64();
        if wait > MOST_PAUSE_SECS || ahead < 0.0 {
            // A rig that was away, or began anew.
            self.clock = Some(restart(capture_nanos));
            return monotonic_nanos();
        }
        if wait > 0.0 {
            std::thread::sleep(flyrig_types::saturating_secs(wait));
        }
        own.saturating_add(ahead as i64)
    }
}
