//! Which way is up: the person in the images tells, however the cameras hang.
#![allow(clippy::unwrap_used, clippy::float_cmp)] // a test may fail by panicking, in its helpers too

use std::path::Path;

use flyrig_calib::{load_calibration, save_easymocap};
use flyrig_tests::run;
use flyrig_types::{Camera, Lens, Rig};
use glam::{DQuat, DVec2};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

const SIM: &str = "width = 320\nheight = 320\ntexture_px = 256\nfps = 10.0\nframes = 3\n\
    [cameras]\ncount = 3\nradial = [0.0, 0.0]\ntangential = [0.0, 0.0]\n";

/// Returns a camera that was turned about its optical axis by quarter turns, so that its images turn clockwise.
fn turned(camera: &Camera, quarters: u32) -> Camera {
    let mut camera = camera.clone();
    for _ in 0..quarters {
        let (size, focal, center) = (camera.intrinsics.height, camera.intrinsics.focal_px, camera.intrinsics.center_px);
        camera.intrinsics.focal_px = DVec2::new(focal.y, focal.x);
        camera.intrinsics.center_px = DVec2::new(f64::from(size) - 1.0 - center.y, center.x);
        camera.intrinsics.height = camera.intrinsics.width;
        camera.intrinsics.width = size;
        let roll = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        camera.camera_from_world.rotation = roll * camera.camera_from_world.rotation;
        camera.camera_from_world.translation = roll * camera.camera_from_world.translation;
    }
    camera
}

/// Writes the take as cameras see it that hang on their side or upside down, with a calibration that does not state up.
fn write_turned(take: &Path, rig: &Rig, quarters: u32, out: &Path) {
    for camera in &rig.cameras {
        let (from, to) = (take.join("images").join(camera.id.as_str()), out.join("images").join(camera.id.as_str()));
        std::fs::create_dir_all(&to).unwrap();
        for entry in std::fs::read_dir(from).unwrap() {
            let path = entry.unwrap().path();
            let mut picture = image::open(&path).unwrap().into_rgb8();
            for _ in 0..quarters {
                picture = image::imageops::rotate90(&picture);
            }
            picture.save(to.join(path.file_name().unwrap())).unwrap();
        }
    }
    let cameras = rig.cameras.iter().map(|camera| turned(camera, quarters)).collect();
    save_easymocap(out, &Rig { cameras, world_up: rig.world_up }).unwrap();
}

#[test]
fn cameras_on_their_side_or_upside_down_find_up_by_the_person() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("sim.toml"), SIM).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let exported = command(&["sim", "export", "sim.toml", "--out", "take", "--frames", "3", "--no-truth"]);
    assert_eq!(exported.code, Some(0), "{exported:?}");
    let take = folder.path().join("take");
    let rig = load_calibration(&take, &|_| None).unwrap();
    let is_pinhole = |camera: &Camera| camera.intrinsics.lens == Lens::PINHOLE;
    assert!(rig.cameras.iter().all(is_pinhole), "turned() knows no other lens: {:?}", rig.cameras[0].intrinsics.lens);
    for quarters in [1, 2, 3] {
        let (name, out) = (format!("turned{quarters}"), format!("converted{quarters}"));
        write_turned(&take, &rig, quarters, &folder.path().join(&name));
        let converted = command(&["calibrate", "convert", &name, "--out", &out]);
        assert_eq!(converted.code, Some(0), "{converted:?}");
        let found = load_calibration(&folder.path().join(&out), &|_| None).unwrap();
        let off = found.world_up.angle_between(rig.world_up).to_degrees();
        assert!(off < 15.0, "{quarters} quarter turns: {off} degrees off\n{}", converted.stdout);
    }
    // A file that states the wrong direction is not believed in silence.
    let file = folder.path().join("converted2/calibration.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    let line = text.lines().find(|line| line.starts_with("up = ")).unwrap();
    let down = -rig.world_up;
    std::fs::write(&file, text.replace(line, &format!("up = {:?}", down.to_array()))).unwrap();
    let wrong = command(&["calibrate", "convert", "converted2", "--images", "turned2", "--out", "wrong"]);
    assert_eq!(wrong.code, Some(0), "{wrong:?}");
    assert!(wrong.stderr.contains("warning: the world is upside down: up is"), "{}", wrong.stderr);
    // Without images the cameras may be the ones that hang upside down.
    std::fs::write(folder.path().join("converted1/calibration.toml"), std::fs::read_to_string(&file).unwrap()).unwrap();
    let alone = command(&["calibrate", "convert", "converted1", "--out", "alone"]);
    assert!(!alone.stderr.contains("upside down"), "the images are upside down, as the file says: {}", alone.stderr);
}
