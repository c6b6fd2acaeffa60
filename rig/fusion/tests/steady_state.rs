//! A running session creates no GPU objects, and compiles nothing once it is built.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use std::sync::Arc;

use flyrig_body::{GpuSkinner, ShapeParams, SurfaceGaussians, Template, default_template, sample_surface};
use flyrig_fusion::{
    BodySettings, DeformOptions, FrameSet, GivenPerception, Outcome, PersonId, Session, SessionBuilder,
    SessionSettings, TrackingSettings,
};
use flyrig_gpu::{GpuContext, testing::device};
use flyrig_renderer::{GaussianBuffers, Outputs, RasterSettings, Rasterizer, RenderTarget, rgba8_from_target};
use flyrig_types::{Camera, Frame, Image, Intrinsics, Isometry, Mask, PixelFormat, Pose, PoseTrack, Rig};
use glam::DVec3;

const FRAME_NANOS: i64 = 33_000_000;
const SIDE: u32 = 128;

/// Returns a camera that looks at the middle of the body at the origin, from 3 m away.
fn camera(azimuth: f64, side: u32) -> Camera {
    let middle = DVec3::new(0.0, 0.9, 0.0);
    let eye = middle + DVec3::new(azimuth.sin(), 0.15, azimuth.cos()) * 3.0;
    let intrinsics = Intrinsics::pinhole(side, side, 1.2 * f64::from(side));
    Camera::new(format!("{azimuth}"), intrinsics, Isometry::look_at(eye, middle, DVec3::Y))
}

/// Person who sways and is displaced by `shift`, rendered on a device of its own.
struct Scene {
    gpu: GpuContext,
    template: Template,
    surface: SurfaceGaussians,
    rig: Rig,
    shift: fn(f64) -> DVec3,
}

impl Scene {
    fn new(azimuths: &[f64], shift: fn(f64) -> DVec3) -> Self {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 4000, 2).unwrap();
        let cameras = azimuths.iter().map(|&azimuth| camera(azimuth, SIDE)).collect();
        let gpu = device();
        Self { gpu, template, surface, rig: Rig { cameras, world_up: DVec3::Y }, shift }
    }

    fn pose(&self, frame: f64) -> Pose {
        let mut pose = self.template.skeleton.rest_pose();
        pose.root_translation += (self.shift)(frame) + DVec3::new(0.02 * (0.4 * frame).sin(), 0.0, 0.0);
        pose
    }

    fn session(&self, gpu: &GpuContext, frames: usize) -> Session {
        let keys = (0..frames + 2).map(|frame| (frame as i64 * FRAME_NANOS, self.pose(frame as f64))).collect();
        let track = PoseTrack::new(keys).unwrap();
        let tracking = TrackingSettings::default();
        let mut options: DeformOptions = tracking.options().unwrap();
        options.max_level = 1;
        options.solver.rest = 0.0;
        let settings = SessionSettings {
            body: BodySettings { gaussians: 3000, nodes: 60, ..BodySettings::default() },
            tracking: TrackingSettings { replaced: Some(options), ..tracking },
            ..SessionSettings::default()
        };
        let perception = GivenPerception::repeating(&self.rig, self.template.clone(), track);
        SessionBuilder::new(gpu.clone(), self.rig.clone()).settings(settings).perception(perception).build().unwrap()
    }

    /// Returns one frame set: each camera exposes a quarter of a frame after the one before it.
    fn set(&self, frame: usize) -> FrameSet {
        let gpu = &self.gpu;
        let count = self.surface.len();
        let gaussians = GaussianBuffers::zeroed(gpu, count).unwrap();
        let color: Vec<[f32; 4]> = self.surface.positions.iter().map(|p| [p.y.fract().abs(), 0.4, 0.2, 1.0]).collect();
        gaussians.color.write(gpu, &color);
        let skinner = GpuSkinner::new(gpu, &self.surface, &self.template.skeleton).unwrap();
        let mut rasterizer = Rasterizer::new(gpu, count).unwrap();
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let draw = |(slot, camera): (usize, &Camera)| {
            let pose = self.pose(frame as f64 + 0.25 * slot as f64);
            let target = RenderTarget::of_color(gpu, SIDE, SIDE).unwrap();
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let (centers, normals) = (&gaussians.center_scale, &gaussians.normal);
            skinner.encode(gpu, &mut encoder, &self.template.skeleton, &pose, None, centers, normals).unwrap();
            rasterizer.encode(gpu, &mut encoder, &gaussians, camera, &settings, &target).unwrap();
            gpu.queue.submit([encoder.finish()]);
            let rgba = rgba8_from_target(&target.color.read(gpu).unwrap());
            let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
            let coverage: Vec<u8> = rgba.chunks_exact(4).map(|p| p[3]).collect();
            Some(Arc::new(Frame {
                camera: camera.id.clone(),
                sequence: frame as u64,
                capture_nanos: frame as i64 * FRAME_NANOS + slot as i64 * FRAME_NANOS / 4,
                exposure_nanos: None,
                image: Image::new(SIDE, SIDE, PixelFormat::Rgb8, rgb).unwrap(),
                mask: Some(Mask::new(SIDE, SIDE, coverage).unwrap()),
            }))
        };
        let frames = self.rig.cameras.iter().enumerate().map(draw).collect();
        FrameSet { index: frame as u64, master_nanos: frame as i64 * FRAME_NANOS, frames }
    }
}

