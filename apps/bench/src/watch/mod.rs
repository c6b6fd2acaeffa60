//! `flyrig-bench watch`: detection of bumped cameras among switched lights, passers-by and exposure jumps: delay, error of the measured
//! bump, false alarms and run time.

use std::time::Instant;

use anyhow::{Context as _, Result};
use clap::Args;
use flyrig_calib::{CameraWatch, WatchState, WatchedImage};
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::parse_minutes, progress_bar};
use flyrig_sim::{LightConfig, LightSwitch, MotionConfig, MotionKind, RingConfig, Shot, SimConfig, Simulator};
use flyrig_types::{Camera, Image, Isometry};
use glam::{DQuat, DVec3};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

/// Arguments of the command.
#[derive(Debug, Args)]
pub struct BenchWatchArgs {
    /// Number of bumps.
    #[arg(long, default_value_t = 12)]
    pub bumps: u32,
    /// Rotation of a bump, degrees.
    #[arg(long, default_value_t = 0.3)]
    pub deg: f64,
    /// Translation of a bump, millimetres.
    #[arg(long, default_value_t = 5.0)]
    pub mm: f64,
    /// Simulated minutes without a bump.
    #[arg(long, default_value_t = 30.0, value_parser = parse_minutes)]
    pub minutes: f64,
    /// Number of cameras.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub cameras: u32,
    /// Width of an image, pixels.
    #[arg(long, default_value_t = 1280)]
    pub width: u32,
    /// Height of an image, pixels.
    #[arg(long, default_value_t = 720)]
    pub height: u32,
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// Time between checks, seconds.
const EVERY_SECS: f64 = 1.0;
/// Checks before a bump, and largest number after it.
const BEFORE: u64 = 6;
const AFTER: u64 = 20;
/// Mean times between switches of a lamp and between exposure jumps, seconds.
const SWITCH_SECS: f64 = 20.0;
const JUMP_SECS: f64 = 15.0;

/// Runs the command.
///
/// # Errors
/// Those of the simulator and of cameras that show too few corners.
pub fn watch(args: &BenchWatchArgs, gpu: &GpuContext) -> Result<()> {
    let mut look_ms = Vec::new();
    let mut found = Found::default();
    let bar = progress_bar(u64::from(args.bumps), "bumps");
    for bump in 0..args.bumps {
        found.bump(args, gpu, bump, &mut look_ms)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    found.print(args);
    quiet(args, gpu, &mut look_ms)?;
    let (ms, worst_ms) = median_and_worst(&mut look_ms);
    println!(
        "a check takes {ms:.1} ms (at worst {worst_ms:.1}): {:.2} % of a core for each camera",
        0.1 * ms / EVERY_SECS
    );
    Ok(())
}

/// Reports about bumped cameras.
#[derive(Default)]
struct Found {
    count: u32,
    /// Checks that reported a camera that was not bumped.
    other: u32,
    late_secs: Vec<f64>,
    /// Error of the rotation as a share of the bump.
    shares: Vec<f64>,
    /// Reprojection error after the correction as a share of that before, and in pixels.
    left_shares: Vec<f64>,
    left_px: Vec<f64>,
}

impl Found {
    /// Simulates a bump until it is reported, or for [`AFTER`] checks.
    fn bump(&mut self, args: &BenchWatchArgs, gpu: &GpuContext, bump: u32, look_ms: &mut Vec<f64>) -> Result<()> {
        let mut room = Room::new(args, gpu, u64::from(bump), (BEFORE + AFTER) as f64 * EVERY_SECS)?;
        let slot = bump as usize % args.cameras as usize;
        let turn = room.direction() * args.deg.to_radians();
        let shift = Isometry::new(DQuat::from_scaled_axis(turn), room.direction() * (1e-3 * args.mm));
        let mut watches = room.watches()?;
        let mut reported = None;
        for look in 1..BEFORE + AFTER {
            for (of, watch) in watches.iter_mut().enumerate() {
                let bumped = (of == slot && look >= BEFORE).then_some(shift);
                let (state, ms) = look_at(watch, &room.capture(look, of, bumped)?);
                look_ms.push(ms);
                match state {
                    WatchState::Moved(motion) if of == slot && look >= BEFORE => {
                        reported.get_or_insert((look - BEFORE, motion));
                    }
                    WatchState::Moved(_) => self.other += 1,
                    _ => {}
                }
            }
            if reported.is_some() {
                break;
            }
        }
        let Some((looks, motion)) = reported else {
            let axis = turn / turn.length();
            println!("bump {bump}, about {axis:.2}, was not found; last motion: {:.2?}", watches[slot].last_motion());
            return Ok(());
        };
        self.count += 1;
        self.late_secs.push((looks + 1) as f64 * EVERY_SECS);
        // `turn` moves points into the axes of the moved camera: the opposite of its own rotation.
        self.shares.push((motion.rotation + turn).length() / turn.length());
        let calibrated = &room.simulator.rig().cameras[slot];
        let bumped = Camera { camera_from_world: shift * calibrated.camera_from_world, ..calibrated.clone() };
        let [as_it_was, corrected] =
            [calibrated, &motion.applied_to(calibrated)].map(|camera| apart_px(camera, &bumped));
        self.left_shares.push(corrected / as_it_was);
        self.left_px.push(corrected);
        Ok(())
    }

    fn print(&mut self, args: &BenchWatchArgs) {
        let ((late, latest), (share, worst)) =
            (median_and_worst(&mut self.late_secs), median_and_worst(&mut self.shares));
        println!(
            "bumps of {} degrees and {} mm, {} cameras of {}x{}: {} of {} found, after {late:.0} s (at worst {latest:.0} s); error of the \
             rotation {:.0} % of the bump (at worst {:.0} %), its translation included; {} checks of other cameras reported a bump",
            args.deg,
            args.mm,
            args.cameras,
            args.width,
            args.height,
            self.count,
            args.bumps,
            100.0 * share,
            100.0 * worst,
            self.other
        );
        let ((share, worst), (px, worst_px)) =
            (median_and_worst(&mut self.left_shares), median_and_worst(&mut self.left_px));
        println!(
            "reprojection error of the corrected cameras in the volume of people: {px:.1} px (at worst {worst_px:.1}), {:.0} % of that \
             without correction (at worst {:.0} %)",
            100.0 * share,
            100.0 * worst
        );
    }
}

/// Watches cameras that are not bumped, and prints the false alarms.
fn quiet(args: &BenchWatchArgs, gpu: &GpuContext, look_ms: &mut Vec<f64>) -> Result<()> {
    let looks = (args.minutes * 60.0 / EVERY_SECS) as u64;
    let mut room = Room::new(args, gpu, 1000, args.minutes * 60.0)?;
    let mut watches = room.watches()?;
    let bar = progress_bar(looks, "checks without a bump");
    let (mut alarms, mut steady) = (0u64, 0u64);
    for look in 1..=looks {
        for (slot, watch) in watches.iter_mut().enumerate() {
            let before = watch.state();
            let (state, ms) = look_at(watch, &room.capture(look, slot, None)?);
            look_ms.push(ms);
            let is_moved = |state: WatchState| matches!(state, WatchState::Moved(_));
            alarms += u64::from(is_moved(state) && !is_moved(before));
            steady += u64::from(state == WatchState::Steady);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    println!(
        "{:.0} minutes of switched lights, a walking person, and exposure jumps: {alarms} false alarms; {steady} of {} checks steady",
        args.minutes,
        looks * u64::from(args.cameras)
    );
    Ok(())
}

/// Returns the median and the largest of the values, which are reordered; NaN without values.
fn median_and_worst(values: &mut [f64]) -> (f64, f64) {
    let [median, worst] = [flyrig_solve::median(values), flyrig_solve::percentile(values, 1.0)];
    (median.unwrap_or(f64::NAN), worst.unwrap_or(f64::NAN))
}

/// Returns the mean distance between the projections of points in the volume that people fill, pixels.
fn apart_px(camera: &Camera, other: &Camera) -> f64 {
    let heights = [0.1, 0.6, 1.1, 1.6];
    let places = [-0.4, 0.0, 0.4];
    let points = heights.iter().flat_map(|z| places.iter().flat_map(move |y| places.map(|x| DVec3::new(x, *y, *z))));
    let apart: Vec<f64> = points.filter_map(|at| Some(camera.project(at)?.distance(other.project(at)?))).collect();
    apart.iter().sum::<f64>() / apart.len() as f64
}

fn look_at(watch: &mut CameraWatch, image: &Image) -> (WatchState, f64) {
    let started = Instant::now();
    let state = watch.compare(&watched(image));
    (state, 1e3 * started.elapsed().as_secs_f64())
}

fn watched(image: &Image) -> WatchedImage<'_> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    WatchedImage { width, height, channels: 3, bytes: image.bytes() }
}

/// A simulated room whose lights are switched.
struct Room {
    simulator: Simulator,
    random: SmallRng,
    exposures: Vec<f64>,
}

impl Room {
    fn new(args: &BenchWatchArgs, gpu: &GpuContext, seed: u64, secs: f64) -> Result<Self> {
        let mut random = SmallRng::seed_from_u64(args.seed + seed);
        let lamp = |azimuth_deg: f64, random: &mut SmallRng| {
            let mut switch = Vec::new();
            let mut at = 0.0;
            while at < secs {
                at += random.random_range(0.5..1.5) * SWITCH_SECS;
                switch.push(LightSwitch { secs: at, level: random.random_range(0.2..1.5) });
            }
            LightConfig { azimuth_deg, elevation_deg: 50.0, intensity: 0.6, switch, ..LightConfig::default() }
        };
        let lights = [20.0, 140.0, 260.0].map(|azimuth| lamp(azimuth, &mut random)).to_vec();
        let config = SimConfig {
            seed: args.seed + seed,
            width: args.width,
            height: args.height,
            motion: MotionConfig { kind: MotionKind::Walk, ..MotionConfig::default() },
            cameras: RingConfig { count: args.cameras as usize, ..RingConfig::default() },
            lights,
            ..SimConfig::default()
        };
        Ok(Self { simulator: Simulator::new(gpu, &config)?, random, exposures: vec![1.0; args.cameras as usize] })
    }

    fn direction(&mut self) -> DVec3 {
        loop {
            let v = DVec3::from([0; 3].map(|_| self.random.random_range(-1.0..1.0)));
            if (0.1..1.0).contains(&v.length()) {
                return v.normalize();
            }
        }
    }

    fn capture(&mut self, look: u64, slot: usize, camera_shift: Option<Isometry>) -> Result<Image> {
        if self.random.random_bool(EVERY_SECS / JUMP_SECS) {
            self.exposures[slot] = self.random.random_range(0.4..1.8);
        }
        let nanos = (look as f64 * EVERY_SECS * 1e9) as i64;
        let exposure = self.exposures[slot];
        Ok(self.simulator.capture_with(&Shot { exposure, camera_shift, ..Shot::new(nanos, slot) })?.0)
    }

    /// Creates a watch for every camera, with its first image as the reference.
    fn watches(&mut self) -> Result<Vec<CameraWatch>> {
        (0..self.exposures.len())
            .map(|slot| {
                let image = self.capture(0, slot, None)?;
                let camera = &self.simulator.rig().cameras[slot];
                CameraWatch::new(&camera.intrinsics, &watched(&image))
                    .with_context(|| format!("camera {} shows too few corners", camera.id))
            })
            .collect()
    }
}
