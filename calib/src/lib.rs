//! Camera calibration: from boards, from a moving person, of colours, and calibration files.
//!
//! Conventions are those of `flyrig_types`: OpenCV camera axes, pixel centres at integers, metres.
//!
//! - **Boards**: [`Board`] describes one, [`BoardSheet`] prints it, [`detector`] finds it in images. [`calibrate_lens`]
//!   and [`calibrate_rig`] start from homographies and refine by bundle adjustment (poses, lenses, a time offset per
//!   camera, the board's bend), which estimates noise and board velocities in turn with the unknowns.
//! - **Person**: [`calibrate_person`] refines poses and time offsets from the [`PersonTracks`] of one moving person.
//! - **Colours**: [`match_colors`] matches cameras by surface points that several of them see; the result is the field
//!   `color` of `flyrig_types::Camera`.
//! - **Watch**: [`CameraWatch`] detects a bumped camera from one rotation of its background.
//! - **Other image sizes**: [`resize_lens`] fits a lens to images that were scaled or cropped.
//! - **Files**: [`load_calibration`] chooses between `calibration.toml` and EasyMocap's files, [`Format`] converts
//!   those of other programs. A camera's time offset is a field of `flyrig_types::Camera`.

mod adjust;
mod board;
mod bundle;
mod calibration_file;
mod color;
mod convert;
mod detect;
mod dictionary;
mod easymocap;
mod error;
mod folder;
mod homography;
mod lens;
mod person;
mod print;
mod projection;
mod resize;
mod rig;
mod start;
mod storage_xml;
#[doc(hidden)]
pub mod testing;
mod uncertainty;
mod up;
mod watch;
mod yaml;
mod yaml_value;

pub use board::{Board, Pattern};
pub use bundle::{BoardShot, BoardView};
pub use calibration_file::{Deviation, calibration_toml, save_calibration, save_lenses};
pub use color::{CameraColors, ColorFit, ColorModel, ColorPoint, ColorSample, color_difference, match_colors};
pub use convert::{Format, Imported, ImportedCamera};
pub use detect::{BoardDetector, GrayImage, SeenCorner, detector};
pub use easymocap::{load_easymocap, save_easymocap};
pub use error::CalibError;
pub use folder::{load_calibration, load_lenses, parse_calibration, save_export};
pub use lens::{LensFit, calibrate_lens};
pub use person::{Agreement, OutlineCorner, PersonCamera, PersonFit, PersonOptions, PersonTracks, calibrate_person};
pub use print::BoardSheet;
pub use projection::LensModel;
pub use resize::{Crop, Resize, resize_lens};
pub use rig::{CornerError, RigCamera, RigFit, RigOptions, calibrate_rig};
pub use start::Pair;
pub use uncertainty::Uncertainty;
pub use watch::{CameraMotion, CameraWatch, WatchState, WatchedImage};
