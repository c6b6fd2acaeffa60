//! Errors of calibrations.

use std::path::PathBuf;

use flyrig_types::{CameraError, CameraId};

/// Error of a calibration or a calibration file; each text names the file, the camera where there is one, and the fix.
#[derive(Debug, thiserror::Error)]
pub enum CalibError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}; a calibration folder holds calibration.toml, or intri.yml and extri.yml", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {reason}", path.display())]
    Write {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
    /// Malformed file, in any format.
    #[error("{}: {problem}", path.display())]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Fault and fix.
        problem: String,
    },
    /// Not a file of OpenCV's FileStorage.
    #[error("{}: is not a YAML file of OpenCV's FileStorage ({reason}); export the calibration again", path.display())]
    Parse {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        reason: String,
    },
    /// File without cameras.
    #[error("{}: names no camera; expected a list `names` or matrices {expected}", path.display())]
    NoCameras {
        /// Path of the file.
        path: PathBuf,
        /// Keys that would name cameras.
        expected: &'static str,
    },
    /// Camera that only the other file has.
    #[error(
        "{}: camera {camera} is missing, but {} has it; calibrate it or take it out of both files",
        path.display(), other.display()
    )]
    OnlyInOther {
        /// Path of the file without it.
        path: PathBuf,
        /// Path of the file with it.
        other: PathBuf,
        /// Name of the camera.
        camera: CameraId,
    },
    /// Missing key.
    #[error("{}: camera {camera}: {key} is missing; {mend}", path.display())]
    Missing {
        /// Path of the file.
        path: PathBuf,
        /// Name of the camera.
        camera: CameraId,
        /// Name of the key.
        key: String,
        /// Fix.
        mend: &'static str,
    },
    /// Invalid value, or one that flyrig cannot model.
    #[error("{}: camera {camera}: {key} {problem}; {mend}", path.display())]
    Value {
        /// Path of the file.
        path: PathBuf,
        /// Name of the camera.
        camera: CameraId,
        /// Name of the key.
        key: String,
        /// Fault, with the value.
        problem: String,
        /// Fix.
        mend: &'static str,
    },
    /// Unknown size of the images.
    #[error("{}: camera {camera}: the image size is unknown; add H_{camera} and W_{camera}, or give images", path.display())]
    UnknownSize {
        /// Path of the file.
        path: PathBuf,
        /// Name of the camera.
        camera: CameraId,
    },
    /// Calibration for images of another size.
    #[error(
        "{}: camera {camera}: calibrated for images of {}x{}, but they are {}x{}; scale K with the images or replace them",
        path.display(), calibrated.0, calibrated.1, pictures.0, pictures.1
    )]
    OtherSize {
        /// Path of the file.
        path: PathBuf,
        /// Name of the camera.
        camera: CameraId,
        /// Width and height in the file.
        calibrated: (u32, u32),
        /// Width and height of the images.
        pictures: (u32, u32),
    },
    /// Invalid camera model.
    #[error("{}: {source}", path.display())]
    Camera {
        /// Path of the folder.
        path: PathBuf,
        /// Fault of the camera.
        source: CameraError,
    },
    /// Invalid description of a board.
    #[error("{}: {reason}", path.display())]
    Board {
        /// Path of the file.
        path: PathBuf,
        /// Invalid key and fix.
        reason: String,
    },
    /// Too few views of the board to calibrate a lens.
    #[error(
        "camera {camera}: the board is seen in {found} images, {different} of them different; show it in at least {needed} poses, \
         near and far, tilted, in all corners of the image"
    )]
    TooFewViews {
        /// Name of the camera.
        camera: CameraId,
        /// Images with the board.
        found: usize,
        /// Images among them that differ from each other.
        different: usize,
        /// Required images.
        needed: usize,
    },
    /// Views that leave the lens undetermined.
    #[error(
        "camera {camera}: the views do not determine the focal length; tilt the board by 30 to 45 degrees, and check columns, rows \
         and dictionary of board.toml"
    )]
    LensOpen {
        /// Name of the camera.
        camera: CameraId,
    },
    /// Cameras that no board links.
    #[error("no board joins the groups of cameras {groups}; show it between them, seen by a camera of each at once")]
    NotLinked {
        /// Groups of linked cameras.
        groups: String,
    },
    /// Boards that leave the rig undetermined.
    #[error("the boards do not determine the cameras' poses; show the board in more places and tilts")]
    RigOpen,
    /// Tracks of a person that leave the rig undetermined.
    #[error(
        "the person is not seen by two cameras at once for long enough; let one person move for ten seconds where all cameras see \
         them whole, and check that the old calibration is roughly right"
    )]
    PersonOpen,
    /// Person who stands still.
    #[error(
        "the person hardly moves ({extent_mm:.0} mm); let one person walk through the whole volume, with raised and lowered arms, and jump"
    )]
    PersonStill {
        /// Extent of the movement, millimetres.
        extent_mm: f64,
    },
    /// Camera whose colours cannot be compared with those of the others.
    #[error(
        "camera {camera}: {found} points of people are seen by it and another camera at once, and {needed} are needed; let a person walk where \
         its view overlaps with the others', in light that is neither clipped nor too dark"
    )]
    ColorsOpen {
        /// Name of the camera.
        camera: CameraId,
        /// Points that it shares with others.
        found: usize,
        /// Required points.
        needed: usize,
    },
    /// Tracks, limbs or mirrored landmarks that do not match the rig.
    #[error(
        "tracks of {cameras} cameras with {landmarks} landmarks for a rig of {expected} cameras; give tracks of this rig, and limbs and \
         mirrored pairs of these landmarks"
    )]
    PersonTracks {
        /// Cameras of the tracks.
        cameras: usize,
        /// Cameras of the rig.
        expected: usize,
        /// Landmarks of the tracks.
        landmarks: usize,
    },
    /// Lens that the format cannot represent.
    #[error("camera {camera}: EasyMocap's format has no fisheye lens; write calibration.toml, or another format")]
    FisheyeUnsupported {
        /// Name of the camera.
        camera: CameraId,
    },
}
