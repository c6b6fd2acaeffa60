//! Endless random captures for training, without files.

use flyrig_body::Template;
use flyrig_gpu::GpuContext;
use flyrig_types::Rig;
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

use crate::camera::calibration_error::CalibrationError;
use crate::camera::faults::{Delivery, Fault, FaultKind, FaultScript};
use crate::camera::frame::SimFrame;
use crate::camera::name::camera_name;
use crate::camera::optics::OpticsConfig;
use crate::camera::sensor::SensorConfig;
use crate::camera::sensor::hash;
use crate::camera::source::shot;
use crate::config::{MotionConfig, MotionKind, RingConfig, SimConfig};
use crate::error::SimError;
use crate::error::check;
use crate::room::scene_config::{SceneConfig, SceneKind};
use crate::simulator::Simulator;

/// Configuration of [`TrainingSamples`].
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingConfig {
    /// Seed of everything.
    pub seed: u64,
    /// Number of cameras per rig, 1 to 128.
    pub cameras: usize,
    /// Size of the images, pixels.
    pub size: [u32; 2],
    /// Side of each texture, pixels.
    pub texture_px: u32,
    /// Consecutive instants per sample, 1 to 1000.
    pub instants: usize,
    /// Samples per person and rig (creating these costs about as much as a dozen images), at least 1.
    pub samples_a_person: usize,
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self { seed: 1, cameras: 4, size: [512, 512], texture_px: 512, instants: 1, samples_a_person: 8 }
    }
}

/// A few consecutive instants of a person, seen by all cameras of a rig.
#[derive(Debug)]
pub struct SimSample {
    /// Configuration that reproduces the sample.
    pub config: SimConfig,
    /// Cameras as their calibration reports them: input of a method.
    pub reported_rig: Rig,
    /// True cameras: reference of a method.
    pub rig: Rig,
    /// Body without clothes.
    pub template: Template,
    /// Index of the first instant; instant `i` is due at [`Simulator::frame_nanos`]`(first + i)`.
    pub first: u64,
    /// Per instant one frame per camera in rig order. Cameras may lag behind the instant; each frame knows its time.
    pub instants: Vec<Vec<SimFrame>>,
}

/// Endless iterator of samples: random people in random clothes with random motion, cameras and rooms. A configuration
/// gives the same samples in every run on the same adapter.
#[derive(Debug)]
pub struct TrainingSamples {
    gpu: GpuContext,
    config: TrainingConfig,
    /// Number of samples returned so far.
    given: u64,
    simulator: Option<Simulator>,
}

impl TrainingSamples {
    /// # Errors
    /// [`SimError::Config`] names the setting and its range.
    pub fn new(gpu: &GpuContext, config: TrainingConfig) -> Result<Self, SimError> {
        check("training.instants", config.instants as f64, 1.0, 1000.0, "1 to 1000 instants")?;
        check("training.samples_a_person", config.samples_a_person as f64, 1.0, 1e9, "at least 1 sample")?;
        random_config(&config, 0).validate()?;
        Ok(Self { gpu: gpu.clone(), config, given: 0, simulator: None })
    }

    fn sample(&mut self) -> Result<SimSample, SimError> {
        let a_person = self.config.samples_a_person as u64;
        let (person, place) = (self.given / a_person, self.given % a_person);
        let mut simulator = match self.simulator.take() {
            Some(simulator) if place > 0 => simulator,
            _ => Simulator::new(&self.gpu, &random_config(&self.config, person))?,
        };
        // Anywhere in the first minute.
        let first = hash(hash(simulator.config().seed, 0x7261), place) % 1800;
        let mut instants = Vec::with_capacity(self.config.instants);
        for index in first..first + self.config.instants as u64 {
            let mut frames = Vec::with_capacity(self.config.cameras);
            for slot in 0..self.config.cameras {
                let plan = simulator.plan(slot, index)?;
                debug_assert_eq!(plan.delivery, Delivery::Frame);
                frames.push(simulator.render_with(&shot(&plan, slot))?);
            }
            instants.push(frames);
        }
        let sample = SimSample {
            config: simulator.config().clone(),
            reported_rig: simulator.reported_rig(),
            rig: simulator.rig().clone(),
            template: simulator.template().clone(),
            first,
            instants,
        };
        self.simulator = Some(simulator);
        Ok(sample)
    }
}

