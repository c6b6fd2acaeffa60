//! Synthetic people in front of synthetic cameras, with ground truth for every pixel.
//!
//! A seed determines a person: body, face, hair, hat, layered clothes, cloth and shoes. The person moves by a clip or
//! turns around on the spot, stands in a lit room, and is seen by a ring of cameras with radial distortion or fisheye
//! lenses, whose sensors and clocks have the configured errors. Images come from an ordinary textured-triangle
//! rasteriser with a z-buffer; this crate shares no drawing code with the splat renderer, so that no method is judged
//! by its own rendering.
//!
//! # Conventions
//!
//! - **World**: z up, the floor is z = 0, metres. At the start the person faces -y, towards camera 0.
//! - **Clock**: nanoseconds from the start of the simulation; frame `i` is taken at exactly
//!   `i * 1e9 / fps`, rounded down ([`Simulator::frame_nanos`]), by all cameras at once.
//!
//! # Example
//!
//! The cameras of a configuration, without rendering:
//!
//! ```
//! use flyrig_sim::{SimConfig, camera_ring};
//!
//! let config: SimConfig = toml::from_str(
//!     "seed = 7
//!      [cameras]
//!      count = 6
//!      [motion]
//!      kind = \"walk\"",
//! )?;
//! let rig = camera_ring(&config)?;
//! assert_eq!(rig.cameras.len(), 6);
//! assert!(rig.cameras[0].position().y < 0.0, "camera 00 sees the person's front");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Images and their ground truth:
//!
//! ```no_run
//! use flyrig_gpu::{AdapterChoice, GpuContext};
//! use flyrig_sim::{SimConfig, Simulator};
//!
//! let gpu = GpuContext::new(&AdapterChoice::Best)?;
//! let mut simulator = Simulator::new(&gpu, &SimConfig::default())?;
//! let frame = simulator.render(simulator.frame_nanos(30), 0)?;
//! println!("{} pixels of the person, pose at {} ns", frame.mask.area_px(), frame.nanos);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod camera;
mod cloth;
mod clothes;
mod config;
mod draw;
mod error;
mod files;
mod motion;
mod noise;
mod person;
mod room;
mod simulator;
mod texture;

pub use camera::calibration_error::CalibrationError;
pub use camera::clock::SimTime;
pub use camera::faults::{Delivery, Fault, FaultKind, FaultScript, FramePlan};
pub use camera::frame::{SimFrame, SurfaceMesh};
pub use camera::optics::OpticsConfig;
pub use camera::ring::camera_ring;
pub use camera::sensor::SensorConfig;
pub use camera::shot::Shot;
pub use camera::source::{SimSource, sources};
pub use config::{Build, MotionConfig, MotionKind, PersonConfig, RingConfig, SimConfig};
pub use error::SimError;
pub use files::export::{ExportOptions, Exported, export};
pub use files::training::{SimSample, TrainingConfig, TrainingSamples, random_config};
pub use motion::choice::{clip_motion, find_debian_clip};
pub use person::describe::describe_person;
pub use room::scene_config::{LightConfig, LightSwitch, SceneConfig, SceneKind};
pub use simulator::Simulator;
