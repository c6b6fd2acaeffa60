//! Encodings of Gaussians: the person stream, and every frame by itself.

use std::{sync::Arc, time::Duration};

use anyhow::{Context, Result};
use flyrig_fusion::{PersonEncoder, PersonMessages};
use flyrig_stream::{ColorSettings, EncodedTemplate, Posed, PosedAxes};
use flyrig_transport::SplatState;
use flyrig_viewing::StreamPerson;

use super::{spz, take::Kept};

/// Level of zstd; its own default.
const ZSTD_LEVEL: i32 = 3;

/// A frame as a viewer receives it, and its cost.
pub struct Coded {
    /// Centres, standard deviations and normals.
    pub posed: Posed,
    /// Axes of an avatar.
    pub axes: Option<PosedAxes>,
    /// Linear colours and opacities.
    pub colors: Arc<Vec<[f32; 4]>>,
    /// Bytes of the frame, of its motion alone, and of the template that is sent once.
    pub bytes: usize,
    pub motion_bytes: usize,
    pub template_bytes: usize,
    /// Milliseconds of one core.
    pub encode_ms: f64,
    pub decode_ms: f64,
    pub pose_ms: f64,
}

/// An encoding of the frames of a take.
pub trait Form {
    /// Returns the name for tables.
    fn name(&self) -> String;

    /// Encodes and decodes frame `at` of the take.
    fn code(&mut self, at: usize, kept: &Kept) -> Result<Coded>;
}

/// The person stream with a quantisation step.
pub struct StreamForm {
    settings: ColorSettings,
    coder: Option<(PersonEncoder, StreamPerson)>,
}

impl StreamForm {
    pub fn new(step: f32) -> Self {
        Self { settings: ColorSettings { step, ..ColorSettings::default() }, coder: None }
    }
}

impl Form for StreamForm {
    fn name(&self) -> String {
        format!("stream, step {}", self.settings.step)
    }

    fn code(&mut self, _at: usize, kept: &Kept) -> Result<Coded> {
        let frame = &kept.frame;
        let hash = frame.template().template.hash;
        let (encoder, person) = match self.coder.take().filter(|(_, person)| person.template().hash == hash) {
            Some(known) => self.coder.insert(known),
            None => {
                let person = StreamPerson::new(Arc::new(frame.template().template.clone()));
                self.coder.insert((PersonEncoder::new(frame, self.settings, 1), person))
            }
        };
        let start = Start::now();
        let PersonMessages { motion, colors, .. } = encoder.encode(frame)?;
        let encode_ms = start.millis();
        let start = Start::now();
        person.ingest_motion(&motion, 0.0)?;
        for layer in &colors {
            person.ingest_colors(layer)?;
        }
        let received = person.motion_at(0.0, false).context("no motion was received")?;
        let mut posed = Posed::default();
        let known = person.pose(&received, &mut posed);
        let all_ms = start.millis();
        // The inverse transform belongs to decoding; posing is timed by itself.
        let start = Start::now();
        person.template().pose(&received, &mut Posed::default());
        let decode_ms = (all_ms - start.millis()).max(0.0);
        let mut axes = PosedAxes::default();
        let has_axes = person.pose_axes(&received, &posed, &mut axes);
        let pose_ms = start.millis();
        Ok(Coded {
            posed,
            axes: has_axes.then_some(axes),
            colors: known,
            bytes: motion.len() + colors.iter().map(Vec::len).sum::<usize>(),
            motion_bytes: motion.len(),
            template_bytes: frame.template().bytes.len(),
            encode_ms,
            decode_ms,
            pose_ms,
        })
    }
}

/// The avatar of the person once, then poses alone.
pub struct AvatarPoses {
    avatar: Arc<EncodedTemplate>,
    person: StreamPerson,
    encoder: Option<PersonEncoder>,
}

impl AvatarPoses {
    pub fn new(avatar: &Arc<EncodedTemplate>) -> Self {
        let person = StreamPerson::new(Arc::new(avatar.template.clone()));
        Self { avatar: Arc::clone(avatar), person, encoder: None }
    }
}

impl Form for AvatarPoses {
    fn name(&self) -> String {
        "avatar, poses".to_owned()
    }

    fn code(&mut self, _at: usize, kept: &Kept) -> Result<Coded> {
        let start = Start::now();
        let frame = kept.frame.of_avatar(&self.avatar);
        let encoder = self.encoder.get_or_insert_with(|| PersonEncoder::new(&frame, ColorSettings::default(), 1));
        let motion = encoder.encode(&frame)?.motion;
        let encode_ms = start.millis();
        let start = Start::now();
        self.person.ingest_motion(&motion, 0.0)?;
        let received = self.person.motion_at(0.0, false).context("no motion was received")?;
        let decode_ms = start.millis();
        let start = Start::now();
        let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
        let colors = self.person.pose(&received, &mut posed);
        let has_axes = self.person.pose_axes(&received, &posed, &mut axes);
        Ok(Coded {
            posed,
            axes: has_axes.then_some(axes),
            colors,
            bytes: motion.len(),
            motion_bytes: motion.len(),
            template_bytes: self.avatar.bytes.len(),
            encode_ms,
            decode_ms,
            pose_ms: start.millis(),
        })
    }
}

/// Every Gaussian of every frame, quantised as by `output.splats` and compressed by zstd.
pub struct Packed;

impl Form for Packed {
    fn name(&self) -> String {
        "splats, zstd".to_owned()
    }

    fn code(&mut self, _at: usize, kept: &Kept) -> Result<Coded> {
        let start = Start::now();
        let bytes = zstd::bulk::compress(&kept.splats.encode()?, ZSTD_LEVEL).context("zstd")?;
        let encode_ms = start.millis();
        let start = Start::now();
        let back = SplatState::decode(&zstd::stream::decode_all(bytes.as_slice()).context("zstd")?)?;
        let posed = Posed { center_scale: back.center_scale, normal: kept.normals.clone() };
        Ok(whole(posed, back.color, bytes.len(), [encode_ms, start.millis()]))
    }
}

/// Every frame as an SPZ file.
pub struct Spz;

impl Form for Spz {
    fn name(&self) -> String {
        "SPZ".to_owned()
    }

    fn code(&mut self, _at: usize, kept: &Kept) -> Result<Coded> {
        let start = Start::now();
        let bytes = spz::encode(&kept.splats.center_scale, &kept.normals, &kept.splats.color)?;
        let encode_ms = start.millis();
        let start = Start::now();
        let (posed, colors) = spz::decode(&bytes)?;
        Ok(whole(posed, colors, bytes.len(), [encode_ms, start.millis()]))
    }
}

/// Builds the result of a frame that is coded by itself.
fn whole(posed: Posed, colors: Vec<[f32; 4]>, bytes: usize, [encode_ms, decode_ms]: [f64; 2]) -> Coded {
    let (motion_bytes, template_bytes, pose_ms) = (0, 0, 0.0);
    Coded {
        posed,
        axes: None,
        colors: Arc::new(colors),
        bytes,
        motion_bytes,
        template_bytes,
        encode_ms,
        decode_ms,
        pose_ms,
    }
}

/// Start of a measurement of the thread's processor time, which other programs do not affect.
struct Start(Duration);

impl Start {
    fn now() -> Self {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        Self(Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32))
    }

    fn millis(&self) -> f64 {
        1e3 * Self::now().0.saturating_sub(self.0).as_secs_f64()
    }
}
