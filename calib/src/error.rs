//! Why a calibration is refused.

use std::path::PathBuf;

use flyrig_types::{CameraError, CameraId};

/// Each text names the file, the camera where there is one, and the fix.
#[derive(Debug, thiserror::Error)]
pub enum CalibError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}; a calibration folder holds calibration.toml, or intri.yml and extri.yml", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("{}: cannot be written: {reason}", path.display())]
    Write {
        /// Which file.
        path: PathBuf,
        /// What went wrong.
        reason: String,
    },
    /// A file that is not what it should be, in any format.
    #[error("{}: {problem}", path.display())]
    Format {
        /// Which file.
        path: PathBuf,
        /// The fault and the fix.
        problem: String,
    },
    /// Not a file of OpenCV's FileStorage.
    #[error("{}: is not a YAML file of OpenCV's FileStorage ({reason}); export the calibration again", path.display())]
    Parse {
        /// Which file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// No camera in it.
    #[error("{}: names no camera; expected a list `names` or matrices {expected}", path.display())]
    NoCameras {
        /// Which file.
        path: PathBuf,
        /// Keys that would name cameras.
        expected: &'static str,
    },
    /// A camera that only the other file has.
    #[error(
        "{}: camera {camera} is missing, but {} has it; calibrate it or take it out of both files",
        path.display(), other.display()
    )]
    OnlyInOther {
        /// The file without it.
        path: PathBuf,
        /// The file with it.
        other: PathBuf,
        /// Which camera.
        camera: CameraId,
    },
    /// A key that must be there.
    #[error("{}: camera {camera}: {key} is missing; {mend}", path.display())]
    Missing {
        /// Which file.
        path: PathBuf,
        /// Which camera.
        camera: CameraId,
        /// Which key.
        key: String,
        /// What to do.
        mend: &'static str,
    },
    /// A value that cannot be right, or that we cannot model.
    #[error("{}: camera {camera}: {key} {problem}; {mend}", path.display())]
    Value {
        /// Which file.
        path: PathBuf,
        /// Which camera.
        camera: CameraId,
        /// Which key.
        key: String,
        /// What is wrong, with the value.
        problem: String,
        /// What to do.
        mend: &'static str,
    },
    /// Nothing says how large the images are.
    #[error("{}: camera {camera}: the image size is unknown; add H_{camera} and W_{camera}, or give images", path.display())]
    UnknownSize {
        /// Which file.
        path: PathBuf,
        /// Which camera.
        camera: CameraId,
    },
    /// The calibration is for images of another size.
    #[error(
        "{}: camera {camera}: calibrated for images of {}x{}, but they are {}x{}; scale K with the images or replace them",
        path.display(), calibrated.0, calibrated.1, pictures.0, pictures.1
    )]
    OtherSize {
        /// Which file.
        path: PathBuf,
        /// Which camera.
        camera: CameraId,
        /// Width and height in the file.
        calibrated: (u32, u32),
        /// Width and height of the images.
        pictures: (u32, u32),
    },
    /// A camera model that no camera has.
    #[error("{}: {source}", path.display())]
    Camera {
        /// Which folder.
        path: PathBuf,
        /// What is wrong.
        source: CameraError,
    },
    /// A description of a board that is of no use.
    #[error("{}: {reason}", path.display())]
    Board {
        /// Which file.
        path: PathBuf,
        /// The wrong key and the fix.
        reason: String,
    },
    /// Too few views of the board to know a lens.
    #[error(
        "camera {camera}: the board is seen in {found} images, {different} of them different; show it in at least {needed} poses, \
         near and far, tilted, in all corners of the image"
    )]
    TooFewViews {
        /// Which camera.
        camera: CameraId,
        /// Images with the board.
        found: usize,
        /// Of them, those that differ.
        different: usize,
        /// How many are needed.
        needed: usize,
    },
    /// The boards do not fix the lens.
    #[error(
        "camera {camera}: the views leave the focal length open; tilt the board by 30 to 45 degrees, and check columns, rows \
         and dictionary of board.toml"
    )]
    LensOpen {
        /// Which camera.
        camera: CameraId,
    },
    /// Cameras that no board joins.
    #[error("no board joins the groups of cameras {groups}; show it between them, seen by a camera of each at once")]
    NotLinked {
        /// The groups.
        groups: String,
    },
    /// The boards do not fix the rig.
    #[error("the boards do not fix the cameras' poses; show the board in more places and tilts")]
    RigOpen,
    /// The person does not fix the rig.
    #[error(
        "the person is not seen by two cameras at once for long enough; let one person move for ten seconds where all cameras see \
         them whole, and check that the old calibration is roughly right"
    )]
    PersonOpen,
    /// The person stands still.
    #[error(
        "the person hardly moves ({extent_mm:.0} mm); let one person walk through the whole volume, with raised and lowered arms, and jump"
    )]
    PersonStill {
        /// Extent of the movement, millimetres.
        extent_mm: f64,
    },
    /// A camera's colours cannot be compared with those of the others.
    #[error(
        "camera {camera}: {found} points of people are seen by it and another camera at once, and {needed} are needed; let somebody walk where \
         it looks together with the others, in light that neither clips nor drowns"
    )]
    ColorsOpen {
        /// Which camera.
        camera: CameraId,
        /// Points that it shares.
        found: usize,
        /// How many are needed.
        needed: usize,
    },
    /// Tracks, limbs or mirrored landmarks do not belong to the rig.
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
    /// The format has no place for this lens.
    #[error("camera {camera}: EasyMocap's format has no fisheye lens; write calibration.toml, or another format")]
    FisheyeUnsupported {
        /// Which camera.
        camera: CameraId,
    },
}
