//! Normals and plane depths of anisotropic Gaussians: against the f64 reference, and on surfaces that are known.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{HarmonicOrder, Outputs, PixelPlane, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3, Quat, Vec3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{Ellipsoids, poison, random_ellipsoids};
use support::planes::{Drawn, PlanePictures, draw};
use support::random_scene::{LENSES, random_camera, random_scene, straight};

/// As in `raster.rs`.
const MAX_ERROR: f64 = 1.0 / 255.0 + 1e-3;
const MEAN_ERROR: f64 = 2e-5;

fn settings(outputs: Outputs) -> RasterSettings {
    RasterSettings { outputs, ..RasterSettings::default() }
}

fn draw_planes(gpu: &GpuContext, scene: &Ellipsoids, camera: &Camera) -> PlanePictures {
    draw(gpu, &mut Rasterizer::new(gpu, 0).unwrap(), scene, camera, &settings(Outputs::PLANES)).unwrap()
}

/// Compares with the reference; returns the largest and the mean error of normals and depths.
fn check(gpu: &GpuContext, name: &str, rasterizer: &mut Rasterizer, scene: &Ellipsoids, camera: &Camera) -> [f64; 2] {
    let settings = settings(Outputs::PLANES);
    let ours = draw(gpu, rasterizer, scene, camera, &settings).unwrap();
    assert!(ours.planes.iter().flatten().all(|v| v.is_finite()), "{name}: not finite");
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    let drawn = Drawn::new(scene, camera, &settings, size);
    let (mut most, mut mean) = (0.0f64, 0.0);
    for (at, found) in ours.planes.iter().enumerate() {
        let (_, expected) = drawn.pixel(at, None);
        let off = found.iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
        mean += off / ours.planes.len() as f64;
        most = most.max(off);
    }
    println!("{name:44} max {most:.1e} mean {mean:.1e}");
    // Depths reach 4 m.
    assert!(most < 4.0 * MAX_ERROR && mean < 4.0 * MEAN_ERROR, "{name}: {most} {mean}");
    [most, mean]
}

#[test]
fn random_scenes_agree_with_the_reference_for_every_lens() {
    on_both(|gpu| {
        let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let mut all = Vec::new();
        for (round, lens) in LENSES.into_iter().cycle().take(20).enumerate() {
            let count = rng.random_range(1..700);
            let mut scene = random_ellipsoids(&mut rng, count, HarmonicOrder::ALL[round % 3]);
            if round % 2 == 1 {
                poison(&mut rng, &mut scene);
            }
            let (width, height) = (rng.random_range(1..140), rng.random_range(1..90));
            let camera = random_camera(&mut rng, lens, width, height);
            all.push(check(gpu, &format!("{width}x{height} n {count}"), &mut rasterizer, &scene, &camera));
        }
        let mean = all.iter().map(|[_, mean]| mean).sum::<f64>() / all.len() as f64;
        let most = all.iter().map(|[most, _]| *most).fold(0.0, f64::max);
        println!("{} scenes on {}: mean error {mean:.1e}, largest {most:.1e}", all.len(), gpu.adapter_name());
    });
}