fn step(session: &mut Session, set: &FrameSet) {
    assert_eq!(session.process(set).unwrap(), Outcome::Updated);
    assert!(!session.render(&camera(0.7, 200)).unwrap().rgba.is_empty());
    assert!(!session.splats(PersonId::default()).unwrap().is_empty());
}

#[test]
fn twenty_frames_create_no_gpu_object() {
    const WARM_UP: usize = 8;
    const FRAMES: usize = 20;
    let scene = Scene::new(&[0.1, 2.2, 4.4], |_| DVec3::ZERO);
    let gpu = device();
    let mut session = scene.session(&gpu, WARM_UP + FRAMES);
    let built = gpu.objects();
    for frame in 0..WARM_UP {
        step(&mut session, &scene.set(frame));
    }
    let warm = gpu.objects();
    println!("built {built:?}\nwarm {warm:?}");
    let mut solved = 0;
    for frame in WARM_UP..WARM_UP + FRAMES {
        step(&mut session, &scene.set(frame));
        assert_eq!(gpu.objects(), warm, "frame {frame}");
        solved += session.subjects()[0].deform_report().map_or(0, |report| report.accepted);
    }
    assert!(solved > 0, "the frames had something to solve");
    assert_eq!(warm.pipelines, built.pipelines, "everything is compiled when the session is built");
}

#[test]
fn a_person_who_walks_closer_compiles_nothing() {
    // From 5.5 m to 2 m before the cameras, and back.
    let walk = |frame: f64| DVec3::new(0.0, 0.0, -2.5 + 3.5 * (0.5 - 0.5 * (frame * 0.5).cos()));
    let scene = Scene::new(&[0.0, 0.3], walk);
    let gpu = device();
    let mut session = scene.session(&gpu, 26);
    let built = gpu.objects();
    let mut halved = Vec::new();
    for frame in 0..26 {
        step(&mut session, &scene.set(frame));
        halved.push(session.stages.counts().find(|(name, _)| *name == "images halved").map_or(0, |(_, count)| count));
        assert_eq!(gpu.objects().pipelines, built.pipelines, "frame {frame}");
    }
    let by_frame: Vec<u64> = halved.iter().zip(std::iter::once(&0).chain(&halved)).map(|(a, b)| a - b).collect();
    println!("images halved by frame: {by_frame:?}");
    let changes = by_frame.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!(changes >= 4, "closer, away, closer and away: {by_frame:?}");
}