impl Iterator for TrainingSamples {
    type Item = Result<SimSample, SimError>;

    /// Returns the next sample. After an error the next call continues with another person.
    fn next(&mut self) -> Option<Self::Item> {
        let sample = self.sample();
        let a_person = self.config.samples_a_person as u64;
        self.given = if sample.is_ok() { self.given + 1 } else { (self.given / a_person + 1) * a_person };
        Some(sample)
    }
}

/// Returns the configuration of person `person`, randomised in everything that a method must not rely on.
#[must_use]
pub fn random_config(training: &TrainingConfig, person: u64) -> SimConfig {
    let seed = hash(training.seed, person);
    let mut rng = SmallRng::seed_from_u64(hash(seed, 0x7274));
    let radius_m = rng.random_range(2.2..4.2);
    let fisheye = rng.random_bool(0.15);
    let cameras = RingConfig {
        count: training.cameras,
        radius_m,
        height_m: rng.random_range(0.8..2.4),
        target_height_m: rng.random_range(0.85..1.0),
        // The person fills more or less of the image's height.
        focal_heights: rng.random_range(0.36..0.5) * radius_m,
        radial: [rng.random_range(-0.18..0.05), rng.random_range(-0.02..0.05)],
        fisheye: fisheye.then(|| [rng.random_range(-0.05..0.08), rng.random_range(-0.015..0.01), 0.002, 0.0]),
        tangential: [0.0; 2].map(|_: f64| rng.random_range(-0.001..0.001)),
        place_jitter_m: rng.random_range(0.0..0.3),
        aim_jitter_deg: rng.random_range(0.0..4.0),
        focal_jitter_percent: rng.random_range(0.0..6.0),
    };
    let sensors = (0..training.cameras)
        .map(|_| {
            let full_well_electrons = rng.random_bool(0.8).then(|| rng.random_range(1500.0..30_000.0));
            SensorConfig {
                exposure: rng.random_range(0.6..1.5),
                gain: rng.random_range(0.8..1.25),
                gamma: rng.random_range(0.88..1.14),
                white_balance: [0.0; 3].map(|_: f64| rng.random_range(0.88..1.12)),
                vignetting: rng.random_range(0.0..0.45),
                full_well_electrons,
                read_noise_electrons: full_well_electrons.map_or(0.0, |_| rng.random_range(0.0..12.0)),
                jpeg_quality: rng.random_bool(0.7).then(|| rng.random_range(45..97)),
            }
        })
        .collect();
    let optics = OpticsConfig {
        exposure_ms: if rng.random_bool(0.3) { rng.random_range(1.0..12.0) } else { 0.0 },
        readout_ms: if rng.random_bool(0.3) { rng.random_range(4.0..28.0) } else { 0.0 },
        aperture_mm: if rng.random_bool(0.15) { rng.random_range(4.0..25.0) } else { 0.0 },
        focus_m: radius_m,
        samples: 4,
    };
    let lags = (0..training.cameras).filter_map(|slot| {
        let lagging = rng.random_bool(0.3);
        lagging.then(|| Fault {
            camera: Some(camera_name(slot)),
            ms: Some(rng.random_range(-6.0..6.0)),
            ..Fault::new(FaultKind::Lag)
        })
    });
    let faults = FaultScript { seed, faults: lags.collect() };
    let motion = MotionConfig {
        kind: MotionKind::BySeed,
        speed: rng.random_range(0.6..1.5),
        phase: rng.random_range(0.0..1.0),
        ..MotionConfig::default()
    };
    let scene = SceneConfig {
        kind: SceneKind::BySeed,
        seed: None,
        occluders: if rng.random_bool(0.25) { rng.random_range(1..3) } else { 0 },
        passer_by: rng.random_bool(0.2),
    };
    SimConfig {
        seed,
        motion,
        cameras,
        sensors,
        optics: vec![optics],
        calibration_error: CalibrationError {
            seed: None,
            rotation_deg: rng.random_range(0.0..0.15),
            translation_mm: rng.random_range(0.0..4.0),
            focal_percent: rng.random_range(0.0..0.3),
            center_px: rng.random_range(0.0..1.0) * f64::from(training.size[0]) / 512.0,
        },
        scene,
        faults,
        width: training.size[0],
        height: training.size[1],
        texture_px: training.texture_px,
        ..SimConfig::default()
    }
}
