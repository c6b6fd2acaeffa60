//! Training samples of simulated people.

use std::sync::Arc;

use anyhow::{Context, Result};
use flyrig_fusion::{AppearanceMode, BodySettings, GivenPerception, Session, SessionBuilder, SessionSettings};
use flyrig_gpu::GpuContext;
use flyrig_renderer::AppearanceSettings;
use flyrig_sim::{OpticsConfig, SceneKind, SimConfig, Simulator, TrainingConfig, random_config};
use flyrig_stfa::TrainingSample;
use flyrig_types::{Camera, Frame, FrameSet, Image, Mask, Rig};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng, seq::SliceRandom as _};
use serde::{Deserialize, Serialize};

use super::gather::{HeldOut, gather};
/// Cameras around each person.
const CAMERAS: usize = 7;
/// Number of held-out images per instant.
const TARGETS: usize = 3;
/// Number of instants before the first sample, in which the deformation converges to the clothes.
const WARM_UP: u64 = 3;
/// Number of instants before each further sample.
const RUN_IN: u64 = 1;
/// Number of further updates at a sample's instant, in which the sharpening of the colours converges.
const LOOKS: usize = 6;
/// Fraction of the people in a furnished room.
const FURNISHED: f64 = 0.15;
/// Number of frames that instants are drawn from, a minute.
const SPAN_FRAMES: u64 = 1800;

/// Simulated people to train on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingPeople {
    /// Seed of all people.
    pub seed: u64,
    /// Number of instants of each person, each with its own cameras, lens and pose.
    pub instants: u64,
    /// Side of an image, pixels; scaled by 0.85 to 1.3 for each person.
    pub side: u32,
    /// Number of Gaussians on the person's surface.
    pub gaussians: usize,
}

impl TrainingPeople {
    /// Returns the capture of one person, with random body, motion, room, lights, lenses and calibration errors.
    ///
    /// Effects that mainly cost time are left out: apertures and rolling shutters (which render the room several times), and most
    /// furnished rooms. Sensors differ only slightly, since a rig's colours are matched, and colour casts of held-out images would be learned.
    pub fn capture(&self, person: u64) -> SimConfig {
        let training =
            TrainingConfig { seed: self.seed, cameras: CAMERAS, size: [self.side; 2], ..TrainingConfig::default() };
        let mut config = random_config(&training, person);
        let mut rng = SmallRng::seed_from_u64(config.seed ^ 0x636f_6c6f_7572);
        let exposure = rng.random_range(0.8..1.25);
        for sensor in &mut config.sensors {
            sensor.exposure = exposure * rng.random_range(0.96..1.04);
            sensor.gain = 1.0;
            sensor.gamma = rng.random_range(0.98..1.02);
            sensor.white_balance = [0.0; 3].map(|_: f64| rng.random_range(0.98..1.02));
            sensor.vignetting = rng.random_range(0.0..0.1);
        }
        config.faults = Default::default();
        config.scene.occluders = 0;
        config.scene.passer_by = false;
        if !rng.random_bool(FURNISHED) {
            config.scene.kind = SceneKind::Studio;
        }
        let exposure_ms = if rng.random_bool(0.2) { rng.random_range(2.0..10.0) } else { 0.0 };
        config.optics = vec![OpticsConfig { exposure_ms, samples: 3, ..OpticsConfig::default() }];
        // Pixels may be finer or coarser than usual for the Gaussians.
        let scale = rng.random_range(0.85..1.3);
        let side = ((f64::from(self.side) * scale / 16.0).round() as u32).max(4) * 16;
        (config.width, config.height) = (side, side);
        config
    }

