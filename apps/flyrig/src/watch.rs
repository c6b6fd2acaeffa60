//! `flyrig watch`: a viewer without a window, which writes images or a video.

use std::{
    collections::BTreeMap,
    io::Cursor,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use flyrig_report::{arguments::parse_size, png, stop, write_whole};
use flyrig_transport::{
    ImageFormat, Interests, Received, Subscriber, TransportConfig, TransportError, TransportErrorKind, ViewFrame,
    ViewpointStatus, Views, printable,
};
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::arguments::{RigArgs, StopArgs};
use crate::video_file::VideoFile;

/// Arguments of `flyrig watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// Name of a published view; --eye requests a viewpoint instead.
    #[arg(long, default_value = "main")]
    pub view: String,
    /// Request a viewpoint: camera position x,y,z, metres in the world of the rig.
    #[arg(long, value_parser = parse_vec3, allow_hyphen_values = true)]
    pub eye: Option<[f64; 3]>,
    /// Point at which the viewpoint of --eye is aimed.
    #[arg(long, value_parser = parse_vec3, allow_hyphen_values = true, default_value = "0,0,1")]
    pub target: [f64; 3],
    /// Size of the viewpoint of --eye, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "512x512")]
    pub size: [u32; 2],
    /// Vertical field of view of the viewpoint of --eye, degrees.
    #[arg(long, default_value_t = 40.0)]
    pub fov_degrees: f64,
    /// Largest frame rate of the viewpoint of --eye; viewers share the rig's budget of pixels per second.
    #[arg(long, default_value_t = 30.0)]
    pub max_fps: f64,
    /// Write every image as PNG into this folder, or a video if the name ends in .mp4 or .avi; its images have their own times.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Record the person stream into this MCAP file, for `flyrig play`, without receiving images.
    #[arg(long, conflicts_with_all = ["out", "eye", "count", "stats"])]
    pub record: Option<PathBuf>,
    /// Stop after this many images.
    #[arg(long)]
    pub count: Option<usize>,
    /// Stop when the rig ends its session.
    #[arg(long)]
    pub until_end: bool,
    /// Write rates and latency as JSON at the end.
    #[arg(long)]
    pub stats: Option<PathBuf>,
    #[command(flatten)]
    pub stop: StopArgs,
}

fn parse_vec3(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> =
        text.split(',').filter_map(|n| n.trim().parse().ok()).filter(|n: &f64| n.is_finite()).collect();
    numbers.try_into().ok().filter(|_| text.split(',').count() == 3).ok_or_else(|| format!("'{text}' is not x,y,z"))
}

/// Interval between lines with rates.
const PRINT_EVERY: Duration = Duration::from_secs(1);

/// Statistics of `--stats`.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct WatchStats {
    pub received: u64,
    pub missed: u64,
    pub replaced: u64,
    pub unreadable: u64,
    pub publisher_restarts: u64,
    pub seconds: f64,
    pub images_per_second: f64,
    pub latency_p50_ms: Option<f64>,
    pub latency_p99_ms: Option<f64>,
    pub latency_is_exact: Option<bool>,
}

