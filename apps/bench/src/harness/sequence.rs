//! A simulated sequence in memory: inputs of every case, and ground truth.

use std::sync::Arc;

use anyhow::{Context, Result};
use flyrig_body::Template;
use flyrig_gpu::GpuContext;
use flyrig_sim::{MotionConfig, MotionKind, RingConfig, SimConfig, Simulator, SurfaceMesh};
use flyrig_types::{Camera, Frame, FrameSet, Image, PoseTrack, Rig};
use glam::DVec3;
use serde::Serialize;

use super::{images::copy, surface::Points};

/// Number of points on the true surface at which completeness is measured.
const TRUE_POINTS: usize = 20_000;
/// Largest depth difference to the simulator's depth image of a visible point, metres.
const DEPTH_TOLERANCE_M: f64 = 0.01;

/// SequenceMotion of the simulated person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SequenceMotion {
    /// A turn around the vertical axis.
    Turn,
    /// No motion.
    Still,
}

/// Parameters of a simulated sequence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SequenceConfig {
    pub motion: SequenceMotion,
    /// Seed of the person.
    pub seed: u64,
    /// Width and height of the images, pixels.
    pub side: u32,
    /// Number of instants.
    pub frames: usize,
    /// Instants per second.
    pub fps: f64,
}

/// Slots of the input cameras in order of use, and of the held-out cameras.
const INPUTS: [usize; 6] = [0, 5, 8, 3, 10, 6];
const HELD_OUT: [usize; 3] = [2, 7, 11];

/// Frames of all cameras, and the surface at the last instant.
pub struct SimulatedSequence {
    config: SequenceConfig,
    rig: Rig,
    pub template: Template,
    pub track: PoseTrack,
    /// Frames by instant and camera slot; `None` for unused cameras.
    frames: Vec<Vec<Option<Arc<Frame>>>>,
    /// Points on the clothed surface at the last instant, world coordinates.
    pub truth: Points,
    /// Depth images of the input cameras at the last instant.
    depths: Vec<(Camera, Vec<f32>)>,
    /// Images of the empty room, by camera slot.
    plates: Vec<Image>,
}

impl SimulatedSequence {
    /// Renders the sequence. All cameras expose simultaneously.
    pub fn simulate(gpu: &GpuContext, config: SequenceConfig) -> Result<Self> {
        Self::simulate_shifted(gpu, config, &[])
    }

    /// Renders the sequence with input camera `i` (in order of use) exposing `shifts[i]` nanoseconds after the instant, as its
    /// timestamps say.
    pub fn simulate_shifted(gpu: &GpuContext, config: SequenceConfig, shifts: &[i64]) -> Result<Self> {
        Self::simulate_cameras(gpu, config, shifts, &[INPUTS.as_slice(), &HELD_OUT].concat())
    }

    /// Renders the images of the first `views` input cameras, and none of the cameras that are held out.
    #[cfg(test)]
    pub fn simulate_inputs(gpu: &GpuContext, config: SequenceConfig, views: usize) -> Result<Self> {
        Self::simulate_cameras(gpu, config, &[], &INPUTS[..views])
    }

