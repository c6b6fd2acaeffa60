//! Notes at the beginning of a recording: names and calibration of its cameras.

use std::path::Path;

use anyhow::{Context as _, Result, anyhow, ensure};
use flyrig_calib::{Imported, ImportedCamera, calibration_toml, parse_calibration};
use flyrig_capture::{ForeignCamera, ForeignCameras, Note, RecordedCamera, foreign_cameras, recorded_notes};
use flyrig_transport::{decode_calibration, decode_transforms, encode_calibration, encode_transforms};
use flyrig_types::{Camera, CameraId, Intrinsics, Rig};
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
    /// Places of their images, in the same order.
    pub images: Vec<RecordedCamera>,
    /// Calibration at the time of the recording; `None` if the cameras were not calibrated.
    pub rig: Option<Rig>,
    /// Known lenses of cameras of another program's recording without a rig.
    pub lenses: Vec<(CameraId, Intrinsics)>,
    /// Why the recording of another program has no rig.
    pub lacks: Option<String>,
    /// Parts of the recording of another program that were left out, one text each.
    pub notes: Vec<String>,
}

impl RecordedCameras {
    fn own(ids: Vec<CameraId>, rig: Option<Rig>) -> Self {
        let images = ids.iter().cloned().map(RecordedCamera::new).collect();
        Self { ids, images, rig, lenses: Vec::new(), lacks: None, notes: Vec::new() }
    }

    /// Returns the calibration of the recording `path`.
    ///
    /// # Errors
    /// The cameras were not calibrated when they were recorded; names what is missing.
    pub fn calibrated(self, path: &Path) -> Result<Rig> {
        let lacks = self.lacks.map_or_else(String::new, |lacks| format!(" ({lacks})"));
        self.rig.with_context(|| {
            format!(
                "{}: was recorded without a calibration{lacks}; make one with flyrig calibrate, and name its folder as \
                 source.calibration, or with --calibration",
                path.display()
            )
        })
    }

    /// Returns the place of a camera's images. A camera that the recording does not name has no frames.
    #[must_use]
    pub fn images_of(&self, id: &CameraId) -> RecordedCamera {
        let found = self.images.iter().find(|camera| camera.id == *id);
        found.cloned().unwrap_or_else(|| RecordedCamera::new(id.clone()))
    }

    /// Logs what was left out of the recording `path`, and what it lacks.
    pub fn log_notes(&self, path: &Path) {
        for note in self.notes.iter().chain(&self.lacks) {
            tracing::warn!("{}: {note}", path.display());
        }
    }
}

/// Reads names and calibration of a recording's cameras. A recording of another program is read to its end.
///
/// # Errors
/// The file cannot be read, names no cameras, gives one a name that no camera may have, or holds a damaged calibration.
pub fn recorded_cameras(path: &Path) -> Result<RecordedCameras> {
    let notes = recorded_notes(path)?;
    let text = |wanted: &str| -> Result<Option<String>> {
        let Some((_, bytes)) = notes.iter().find(|(topic, _)| topic == wanted) else { return Ok(None) };
        let log = Log::decode(bytes.as_slice()).with_context(|| format!("{}: {wanted} is damaged", path.display()))?;
        Ok(Some(log.message))
    };
    let (names, calibration) = (text(CAMERAS)?, text(CALIBRATION_FILE)?);
    let rig = match calibration {
        Some(text) => Some(parse_calibration(path, &text)?),
        None if names.is_some() => rig_from_messages(path, &notes)?,
        // Another program may use the same topics.
        None => rig_from_messages(path, &notes).ok().flatten(),
    };
    let ids: Vec<CameraId> = match (&rig, names) {
        (Some(rig), _) => rig.cameras.iter().map(|camera| camera.id.clone()).collect(),
        (None, Some(names)) => names.split('\n').map(CameraId::from).collect(),
        (None, None) => return from_foreign(path, foreign_cameras(path)?),
    };
    for (i, id) in ids.iter().enumerate() {
        id.check().map_err(|error| anyhow!("{}: {error}", path.display()))?;
        ensure!(!ids[..i].contains(id), "{}: camera {id} is named twice; record again", path.display());
    }
    Ok(RecordedCameras::own(ids, rig))
}