/// Counts of unusable messages by kind, reported the 1st, 2nd, 4th time. Such messages do not end the command.
#[derive(Debug, Default)]
struct Complaints(BTreeMap<&'static str, u64>);

impl Complaints {
    /// Counts a message; returns the line to print if one is due.
    fn count(&mut self, kind: &'static str, text: impl std::fmt::Display) -> Option<String> {
        let count = self.0.entry(kind).or_default();
        *count += 1;
        count.is_power_of_two().then(|| format!("watch: {text} ({kind}, {count} so far)"))
    }

    fn add(&mut self, kind: &'static str, text: impl std::fmt::Display) {
        if let Some(line) = self.count(kind, text) {
            eprintln!("{line}");
        }
    }

    fn add_error(&mut self, error: &TransportError) {
        let kind = match error.kind {
            TransportErrorKind::UnknownVersion => "messages of other versions",
            TransportErrorKind::Malformed => "malformed messages",
            TransportErrorKind::Config | TransportErrorKind::Session | TransportErrorKind::Closed => "errors",
        };
        self.add(kind, error);
    }
}

/// Runs the command.
pub fn watch(args: &WatchArgs) -> Result<()> {
    let mut sink = args.out.as_deref().map(Sink::new).transpose()?;
    let config = args.rig.transport()?;
    let views = if args.eye.is_some() { Views::None } else { Views::Named(vec![args.view.clone()]) };
    let subscriber = Subscriber::open(&config, &Interests { views, ..Interests::default() })?;
    let mut complaints = Complaints::default();
    eprintln!("watch: rig '{}' at {}, waiting for images (Ctrl-C ends)", config.rig, config.connect.join(", "));
    let opened = Instant::now();
    if let Some(eye) = args.eye {
        // The rig says which way is up.
        let rig = loop {
            match subscriber.rig(Duration::from_millis(500)) {
                Ok(Some(rig)) => break rig,
                Ok(None) => {}
                Err(error) => complaints.add_error(&error),
            }
            let over = args.stop.seconds.is_some_and(|limit| opened.elapsed().as_secs_f64() >= limit);
            if stop::requested() || over {
                bail!("no image was received: {}", absence(&subscriber, &config, args, ""));
            }
        };
        subscriber.request_viewpoint(&viewpoint(eye, args, rig.world_up)?, args.max_fps)?;
    }

    let stop = stop::flag();
    let started = Instant::now();
    let (mut first, mut last_print, mut received) = (None, Instant::now(), 0u64);
    let mut refused = String::new();
    while !stop.load(std::sync::atomic::Ordering::Relaxed) {
        if args.until_end && received > 0 && subscriber.publishers() == 0 {
            break;
        }
        let over_time = args.stop.seconds.is_some_and(|limit| started.elapsed().as_secs_f64() >= limit);
        if over_time || args.count.is_some_and(|count| received >= count as u64) {
            break;
        }
        match subscriber.next_view(Duration::from_millis(100)) {
            Ok(Some(picture)) => {
                received += 1;
                first.get_or_insert_with(Instant::now);
                if let Some(sink) = &mut sink {
                    sink.write(&picture, &mut complaints)?;
                }
            }
            Ok(None) => {}
            Err(error) => complaints.add_error(&error),
        }
        if let ViewpointStatus::Refused { reason } = subscriber.viewpoint_status()
            && reason != refused
        {
            eprintln!("watch: the rig refuses the viewpoint: {reason}");
            refused = reason;
        }
        if last_print.elapsed() >= PRINT_EVERY {
            last_print = Instant::now();
            eprintln!("{}", line(&subscriber, &config, &args.view));
        }
    }
    if let Some(sink) = sink {
        sink.finish()?;
    }
    let stats = stats(&subscriber, received, first.map_or(0.0, |first| first.elapsed().as_secs_f64()));
    eprintln!(
        "watch: {received} images, {} missed, {} replaced unseen, {:.1} per second",
        stats.missed, stats.replaced, stats.images_per_second
    );
    if let Some(path) = &args.stats {
        write_whole(path, &serde_json::to_vec_pretty(&stats)?)?;
    }
    let absence = absence(&subscriber, &config, args, &refused);
    subscriber.close()?;
    ensure!(received > 0, "no image was received: {absence}");
    Ok(())
}

/// Explains why no image has come.
fn absence(subscriber: &Subscriber, config: &TransportConfig, args: &WatchArgs, refused: &str) -> String {
    if !refused.is_empty() {
        return format!("the rig refuses the viewpoint: {refused}");
    }
    match (subscriber.publishers(), subscriber.trouble(), args.eye) {
        (0, Some(trouble), _) => trouble,
        (0, None, _) => format!("no rig '{}' at {}; check --rig and --connect", config.rig, config.connect.join(", ")),
        (_, _, Some(_)) => format!("rig '{}' is up, but drew nothing from --eye; has it seen a person?", config.rig),
        (_, _, None) => format!(
            "rig '{}' is up, but published no image of view '{}'; check --view, and whether it has seen a person",
            config.rig, args.view
        ),
    }
}

fn viewpoint(eye: [f64; 3], args: &WatchArgs, world_up: DVec3) -> Result<Camera> {
    let [width, height] = args.size;
    let (eye, target) = (DVec3::from(eye), DVec3::from(args.target));
    ensure!(eye.distance(target) > 1e-3, "--eye and --target are the same point");
    ensure!(args.fov_degrees > 1.0 && args.fov_degrees < 170.0, "--fov-degrees must lie between 1 and 170");
    let focal = f64::from(height) / 2.0 / (args.fov_degrees.to_radians() / 2.0).tan();
    Ok(Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "watch".into(),
        intrinsics: Intrinsics::pinhole(width, height, focal),
        camera_from_world: Isometry::look_at(eye, target, world_up),
    })
}

