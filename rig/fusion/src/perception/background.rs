//! Backgrounds of a rig's cameras, from plates or a key colour: creation, schedule of updates, and warnings that name the camera.
//!
//! A background is updated with every fourth frame set, and with every one while it is being learnt.

use flyrig_tracker::{Background, BackgroundEvent};
use flyrig_types::{Camera, Image};

use crate::{error::FusionError, settings::perception::PerceptionSettings};

/// Frame sets from one update of the backgrounds to the next.
const UPDATE_EVERY: u32 = 4;

/// Returns the background of each camera, where the settings or a plate give one. A key colour replaces the plates.
pub(super) fn backgrounds(
    cameras: &[Camera],
    settings: &PerceptionSettings,
    plates: &[Option<Image>],
) -> Result<Vec<Option<Background>>, FusionError> {
    if let Some(key) = settings.key()? {
        return Ok(cameras.iter().map(|camera| Some(Background::from_key(camera, key))).collect());
    }
    let of = |(slot, camera): (usize, &Camera)| {
        let plate = plates.get(slot).and_then(Option::as_ref);
        Ok(plate.map(|plate| Background::from_plate(camera, plate)).transpose()?)
    };
    cameras.iter().enumerate().map(of).collect()
}

/// Count of frame sets between updates of the backgrounds.
#[derive(Debug, Default)]
pub(super) struct BackgroundWatch {
    sets: u32,
}

impl BackgroundWatch {
    /// Counts a frame set, and returns whether the backgrounds are updated with it. Backgrounds that are being learnt use every frame set.
    pub fn is_due(&mut self, are_learning: bool) -> bool {
        self.sets = self.sets.wrapping_add(1);
        self.sets % UPDATE_EVERY == 1 || are_learning
    }
}

/// Logs the events of a camera's background.
pub(super) fn report(camera: &Camera, events: &[BackgroundEvent]) {
    for event in events {
        match event {
            BackgroundEvent::Recovered => tracing::info!(camera = %camera.id, "{event}"),
            _ => tracing::warn!(camera = %camera.id, "{event}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_colour_is_read_and_a_wrong_one_names_the_key() {
        let settings = |text: &str| PerceptionSettings { key_color: text.to_owned(), ..PerceptionSettings::default() };
        assert_eq!(settings("").key().unwrap(), None);
        assert!(settings("green").key().unwrap().is_some());
        let error = settings("grey").key().unwrap_err().to_string();
        assert!(error.contains("perception.key_color") && error.contains("grey"), "{error}");
    }

    #[test]
    fn the_first_set_and_every_fourth_are_taken_in() {
        let mut watch = BackgroundWatch::default();
        let due: Vec<bool> = (0..9).map(|_| watch.is_due(false)).collect();
        assert_eq!(due, [true, false, false, false, true, false, false, false, true]);
    }
}
