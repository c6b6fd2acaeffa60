//! Embeds flyrig in another program: images with timestamps in, Gaussians and a view out; no network, files or command line.
//!
//!     cargo run --release -p flyrig-fusion --example embed

use std::error::Error;

use flyrig_fusion::{
    BodySettings, GivenPerception, PersonId, SessionBuilder, SessionSettings, Splat,
    body::{ShapeParams, default_template},
    glam::{DVec2, DVec3},
    gpu::{AdapterChoice, GpuContext},
    sync::{SyncSettings, Synchronizer},
    types::{
        Camera, CameraId, Frame, Image, Intrinsics, Isometry, Lens, Mask, PixelFormat, PoseTrack, RenderedView, Rig,
    },
};

const SIZE: u32 = 160;

/// Returns a calibrated camera on a circle of 3 m around the person; the world is y up here.
fn camera(name: &str, degrees: f64) -> Camera {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let middle = DVec3::new(0.0, 0.85, 0.0);
    let (focal_px, center_px) = (DVec2::splat(210.0), DVec2::splat(0.5 * f64::from(SIZE) - 0.5));
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics: Intrinsics { width: SIZE, height: SIZE, focal_px, center_px, lens: Lens::PINHOLE },
        camera_from_world: Isometry::look_at(middle + DVec3::new(sin, 0.2, cos) * 3.0, middle, DVec3::Y),
    }
}

/// Reconstructs a person from three cameras; returns the person's Gaussians and a view from a fourth side.
///
/// # Errors
/// When the adapter, the calibration or an image cannot be used.
pub fn run() -> Result<(Vec<Splat>, RenderedView), Box<dyn Error>> {
    let rig = Rig { cameras: vec![camera("a", 0.0), camera("b", 120.0), camera("c", 240.0)], world_up: DVec3::Y };
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();

    // The pose is known here: the built-in body stands still. `EstimatedPerception` finds pose and masks in the images.
    let template = default_template(&ShapeParams::default())?;
    let track =
        PoseTrack::new(vec![(0, template.skeleton.rest_pose()), (1_000_000_000, template.skeleton.rest_pose())])?;
    let settings = SessionSettings { body: BodySettings::with_gaussians(12_000), ..SessionSettings::default() };
    let mut session = SessionBuilder::new(GpuContext::fastest_of(&AdapterChoice::Best)?, rig.clone())
        .settings(settings)
        .perception(GivenPerception::repeating(&rig, template, track))
        .build()?;

    let mut sync = Synchronizer::new(&ids, &SyncSettings::default());
    for number in 0..4u64 {
        for camera in &rig.cameras {
            // In place of a camera's driver: the silhouette of the untouched body, the image red on the left.
            let silhouette = session.render(camera)?.rgba.chunks_exact(4).map(|p| p[3]).collect();
            let red_left = |i: u32| if i % SIZE < SIZE / 2 { [200, 40, 40] } else { [40, 60, 180] };
            let rgb: Vec<u8> = (0..SIZE * SIZE).flat_map(red_left).collect();
            let frame = Frame {
                camera: camera.id.clone(),
                sequence: number,
                capture_nanos: number as i64 * 33_333_333,
                exposure_nanos: None,
                image: Image::new(SIZE, SIZE, PixelFormat::Rgb8, rgb)?,
                mask: Some(Mask::new(SIZE, SIZE, silhouette)?),
            };
            // Frames of one instant come out as a frame set, in any order in which the cameras deliver them.
            for set in sync.push(frame) {
                println!("frame set {}: {:?}", set.index, session.process(&set)?);
            }
        }
    }
    Ok((session.splats(PersonId::default())?, session.render(&camera("mine", 30.0))?))
}

fn main() -> Result<(), Box<dyn Error>> {
    let (splats, view) = run()?;
    let covered = view.rgba.chunks_exact(4).filter(|p| p[3] > 127).count();
    println!("{} Gaussians; {covered} of {} pixels of the view show the person", splats.len(), SIZE * SIZE);
    Ok(())
}
