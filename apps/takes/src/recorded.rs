//! Notes at the beginning of a recording: names and calibration of its cameras.

use std::path::Path;

use anyhow::{Context as _, Result, bail};
use flyrig_calib::{calibration_toml, parse_calibration};
use flyrig_capture::{Note, recorded_notes};
use flyrig_transport::{decode_calibration, decode_transforms, encode_calibration, encode_transforms};
use flyrig_types::{Camera, CameraId, Rig};
use foxglove::{
    Decode as _, Encode,
    messages::{CameraCalibration, FrameTransforms, Log},
};

/// Topics of the calibration, the same as on the network.
const CALIBRATION: &str = "calibration/";
const TRANSFORMS: &str = "transforms";
/// Topic of the cameras' names, one per line, as the text of a foxglove `Log`.
const CAMERAS: &str = "cameras";
/// Topic of the whole calibration, time offsets included, as the text of a foxglove `Log`.
const CALIBRATION_FILE: &str = "calibration.toml";

/// Returns name, encoding and content of a message's schema.
#[must_use]
pub fn schema<M: Encode>() -> (String, String, Vec<u8>) {
    M::get_schema().map(|schema| (schema.name, schema.encoding, schema.data.into_owned())).unwrap_or_default()
}

/// Encodes a text as foxglove `Log`.
///
/// # Errors
/// The text is too long for a message.
pub fn log(name: &str, message: String) -> Result<Vec<u8>> {
    let mut payload = Vec::new();
    Log { name: name.to_owned(), message, ..Log::default() }.encode(&mut payload)?;
    Ok(payload)
}

/// Returns the notes with which a recording of these cameras begins. Without a rig it is recorded uncalibrated.
///
/// # Errors
/// The calibration cannot be encoded.
pub fn camera_notes(cameras: &[CameraId], rig: Option<&Rig>) -> Result<Vec<Note>> {
    fn note<M: Encode>(topic: String, payload: Vec<u8>) -> Note {
        Note { topic, schema: schema::<M>(), payload }
    }
    let text =
        |topic: &str, message: String| -> Result<Note> { Ok(note::<Log>(topic.to_owned(), log(topic, message)?)) };
    let names: Vec<&str> = cameras.iter().map(CameraId::as_str).collect();
    let mut notes = vec![text(CAMERAS, names.join("\n"))?];
    if let Some(rig) = rig {
        notes.push(text(CALIBRATION_FILE, calibration_toml(rig, &[])?)?);
        notes.push(note::<FrameTransforms>(TRANSFORMS.to_owned(), encode_transforms(rig)?));
        for camera in &rig.cameras {
            notes.push(note::<CameraCalibration>(format!("{CALIBRATION}{}", camera.id), encode_calibration(camera)?));
        }
    }
    Ok(notes)
}

/// Cameras of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedCameras {
    /// Names of the cameras, in the rig's order if there is a rig.
    pub ids: Vec<CameraId>,
    /// Calibration at the time of the recording; `None` if the cameras were not calibrated.
    pub rig: Option<Rig>,
}

impl RecordedCameras {
    /// Returns the calibration of the recording `path`.
    ///
    /// # Errors
    /// The cameras were not calibrated when they were recorded.
    pub fn calibrated(self, path: &Path) -> Result<Rig> {
        self.rig.with_context(|| {
            format!(
                "{}: was recorded without a calibration; make one with flyrig calibrate, and name its folder as source.calibration, or \
                 with --calibration",
                path.display()
            )
        })
    }
}