#[test]
fn hard_cases_agree_with_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(2);
        let mut rasterizer = Rasterizer::new(gpu, 0).unwrap();
        let camera = straight(Lens::PINHOLE, 70, 50);
        let scene = random_ellipsoids(&mut rng, 300, HarmonicOrder::Two);
        let mut check = |name: &str, change: &dyn Fn(usize, &mut Ellipsoids)| {
            let mut other = scene.clone();
            (0..other.count()).for_each(|i| change(i, &mut other));
            check(gpu, name, &mut rasterizer, &other, &camera);
        };
        check("zero scales", &|i, s| s.scale_opacity[i][i % 3] = 0.0);
        check("equal scales", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1; 3]));
        check("two equal scales", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.05, 0.05]));
        check("zero quaternions", &|i, s| s.rotation[i] = [0.0; 4]);
        check("quaternions that are no numbers", &|i, s| s.rotation[i][i % 4] = f32::NAN);
        check("zero opacities", &|i, s| s.scale_opacity[i][3] = 0.0);
        check("behind the camera", &|i, s| s.center[i][2] = -5.0);
        check("on the camera's plane", &|i, s| s.center[i][2] = [-2.0, -2.1, -1.951][i % 3]);
        check("in one place", &|i, s| s.center[i] = [0.1, -0.05, 0.3, 0.0]);
        check("needles", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.3, 0.002, 0.001]));
        check("discs", &|i, s| s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.1, 1e-6]));
        check("as deep as their distance", &|i, s| s.scale_opacity[i] = [3.0, 2.0, 1.0, 0.3]);
        check("edge-on", &|i, s| {
            s.rotation[i] = [0.0, 0.5f32.sqrt(), 0.0, 0.5f32.sqrt()];
            s.scale_opacity[i][..3].copy_from_slice(&[0.1, 0.09, 0.01]);
        });
        let none = random_ellipsoids(&mut rng, 0, HarmonicOrder::Two);
        let empty = draw(gpu, &mut rasterizer, &none, &camera, &settings(Outputs::PLANES)).unwrap();
        assert!(empty.planes.iter().flatten().all(|v| v.abs() <= 0.0), "nothing is drawn without Gaussians");
    });
}

#[test]
fn the_first_of_equal_scales_has_the_normal_which_faces_the_camera() {
    on_both(|gpu| {
        let mut scene = random_ellipsoids(&mut StdRng::seed_from_u64(3), 1, HarmonicOrder::Zero);
        scene.center[0] = [0.0; 4];
        scene.scale_opacity[0] = [0.5, 0.5, 0.5, 0.9];
        let camera = straight(Lens::PINHOLE, 9, 9);
        let tilt = Quat::from_rotation_y(-0.3);
        // The first axis along z and against it, then another one.
        for turn in [Quat::from_rotation_y(1.5), Quat::from_rotation_y(-1.5), Quat::from_rotation_z(1.5)] {
            let turn = tilt * turn;
            scene.rotation[0] = turn.to_array();
            let axis = turn * Vec3::X;
            let expected = if axis.z > 0.0 { -axis } else { axis };
            let ours = draw_planes(gpu, &scene, &camera);
            let seen = PixelPlane::new(ours.planes[4 * 9 + 4], ours.color[4 * 9 + 4][3], 0.5).unwrap();
            assert!(Vec3::from(seen.normal).distance(expected) < 1e-5, "{seen:?}, not {expected}");
        }
    });
}

/// Flat Gaussians of a surface, at points with normals; the third axis is the thin one.
fn flat(surface: &[(DVec3, DVec3)], scale: f32, thickness: f32) -> Ellipsoids {
    let mut rng = StdRng::seed_from_u64(4);
    let mut scene = random_ellipsoids(&mut rng, surface.len(), HarmonicOrder::Zero);
    for (i, (point, normal)) in surface.iter().enumerate() {
        let spin = DQuat::from_rotation_z(rng.random_range(0.0..6.0));
        scene.center[i] = point.as_vec3().extend(0.0).to_array();
        scene.scale_opacity[i] = [scale, scale, thickness, 0.95];
        scene.rotation[i] = (DQuat::from_rotation_arc(DVec3::Z, *normal) * spin).as_quat().to_array();
    }
    scene
}

fn pinhole(size: u32) -> Camera {
    Camera {
        id: "front".into(),
        intrinsics: Intrinsics::pinhole(size, size, f64::from(size)),
        camera_from_world: Isometry::new(DQuat::IDENTITY, DVec3::new(0.0, 0.0, 2.0)),
        time_offset_nanos: 0,
        color: Default::default(),
    }
}

/// The ray of a pixel, z = 1.
fn ray(camera: &Camera, at: usize) -> DVec3 {
    let i = &camera.intrinsics;
    let pixel = DVec2::new((at % i.width as usize) as f64, (at / i.width as usize) as f64);
    ((pixel - i.center_px) / i.focal_px).extend(1.0)
}

