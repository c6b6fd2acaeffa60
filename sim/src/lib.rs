//! Synthetic people in front of synthetic cameras, with the truth about every pixel.
//!
//! A seed makes a person: body, face, hair, hat, layered clothes, cloth and shoes. The person moves by a clip
//! or turns around on the spot, stands in a lit room, and is seen by a ring of cameras with radial distortion or
//! fisheye lenses, whose sensors and clocks have the configured errors. Images are made by an ordinary textured-triangle
//! rasteriser with a z-buffer; this crate knows nothing of splats, so that no method is judged on its own drawings.
//!
//! # Conventions
//!
//! - **World**: z up, the floor is z = 0, metres. At the start the person faces -y, towards camera 0.
//! - **Clock**: nanoseconds from the start of the simulation; frame `i` is taken at exactly
//!   `i * 1e9 / fps`, rounded down ([`Simulator::frame_nanos`]), by all cameras at once.

mod actor;
mod calibration_error;
mod capsules;
mod cast;
mod clips;
mod clock;
mod cloth;
mod collars;
mod config;
mod constants;
mod curve;
mod cuts;
mod describe;
mod draw;
mod error;
mod export;
mod fabric;
mod face;
mod faults;
mod features;
mod figure;
mod fingers;
mod frame;
mod furniture;
mod garments;
mod glyphs;
mod gpu_parts;
mod hair;
mod hanging;
mod hats;
mod lamps;
mod lift;
mod look;
mod loose;
mod motion;
mod noise;
mod optics;
mod palette;
mod passer;
mod person;
mod plates;
mod posture;
mod prints;
mod puppet;
mod regions;
mod ring;
mod rooms;
mod scene;
mod scene_config;
mod scene_mesh;
mod sensor;
mod sheet;
mod shoes;
mod shot;
mod simulator;
mod source;
mod steps;
mod straps;
mod surfaces;
mod texture;
mod training;
mod truth_file;
mod wardrobe;

pub use calibration_error::CalibrationError;
pub use clock::SimTime;
pub use config::{Build, MotionConfig, MotionKind, PersonConfig, RingConfig, SimConfig};
pub use describe::{describe_person, person_fingerprint};
pub use error::SimError;
pub use export::{ExportOptions, Exported, export};
pub use faults::{Delivery, Fault, FaultKind, FaultScript, FramePlan};
pub use frame::{SimFrame, SurfaceMesh};
pub use motion::find_debian_clip;
pub use optics::OpticsConfig;
pub use ring::camera_ring;
pub use scene_config::{LightConfig, LightSwitch, SceneConfig, SceneKind};
pub use sensor::SensorConfig;
pub use shot::Shot;
pub use simulator::Simulator;
pub use source::{SimSource, sources};
pub use training::{SimSample, TrainingConfig, TrainingSamples, random_config};