fn line(subscriber: &Subscriber, config: &TransportConfig, view: &str) -> String {
    let reports: Vec<String> = subscriber
        .reports()
        .into_iter()
        .filter(|(topic, _)| topic.starts_with("view"))
        .map(|(topic, report)| {
            let latency = report.latency.as_ref().map_or_else(String::new, |l| {
                format!(
                    ", latency {:.1} ms (99 %: {:.1}{})",
                    l.p50_millis,
                    l.p99_millis,
                    if l.is_exact { "" } else { ", clocks differ" }
                )
            });
            format!("{topic}: {:.1}/s, {} missed{latency}", report.per_second, report.missed)
        })
        .collect();
    match (reports.is_empty(), subscriber.publishers()) {
        (true, 0) => match subscriber.trouble() {
            Some(trouble) => format!("watch: {trouble}"),
            None => format!(
                "watch: no rig '{}' at {} yet; check --rig and --connect",
                config.rig,
                config.connect.join(", ")
            ),
        },
        (true, _) => format!("watch: rig '{}' is up, no image of view '{view}' yet", config.rig),
        (false, _) => format!("watch: {}", reports.join("; ")),
    }
}

fn stats(subscriber: &Subscriber, received: u64, seconds: f64) -> WatchStats {
    let mut stats = WatchStats { received, seconds, unreadable: subscriber.unreadable(), ..WatchStats::default() };
    if seconds > 0.0 {
        stats.images_per_second = received as f64 / seconds;
    }
    for (_, report) in subscriber.reports().into_iter().filter(|(topic, _)| topic.starts_with("view")) {
        stats.missed += report.missed;
        stats.replaced += report.replaced;
        stats.publisher_restarts += report.restarts;
        if let Some(latency) = report.latency {
            stats.latency_p50_ms = Some(latency.p50_millis);
            stats.latency_p99_ms = Some(latency.p99_millis);
            stats.latency_is_exact = Some(latency.is_exact);
        }
    }
    stats
}

/// Destination of the images.
enum Sink {
    Folder(PathBuf),
    Video { path: PathBuf, writer: Option<VideoFile> },
}

impl Sink {
    fn new(path: &Path) -> Result<Self> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if matches!(extension.as_deref(), Some("mp4" | "avi")) {
            return Ok(Self::Video { path: path.to_owned(), writer: None });
        }
        std::fs::create_dir_all(path).with_context(|| format!("cannot create {}", path.display()))?;
        Ok(Self::Folder(path.to_owned()))
    }

    /// Writes an image and skips an unusable one. Errors are those of the disk and of the encoder.
    fn write(&mut self, picture: &Received<ViewFrame>, complaints: &mut Complaints) -> Result<()> {
        let body = &picture.body;
        let rgb = match decode(body) {
            Ok(rgb) => rgb,
            Err(error) => {
                let text = format!("image of frame {} cannot be decoded ({error}); skipped", body.frame);
                complaints.add("damaged images", printable(&text));
                return Ok(());
            }
        };
        let (width, height) = rgb.dimensions();
        match self {
            Self::Folder(folder) => {
                let path = folder.join(format!("{:06}.png", body.frame));
                write_whole(&path, &png::encode_rgb(&rgb, width, height)?)
            }
            Self::Video { path, writer } => {
                let writer = match writer {
                    Some(writer) => writer,
                    None => writer.insert(VideoFile::create(path, (width, height))?),
                };
                let (w, h) = writer.size();
                if (w, h) != (width, height) {
                    let text = format!("an image of {width}x{height} is left out of {}, of {w}x{h}", path.display());
                    complaints.add("images of another size", text);
                    return Ok(());
                }
                let failed = || format!("writing a video frame to {}", path.display());
                writer.write(&rgb, picture.header.publisher, body.capture_nanos).with_context(failed)
            }
        }
    }

    fn finish(self) -> Result<()> {
        if let Self::Video { path, writer: Some(writer) } = self {
            writer.finish().with_context(|| format!("closing {}", path.display()))?;
        }
        Ok(())
    }
}

