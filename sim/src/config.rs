//! Configuration of a simulation.

use std::path::PathBuf;

use flyrig_body::{ShapeParams, default_template};
use serde::{Deserialize, Serialize};

use crate::camera::calibration_error::CalibrationError;
use crate::camera::faults::FaultScript;
use crate::camera::optics::OpticsConfig;
use crate::camera::sensor::SensorConfig;
use crate::error::SimError;
use crate::error::check;
use crate::room::scene_config::{LightConfig, SceneConfig};

/// Simulated capture. A configuration gives the same bytes in every run on the same graphics adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// Seed of the person: body, face, hair, clothes and prints.
    pub seed: u64,
    /// Choices about the person that override the seed's.
    pub person: PersonConfig,
    /// Motion of the person.
    pub motion: MotionConfig,
    /// Placement of the cameras.
    pub cameras: RingConfig,
    /// Sensors of the cameras; camera `i` has the sensor of index `i` modulo their number. Without any, images are as
    /// rendered.
    pub sensors: Vec<SensorConfig>,
    /// Shutters and apertures of the cameras, assigned like `sensors`.
    pub optics: Vec<OpticsConfig>,
    /// Error of the calibration that [`crate::Simulator::reported_rig`] reports.
    pub calibration_error: CalibrationError,
    /// Surroundings of the person.
    pub scene: SceneConfig,
    /// Lamps; without any, the scene has its own.
    pub lights: Vec<LightConfig>,
    /// Faults of the cameras and their clocks.
    pub faults: FaultScript,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Frames per second of every camera.
    pub fps: f64,
    /// Frames of a source before its stream ends; endless when `None`.
    pub frames: Option<u64>,
    /// Side of each texture, pixels.
    pub texture_px: u32,
}

/// Build of a simulated body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Build {
    /// Chosen by the seed.
    #[default]
    BySeed,
    /// Slim woman.
    SlimWoman,
    /// Round woman.
    RoundWoman,
    /// Slim man.
    SlimMan,
    /// Broad, muscular man.
    BroadMan,
    /// Heavy man.
    HeavyMan,
}

/// Choices about the person.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PersonConfig {
    /// Body build.
    pub build: Build,
    /// Whether the body has finger joints, which make gestures. Poses then have 28 more joints.
    pub fingers: bool,
    /// Shape parameters of the body that replace the seed's; all others and the clothes, face and colours stay those of
    /// the seed.
    pub shape: ShapeParams,
}

/// Kind of motion. All but the clips from files are generated for the body, need no file, and are closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionKind {
    /// Stands still.
    Still,
    /// Turns around on the spot in small steps, shifts weight and moves the arms.
    #[default]
    Turn,
    /// Walks a circle around the centre, 0.8 m from it.
    Walk,
    /// Waves with the right hand.
    Wave,
    /// Squats twice.
    Squat,
    /// Reaches up high, then down to the floor.
    Reach,
    /// Sits down on a chair and gets up.
    Sit,
    /// Jumps on the spot.
    Jump,
    /// Crosses the arms and lets go.
    CrossArms,
    /// Dances a mixture of moves that depends on the seed.
    Dance,
    /// Lies down on the back, knees up, and gets up.
    Lie,
    /// The seed chooses one of the kinds above except lying down, its speed (0.5 to 1.5 times `motion.speed`) and its
    /// phase.
    BySeed,
    /// BVH clip.
    Bvh,
    /// First animation of a glTF file that moves.
    Gltf,
}

impl MotionKind {
    /// Generated motions by their names in a configuration.
    pub const CLIPS: [(&'static str, Self); 11] = [
        ("still", Self::Still),
        ("turn", Self::Turn),
        ("walk", Self::Walk),
        ("wave", Self::Wave),
        ("squat", Self::Squat),
        ("reach", Self::Reach),
        ("sit", Self::Sit),
        ("jump", Self::Jump),
        ("cross-arms", Self::CrossArms),
        ("dance", Self::Dance),
        ("lie", Self::Lie),
    ];
}

/// Motion of the person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionConfig {
    /// Kind of motion.
    pub kind: MotionKind,
    /// Speed: 1 is normal, 0 still. Walkers also take longer steps.
    pub speed: f64,
    /// Phase of the clip at the start, in 0..=1. Not for clips from files, see `start_secs`.
    pub phase: f64,
    /// Seconds of one full turn at speed 1.
    pub turn_secs: f64,
    /// BVH file; without one, walking subject 01_01 of Debian's `assimp-testmodels`.
    pub bvh: Option<PathBuf>,
    /// glTF file (`.glb`, `.gltf`) of a skinned human with an animation. Joints are found by the names of the usual rigs
    /// (Mixamo, VRM, SMPL, Unreal).
    pub gltf: Option<PathBuf>,
    /// Seconds of a clip from a file to skip.
    pub start_secs: f64,
    /// Largest distance of a clip from a file from the ring's centre, metres; one that goes farther takes shorter
    /// steps, so that the cameras keep seeing the person.
    pub reach_m: f64,
    /// Position of the person or centre of the motion, from the ring's centre (x, y), metres.
    pub at_m: [f64; 2],
}

