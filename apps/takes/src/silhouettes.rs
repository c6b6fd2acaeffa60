//! Silhouettes of one person, found in each camera independently.

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_sync::SilhouetteTrack;
use flyrig_tracker::{PoseConfig, PoseNet, Viewers};
use flyrig_types::{FrameSet, Image, Rig};

/// Finder of one person's silhouettes.
pub struct SilhouetteFinder {
    viewers: Viewers,
    tracks: Vec<SilhouetteTrack>,
    given_masks: bool,
}

impl SilhouetteFinder {
    /// Creates a finder. `plates` are images of the empty scene, one per slot; `given_masks` uses the frames' own masks.
    ///
    /// # Errors
    /// The network cannot be loaded, or a plate does not fit its camera.
    pub fn new(rig: &Rig, plates: Vec<Option<Image>>, given_masks: bool) -> Result<Self> {
        let template = default_template(&ShapeParams::default())?;
        let viewers = Viewers::new(&PoseNet::embedded()?, &template, rig, plates, &PoseConfig::default())?;
        Ok(Self { viewers, tracks: rig.cameras.iter().map(SilhouetteTrack::new).collect(), given_masks })
    }

    /// Adds the silhouettes of a frame set.
    ///
    /// # Errors
    /// An image cannot be read by the network.
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
        let found = self.viewers.estimate(&unknown)?;
        for ((track, frame), found) in self.tracks.iter_mut().zip(&unknown.frames).zip(found) {
            if let (Some(frame), Some(found)) = (frame, found) {
                found.masks.iter().flatten().for_each(|mask| track.add(frame.capture_nanos, mask));
            }
        }
        Ok(())
    }

    /// Returns one track per camera.
    #[must_use]
    pub fn into_tracks(self) -> Vec<SilhouetteTrack> {
        self.tracks
    }
}
