//! Silhouettes of one person in the images of every camera by itself.

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_sync::SilhouetteTrack;
use flyrig_tracker::{PoseConfig, PoseNet, Viewers};
use flyrig_types::{FrameSet, Image, Rig};

/// Finder of silhouettes.
pub struct Silhouettes {
    viewers: Viewers,
    tracks: Vec<SilhouetteTrack>,
    given_masks: bool,
}

impl Silhouettes {
    /// Creates a finder. `plates` are images of the empty scene by slot; `given_masks` uses the masks of the take.
    pub fn new(rig: &Rig, plates: Vec<Option<Image>>, given_masks: bool) -> Result<Self> {
        let template = default_template(&ShapeParams::default())?;
        let viewers = Viewers::new(&PoseNet::embedded()?, &template, rig, plates, &PoseConfig::default())?;
        Ok(Self { viewers, tracks: rig.cameras.iter().map(SilhouetteTrack::new).collect(), given_masks })
    }

    /// Adds the images of a set.
    pub fn add(&mut self, set: &FrameSet) -> Result<()> {
        let mut unknown = set.clone();
        for (track, frame) in self.tracks.iter_mut().zip(&mut unknown.frames) {
            if let Some(given) = frame.as_ref().filter(|_| self.given_masks)
                && let Some(mask) = &given.mask
            {
                track.add(given.capture_nanos, mask);
                *frame = None;
            }
        }
        if unknown.present().next().is_none() {
            return Ok(());
        }
        let found = self.viewers.look(&unknown)?;
        for ((track, frame), found) in self.tracks.iter_mut().zip(&unknown.frames).zip(found) {
            if let (Some(frame), Some(found)) = (frame, found) {
                found.masks.iter().flatten().for_each(|mask| track.add(frame.capture_nanos, mask));
            }
        }
        Ok(())
    }

    /// Returns one track per camera.
    pub fn into_tracks(self) -> Vec<SilhouetteTrack> {
        self.tracks
    }
}
