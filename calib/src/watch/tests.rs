//! Watch of a textured room with moving camera, lights and people.

use flyrig_types::{Camera, Isometry, Lens};

use super::*;
use crate::testing::Random;

const SIZE: [usize; 2] = [640, 360];

fn camera() -> Camera {
    Camera {
        id: "watched".into(),
        intrinsics: Intrinsics {
            width: SIZE[0] as u32,
            height: SIZE[1] as u32,
            focal_px: DVec2::splat(480.0),
            center_px: DVec2::new(318.0, 181.0),
            lens: Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [0.001, -0.001] },
        },
        camera_from_world: Isometry::look_at(DVec3::new(2.0, -1.5, 1.8), DVec3::new(-0.5, 0.5, 0.9), DVec3::Z),
        time_offset_nanos: 0,
        color: Default::default(),
    }
}

/// Returns a camera turned in its own axes (degrees) and shifted (millimetres).
fn bumped(camera: &Camera, degrees: DVec3, mm: DVec3) -> Camera {
    let turn = Isometry::new(exp_rotation(-degrees * std::f64::consts::PI / 180.0), -mm * 1e-3);
    Camera { camera_from_world: turn * camera.camera_from_world, ..camera.clone() }
}

fn hash(x: i64, y: i64, salt: i64) -> f64 {
    let mut h = (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B) ^ salt.wrapping_mul(0xC2B2_AE35)) as u64;
    h ^= h >> 15;
    h = h.wrapping_mul(0x2545_F491_4F6C_DD1D);
    ((h >> 40) & 0xffff) as f64 / 65535.0
}

/// Returns smooth noise with cells of `cell` metres.
fn noise(u: f64, v: f64, cell: f64, salt: i64) -> f64 {
    let (x, y) = (u / cell, v / cell);
    let (x0, y0) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (smooth(x - x0), smooth(y - y0));
    let at = |dx: i64, dy: i64| hash(x0 as i64 + dx, y0 as i64 + dy, salt);
    let row = |dy: i64| at(0, dy) + fx * (at(1, dy) - at(0, dy));
    row(0) + fy * (row(1) - row(0))
}

/// Lights, exposure and people of an image.
#[derive(Clone, Copy)]
struct Scene {
    gain: f64,
    /// Brightness of each of the six walls and floors, and a shadow's edge on the floor.
    lights: [f64; 6],
    shadow: f64,
    /// Position and half width of a person, pixels; none at 0.
    person: (f64, f64),
    noise: f64,
}

const CALM: Scene = Scene { gain: 1.0, lights: [1.0; 6], shadow: -9.0, person: (0.0, 0.0), noise: 2.0 };

/// Renders the inside of a box of 6 x 6 x 3 m with patterned walls.
fn draw(camera: &Camera, scene: &Scene, random: &mut Random) -> Vec<u8> {
    let world_from_camera = camera.camera_from_world.inverse();
    let eye = world_from_camera.translation;
    let (low, high) = (DVec3::new(-3.0, -3.0, 0.0), DVec3::new(3.0, 3.0, 3.0));
    let mut bytes = Vec::with_capacity(SIZE[0] * SIZE[1]);
    let i = &camera.intrinsics;
    for y in 0..SIZE[1] {
        for x in 0..SIZE[0] {
            // Distortion of first order is undone by one step: what counts is that all images are drawn alike.
            let distorted = (DVec2::new(x as f64, y as f64) - i.center_px) / i.focal_px;
            let mut ideal = distorted;
            for _ in 0..4 {
                ideal += distorted - i.lens.distort(ideal);
            }
            let ray = world_from_camera.rotation * ideal.extend(1.0);
            let mut nearest = (f64::INFINITY, 0usize);
            for axis in 0..3 {
                let wall = if ray[axis] > 0.0 { high[axis] } else { low[axis] };
                let t = (wall - eye[axis]) / ray[axis];
                if t > 0.0 && t < nearest.0 {
                    nearest = (t, 2 * axis + usize::from(ray[axis] > 0.0));
                }
            }
            let (t, wall) = nearest;
            let hit = eye + ray * t;
            let (u, v) = match wall / 2 {
                0 => (hit.y, hit.z),
                1 => (hit.x, hit.z),
                _ => (hit.x, hit.y),
            };
            let salt = wall as i64;
            let mut value = 40.0 + 90.0 * noise(u, v, 0.35, salt) + 60.0 * noise(u, v, 0.08, salt + 10);
            value *= scene.lights[wall];
            if wall == 4 && hit.x + 0.3 * hit.y < scene.shadow {
                value *= 0.5;
            }
            if (x as f64 - scene.person.0).abs() < scene.person.1 && y > 40 {
                value = 120.0 + 60.0 * noise(x as f64 - scene.person.0, y as f64, 9.0, 77);
            }
            bytes.push((value * scene.gain + scene.noise * random.normal()).clamp(0.0, 255.0) as u8);
        }
    }
    bytes
}

fn image(bytes: &[u8]) -> WatchedImage<'_> {
    WatchedImage { width: SIZE[0], height: SIZE[1], channels: 1, bytes }
}