/// Joins what a recording of another program has of its cameras.
fn from_foreign(path: &Path, found: ForeignCameras) -> Result<RecordedCameras> {
    let ForeignCameras { cameras, up, lacks, notes } = found;
    let ids = cameras.iter().map(|camera| camera.images.id.clone()).collect();
    let images = cameras.iter().map(|camera| camera.images.clone()).collect();
    let imported = |camera: &ForeignCamera| {
        let (id, pose) = (camera.images.id.clone(), camera.camera_from_world);
        let color = Default::default();
        camera.intrinsics.map(|intrinsics| ImportedCamera { id, intrinsics, pose, time_offset_nanos: 0, color })
    };
    let imported = Imported::new(cameras.iter().filter_map(imported).collect(), up);
    if lacks.is_some() {
        return Ok(RecordedCameras { ids, images, rig: None, lenses: imported.lenses(), lacks, notes });
    }
    let rig = imported.rig(path)?;
    rig.iter().try_for_each(Rig::validate).with_context(|| path.display().to_string())?;
    Ok(RecordedCameras { ids, images, rig, lenses: Vec::new(), lacks, notes })
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

    #[test]
    fn a_recording_of_another_program_has_a_rig_or_says_what_is_missing() {
        let place = Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::Z, DVec3::Z);
        let camera = |id: &str, camera_from_world| ForeignCamera {
            images: RecordedCamera { topic: format!("/{id}/image"), ..RecordedCamera::new(id.into()) },
            intrinsics: Some(Intrinsics::pinhole(640, 480, 500.0)),
            camera_from_world,
        };
        let found = |pose, up, lacks: Option<&str>| {
            let cameras = vec![camera("a", Some(place)), camera("b", pose)];
            from_foreign(
                "x.mcap".as_ref(),
                ForeignCameras { cameras, up, lacks: lacks.map(str::to_owned), notes: vec![] },
            )
        };
        let recorded = found(Some(place), Some(DVec3::Z), None).unwrap();
        assert_eq!(recorded.images_of(&"b".into()).topic, "/b/image");
        assert_eq!(recorded.images_of(&"c".into()), RecordedCamera::new("c".into()));
        let rig = recorded.calibrated("x.mcap".as_ref()).unwrap();
        assert_eq!((rig.cameras[1].camera_from_world, rig.world_up), (place, DVec3::Z));
        // A world without a known vertical gets that of its cameras.
        let rig = found(Some(place), None, None).unwrap().rig.unwrap();
        assert!(rig.world_up.dot(DVec3::Z) > 0.9, "{}", rig.world_up);
        let recorded = found(None, None, Some("the cameras have no poses")).unwrap();
        assert_eq!((recorded.lenses.len(), recorded.rig.is_none()), (2, true));
        let text = recorded.calibrated("x.mcap".as_ref()).unwrap_err().to_string();
        assert!(
            text.starts_with("x.mcap: was recorded without a calibration (the cameras have no poses); make"),
            "{text}"
        );
    }

    #[test]
    fn names_that_no_camera_may_have_are_refused_with_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let long = "x".repeat(300);
        for (n, name) in ["../../x", "/tmp/x", "..", "a\u{1b}[2J", "", &long].into_iter().enumerate() {
            let path = folder.path().join(format!("{n}.mcap"));
            let notes = camera_notes(&["left".into(), name.into()], None).unwrap();
            let recorder = Recorder::create_with(&path, &notes, &RecorderConfig::default()).unwrap();
            assert!(recorder.finish().problem.is_none());
            let error = format!("{:#}", recorded_cameras(&path).unwrap_err());
            assert!(error.contains(&format!("{n}.mcap: the camera name '")), "{error}");
            assert!(!error.contains('\u{1b}') && error.chars().count() < 400, "{error}");
        }
        let path = folder.path().join("twice.mcap");
        let notes = camera_notes(&["left".into(), "left".into()], None).unwrap();
        drop(Recorder::create_with(&path, &notes, &RecorderConfig::default()).unwrap());
        assert!(recorded_cameras(&path).unwrap_err().to_string().contains("camera left is named twice"));
    }
}
