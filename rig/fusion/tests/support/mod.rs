//! Small scene for sessions: cameras on a circle, still people with the built-in body, painted silhouettes.
#![allow(dead_code, clippy::unwrap_used)] // each test uses a part; a test may fail by panicking

use std::{
    sync::{Arc, OnceLock},
    time::Duration,
};

use flyrig_body::{ShapeParams, Template, default_template};
use flyrig_capture::{CameraSource, CaptureError, CaptureErrorKind};
use flyrig_fusion::{BodySettings, GivenPerception, GivenPerson, Session, SessionBuilder, SessionSettings};
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_types::{
    Camera, CameraId, Frame, FrameSet, Image, Intrinsics, Isometry, Lens, Mask, PersonId, PixelFormat, Pose, PoseTrack,
    Rig,
};
use glam::{DVec2, DVec3};

pub const SIZE: u32 = 96;
pub const PERIOD_NANOS: i64 = 33_333_333;

pub fn gpu() -> GpuContext {
    static GPU: OnceLock<GpuContext> = OnceLock::new();
    GPU.get_or_init(|| GpuContext::new(&AdapterChoice::Best).unwrap()).clone()
}

pub fn camera(name: &str, degrees: f64) -> Camera {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let middle = DVec3::new(0.0, 0.85, 0.0);
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics: Intrinsics {
            width: SIZE,
            height: SIZE,
            focal_px: DVec2::splat(1.2 * f64::from(SIZE)),
            center_px: DVec2::splat(0.5 * f64::from(SIZE) - 0.5),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::look_at(middle + DVec3::new(sin, 0.2, cos) * 3.4, middle, DVec3::Y),
    }
}

pub fn rig() -> Rig {
    let cameras = [0.0, 90.0, 180.0, 270.0].map(|degrees| camera(&format!("{degrees}"), degrees));
    Rig { cameras: cameras.into(), world_up: DVec3::Y }
}

pub fn template() -> Template {
    default_template(&ShapeParams::default()).unwrap()
}

/// Returns the rest pose, `x` metres to the right of the first camera's middle.
pub fn pose(x: f64) -> Pose {
    let mut pose = template().skeleton.rest_pose();
    pose.root_translation.x += x;
    pose
}

/// Returns people who stand at these positions, metres.
pub fn people(rig: &Rig, at: &[(u32, f64)]) -> GivenPerception {
    let person = |&(person, x): &(u32, f64)| GivenPerson {
        person: PersonId(person),
        template: template(),
        track: PoseTrack::new(vec![(0, pose(x)), (1_000_000_000, pose(x))]).unwrap(),
        repeat: true,
    };
    GivenPerception::new(rig, at.iter().map(person).collect())
}

pub fn settings(gaussians: usize) -> SessionSettings {
    SessionSettings { body: BodySettings::with_gaussians(gaussians), ..SessionSettings::default() }
}

pub fn session(gpu: GpuContext, at: &[(u32, f64)]) -> Session {
    let rig = rig();
    let people = people(&rig, at);
    SessionBuilder::new(gpu, rig).settings(settings(3000)).perception(people).build().unwrap()
}

/// Returns a frame set of these images and masks, one per slot.
pub fn frame_set(index: u64, images: &[(Vec<u8>, Vec<u8>)]) -> FrameSet {
    let nanos = index as i64 * PERIOD_NANOS;
    let frame = |(camera, (rgb, mask)): (&Camera, &(Vec<u8>, Vec<u8>))| {
        Some(Arc::new(Frame {
            camera: camera.id.clone(),
            sequence: index,
            capture_nanos: nanos,
            exposure_nanos: None,
            image: Image::new(SIZE, SIZE, PixelFormat::Rgb8, rgb.clone()).unwrap(),
            mask: Some(Mask::new(SIZE, SIZE, mask.clone()).unwrap()),
        }))
    };
    FrameSet { index, master_nanos: nanos, frames: rig().cameras.iter().zip(images).map(frame).collect() }
}

/// Renders the coverage of one person at a position, one element per camera.
pub fn silhouettes(x: f64) -> Vec<Vec<u8>> {
    let mut session = session(gpu(), &[(0, x)]);
    // Without any mask the person is posed only.
    let nothing = (vec![0; (SIZE * SIZE * 3) as usize], vec![0; (SIZE * SIZE) as usize]);
    session.process(&frame_set(0, &vec![nothing; 4])).unwrap();
    let views = rig().cameras.into_iter().map(|camera| session.render(&camera).unwrap().rgba);
    views.map(|rgba| rgba.chunks_exact(4).map(|p| p[3]).collect()).collect()
}

/// Renders images of people at these positions in these colours, nearer ones hiding farther ones, with the mask of all people.
pub fn images(people: &[(f64, [u8; 3])]) -> Vec<(Vec<u8>, Vec<u8>)> {
    let all: Vec<(f64, [u8; 3], Vec<Vec<u8>>)> = people.iter().map(|&(x, c)| (x, c, silhouettes(x))).collect();
    let of = |(slot, camera): (usize, &Camera)| {
        let mut far_first: Vec<_> = all.iter().collect();
        let distance = |x: f64| camera.position().distance(DVec3::new(x, 0.85, 0.0));
        far_first.sort_by(|a, b| distance(b.0).total_cmp(&distance(a.0)));
        let (mut rgb, mut mask) = (vec![90; (SIZE * SIZE * 3) as usize], vec![0; (SIZE * SIZE) as usize]);
        for (_, color, silhouettes) in far_first {
            for (i, &alpha) in silhouettes[slot].iter().enumerate().filter(|(_, alpha)| **alpha > 0) {
                rgb[3 * i..3 * i + 3].copy_from_slice(color);
                mask[i] = alpha.max(mask[i]);
            }
        }
        (rgb, mask)
    };
    rig().cameras.iter().enumerate().map(of).collect()
}

/// Source that plays the frames of one slot.
struct Played {
    camera: CameraId,
    frames: std::vec::IntoIter<Frame>,
}

impl CameraSource for Played {
    fn camera(&self) -> &CameraId {
        &self.camera
    }

    fn next_frame(&mut self, _: Duration) -> Result<Frame, CaptureError> {
        let end = || CaptureError::new(&self.camera, CaptureErrorKind::EndOfStream, "played through");
        self.frames.next().ok_or_else(end)
    }
}

/// Returns cameras that play frame sets.
pub fn played(sets: &[FrameSet]) -> Vec<Box<dyn CameraSource>> {
    let source = |slot: usize| {
        let copy = |set: &FrameSet| {
            let frame = set.frames[slot].as_ref().unwrap();
            let (image, mask) = (&frame.image, frame.mask.as_ref().unwrap());
            let (width, height) = (image.width(), image.height());
            Frame {
                camera: frame.camera.clone(),
                sequence: frame.sequence,
                capture_nanos: frame.capture_nanos,
                exposure_nanos: None,
                image: Image::new(width, height, image.format(), image.bytes().to_vec()).unwrap(),
                mask: Some(Mask::new(width, height, mask.coverage().to_vec()).unwrap()),
            }
        };
        let frames: Vec<Frame> = sets.iter().map(copy).collect();
        Box::new(Played { camera: frames[0].camera.clone(), frames: frames.into_iter() }) as Box<dyn CameraSource>
    };
    (0..4).map(source).collect()
}
