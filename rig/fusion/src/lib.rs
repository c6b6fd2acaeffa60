//! The live system as a library: frame sets in, tracked people as 3D Gaussians and rendered views out.
//!
//! A [`Session`] holds any number of [`Subject`]s, one a person. [`SessionBuilder`] makes one from a graphics device, the
//! calibrated input cameras and a [`Perception`], which finds people in frame sets. [`Session::process`] takes in a
//! [`FrameSet`]; [`Session::render`] draws everybody into a view; [`Session::splats`] reads a person's Gaussians back.
//! Sets are formed by [`Intake`] from live cameras, by [`SetReader`] from recordings, or by a
//! [`flyrig_sync::Synchronizer`] from any frames.
//!
//! `examples/embed.rs` shows all of it without network, files or command line.

mod age;
mod budget;
mod deformation;
mod drawing;
mod effort;
mod error;
mod health;
mod intake;
mod live_publisher;
mod live_rig;
mod live_views;
mod memory;
mod newcomers;
mod perceiver;
mod perception;
mod person_stream;
mod pose_curve;
mod rig_watch;
mod session;
mod set_reader;
mod settings;
mod stage_times;
mod stage_trace;
mod stillness;
mod subject;
mod track_state;
mod viewpoints;

pub use budget::Budget;
pub use deformation::{DeformOptions, PAPER_COLOR_WEIGHT};
pub use effort::Effort;
pub use error::FusionError;
pub use health::{CameraHealth, Health, STUCK_AFTER, check_threads};
pub use intake::{InputFormat, Intake};
pub use live_publisher::LivePublisher;
pub use live_rig::{LiveRig, LiveStep};
pub use live_views::{LiveViews, OutputSettings};
pub use memory::PersonMemory;
pub use perception::{
    EstimatedPerception, GivenPerception, GivenPerson, KnownPerson, Observation, Perception, SHAPE_SECS, SHAPE_SETS,
    SeenPerson, ViewObservation,
};
pub use person_stream::{PersonEncoder, PersonFrame, PersonMessages, stream_joints};
pub use rig_watch::{Correction, RigWatch, WatchEvent};
pub use session::{Counts, Outcome, Session, SessionBuilder};
pub use set_reader::{SetReader, next_frame};
pub use settings::{
    AppearanceMode, AppearanceOptions, BodySettings, BudgetSettings, Origin, PerceptionSettings, SessionSettings,
    Solver, TrackingSettings,
};
pub use stage_times::{StageSummary, StageTimes, processor_time, resident_mib};
pub use stage_trace::{TracedStage, start_stage_trace, take_stage_trace};
pub use subject::{Observed, PROCESSOR_STAGE, Subject, person_gaussians, person_surface};
pub use track_state::{Remedy, TrackState, TrackWatch};
pub use viewpoints::orbit;

pub use flyrig_types::{FrameSet, PersonId};
