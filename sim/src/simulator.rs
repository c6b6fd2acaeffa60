//! Simulator of a capture.

use std::fmt;

use flyrig_body::{Part, Template};
use flyrig_gpu::GpuContext;
use flyrig_types::{Camera, Image, Mask, PixelFormat, Pose, PoseTrack, Rig};

use crate::camera::faults::FramePlan;
use crate::camera::frame::{SimFrame, SurfaceMesh};
use crate::camera::optics::OpticsConfig;
use crate::camera::ring::camera_ring;
use crate::camera::sensor::SensorConfig;
use crate::camera::sensor::{hash, linear_of_half};
use crate::camera::shot::Shot;
use crate::config::SimConfig;
use crate::draw::cast::Cast;
use crate::draw::drawing::Drawing;
use crate::draw::moment::{ImageRequest, RawImage};
use crate::error::SimError;
use crate::person::actor::ActorShape;
use crate::person::assembly::Person;
use crate::room::scene::Scene;

/// Simulator of a person, a motion, a room and cameras.
pub struct Simulator {
    config: SimConfig,
    rig: Rig,
    cast: Cast,
    plates: Vec<Image>,
    drawing: Drawing,
    /// Instant and reach of the people last set in the drawing.
    posed: Option<(i64, f64)>,
    cameras: Vec<Kept>,
}

/// Cached state of a camera.
#[derive(Debug, Default)]
struct Kept {
    /// Instant requested last.
    asked_nanos: Option<i64>,
    drawn: Option<(i64, RawImage)>,
}

