//! Encoding and publishing of the person stream, on a thread of its own.
//!
//! With `output.avatar` the template of the first person holds the avatar's colours, and every frame is a pose: no node translations, no
//! colours.
//! While a viewer subscribes, each frame set yields one [`PersonFrame`] per person. Motion is published before the colours, which take
//! longer to encode. Templates are offered by their hash; viewers fetch each once, and the present colours with it.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
    time::Duration,
};

use flyrig_capture::{LatestQueue, PopError};
use flyrig_stream::{ColorEncoder, ColorSettings, LAYERS, MotionEncoder, Stamp, WholeColors};
use flyrig_transport::{Publisher, SharedColors};
use flyrig_types::{PersonId, SupervisedThread, ThreadHealth, lock};

use crate::{error::FusionError, subject::stream_frame::PersonFrame};

/// Capacity of the queue before the encoder, in frames of people.
const WAITING: usize = 4;

/// Encoder of one person's motion and colours.
#[derive(Debug)]
pub struct PersonEncoder {
    hash: u64,
    motion: MotionEncoder,
    settings: ColorSettings,
    epoch: u32,
    colors: Arc<FrameColors>,
}

/// Encoder of one person's colours; `None` before the first colours, since motion does not wait for it.
#[derive(Debug, Default)]
struct FrameColors(Mutex<Option<ColorEncoder>>);

impl WholeColors for FrameColors {
    fn whole(&self, first_layer: usize) -> Vec<(usize, Vec<u8>)> {
        lock(&self.0).as_ref().map(|encoder| encoder.whole(first_layer)).unwrap_or_default()
    }
}

/// Messages of one frame: motion, and the layers of the colours.
#[derive(Debug)]
pub struct PersonMessages {
    /// Template, person and frame.
    pub stamp: Stamp,
    /// Encoded motion.
    pub motion: Vec<u8>,
    /// Encoded colours, one element per layer; all empty where the template has them.
    pub colors: [Vec<u8>; LAYERS],
}

impl PersonEncoder {
    /// Creates an encoder for the person of a frame. `epoch` distinguishes its colours from those of earlier encoders.
    #[must_use]
    pub fn new(frame: &PersonFrame, settings: ColorSettings, epoch: u32) -> Self {
        Self {
            hash: frame.template.template.hash,
            motion: MotionEncoder::new(&frame.template),
            settings,
            epoch,
            colors: Arc::default(),
        }
    }

    /// Returns the colours, for viewers that join.
    #[must_use]
    pub fn colors(&self) -> SharedColors {
        self.colors.clone()
    }

    /// Encodes a frame.
    ///
    /// # Errors
    /// [`FusionError::Stream`] for a pose that does not fit the template.
    pub fn encode(&mut self, frame: &PersonFrame) -> Result<PersonMessages, FusionError> {
        let (stamp, motion) = self.encode_motion(frame)?;
        Ok(PersonMessages { stamp, motion, colors: self.encode_colors(frame) })
    }

    fn stamp(&self, frame: &PersonFrame) -> Stamp {
        Stamp { template: self.hash, ..frame.motion.stamp }
    }

    fn encode_motion(&mut self, frame: &PersonFrame) -> Result<(Stamp, Vec<u8>), FusionError> {
        Ok((self.stamp(frame), self.motion.encode(&frame.motion)?))
    }

    /// Encodes the colours; all layers are empty where the template has them.
    fn encode_colors(&mut self, frame: &PersonFrame) -> [Vec<u8>; LAYERS] {
        if frame.colors.is_empty() {
            return Default::default();
        }
        let stamp = self.stamp(frame);
        let (settings, epoch) = (self.settings, self.epoch);
        let mut colors = lock(&self.colors.0);
        let encoder = colors.get_or_insert_with(|| ColorEncoder::new(&frame.template, settings, epoch));
        encoder.encode(stamp, &frame.colors)
    }
}

/// Thread that encodes and publishes people. The session never waits for it: a full queue drops its oldest frame.
pub(crate) struct PersonPublisher {
    frames: Arc<LatestQueue<PersonFrame>>,
    thread: SupervisedThread,
}

impl PersonPublisher {
    pub fn start(publisher: Arc<Publisher>) -> Result<Self, FusionError> {
        let frames = Arc::new(LatestQueue::<PersonFrame>::new(WAITING));
        let waiting = Arc::clone(&frames);
        let mut encoders = BTreeMap::<u32, PersonEncoder>::new();
        let work = move || {
            loop {
                let frame = match waiting.pop(Duration::from_millis(200)) {
                    Ok(frame) => frame,
                    Err(PopError::Timeout) => continue,
                    Err(PopError::Closed) => return,
                };
                publish(&publisher, &mut encoders, &frame);
            }
        };
        let thread =
            SupervisedThread::start("person", work).map_err(|source| FusionError::Thread { name: "person", source })?;
        Ok(Self { frames, thread })
    }

    pub fn push(&self, frame: PersonFrame) {
        drop(self.frames.push(frame));
    }

    pub fn dropped(&self) -> u64 {
        self.frames.dropped()
    }

    pub fn health(&self) -> ThreadHealth {
        self.thread.health()
    }

    /// Publishes the waiting frames and ends the thread.
    pub fn finish(mut self) {
        self.frames.close();
        self.thread.join();
    }
}

/// Returns the epoch of an encoder that starts now: the low bits of the time in microseconds.
fn epoch() -> u32 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_micros() as u32)
}

fn publish(publisher: &Publisher, encoders: &mut BTreeMap<u32, PersonEncoder>, frame: &PersonFrame) {
    let person = frame.motion.stamp.person;
    let template = &frame.template;
    if encoders.get(&person).is_none_or(|encoder| encoder.hash != template.template.hash) {
        while encoders.len() > flyrig_transport::MAX_PERSON_TOPICS {
            encoders.pop_first();
        }
        let encoder = PersonEncoder::new(frame, ColorSettings::default(), epoch());
        let (hash, bytes) = (encoder.hash, template.bytes.clone().into());
        if template.template.has_colors() {
            publisher.offer_template(person, hash, bytes);
        } else {
            publisher.offer_template_with(person, hash, bytes, encoder.colors());
        }
        encoders.insert(person, encoder);
    }
    let Some(encoder) = encoders.get_mut(&person) else { return };
    match encoder.encode_motion(frame) {
        Ok((stamp, motion)) => {
            // Before the colours, which take longer to encode.
            publisher.publish_person(&stamp, None, motion.into());
            let colors = encoder.encode_colors(frame).into_iter().enumerate();
            for (layer, bytes) in colors.filter(|(_, bytes)| !bytes.is_empty()) {
                publisher.publish_person(&stamp, Some(layer), bytes.into());
            }
        }
        Err(error) => tracing::warn!(person = %PersonId(person), %error, "person not published"),
    }
}