    fn simulate_cameras(gpu: &GpuContext, config: SequenceConfig, shifts: &[i64], slots: &[usize]) -> Result<Self> {
        let turn_secs = (config.frames as f64 / config.fps * 6.0).clamp(2.0, 60.0);
        let mut simulator = Simulator::new(
            gpu,
            &SimConfig {
                seed: config.seed,
                motion: match config.motion {
                    SequenceMotion::Turn => MotionConfig { turn_secs, ..MotionConfig::default() },
                    SequenceMotion::Still => MotionConfig { kind: MotionKind::Still, ..MotionConfig::default() },
                },
                cameras: RingConfig { count: 12, ..RingConfig::default() },
                width: config.side,
                height: config.side,
                fps: config.fps,
                ..SimConfig::default()
            },
        )?;
        let rig = simulator.rig().clone();
        let mut frames = Vec::with_capacity(config.frames);
        for index in 0..config.frames as u64 {
            let nanos = simulator.frame_nanos(index);
            let mut row: Vec<Option<Arc<Frame>>> = rig.cameras.iter().map(|_| None).collect();
            for &slot in slots {
                let shift = INPUTS.iter().position(|&s| s == slot).and_then(|i| shifts.get(i)).copied().unwrap_or(0);
                let capture_nanos = nanos.saturating_add(shift);
                let (image, mask) = simulator.capture(capture_nanos, slot)?;
                row[slot] = Some(Arc::new(Frame {
                    camera: rig.cameras[slot].id.clone(),
                    sequence: index,
                    capture_nanos,
                    exposure_nanos: None,
                    image,
                    mask: Some(mask),
                }));
            }
            frames.push(row);
        }
        let last = simulator.frame_nanos((config.frames as u64).saturating_sub(1));
        let SurfaceMesh { positions, triangles, .. } = simulator.clothed_surface(last);
        let truth = Points::on(&positions, &triangles, TRUE_POINTS);
        let depths = INPUTS
            .into_iter()
            .map(|slot| Ok((rig.cameras[slot].clone(), simulator.render(last, slot)?.depth)))
            .collect::<Result<_>>()?;
        let (template, track) = (simulator.template().clone(), simulator.track().clone());
        let plates = (0..rig.cameras.len()).map(|slot| copy(simulator.plate(slot)?)).collect::<Result<_>>()?;
        Ok(Self { config, rig, template, track, frames, truth, depths, plates })
    }

    /// Returns the parameters of the simulation.
    pub fn config(&self) -> SequenceConfig {
        self.config
    }

    /// Returns the rig of the first `views` input cameras.
    pub fn inputs(&self, views: usize) -> Rig {
        let mut rig = self.rig.clone();
        rig.cameras = INPUTS.iter().take(views).map(|&slot| self.rig.cameras[slot].clone()).collect();
        rig
    }

    /// Returns images of the empty room by the first `views` input cameras.
    pub fn plates(&self, views: usize) -> Result<Vec<Option<Image>>> {
        INPUTS.iter().take(views).map(|&slot| Ok(Some(copy(&self.plates[slot])?))).collect()
    }

    /// Iterates over the frame sets of the first `views` input cameras.
    pub fn sets(&self, views: usize) -> impl Iterator<Item = FrameSet> + '_ {
        let fps = self.config.fps;
        self.frames.iter().enumerate().map(move |(index, row)| FrameSet {
            index: index as u64,
            master_nanos: (index as f64 * 1e9 / fps) as i64,
            frames: INPUTS.iter().take(views).map(|&slot| row[slot].clone()).collect(),
        })
    }

    /// Returns the held-out cameras with their frames at an instant.
    pub fn held_out(&self, index: usize) -> Result<Vec<(&Camera, Arc<Frame>)>> {
        let row = self.frames.get(index).context("no such instant")?;
        let one = |slot: usize| Some((&self.rig.cameras[slot], row[slot].clone()?));
        Ok(HELD_OUT.into_iter().filter_map(one).collect())
    }

    /// Whether one of the first `views` input cameras sees a point of the true surface at the last instant.
    pub fn seen(&self, point: DVec3, views: usize) -> bool {
        self.depths.iter().take(views).any(|(camera, depth)| {
            let Some(pixel) = camera.project(point).map(glam::DVec2::round) else { return false };
            let (width, height) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
            if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width && pixel.y < height) {
                return false;
            }
            let at = pixel.y as usize * camera.intrinsics.width as usize + pixel.x as usize;
            let own = camera.camera_from_world.transform_point(point).z;
            depth.get(at).is_some_and(|&nearest| nearest > 0.0 && own < f64::from(nearest) + DEPTH_TOLERANCE_M)
        })
    }
}