impl fmt::Debug for Simulator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Simulator").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Simulator {
    /// Creates the person, the room and the cameras. They are drawn on the adapter of `gpu`, which is opened if need be.
    ///
    /// # Errors
    /// [`SimError`] names the setting, the missing file or the adapter's limit.
    pub fn new(gpu: &GpuContext, config: &SimConfig) -> Result<Self, SimError> {
        let rig = camera_ring(config)?;
        let cast = Cast::new(config)?;
        let people: Vec<&Person> = cast.actors().map(|actor| &actor.person).collect();
        let drawing =
            Drawing::new(&gpu.with_adapter()?, [config.width, config.height], Scene::new(config, &rig), &people)?;
        let cameras = rig.cameras.iter().map(|_| Kept::default()).collect();
        let mut new = Self { config: config.clone(), rig, cast, plates: Vec::new(), drawing, posed: None, cameras };
        for slot in 0..new.rig.cameras.len() {
            let take = ImageRequest { people: false, ..new.take(&Shot::new(0, slot))? };
            for raw in new.drawing.pictures(&[take])? {
                // An instant that no frame has.
                let plate = new.develop(&raw, &Shot::new(i64::MIN, slot))?;
                new.plates.push(plate);
            }
        }
        Ok(new)
    }

    /// Returns the configuration.
    #[must_use]
    pub fn config(&self) -> &SimConfig {
        &self.config
    }

    /// Returns the true cameras, z up.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// Returns the cameras as a calibration with the configured error reports them.
    #[must_use]
    pub fn reported_rig(&self) -> Rig {
        self.config.calibration_error.reported(&self.rig, self.config.seed)
    }

    /// Returns the body without clothes: input of a tracker.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.cast.main.person.body
    }

    /// Returns one cycle of the motion; see [`Self::pose`] for later times.
    #[must_use]
    pub fn track(&self) -> &PoseTrack {
        &self.cast.main.track
    }

    /// Returns the pose at a time; the motion repeats.
    #[must_use]
    pub fn pose(&self, nanos: i64) -> Pose {
        self.cast.pose(nanos)
    }

    /// Returns the room without people at time 0, as camera `slot` sees it.
    ///
    /// # Errors
    /// [`SimError::NoSlot`].
    pub fn plate(&self, slot: usize) -> Result<&Image, SimError> {
        self.plates.get(slot).ok_or(SimError::NoSlot { slot, count: self.rig.cameras.len() })
    }

    /// Returns the time of frame `index` of every camera, nanoseconds.
    #[must_use]
    pub fn frame_nanos(&self, index: u64) -> i64 {
        (index as f64 * 1e9 / self.config.fps) as i64
    }

    /// Returns the fault script's effect on frame `index` of camera `slot`.
    ///
    /// # Errors
    /// [`SimError::NoSlot`].
    pub fn plan(&self, slot: usize, index: u64) -> Result<FramePlan, SimError> {
        Ok(self.config.faults.plan(&self.camera(slot)?.id, index, |index| self.frame_nanos(index)))
    }

    /// Renders image and truth of one camera at a time.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn render(&mut self, nanos: i64, slot: usize) -> Result<SimFrame, SimError> {
        self.render_with(&Shot::new(nanos, slot))
    }

    /// Renders image and truth of a shot.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Config`] for a shot out of range, [`SimError::Gpu`].
    pub fn render_with(&mut self, shot: &Shot) -> Result<SimFrame, SimError> {
        let (color, mask) = self.capture_with(shot)?;
        let take = self.take(shot)?;
        self.set_moment(shot.nanos, take.optics.reach_secs())?;
        let truth = self.drawing.truth(&take)?;
        let mut frame = SimFrame {
            nanos: shot.nanos,
            pose: self.pose(shot.nanos),
            color,
            mask,
            depth: truth.canonical_depth.iter().map(|&[.., z]| z).collect(),
            normal: truth.normal_part.iter().map(|&[x, y, z, _]| [x, y, z]).collect(),
            canonical: Vec::with_capacity(truth.canonical_depth.len()),
            part: truth.normal_part.iter().map(|&[.., part]| part_of_index(part as u32)).collect(),
        };
        for (&[x, y, z, _], &[.., part]) in truth.canonical_depth.iter().zip(&truth.normal_part) {
            frame.canonical.push([x, y, z, f32::from(u8::from(part > 0.5))]);
        }
        Ok(frame)
    }

    /// Renders image and mask only, at lower cost than [`Self::render`]. Cameras that were requested for the same
    /// instants before are rendered together, at the first request.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture(&mut self, nanos: i64, slot: usize) -> Result<(Image, Mask), SimError> {
        self.capture_with(&Shot::new(nanos, slot))
    }

    /// Renders image and mask of a shot.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Config`] for a shot out of range, [`SimError::Gpu`].
    pub fn capture_with(&mut self, shot: &Shot) -> Result<(Image, Mask), SimError> {
        let raw = self.raw(shot)?;
        self.finished(&raw, shot)
    }

    /// Renders images and masks of several cameras at one time, in one pass.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture_all(&mut self, nanos: i64, slots: &[usize]) -> Result<Vec<(Image, Mask)>, SimError> {
        self.draw_all(nanos, slots)?;
        slots.iter().map(|&slot| self.capture(nanos, slot)).collect()
    }

    /// Renders the linear light on the sensor of a shot, before exposure, noise and encoding: RGB, 1 is the brightest
    /// sRGB value.
    ///
    /// # Errors
    /// As [`Self::capture_with`].
    pub fn light(&mut self, shot: &Shot) -> Result<Vec<[f32; 3]>, SimError> {
        let raw = self.raw(shot)?;
        Ok(raw.iter().map(|&[r, g, b, _]| [r, g, b].map(linear_of_half)).collect())
    }

    /// Returns the person's visible surface at a time, as a mesh.
    pub fn clothed_surface(&mut self, nanos: i64) -> SurfaceMesh {
        let ActorShape { positions, normals, displacement } = self.cast.main.shape(nanos);
        let Person { clothed, carriers, .. } = &self.cast.main.person;
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

    /// Returns light and coverage of a shot, rendered unless cached.
    fn raw(&mut self, shot: &Shot) -> Result<RawImage, SimError> {
        shot.validate()?;
        let take = self.take(shot)?;
        if shot.camera_shift.is_some() {
            self.set_moment(shot.nanos, take.optics.reach_secs())?;
            return Ok(self.drawing.pictures(&[take])?.pop().unwrap_or_default());
        }
        let Shot { nanos, slot, .. } = *shot;
        let before = self.cameras[slot].asked_nanos;
        if before != Some(nanos) {
            // Who was asked for the same instant as this camera the last time will be again.
            let together = |kept: &Kept| before.is_some() && kept.asked_nanos == before;
            let mut slots: Vec<usize> = (0..self.cameras.len()).filter(|&i| together(&self.cameras[i])).collect();
            if !slots.contains(&slot) {
                slots.push(slot);
            }
            self.draw_all(nanos, &slots)?;
            self.cameras[slot].asked_nanos = Some(nanos);
        } else {
            self.draw_all(nanos, &[slot])?;
        }
        Ok(self.cameras[slot].drawn.as_ref().map(|(_, raw)| raw.clone()).unwrap_or_default())
    }

    /// Renders the images of an instant that are not cached.
    fn draw_all(&mut self, nanos: i64, slots: &[usize]) -> Result<(), SimError> {
        /// Bytes that are read back together.
        const BATCH_BYTES: usize = 256 << 20;
        let mut missing: Vec<usize> = Vec::new();
        for &slot in slots {
            self.camera(slot)?;
            let there = self.cameras[slot].drawn.as_ref().is_some_and(|(of, _)| *of == nanos);
            if !there && !missing.contains(&slot) {
                missing.push(slot);
            }
        }
        let each = self.config.width as usize * self.config.height as usize * size_of::<[u16; 4]>();
        for slots in missing.chunks((BATCH_BYTES / each).max(1)) {
            let takes: Vec<ImageRequest> =
                slots.iter().map(|&slot| self.take(&Shot::new(nanos, slot))).collect::<Result<_, _>>()?;
            self.set_moment(nanos, takes.iter().map(|take| take.optics.reach_secs()).fold(0.0, f64::max))?;
            for (&slot, raw) in slots.iter().zip(self.drawing.pictures(&takes)?) {
                self.cameras[slot].drawn = Some((nanos, raw));
            }
        }
        Ok(())
    }

    fn set_moment(&mut self, nanos: i64, reach_secs: f64) -> Result<(), SimError> {
        if self.posed != Some((nanos, reach_secs)) {
            self.posed = None;
            let moment = self.cast.moment(nanos, reach_secs);
            self.drawing.set_moment(moment)?;
            self.posed = Some((nanos, reach_secs));
        }
        Ok(())
    }

    fn take(&self, shot: &Shot) -> Result<ImageRequest, SimError> {
        let mut camera = self.camera(shot.slot)?.clone();
        if let Some(shift) = shot.camera_shift {
            camera.camera_from_world = shift * camera.camera_from_world;
        }
        let optics = match self.config.optics.len() {
            0 => OpticsConfig::default(),
            count => self.config.optics[shot.slot % count].clone(),
        };
        Ok(ImageRequest { nanos: shot.nanos, camera, optics, people: true })
    }

    fn finished(&self, raw: &[[u16; 4]], shot: &Shot) -> Result<(Image, Mask), SimError> {
        let coverage = raw.iter().map(|&[.., a]| (linear_of_half(a).clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        Ok((self.develop(raw, shot)?, Mask::new(self.config.width, self.config.height, coverage)?))
    }

    /// Applies the camera's sensor to light.
    fn develop(&self, raw: &[[u16; 4]], shot: &Shot) -> Result<Image, SimError> {
        let mut sensor = match self.config.sensors.len() {
            0 => SensorConfig::default(),
            count => self.config.sensors[shot.slot % count].clone(),
        };
        sensor.exposure *= shot.exposure;
        let key = hash(hash(self.config.seed, shot.slot as u64), shot.nanos as u64);
        let (width, height) = (self.config.width, self.config.height);
        let bytes = sensor.develop(raw, width, height, key)?;
        Ok(Image::new(width, height, PixelFormat::Rgb8, bytes)?)
    }
}

/// Inverts `part as u32 + 1`.
fn part_of_index(index: u32) -> Option<Part> {
    Part::ALL.into_iter().find(|&part| part as u32 + 1 == index)
}