/// Reads names and calibration of a recording's cameras.
///
/// # Errors
/// The file cannot be read, names no cameras, or holds a damaged calibration.
pub fn recorded_cameras(path: &Path) -> Result<RecordedCameras> {
    let notes = recorded_notes(path)?;
    let text = |wanted: &str| -> Result<Option<String>> {
        let Some((_, bytes)) = notes.iter().find(|(topic, _)| topic == wanted) else { return Ok(None) };
        let log = Log::decode(bytes.as_slice()).with_context(|| format!("{}: {wanted} is damaged", path.display()))?;
        Ok(Some(log.message))
    };
    let rig = match text(CALIBRATION_FILE)? {
        Some(text) => Some(parse_calibration(path, &text)?),
        None => rig_from_messages(path, &notes)?,
    };
    let ids = match (&rig, text(CAMERAS)?) {
        (Some(rig), _) => rig.cameras.iter().map(|camera| camera.id.clone()).collect(),
        (None, Some(names)) => names.lines().map(CameraId::from).collect(),
        (None, None) => bail!("{}: names no cameras; it is no recording of flyrig's", path.display()),
    };
    Ok(RecordedCameras { ids, rig })
}

/// Decodes the rig of a recording of an earlier version, which has no `calibration.toml`.
fn rig_from_messages(path: &Path, notes: &[(String, Vec<u8>)]) -> Result<Option<Rig>> {
    let named = |text: &str| format!("{}: {text}", path.display());
    let Some((_, bytes)) = notes.iter().find(|(topic, _)| topic == TRANSFORMS) else { return Ok(None) };
    let transforms = decode_transforms(bytes)?;
    let mut cameras = Vec::new();
    for (_, bytes) in notes.iter().filter(|(topic, _)| topic.starts_with(CALIBRATION)) {
        let (id, intrinsics) = decode_calibration(bytes)?;
        let place = transforms.camera_from_world.iter().find(|(camera, _)| *camera == id);
        let (_, camera_from_world) = place.with_context(|| named(&format!("camera {id} has no place")))?;
        cameras.push(Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id,
            intrinsics,
            camera_from_world: *camera_from_world,
        });
    }
    let rig = Rig { cameras, world_up: transforms.world_up };
    rig.validate()?;
    Ok(Some(rig))
}

#[cfg(test)]
mod tests {
    use flyrig_capture::{Recorder, RecorderConfig};
    use flyrig_types::{ColorMatch, Intrinsics, Isometry, Lens};
    use glam::{DVec2, DVec3};

    use super::*;

    #[test]
    fn a_recording_keeps_the_whole_calibration_or_says_that_it_has_none() {
        let folder = tempfile::tempdir().unwrap();
        let ids = ["left".into(), "right".into()];
        let make = |name: &str, rig: Option<&Rig>| {
            let path = folder.path().join(name);
            let notes = camera_notes(&ids, rig).unwrap();
            let recorder = Recorder::create_with(&path, &notes, &RecorderConfig::default()).unwrap();
            assert!(recorder.finish().problem.is_none());
            path
        };
        let bare = make("bare.mcap", None);
        let found = recorded_cameras(&bare).unwrap();
        assert_eq!((found.ids.as_slice(), &found.rig), (ids.as_slice(), &None));
        let text = found.calibrated(&bare).unwrap_err().to_string();
        assert!(
            text.contains("bare.mcap: was recorded without a calibration; make one with flyrig calibrate"),
            "{text}"
        );

        let lens = Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] };
        let camera = |id: &CameraId, lens| Camera {
            id: id.clone(),
            intrinsics: Intrinsics {
                width: 640,
                height: 480,
                focal_px: DVec2::splat(500.0),
                center_px: DVec2::new(320.0, 240.0),
                lens,
            },
            camera_from_world: Isometry::IDENTITY,
            time_offset_nanos: -45_712_345,
            color: ColorMatch { gain: [1.1, 1.0, 0.9], exponent: 1.05, falloff: [0.2, 0.1] },
        };
        let cameras =
            vec![camera(&ids[0], lens), camera(&ids[1], Lens::Fisheye { coefficients: [0.1, 0.0, 0.0, 0.0] })];
        let rig = Rig { cameras, world_up: DVec3::new(0.0, 0.6, 0.8) };
        let found = recorded_cameras(&make("whole.mcap", Some(&rig))).unwrap();
        assert_eq!(found.rig, Some(rig));
    }
}