/// Decodes an image of the size that its message states, with memory limited to that size.
fn decode(frame: &ViewFrame) -> Result<image::RgbImage> {
    let format = match frame.format {
        ImageFormat::Jpeg => image::ImageFormat::Jpeg,
        ImageFormat::Png => image::ImageFormat::Png,
    };
    let mut reader = image::ImageReader::with_format(Cursor::new(&frame.bytes), format);
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(frame.width), Some(frame.height));
    reader.limits(limits);
    let rgb = reader.decode()?.into_rgb8();
    let (found, stated) = (rgb.dimensions(), (frame.width, frame.height));
    ensure!(found == stated, "it is {}x{}, not {}x{}", found.0, found.1, stated.0, stated.1);
    Ok(rgb)
}

#[cfg(test)]
mod tests {
    use flyrig_transport::Header;

    #[test]
    fn odd_positions_are_refused() {
        assert_eq!(parse_vec3("1,-2.5,3"), Ok([1.0, -2.5, 3.0]));
        for bad in ["", "1,2", "1,2,3,4", "a,b,c", "1,2,nan", "1,,3"] {
            assert!(parse_vec3(bad).is_err(), "{bad}");
        }
    }

    use super::*;

    fn picture(bytes: Vec<u8>, width: u32, height: u32) -> Received<ViewFrame> {
        let header = Header {
            kind: flyrig_transport::MessageKind::View,
            sequence: 0,
            frame: 7,
            capture_nanos: 0,
            publish_unix_nanos: 0,
            publish_nanos: 0,
            host: 0,
            publisher: 0,
            width,
            height,
        };
        let format = ImageFormat::Png;
        let body = ViewFrame { width, height, format, bytes: bytes.into(), frame: 7, capture_nanos: 0 };
        Received { topic: "main".into(), header, latency_nanos: 0, latency_is_exact: false, body }
    }

    fn png(width: u32, height: u32) -> Vec<u8> {
        png::encode_rgb(&vec![90; (width * height * 3) as usize], width, height).unwrap()
    }

    #[test]
    fn no_image_ends_a_recording() {
        let folder = tempfile::tempdir().unwrap();
        let mut complaints = Complaints::default();
        for name in ["images", "video.avi"] {
            let mut sink = Sink::new(&folder.path().join(name)).unwrap();
            let mut write = |bytes: Vec<u8>, width, height| {
                sink.write(&picture(bytes, width, height), &mut complaints).unwrap();
            };
            write(png(64, 48), 64, 48);
            for _ in 0..5 {
                write(b"noise".to_vec(), 64, 48);
                // Larger than stated, and smaller.
                write(png(64, 48), 32, 48);
                write(png(64, 48), 128, 96);
                write(png(32, 48), 32, 48);
            }
            write(png(64, 48), 64, 48);
            sink.finish().unwrap();
        }
        assert!(folder.path().join("images/000007.png").exists());
        assert_eq!(complaints.0["damaged images"], 30);
        assert_eq!(complaints.0["images of another size"], 5);
    }

    #[test]
    fn complaints_are_reported_the_1st_2nd_and_4th_time() {
        let mut complaints = Complaints::default();
        let lines: Vec<String> = (0..100).filter_map(|_| complaints.count("malformed messages", "x: y")).collect();
        assert_eq!(lines.len(), 7);
        assert_eq!(lines[6], "watch: x: y (malformed messages, 64 so far)");
    }
}
