//! The live system as a library: frame sets in, tracked people as 3D Gaussians and rendered views out.
//!
//! A [`Session`] holds any number of [`Subject`]s, one per person. [`SessionBuilder`] creates one from a graphics device, the calibrated
//! input cameras and a [`Perception`], which finds people in frame sets. [`Session::process`] processes a [`FrameSet`];
//! [`Session::render`] renders all people into a view; [`Session::splats`] reads a person's Gaussians back. Frame sets are formed by
//! [`Intake`] from live cameras, by [`SetReader`] from recordings, or by a [`sync::Synchronizer`] from any frames. [`LiveRig`] joins
//! cameras, session and publisher, and recovers from faults.
//!
//! Embedding programs depend on this crate alone: [`body`], [`calib`], [`capture`], [`gpu`], [`sync`], [`types`] and [`glam`] are the
//! parts of the other crates that its interface needs. `examples/embed.rs` shows all of it without network, files or command line.
//!
//! # One frame set
//!
//! | step | module |
//! |---|---|
//! | frames of the cameras to a frame set | `intake` |
//! | frame set to poses and masks of people | `perception` |
//! | poses, masks and images to Gaussians | `session`, `subject`, `deformation` |
//! | images of the past to an avatar of the person | `learner` |
//! | Gaussians to views, streams and statistics | `publish` |
//! | steps, look-ahead and recovery of a live rig | `live` |
//!
//! # Threads
//!
//! | thread | task | number |
//! |---|---|---|
//! | caller of [`LiveRig::step`] ("pipeline") | everything else; owns the GPU queue | one |
//! | "perception" | observes the next frame set beside the pipeline | one, per frame set |
//! | "shape", "new person" | measures a person who has come, prepares the subject | one each per such person, for seconds |
//! | "learner" | fits an avatar to the first person, with `body.learn` | one |
//! | "encode" | compresses views | one |
//! | "person" | encodes the person stream | one |
//!
//! Queues between threads are bounded. A slow stage loses the oldest entry, counts it, and the count is published. Threads that compress
//! and publish are restarted after a panic, five times at once; a panic of the pipeline builds the session again.

mod deformation;
mod error;
mod health;
mod intake;
mod learner;
mod live;
mod perception;
mod publish;
mod session;
mod settings;
mod subject;

pub use deformation::{DeformOptions, PAPER_COLOR_WEIGHT};
pub use error::FusionError;
pub use health::{
    CameraHealth, Health, STUCK_AFTER, StageSummary, StageTimes, TracedStage, check_threads, processor_time,
    resident_mib, share_memory_pools, start_stage_trace, take_stage_trace,
};
pub use intake::{InputFormat, Intake, SetReader, next_frame};
pub use live::{Correction, LiveRig, LiveStep, RigWatch, WatchEvent};
pub use perception::{
    EstimatedPerception, GivenPerception, GivenPerson, KnownPerson, Perception, PersonObservation, SHAPE_SECS,
    SHAPE_SETS, SeenPerson, ViewObservation,
};
pub use publish::{LivePublisher, LiveViews, OutputSettings, PersonEncoder, PersonMessages, orbit};
pub use session::{Budget, Counts, Outcome, Session, SessionBuilder};
pub use settings::{
    AppearanceMode, AppearanceOptions, BodySettings, BudgetSettings, Effort, Origin, PerceptionSettings,
    SessionSettings, Solver, TrackingSettings,
};
pub use subject::{
    Observed, PROCESSOR_STAGE, PersonFrame, PersonMemory, Remedy, Subject, TrackState, TrackWatch, Upright,
    encode_posed_avatar, person_gaussians, person_surface, stream_joints,
};

pub use flyrig_renderer::Splat;
pub use flyrig_types::{FrameSet, PersonId};
pub use glam;

/// Template bodies: the built-in one, and skinned glTF files.
pub mod body {
    pub use flyrig_body::{BodyError, Outfit, ShapeParams, Template, default_template, load_gltf};
}

/// Calibrations of the input cameras.
pub mod calib {
    pub use flyrig_calib::{CalibError, load_calibration};
}

/// Cameras and recordings.
pub mod capture {
    #[cfg(target_os = "linux")]
    pub use flyrig_capture::V4l2Camera;
    pub use flyrig_capture::{
        CameraControls, CameraIdentity, CameraOptions, CameraSource, CaptureError, CaptureErrorKind, FolderOptions,
        FolderReplay, FormatChoice, McapReplay, NokhwaCamera, NokhwaOptions, Pacing, SourceOpener, VideoOptions,
        VideoReplay, folder_image_size,
    };
}

/// Graphics device.
pub mod gpu {
    pub use flyrig_gpu::{AdapterChoice, GpuContext, GpuError};
}

/// Formation of frame sets.
pub mod sync {
    pub use flyrig_sync::{ClockKind, SyncSettings, Synchronizer};
}

/// Frames, cameras, poses and masks.
pub mod types {
    pub use flyrig_types::{
        Camera, CameraId, Frame, FrameSet, Image, Intrinsics, Isometry, Lens, Mask, PersonId, PixelFormat, Pose,
        PoseTrack, RenderedView, Rig,
    };
}
