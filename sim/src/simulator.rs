//! The simulation itself.

use std::fmt;

use flyrig_body::{Part, Template};
use flyrig_gpu::GpuContext;
use flyrig_types::{Camera, Image, Mask, PixelFormat, Pose, PoseTrack, Rig};

use crate::camera::sensor::{hash, linear_of_half};
use crate::draw::cast::Cast;
use crate::draw::drawing::Drawing;
use crate::draw::moment::{ImageRequest, RawImage};
use crate::person::actor::Shape;
use crate::person::assembly::Person;
use crate::room::scene::Scene;
use crate::{FramePlan, OpticsConfig, SensorConfig, Shot, SimConfig, SimError, SimFrame, SurfaceMesh, camera_ring};

/// A person, a motion, a room and cameras.
pub struct Simulator {
    config: SimConfig,
    rig: Rig,
    cast: Cast,
    plates: Vec<Image>,
    drawing: Drawing,
    /// Instant and reach of what the drawing's people do.
    posed: Option<(i64, f64)>,
    cameras: Vec<Kept>,
}

/// What is remembered of a camera.
#[derive(Debug, Default)]
struct Kept {
    /// Instant that was asked for last.
    asked_nanos: Option<i64>,
    drawn: Option<(i64, RawImage)>,
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
        let cast = Cast::new(config)?;
        let people: Vec<&Person> = cast.actors().map(|actor| &actor.person).collect();
        let drawing = Drawing::new(gpu, [config.width, config.height], Scene::new(config, &rig), &people)?;
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

    /// The configuration.
    #[must_use]
    pub fn config(&self) -> &SimConfig {
        &self.config
    }

    /// The cameras as they are, z up.
    #[must_use]
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The cameras as a calibration with the configured error reports them.
    #[must_use]
    pub fn reported_rig(&self) -> Rig {
        self.config.calibration_error.reported(&self.rig, self.config.seed)
    }

    /// The body without clothes: what a tracker is given.
    #[must_use]
    pub fn template(&self) -> &Template {
        &self.cast.main.person.body
    }

    /// One round of the motion; see [`Self::pose`] for later times.
    #[must_use]
    pub fn track(&self) -> &PoseTrack {
        &self.cast.main.track
    }

    /// Pose at a time; the motion starts over after its end.
    #[must_use]
    pub fn pose(&self, nanos: i64) -> Pose {
        self.cast.pose(nanos)
    }

    /// The room without people at time 0, as camera `slot` sees it.
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

    /// What the fault script does to frame `index` of camera `slot`.
    ///
    /// # Errors
    /// [`SimError::NoSlot`].
    pub fn plan(&self, slot: usize, index: u64) -> Result<FramePlan, SimError> {
        Ok(self.config.faults.plan(&self.camera(slot)?.id, index, |index| self.frame_nanos(index)))
    }

    /// Image and truth of one camera at a time.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn render(&mut self, nanos: i64, slot: usize) -> Result<SimFrame, SimError> {
        self.render_with(&Shot::new(nanos, slot))
    }

    /// Image and truth of a shot.
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

    /// Image and mask only, at less cost than [`Self::render`]. Cameras that were asked for the same instants before
    /// are drawn together, when the first of them is asked for.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture(&mut self, nanos: i64, slot: usize) -> Result<(Image, Mask), SimError> {
        self.capture_with(&Shot::new(nanos, slot))
    }

    /// Image and mask of a shot.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Config`] for a shot out of range, [`SimError::Gpu`].
    pub fn capture_with(&mut self, shot: &Shot) -> Result<(Image, Mask), SimError> {
        let raw = self.raw(shot)?;
        self.finished(&raw, shot)
    }

    /// Images and masks of several cameras at one time, drawn in one pass.
    ///
    /// # Errors
    /// [`SimError::NoSlot`], [`SimError::Gpu`].
    pub fn capture_all(&mut self, nanos: i64, slots: &[usize]) -> Result<Vec<(Image, Mask)>, SimError> {
        self.draw_all(nanos, slots)?;
        slots.iter().map(|&slot| self.capture(nanos, slot)).collect()
    }

    /// Linear light on the sensor of a shot, before exposure, noise and code: RGB, 1 is the brightest sRGB value.
    ///
    /// # Errors
    /// As [`Self::capture_with`].
    pub fn light(&mut self, shot: &Shot) -> Result<Vec<[f32; 3]>, SimError> {
        let raw = self.raw(shot)?;
        Ok(raw.iter().map(|&[r, g, b, _]| [r, g, b].map(linear_of_half)).collect())
    }

    /// What the cameras see of the person at a time, as a mesh.
    pub fn clothed_surface(&mut self, nanos: i64) -> SurfaceMesh {
        let Shape { positions, normals, displacement } = self.cast.main.shape(nanos);
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

    /// Light and coverage of a shot, drawn unless it was.
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

    /// Draws what of an instant is not drawn yet.
    fn draw_all(&mut self, nanos: i64, slots: &[usize]) -> Result<(), SimError> {
        /// Bytes that are read back at once.
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

    /// What the camera's sensor makes of light.
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

/// Inverse of `part as u32 + 1`.
fn part_of_index(index: u32) -> Option<Part> {
    Part::ALL.into_iter().find(|&part| part as u32 + 1 == index)
}
