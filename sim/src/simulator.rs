//! The simulation itself.

use std::fmt;

use flyrig_body::{Part, Template};
use flyrig_gpu::GpuContext;
use flyrig_types::{Camera, Image, Mask, PixelFormat, Pose, PoseTrack, Rig};
use glam::Vec3;

use crate::actor::{Actor, Shape};
use crate::draw::{Drawing, Posed};
use crate::noise::smoothstep;
use crate::person::Person;
use crate::room::{LensGrid, Room};
use crate::sensor::hash;
use crate::{SensorConfig, SimConfig, SimError, SimFrame, SurfaceMesh, camera_ring};

/// A person, a motion, a room and cameras.
pub struct Simulator {
    config: SimConfig,
    rig: Rig,
    actor: Actor,
    plates: Vec<Image>,
    drawing: Drawing,
    drawn_nanos: Option<i64>,
}

impl fmt::Debug for Simulator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Simulator").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Simulator {
    /// Makes the person, the room and the cameras.
    ///
    /// # Errors
    /// [`SimError`] names the setting, the missing file or the adapter's limit.
    pub fn new(gpu: &GpuContext, config: &SimConfig) -> Result<Self, SimError> {
        let rig = camera_ring(config)?;
        let actor = Actor::new(config)?;
        let room = Room::new(config.seed, config.cameras.radius_m);
        let mut plates = Vec::with_capacity(rig.cameras.len());
        if let Some(grid) = rig.cameras.first().and_then(|camera| LensGrid::new(&camera.intrinsics)) {
            plates.extend(rig.cameras.iter().map(|camera| room.plate(camera, &grid)));
        }
        let (width, height) = (config.width, config.height);
        let drawing = Drawing::new(gpu, &actor.person, [width, height], &plates)?;
        let plates = plates
            .into_iter()
            .enumerate()
            .map(|(slot, plate)| {
                let drawn = Image::new(width, height, PixelFormat::Rgb8, rgb_bytes(&plate.rgba))?;
                // An instant that no frame has.
                develop(config, drawn, i64::MIN, slot, 1.0)
            })
            .collect::<Result<_, SimError>>()?;
        Ok(Self { config: config.clone(), rig, actor, plates, drawing, drawn_nanos: None })
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
        &self.actor.person.body
    }

    /// One round of the motion; see [`Self::pose`] for later times.
    #[must_use]
    pub fn track(&self) -> &PoseTrack {
        &self.actor.track
    }

    /// Pose at a time; the motion starts over after its end.
    #[must_use]
    pub fn pose(&self, nanos: i64) -> Pose {
        self.actor.pose(nanos)
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
        (index as f64 * 1e9 / self.config.fps) as i64
    }

    /// Picture and truth of one camera at a time.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn render(&mut self, nanos: i64, slot: usize) -> Result<SimFrame, SimError> {
        let (color, mask) = self.capture(nanos, slot)?;
        let truth = self.drawing.truth(self.camera(slot)?)?;
        let parts = truth.part.iter().map(|&part| part_of_index(part)).collect();
        let mut depth = Vec::with_capacity(truth.canonical_depth.len());
        let mut canonical = Vec::with_capacity(truth.canonical_depth.len());
        for (&[x, y, z, camera_z], part) in truth.canonical_depth.iter().zip(&truth.part) {
            depth.push(camera_z);
            canonical.push([x, y, z, f32::from(u8::from(*part > 0))]);
        }
        Ok(SimFrame { nanos, pose: self.pose(nanos), color, mask, depth, canonical, part: parts })
    }

    /// Picture and mask only, at less cost than [`Self::render`].
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture(&mut self, nanos: i64, slot: usize) -> Result<(Image, Mask), SimError> {
        self.capture_exposed(nanos, slot, 1.0)
    }

    /// [`Self::capture`] with the sensor's exposure multiplied by `exposure`.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture_exposed(&mut self, nanos: i64, slot: usize, exposure: f64) -> Result<(Image, Mask), SimError> {
        self.camera(slot)?;
        if self.drawn_nanos != Some(nanos) {
            let posed = self.posed(nanos);
            self.drawing.set_person(&posed);
            self.drawn_nanos = Some(nanos);
        }
        let rgba = self.drawing.picture(self.camera(slot)?, slot)?;
        let (width, height) = (self.config.width, self.config.height);
        let color = Image::new(width, height, PixelFormat::Rgb8, rgb_bytes(&rgba))?;
        let color = develop(&self.config, color, nanos, slot, exposure)?;
        let mask = Mask::new(width, height, rgba.iter().map(|pixel| pixel[3]).collect())?;
        Ok((color, mask))
    }

    /// What the cameras see of the person at a time, as a mesh.
    pub fn clothed_surface(&mut self, nanos: i64) -> SurfaceMesh {
        let Shape { positions, normals, displacement } = self.actor.shape(nanos);
        let Person { clothed, carriers, .. } = &self.actor.person;
        SurfaceMesh {
            positions,
            normals,
            triangles: clothed.triangles.clone(),
            canonical: carriers.clone(),
            parts: clothed.parts.clone(),
            displacement,
        }
    }

    fn camera(&self, slot: usize) -> Result<&Camera, SimError> {
        self.rig.cameras.get(slot).ok_or(SimError::NoSlot { slot, count: self.rig.cameras.len() })
    }

    fn posed(&mut self, nanos: i64) -> Posed {
        let Shape { positions, normals, .. } = self.actor.shape(nanos);
        let low = positions.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = positions.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        let shoes = self.actor.person.shoe_vertices.clone();
        let middle = shoes.start + shoes.len() / 2;
        let feet = [shoes.start..middle, middle..shoes.end].map(|range| {
            let foot = &positions[range];
            let lowest = foot.iter().map(|p| p.z).fold(f32::INFINITY, f32::min);
            let mean = foot.iter().sum::<Vec3>() / foot.len().max(1) as f32;
            mean.truncate().extend(smoothstep(0.07, 0.0, lowest))
        });
        Posed { positions, normals, center: (low + high) * 0.5, feet }
    }
}

/// What camera `slot`'s sensor makes of a picture drawn for an instant.
fn develop(config: &SimConfig, drawn: Image, nanos: i64, slot: usize, exposure: f64) -> Result<Image, SimError> {
    let mut sensor = match config.sensors.len() {
        0 => SensorConfig::default(),
        count => config.sensors[slot % count].clone(),
    };
    sensor.exposure *= exposure;
    sensor.develop(drawn, hash(hash(config.seed, slot as u64), nanos as u64))
}

fn rgb_bytes(rgba: &[[u8; 4]]) -> Vec<u8> {
    rgba.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect()
}

/// Inverse of `part as u32 + 1`.
fn part_of_index(index: u32) -> Option<Part> {
    const PARTS: [Part; 10] = [
        Part::Head,
        Part::Torso,
        Part::LeftArm,
        Part::RightArm,
        Part::LeftHand,
        Part::RightHand,
        Part::LeftLeg,
        Part::RightLeg,
        Part::LeftFoot,
        Part::RightFoot,
    ];
    PARTS.into_iter().find(|&part| part as u32 + 1 == index)
}
