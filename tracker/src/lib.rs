//! Person masks, keypoints, triangulation, the pose and shape fit of a template, and its deformation.
//!
//! The input is a [`flyrig_types::FrameSet`] of calibrated cameras, the output the pose of a [`flyrig_body::Template`] and
//! one mask per camera:
//!
//! 1. [`PoseNet`] (BlazePose) finds 33 landmarks and a coarse mask in a rotated square crop of each image. The crop
//!    follows the person; after a loss the whole image is searched.
//! 2. [`triangulate`] joins the landmarks of the views and leaves out views that disagree.
//! 3. A damped least-squares fit in pixels turns the template's joints, then refines them with outlines and texture; the
//!    shape is fitted once, over the first frame sets ([`PoseEstimator::fit_shape`]).
//! 4. Masks come from the background ([`Background`]) and the network, sharpened on the image and gated by the fitted
//!    body. [`matte`] solves for coverage and foreground colour along their outlines.
//!
//! [`HandTracker`] adds fingers and the head's rotation. [`DeformTracker`] then moves the nodes of a deformation graph so
//! that the posed Gaussians explain the images.

mod deform;
mod error;
mod hands;
mod image;
mod landmarks;
mod masks;
mod network;
mod pose;
mod settings;
mod shape;
#[cfg(test)]
mod testing;

pub use deform::data::{DataTerm, PointDerivatives};
pub use deform::outline::{OutlineTerm, OutlineView};
pub use deform::settings::{DeformSettings, DeformSolver, FIRST_FRAMES};
pub use deform::track::{DeformReport, DeformTracker};
pub use error::{TrackError, TrackErrorKind};
pub use hands::face_net::{FACE_LANDMARKS, FACE_SIDE, FaceNet, FaceOutput};
pub use hands::face_study::FaceStudy;
pub use hands::hand_net::{HAND_LANDMARKS, HAND_SIDE, HandNet, HandOutput};
pub use hands::quality::{HandQuality, HandState, HandsQuality, HeadQuality};
pub use hands::tracker::{HandConfig, HandTracker};
pub use image::pixels::is_blank;
pub use landmarks::keypoints::{Keypoint, LANDMARK_COUNT, LANDMARK_NAMES, Sharpness, ViewKeypoints};
pub use landmarks::presence::shows_person;
pub use landmarks::study::{LandmarkBias, LandmarkStudy, RelativeSpread, SpreadBy};
pub use landmarks::triangulate::{WorldPoint, triangulate};
pub use masks::background::Background;
pub use masks::background_event::BackgroundEvent;
pub use masks::edge_color::{EdgeColor, Matte};
pub use masks::gate::BodyGate;
pub use masks::key_color::{KeyColor, KeyColorError};
pub use masks::matte::matte;
pub use masks::person_area::PersonArea;
pub use masks::seen_background::SeenBackground;
pub use network::pose_net::PoseNet;
pub use pose::config::PoseConfig;
pub use pose::estimate::{NoMask, PoseEstimate, PoseQuality, StageSeconds, ViewQuality};
pub use pose::estimator::{Marks, PoseEstimator, ShapeSighting};
pub use pose::viewers::Viewers;
pub use settings::PoseSettings;
pub use shape::bone_lengths::{HeightFrom, ShapeFit};
pub use shape::outfit_fit::{MaskedPoses, MaskedView, find_outfit};