    /// Simulates the samples of one person; equal configurations give equal samples on the same adapter.
    pub fn samples(&self, gpu: &GpuContext, person: u64) -> Result<Vec<TrainingSample>> {
        let mut simulator = Simulator::new(gpu, &self.capture(person))?;
        let seed = simulator.config().seed;
        let mut rng = SmallRng::seed_from_u64(seed ^ 0x7069_636b);
        let (rig, reported) = (simulator.rig().clone(), simulator.reported_rig());
        let template = simulator.template().clone();
        // With time: sharpening continues from the last colours. The networks' inputs are of this instant alone.
        let settings = AppearanceMode::Direct.settings();
        let body = BodySettings::with_gaussians(self.gaussians);
        let perception = GivenPerception::repeating(&reported, template, simulator.track().clone());
        let mut session = SessionBuilder::new(gpu.clone(), reported)
            .settings(SessionSettings { body, ..SessionSettings::default() })
            .perception(perception)
            .build()?;
        session.keep_observations()?;
        let mut samples = Vec::new();
        let mut index = 0;
        for instant in 0..self.instants {
            let first: u64 = rng.random_range(0..SPAN_FRAMES);
            let (inputs, targets) = choose(&mut rng);
            let warm_up = if instant == 0 { WARM_UP } else { RUN_IN };
            for step in 0..=warm_up {
                let set = frame_set(&mut simulator, &rig, first + step, index, &inputs)?;
                index += 1;
                session.process(&set)?;
                if step == warm_up {
                    session.hold_shape(true);
                    for _ in 0..LOOKS {
                        session.process(&set)?;
                    }
                    session.hold_shape(false);
                }
            }
            let nanos = simulator.frame_nanos(first + warm_up);
            let pictures = simulator.capture_all(nanos, &targets)?;
            let held_out: Vec<HeldOut<'_>> = targets
                .iter()
                .zip(&pictures)
                .map(|(&slot, (image, mask))| HeldOut { camera: &rig.cameras[slot], image, mask })
                .collect();
            samples.push(sample_of(&session, &held_out, &settings, seed ^ instant)?);
        }
        Ok(samples)
    }
}

fn sample_of(
    session: &Session,
    held_out: &[HeldOut<'_>],
    settings: &AppearanceSettings,
    seed: u64,
) -> Result<TrainingSample> {
    gather(session, held_out, settings, seed).context("gathering a training sample")
}

/// Draws the slots of input and held-out cameras: mostly three distant inputs, sometimes two or one.
fn choose(rng: &mut SmallRng) -> (Vec<usize>, Vec<usize>) {
    let start = rng.random_range(0..CAMERAS);
    let places = [0, if rng.random_bool(0.5) { 2 } else { 3 }, 5];
    let count = [1, 1, 2, 2, 3, 3, 3, 3, 3, 3][rng.random_range(0..10)];
    let inputs: Vec<usize> = places.iter().take(count).map(|place| (start + place) % CAMERAS).collect();
    let mut others: Vec<usize> = (0..CAMERAS).filter(|slot| !inputs.contains(slot)).collect();
    others.shuffle(rng);
    others.truncate(TARGETS);
    (inputs, others)
}

/// Simulates the input cameras at an instant; the other slots are empty.
fn frame_set(simulator: &mut Simulator, rig: &Rig, instant: u64, index: u64, inputs: &[usize]) -> Result<FrameSet> {
    let nanos = simulator.frame_nanos(instant);
    let mut frames: Vec<Option<Arc<Frame>>> = vec![None; rig.cameras.len()];
    for (&slot, (image, mask)) in inputs.iter().zip(simulator.capture_all(nanos, inputs)?) {
        frames[slot] = Some(Arc::new(frame(&rig.cameras[slot], nanos, image, mask)));
    }
    Ok(FrameSet { index, master_nanos: nanos, frames })
}

fn frame(camera: &Camera, nanos: i64, image: Image, mask: Mask) -> Frame {
    Frame {
        camera: camera.id.clone(),
        sequence: 0,
        capture_nanos: nanos,
        exposure_nanos: None,
        image,
        mask: Some(mask),
    }
}
