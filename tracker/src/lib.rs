//! Person masks, keypoints, triangulation, the pose and shape fit of a template, and its deformation.
//!
//! Images of several calibrated cameras go in as a [`flyrig_types::FrameSet`]; the pose of a
//! [`flyrig_body::Template`] and one mask a camera come out:
//!
//! 1. [`PoseNet`] (BlazePose) finds 33 landmarks and a coarse mask in a turned square crop of each image;
//!    the crop follows the person, and is searched over the whole image after the person was lost.
//! 2. [`triangulate`] joins the landmarks of the views, leaving out views that disagree.
//! 3. A damped least-squares fit in pixels turns the template's joints; the bone lengths are
//!    fitted once, over the first frames ([`PoseEstimator::fit_shape`]).
//! 4. Masks come from the background ([`Background`]) and the network, sharpened on the image and gated by the fitted
//!    body. [`matte`] solves for coverage and foreground colour along their outlines.
//!
//! [`DeformTracker`] then moves the nodes of a deformation graph so that the posed Gaussians explain the images.

mod anatomy;
mod background;
mod beside;
mod body_model;
mod body_shape;
mod chosen_net;
mod config;
mod crop;
mod deform;
mod edge_color;
mod error;
mod estimate;
mod estimator;
mod fit;
mod gate;
mod grid;
mod habits;
mod hands;
mod key;
mod landmark_net;
mod landmarks;
mod light;
mod line_point;
mod looks;
mod matte;
mod net;
mod network_file;
mod outfit_fit;
mod outline;
mod pixels;
mod plate;
mod presence;
mod search;
mod settings;
mod shape;
mod shape_solve;
mod sighting;
mod silhouette;
mod single_view;
mod support;
mod surface_marks;
#[cfg(test)]
mod testing;
mod texture;
mod triangulate;
mod upsample;
mod vector_state;
mod view;
mod viewers;

pub use background::{Background, BackgroundEvent, PersonArea};
pub use config::PoseConfig;
pub use deform::{DataTerm, DeformReport, DeformSettings, DeformSolver, DeformTracker, FIRST_FRAMES, PointDerivatives};
pub use edge_color::{EdgeColor, Matte};
pub use error::{TrackError, TrackErrorKind};
pub use estimate::{NoMask, PoseEstimate, PoseQuality, StageSeconds, ViewQuality};
pub use estimator::{Marks, PoseEstimator, ShapeSighting};
pub use gate::BodyGate;
pub use habits::{Doubt, Habit, LandmarkStudy};
pub use hands::{
    FACE_LANDMARKS, FACE_SIDE, FaceNet, FaceOutput, FaceStudy, HAND_LANDMARKS, HAND_SIDE, HandConfig, HandNet,
    HandOutput, HandQuality, HandState, HandTracker, HandsQuality, HeadQuality,
};
pub use key::{KeyColor, KeyColorError};
pub use landmarks::{Keypoint, LANDMARK_BONES, LANDMARK_COUNT, LANDMARK_NAMES, ViewKeypoints};
pub use matte::matte;
pub use net::{CropLandmark, NET_SIDE, NetOutput, PoseNet};
pub use outfit_fit::{MaskedPoses, MaskedView, find_outfit};
pub use pixels::is_blank;
pub use plate::mask_from_plate;
pub use presence::shows_person;
pub use settings::PoseSettings;
pub use shape::{HeightFrom, ShapeFit, fit_template_shape};
pub use triangulate::{WorldPoint, triangulate};
pub use viewers::Viewers;