/// Cameras on a ring around the person, all aimed at the same point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RingConfig {
    /// Number of cameras, evenly spaced; camera 0 sees the person's front at the start.
    pub count: usize,
    /// Distance from the centre, metres.
    pub radius_m: f64,
    /// Height of the cameras above the floor, metres.
    pub height_m: f64,
    /// Height of the point that all cameras are aimed at, metres.
    pub target_height_m: f64,
    /// Focal length as a multiple of the image height.
    pub focal_heights: f64,
    /// Radial distortion k1, k2 (OpenCV's).
    pub radial: [f64; 2],
    /// Coefficients k1 to k4 of an equidistant fisheye lens (OpenCV's), instead of `radial`.
    pub fisheye: Option<[f64; 4]>,
    /// Tangential distortion p1, p2 (OpenCV's), in addition to `radial`.
    pub tangential: [f64; 2],
    /// Largest displacement of each camera from its place on the ring, along each axis, metres.
    pub place_jitter_m: f64,
    /// Largest rotation of each camera from its aim, about each axis (roll included), degrees.
    pub aim_jitter_deg: f64,
    /// Largest deviation of each camera's focal length from the ring's, percent.
    pub focal_jitter_percent: f64,
}

impl Default for SimConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            person: PersonConfig::default(),
            motion: MotionConfig::default(),
            cameras: RingConfig::default(),
            sensors: Vec::new(),
            optics: Vec::new(),
            calibration_error: CalibrationError::default(),
            scene: SceneConfig::default(),
            lights: Vec::new(),
            faults: FaultScript::default(),
            width: 512,
            height: 512,
            fps: 30.0,
            frames: None,
            texture_px: 1024,
        }
    }
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self {
            kind: MotionKind::Turn,
            speed: 1.0,
            phase: 0.0,
            turn_secs: 10.0,
            bvh: None,
            gltf: None,
            start_secs: 0.0,
            reach_m: 0.5,
            at_m: [0.0; 2],
        }
    }
}

impl Default for RingConfig {
    fn default() -> Self {
        Self {
            count: 7,
            radius_m: 3.0,
            height_m: 1.5,
            target_height_m: 0.93,
            focal_heights: 1.36,
            radial: [-0.12, 0.03],
            fisheye: None,
            tangential: [0.0; 2],
            place_jitter_m: 0.0,
            aim_jitter_deg: 0.0,
            focal_jitter_percent: 0.0,
        }
    }
}

impl SimConfig {
    /// Validates every number.
    ///
    /// # Errors
    /// [`SimError::Config`] names the setting and its range.
    pub fn validate(&self) -> Result<(), SimError> {
        let (ring, motion) = (&self.cameras, &self.motion);
        check("width", self.width.into(), 16.0, 4096.0, "16 to 4096 pixels")?;
        check("height", self.height.into(), 16.0, 4096.0, "16 to 4096 pixels")?;
        check("fps", self.fps, 0.1, 1000.0, "0.1 to 1000 frames per second")?;
        check("texture_px", self.texture_px.into(), 64.0, 4096.0, "64 to 4096 pixels")?;
        check("cameras.count", ring.count as f64, 1.0, 128.0, "1 to 128 cameras")?;
        check("cameras.radius_m", ring.radius_m, 0.8, 6.0, "0.8 to 6 metres")?;
        check("cameras.height_m", ring.height_m, 0.1, 3.0, "0.1 to 3 metres")?;
        check("cameras.target_height_m", ring.target_height_m, 0.0, 3.0, "0 to 3 metres")?;
        check("cameras.focal_heights", ring.focal_heights, 0.2, 20.0, "0.2 to 20 image heights")?;
        for k in ring.radial {
            check("cameras.radial", k, -1.0, 1.0, "coefficients between -1 and 1")?;
        }
        for k in ring.fisheye.unwrap_or_default() {
            check("cameras.fisheye", k, -1.0, 1.0, "coefficients between -1 and 1")?;
        }
        for p in ring.tangential {
            check("cameras.tangential", p, -0.1, 0.1, "coefficients between -0.1 and 0.1")?;
        }
        check("cameras.place_jitter_m", ring.place_jitter_m, 0.0, 0.4, "0 to 0.4 metres")?;
        check("cameras.aim_jitter_deg", ring.aim_jitter_deg, 0.0, 45.0, "0 to 45 degrees")?;
        check("cameras.focal_jitter_percent", ring.focal_jitter_percent, 0.0, 50.0, "0 to 50 percent")?;
        if !self.person.shape.0.is_empty() {
            default_template(&self.person.shape).map_err(SimError::Shape)?;
        }
        self.optics.iter().try_for_each(OpticsConfig::validate)?;
        self.calibration_error.validate()?;
        self.scene.validate(ring.radius_m)?;
        LightConfig::validate_all(&self.lights)?;
        self.sensors.iter().try_for_each(SensorConfig::validate)?;
        self.faults.validate()?;
        self.faults.check_cameras(ring.count)?;
        check("motion.turn_secs", motion.turn_secs, 1.0, 600.0, "1 to 600 seconds")?;
        check("motion.speed", motion.speed, 0.0, 3.0, "0 to 3")?;
        check("motion.phase", motion.phase, 0.0, 1.0, "0 to 1 of the clip")?;
        check("motion.reach_m", motion.reach_m, 0.0, 100.0, "0 to 100 metres")?;
        for at_m in motion.at_m {
            check("motion.at_m", at_m, -20.0, 20.0, "-20 to 20 metres")?;
        }
        check("motion.start_secs", motion.start_secs, 0.0, 3600.0, "0 to 3600 seconds")
    }
}