#[test]
fn a_tilted_wall_has_its_depth_where_that_of_the_centres_is_off() {
    on_both(|gpu| {
        let (scale, camera) = (0.04, pinhole(128));
        let tilt = DQuat::from_rotation_y(60f64.to_radians());
        let normal = tilt * DVec3::Z;
        let grid = (-25..=25).flat_map(|x| (-25..=25).map(move |y| DVec3::new(f64::from(x), f64::from(y), 0.0)));
        let points: Vec<_> = grid.map(|p| (tilt * p * 0.05, normal)).collect();
        let scene = flat(&points, scale, 0.1 * scale);
        let outputs = Outputs { depth: true, ..Outputs::PLANES };
        let ours = draw(gpu, &mut Rasterizer::new(gpu, 0).unwrap(), &scene, &camera, &settings(outputs)).unwrap();
        let (mut by_plane, mut by_center, mut worst, mut seen) = (0.0, 0.0, 0.0f64, 0.0);
        let mut angle = 0.0f64;
        for (at, sums) in ours.planes.iter().enumerate() {
            let ray = ray(&camera, at);
            let Some(plane) = PixelPlane::new(*sums, ours.color[at][3], 0.9) else { continue };
            // The wall passes the world's origin, 2 m away.
            let expected = 2.0 * normal.z / normal.dot(ray);
            let off = f64::from(plane.depth_m) - expected;
            by_plane += off * off;
            worst = worst.max(off.abs());
            by_center += (f64::from(ours.depth[at]) - expected).powi(2);
            angle = angle.max(Vec3::from(plane.normal).as_dvec3().dot(-normal).clamp(-1.0, 1.0).acos());
            seen += 1.0;
        }
        let scale = f64::from(scale);
        let [by_plane, by_center] = [by_plane, by_center].map(|sum: f64| (sum / seen).sqrt() / scale);
        println!(
            "{}: errors of the depth in scales: planes {by_plane:.1e} (worst {:.1e}), centres {by_center:.2}; normals {:.1e} degrees",
            gpu.adapter_name(),
            worst / scale,
            angle.to_degrees()
        );
        assert!(seen > 8000.0, "{seen} pixels show the wall");
        // The faint rim of a Gaussian beyond three deviations is all that is off.
        assert!(by_plane < 5e-3 && worst < 0.02 * scale && by_center > 0.5 && by_center > 100.0 * by_plane);
        assert!(angle.to_degrees() < 0.1);
    });
}

#[test]
fn a_sphere_has_its_normals_and_depths() {
    on_both(|gpu| {
        let (radius, scale, camera) = (0.5, 0.012, pinhole(160));
        let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
        let count = 24_000;
        let point = |i: i32| {
            let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(count);
            let (sin, cos) = (golden * f64::from(i)).sin_cos();
            DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
        };
        let points: Vec<_> = (0..count).map(point).map(|normal| (normal * radius, normal)).collect();
        let scene = flat(&points, scale, 0.1 * scale);
        let outputs = Outputs { depth: true, ..Outputs::PLANES };
        let ours = draw(gpu, &mut Rasterizer::new(gpu, 0).unwrap(), &scene, &camera, &settings(outputs)).unwrap();
        let (mut angles, mut by_plane, mut by_center) = (Vec::new(), 0.0, 0.0);
        for (at, sums) in ours.planes.iter().enumerate() {
            // The ray meets the sphere about (0, 0, 2), not at a grazing angle.
            let ray = ray(&camera, at);
            let (a, b, c) = (ray.length_squared(), -4.0, 4.0 - radius * radius);
            let depth = (-b - (b * b - 4.0 * a * c).max(0.0).sqrt()) / (2.0 * a);
            let normal = (ray * depth - DVec3::new(0.0, 0.0, 2.0)) / radius;
            if -normal.dot(ray.normalize()) < 0.3 || b * b < 4.0 * a * c {
                continue;
            }
            let plane = PixelPlane::new(*sums, ours.color[at][3], 0.9).unwrap();
            angles.push(Vec3::from(plane.normal).as_dvec3().dot(normal).clamp(-1.0, 1.0).acos().to_degrees());
            by_plane += (f64::from(plane.depth_m) - depth).abs();
            by_center += (f64::from(ours.depth[at]) - depth).abs();
        }
        angles.sort_by(f64::total_cmp);
        let (seen, scale) = (angles.len() as f64, f64::from(scale));
        let mean = angles.iter().sum::<f64>() / seen;
        let high = angles[(seen * 0.99) as usize];
        let [by_plane, by_center] = [by_plane, by_center].map(|sum| sum / seen / scale);
        println!(
            "{}: normals mean {mean:.2}, 99 % {high:.2} degrees; depth in scales: planes {by_plane:.3}, centres {by_center:.3}",
            gpu.adapter_name()
        );
        // Blending prefers the Gaussians that are nearer to the camera: normals are those of a place 1.5 scales from there.
        assert!(seen > 3000.0 && mean < 2.5 && high < 3.5 && by_plane < 0.1 && by_plane < 0.2 * by_center);
    });
}