#[test]
fn bumps_are_measured_and_small_ones_are_found() {
    let mut random = Random(1);
    let camera = camera();
    let reference = draw(&camera, &CALM, &mut random);
    for (degrees, mm) in [
        (DVec3::new(0.2, -0.2, 0.1), DVec3::ZERO),
        (DVec3::new(0.17, 0.25, 0.0), DVec3::new(3.0, -3.0, 3.0)),
        (DVec3::new(-1.5, 1.0, 0.8), DVec3::new(10.0, 5.0, 0.0)),
        (DVec3::new(0.0, 5.0, 0.0), DVec3::ZERO),
    ] {
        let mut watch = CameraWatch::new(&camera.intrinsics, &image(&reference)).unwrap();
        for _ in 0..3 {
            assert!(!matches!(watch.compare(&image(&draw(&camera, &CALM, &mut random))), WatchState::Moved(_)));
        }
        assert_eq!(watch.state(), WatchState::Steady);
        let moved = bumped(&camera, degrees, mm);
        let states: Vec<WatchState> =
            (0..CONFIRMATIONS).map(|_| watch.compare(&image(&draw(&moved, &CALM, &mut random)))).collect();
        assert!(states[..CONFIRMATIONS - 1].iter().all(|state| *state == WatchState::Steady), "{states:?}");
        let WatchState::Moved(found) = states[CONFIRMATIONS - 1] else { panic!("{degrees} {mm}: {states:?}") };
        let truth = degrees * std::f64::consts::PI / 180.0;
        let off = found.rotation.distance(truth) / truth.length();
        // A shift of the camera shows as rotation: parallax at 3 m.
        let allowed = 0.05 + 1.5 * mm.length() * 1e-3 / 3.0 / truth.length();
        assert!(off < allowed, "{degrees} {mm}: {found:?}, off by {off}");
        // Put back, it is steady again.
        for _ in 0..CONFIRMATIONS {
            watch.compare(&image(&draw(&camera, &CALM, &mut random)));
        }
        assert_eq!(watch.state(), WatchState::Steady);
    }
}

#[test]
fn lights_people_and_exposure_are_no_bump() {
    let mut random = Random(2);
    let camera = camera();
    let mut watch = CameraWatch::new(&camera.intrinsics, &image(&draw(&camera, &CALM, &mut random))).unwrap();
    let mut scene = CALM;
    let mut steady = 0;
    for look in 0..150 {
        // A switch every few seconds, people who walk and stand, an exposure that follows.
        if random.uniform() < 0.2 {
            scene.lights = std::array::from_fn(|_| random.between(0.3, 1.5));
            scene.shadow = random.between(-4.0, 4.0);
        }
        if random.uniform() < 0.1 {
            scene.gain = random.between(0.4, 1.6);
        }
        let width = if look % 50 < 30 { random.between(30.0, 140.0) } else { 0.0 };
        scene.person = ((look as f64 * 7.0) % 640.0, width);
        let state = watch.compare(&image(&draw(&camera, &scene, &mut random)));
        assert!(!matches!(state, WatchState::Moved(_)), "look {look}: {state:?}");
        steady += usize::from(state == WatchState::Steady);
    }
    assert!(steady > 100, "{steady} of 150 looks were steady");
    // In the middle of it all, a bump is found.
    let moved = bumped(&camera, DVec3::new(0.2, 0.22, 0.0), DVec3::new(3.0, 2.0, -3.0));
    scene.person = (200.0, 80.0);
    for _ in 0..8 {
        scene.lights = std::array::from_fn(|_| random.between(0.4, 1.4));
        watch.compare(&image(&draw(&moved, &scene, &mut random)));
    }
    assert!(matches!(watch.state(), WatchState::Moved(_)), "{:?}", watch.state());
}

#[test]
fn poisoned_and_blank_images_change_nothing() {
    let mut random = Random(3);
    let camera = camera();
    let reference = draw(&camera, &CALM, &mut random);
    let blank = vec![128; SIZE[0] * SIZE[1]];
    assert!(CameraWatch::new(&camera.intrinsics, &image(&blank)).is_none());
    assert!(CameraWatch::new(&camera.intrinsics, &image(&reference[1..])).is_none());
    let small = WatchedImage { width: 4, height: 4, channels: 1, bytes: &[0; 16] };
    assert!(CameraWatch::new(&camera.intrinsics, &small).is_none());
    let mut watch = CameraWatch::new(&camera.intrinsics, &image(&reference)).unwrap();
    for _ in 0..CONFIRMATIONS {
        watch.compare(&image(&reference));
    }
    let noise: Vec<u8> = blank.iter().map(|_| (256.0 * random.uniform()) as u8).collect();
    for _ in 0..5 {
        for bytes in [&blank, &noise, &vec![0; blank.len()], &vec![255; blank.len()]] {
            assert_eq!(watch.compare(&image(bytes)), WatchState::Steady);
        }
        assert_eq!(watch.compare(&small), WatchState::Steady);
    }
    // A lens whose numbers are no numbers projects nothing.
    let broken = Intrinsics { focal_px: DVec2::splat(f64::NAN), ..camera.intrinsics };
    if let Some(mut watch) = CameraWatch::new(&broken, &image(&reference)) {
        assert_eq!(watch.compare(&image(&reference)), WatchState::Unknown);
    }
}
