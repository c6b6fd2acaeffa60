//! Throughput and latency of the transport on loopback between two processes:
//! `cargo bench -p flyrig-transport --bench throughput [-- SECONDS]`.
//!
//! Prints the duration of the publish calls, the latency from the call to the receipt in the other process, rates and losses: 60 kB
//! images of four views and splat states of 115k Gaussians, at 30 per second and at full speed, with and without shared memory.

use std::{
    io::Read,
    process::{Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use flyrig_transport::{
    ImageFormat, Interests, Publisher, SplatError, SplatState, Subscriber, TransportConfig, ViewFrame, Views,
};

const GAUSSIANS: usize = 115_000;
const PICTURE_BYTES: usize = 60_000;
const VIEWS: [&str; 4] = ["front", "left", "back", "right"];

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    if let [word, endpoint, seconds] = arguments.as_slice()
        && word == "watch"
    {
        let seconds = flyrig_types::saturating_secs(seconds.parse()?);
        return watch(endpoint, seconds);
    }
    let seconds: f64 = arguments.first().map_or(Ok(3.0), |seconds| seconds.parse())?;
    codec()?;
    println!("\nload            publish us p50/p99  latency ms p50/p99/max  MiB/s  per sec.  missed");
    for load in [Load::Views, Load::Splats, Load::FastViews, Load::FastSplats] {
        measure(load, seconds)?;
    }
    Ok(())
}

#[derive(Debug, Clone, Copy)]
enum Load {
    Views,
    Splats,
    FastViews,
    FastSplats,
}

/// Returns a person-sized cloud with smooth colours.
fn state(frame: u64) -> SplatState {
    let mut numbers = (0u32..).map(|i| f32::from((i.wrapping_mul(2_654_435_761) >> 16) as u16) / 65_535.0);
    let mut next = || numbers.next().unwrap_or_default();
    let center_scale = (0..GAUSSIANS)
        .map(|i| {
            let (angle, height) = (next() * std::f32::consts::TAU, i as f32 / GAUSSIANS as f32 * 1.8);
            [0.25 * angle.cos(), 0.15 * angle.sin(), height, 0.003 + 0.002 * next()]
        })
        .collect::<Vec<_>>();
    let color = center_scale.iter().map(|c| [0.5 + c[0], 0.4 + c[1], 0.2 + 0.3 * c[2], 1.0]).collect();
    SplatState { person: 0, frame, capture_nanos: 0, center_scale, color, invalid: 0 }
}

fn codec() -> Result<(), SplatError> {
    let state = state(1);
    let bytes = state.encode()?;
    let time = |work: &dyn Fn() -> Result<(), SplatError>| {
        let mut millis = Vec::new();
        for _ in 0..20 {
            let start = Instant::now();
            work()?;
            millis.push(start.elapsed().as_secs_f64() * 1e3);
        }
        Ok::<f64, SplatError>(percentile(&mut millis, 0.5))
    };
    let encode = time(&|| state.encode().map(drop))?;
    let decode = time(&|| SplatState::decode(&bytes).map(drop))?;
    let error = state.position_error_m().map(|metres| metres * 1e6);
    println!(
        "{GAUSSIANS} Gaussians: {} bytes, encode {encode:.2} ms, decode {decode:.2} ms, position error at most {error:.1?} um",
        bytes.len()
    );
    Ok(())
}

fn measure(load: Load, seconds: f64) -> Result<(), Failure> {
    let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::publisher("bench") };
    let publisher = Publisher::open(&config)?;
    let mut child = Command::new(std::env::current_exe()?)
        .args(["watch", &publisher.endpoints()[0], &seconds.to_string()])
        .stdout(Stdio::piped())
        .spawn()?;
    VIEWS.iter().try_for_each(|view| publisher.add_view(view))?;
    let ready = || publisher.has_splat_subscribers() && VIEWS.iter().all(|view| publisher.has_subscribers(view));
    let start = Instant::now();
    while !ready() && start.elapsed() < Duration::from_secs(20) {
        std::thread::sleep(Duration::from_millis(10));
    }

    // Pseudo-random bytes, as incompressible as a JPEG.
    let picture: Vec<u8> = (0u32..PICTURE_BYTES as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let picture = ViewFrame {
        width: 512,
        height: 512,
        format: ImageFormat::Jpeg,
        bytes: picture.into(),
        frame: 0,
        capture_nanos: 0,
    };
    let splats = Arc::new(state(1));
    let mut micros = Vec::new();
    let start = Instant::now();
    let mut next = start;
    while start.elapsed().as_secs_f64() < seconds {
        match load {
            Load::Views | Load::FastViews => {
                for view in VIEWS {
                    let frame = picture.clone();
                    let call = Instant::now();
                    publisher.publish_view(view, frame)?;
                    micros.push(call.elapsed().as_secs_f64() * 1e6);
                }
            }
            Load::Splats | Load::FastSplats => {
                let state = splats.clone();
                let call = Instant::now();
                publisher.publish_splats(state);
                micros.push(call.elapsed().as_secs_f64() * 1e6);
            }
        }
        next += match load {
            Load::Views | Load::Splats => Duration::from_nanos(33_333_333),
            // Faster than it can go, but not a loop that takes the core from the other process.
            Load::FastViews | Load::FastSplats => Duration::from_micros(500),
        };
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    let mut line = String::new();
    if let Some(mut out) = child.stdout.take() {
        out.read_to_string(&mut line)?;
    }
    child.wait()?;
    let (p50, p99) = (percentile(&mut micros, 0.5), percentile(&mut micros, 0.99));
    println!("{:<14} {p50:>9.1} / {p99:>6.1}   {}", format!("{load:?}"), line.trim());
    publisher.close()?;
    Ok(())
}

/// Receives in the second process for a while and prints the figures of all topics together.
fn watch(endpoint: &str, seconds: Duration) -> Result<(), Failure> {
    let config = TransportConfig { connect: vec![endpoint.to_owned()], ..TransportConfig::subscriber("bench") };
    let subscriber = Subscriber::open(&config, &Interests { views: Views::All, splats: true, ..Interests::default() })?;
    let mut millis = Vec::new();
    let mut first = None;
    let start = Instant::now();
    while first.map_or(start.elapsed() < Duration::from_secs(20), |first: Instant| first.elapsed() < seconds * 9 / 10) {
        let view = subscriber.next_view(Duration::from_millis(5))?.map(|received| received.latency_nanos);
        let splats = subscriber.next_splats(Duration::ZERO)?.map(|received| received.latency_nanos);
        for nanos in [view, splats].into_iter().flatten() {
            first.get_or_insert_with(Instant::now);
            millis.push(nanos as f64 / 1e6);
        }
    }
    let elapsed = first.map_or(1.0, |first| first.elapsed().as_secs_f64());
    let reports = subscriber.reports();
    let sum =
        |of: &dyn Fn(&flyrig_transport::TopicReport) -> u64| reports.iter().map(|(_, report)| of(report)).sum::<u64>();
    let (received, bytes, missed) = (sum(&|r| r.received), sum(&|r| r.bytes), sum(&|r| r.missed));
    let [p50, p99, max] = [0.5, 0.99, 1.0].map(|share| percentile(&mut millis, share));
    println!(
        "{p50:>6.2} / {p99:>6.2} / {max:>6.2}   {:>7.1}  {:>8.1}  {missed:>6}",
        bytes as f64 / elapsed / f64::from(1 << 20),
        received as f64 / elapsed
    );
    subscriber.close()?;
    Ok(())
}

fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let index = (values.len().max(1) - 1) as f64 * share;
    values.get(index.round() as usize).copied().unwrap_or(f64::NAN)
}