#[test]
fn colors_and_depths_keep_their_bytes_beside_planes() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(5);
        let scene = random_ellipsoids(&mut rng, 3000, HarmonicOrder::Two);
        let camera = random_camera(&mut rng, LENSES[1], 161, 119);
        let mut rasterizer = Rasterizer::new(gpu, 1).unwrap();
        let mut draw = |outputs| draw(gpu, &mut rasterizer, &scene, &camera, &settings(outputs)).unwrap();
        let plain = draw(Outputs { depth: true, ..Outputs::COLOR });
        assert!(plain.planes.iter().flatten().all(|v| v.abs() <= 0.0), "planes are not asked for");
        let both = draw(Outputs { depth: true, ..Outputs::PLANES });
        let first = draw(Outputs::PLANES);
        let alone = draw(Outputs { color: false, ..Outputs::PLANES });
        assert!(both.color == plain.color && both.depth == plain.depth && first.color == plain.color);
        assert!(first.planes == both.planes && alone.planes == both.planes && draw(Outputs::PLANES) == first);
        assert!(first.planes.iter().any(|sums| sums[2] < -0.5 && sums[3] > 1.0), "something is seen");
    });
}

#[test]
fn other_gaussians_and_targets_keep_the_image_of_planes() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(6);
        let camera = random_camera(&mut rng, LENSES[0], 60, 40);
        let isotropic = support::upload(gpu, &random_scene(&mut rng, 500)).unwrap();
        let scene = random_ellipsoids(&mut rng, 500, HarmonicOrder::Zero);
        let anisotropic = support::anisotropic::upload(gpu, &scene).unwrap();
        let mut rasterizer = Rasterizer::new(gpu, 1).unwrap();
        let target = RenderTarget::new(gpu, 60, 40).unwrap().with_planes(gpu).unwrap();
        let read = |target: &RenderTarget| target.planes.as_ref().unwrap().read(gpu).unwrap();
        let marks = vec![[7.0; 4]; 60 * 40];
        target.planes.iter().for_each(|planes| planes.write(gpu, &marks));
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        rasterizer.encode(gpu, &mut encoder, &isotropic, &camera, &settings(Outputs::PLANES), &target).unwrap();
        gpu.queue.submit([encoder.finish()]);
        assert!(read(&target) == marks, "isotropic Gaussians have no planes");
        // Only the tiles of the area are drawn.
        let area = RasterSettings { area: Some([0, 0, 16, 16]), ..settings(Outputs::PLANES) };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        rasterizer.encode(gpu, &mut encoder, &anisotropic, &camera, &area, &target).unwrap();
        gpu.queue.submit([encoder.finish()]);
        let found = read(&target);
        assert!(found[60 * 20..] == marks[60 * 20..] && found[..16] != marks[..16]);
        // A target without planes: colour alone.
        let plain = RenderTarget::of_color(gpu, 60, 40).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        rasterizer.encode(gpu, &mut encoder, &anisotropic, &camera, &settings(Outputs::PLANES), &plain).unwrap();
        gpu.queue.submit([encoder.finish()]);
        assert!(plain.color.read(gpu).unwrap().iter().any(|color| color[3] > 0.1));
    });
}
