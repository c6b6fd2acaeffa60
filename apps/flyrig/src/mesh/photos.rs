//! Photographs of a take: those of the inputs, and those of held-out cameras.

use anyhow::Result;
use flyrig_fit::TrainingView;
use flyrig_takes::{Replay, frame_number};
use flyrig_types::{Camera, FrameSet, Image, Mask};

/// Frames from one compared with held-out cameras to the next.
const HELD_EVERY: u64 = 10;

/// Photographs of a take.
#[derive(Debug, Default)]
pub(super) struct Photos {
    /// Images of the inputs, cropped to the person.
    pub views: Vec<TrainingView>,
    /// Images of the held-out cameras.
    pub held: Vec<HeldImage>,
}

/// Image of a held-out camera.
#[derive(Debug)]
pub(super) struct HeldImage {
    pub number: u64,
    pub camera: Camera,
    pub image: Image,
    pub mask: Option<Mask>,
}

impl Photos {
    /// Keeps the images of the held-out cameras of the first frame in which the person was found and of every tenth one, or of `only` this
    /// one.
    pub fn hold(&mut self, replay: &mut Replay, set: &FrameSet, only: Option<u64>) -> Result<()> {
        let number = frame_number(set);
        let is_held = only.map_or(self.held.is_empty() || number.is_multiple_of(HELD_EVERY), |only| only == number);
        if replay.holdout.is_empty() || !is_held {
            return Ok(());
        }
        let truths = replay.truth.at(set.master_nanos)?;
        for (camera, truth) in replay.holdout.iter().zip(truths) {
            let Some(truth) = truth else { continue };
            let (image, mask) = (&truth.image, truth.mask.clone());
            let image = Image::new(image.width(), image.height(), image.format(), image.bytes().to_vec())?;
            self.held.push(HeldImage { number, camera: camera.clone(), image, mask });
        }
        Ok(())
    }
}
