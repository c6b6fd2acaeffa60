//! Anisotropic Gaussians that belong to a surface: culling, canonical positions, corrected colours, and joining with others.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_gpu::{GpuContext, StorageBuffer, testing::on_both};
use flyrig_renderer::{
    AWAY_COSINE, AnisotropicBuffers, Corrected, GaussianJoin, Gaussians, HarmonicOrder, RasterSettings, Rasterizer,
    Recolor, RenderTarget, SH_DEGREE_0,
};
use flyrig_types::{Camera, Lens};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{Ellipsoids, from_isotropic, random_ellipsoids, upload};
use support::random_scene::{random_camera, random_scene, straight};
use support::reference::{Scene, blend, vec3};
use support::{Difference, Pictures};

/// As in `anisotropic.rs`.
const MAX_ERROR: f64 = 4.0 * (1.0 / 255.0 + 1e-3);
const MEAN_ERROR: f64 = 4.0 * 2e-5;

/// Adds a surface with random normals, some of them poisoned, and canonical positions.
fn with_surface(gpu: &GpuContext, rng: &mut StdRng, scene: &Ellipsoids) -> (AnisotropicBuffers, Scene) {
    let mut row = || [0; 4].map(|_| rng.random_range(-1.0f32..1.0));
    let mut normal: Vec<[f32; 4]> = (0..scene.count()).map(|_| row()).collect();
    let canonical: Vec<[f32; 4]> = (0..scene.count()).map(|_| row()).collect();
    for (i, normal) in normal.iter_mut().enumerate().step_by(17) {
        *normal = [[f32::NAN; 4], [0.0; 4], [f32::INFINITY; 4]][i / 17 % 3];
    }
    let buffers = upload(gpu, scene).unwrap().with_surface(gpu).unwrap();
    let surface = buffers.surface.as_ref().unwrap();
    surface.normal.write(gpu, &normal);
    surface.canonical.write(gpu, &canonical);
    (buffers, Scene { normal, canonical, ..Scene::default() })
}

/// Draws into a target of the camera's size.
fn draw<'a>(gpu: &GpuContext, gaussians: impl Into<Gaussians<'a>>, camera: &Camera, cull: bool) -> Pictures {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let mut rasterizer = Rasterizer::new(gpu, 16).unwrap();
    let target = RenderTarget::new(gpu, width, height).unwrap();
    let settings = RasterSettings { cull_backfacing: cull, ..RasterSettings::default() };
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    rasterizer.encode(gpu, &mut encoder, gaussians, camera, &settings, &target).unwrap();
    gpu.queue.submit([encoder.finish()]);
    Pictures {
        color: target.color.read(gpu).unwrap(),
        depth: target.depth.read(gpu).unwrap(),
        canonical: target.canonical.read(gpu).unwrap(),
    }
}

#[test]
fn what_faces_away_is_culled_and_canonical_positions_are_those_of_the_reference() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(11);
        for order in HarmonicOrder::ALL {
            let scene = random_ellipsoids(&mut rng, 600, order);
            let camera = straight(Lens::PINHOLE, 90, 70);
            let (buffers, surface) = with_surface(gpu, &mut rng, &scene);
            let settings = RasterSettings::default();
            let mut splats = scene.splats(&camera, &settings);
            let all = splats.len();
            splats.retain(|splat| {
                let (normal, sight) = (vec3(surface.normal[splat.index]), splat.center - camera.position());
                normal.is_finite() && normal.dot(sight) <= AWAY_COSINE * normal.length() * sight.length()
            });
            assert!(splats.len() < all && splats.len() > all / 3, "{} of {all}", splats.len());
            let mut painted = Scene { color: vec![[0.0; 4]; scene.count()], ..surface };
            for (splat, color) in splats.iter().zip(scene.colors(&camera, &splats)) {
                painted.color[splat.index] = color.as_vec3().extend(0.0).to_array();
            }
            let expected = blend(&painted, &splats, 90, 70);
            let ours = draw(gpu, &buffers, &camera, true);
            let d = Difference::between(&ours, &expected);
            assert!(d.color_max < MAX_ERROR && d.color_mean < MEAN_ERROR, "{order:?}: {d:?}");
            assert!(d.canonical_max < MAX_ERROR, "{order:?}: {d:?}");
            assert!(ours.canonical.iter().any(|p| p[0].abs() > 0.1), "positions are drawn");
            let whole = draw(gpu, &buffers, &camera, false);
            assert!(whole.color != ours.color, "culling was asked for");
        }
    });
}

#[test]
fn corrections_change_the_constant_harmonic_and_the_colour_of_the_surface() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(12);
        for order in HarmonicOrder::ALL {
            let scene = random_ellipsoids(&mut rng, 777, order);
            let buffers = upload(gpu, &scene).unwrap();
            let mut rows =
                || -> Vec<[f32; 4]> { (0..777).map(|_| [0; 4].map(|_| rng.random_range(-1.0f32..1.0))).collect() };
            let (constant, mut correction, look) = (rows(), rows(), rows());
            correction[5] = [f32::NAN; 4];
            let on_gpu = |rows: &[[f32; 4]]| StorageBuffer::from_slice(gpu, "rows", rows).unwrap();
            let (constants, corrections, looks) = (on_gpu(&constant), on_gpu(&correction), on_gpu(&look));
            let color = StorageBuffer::zeroed(gpu, "colours", 777).unwrap();
            let corrected = Corrected { constant: &constants, correction: &corrections, look: &looks, color: &color };
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            Recolor::new(gpu, order).encode(gpu, &mut encoder, &buffers, corrected);
            gpu.queue.submit([encoder.finish()]);
            let (found, colors) = (buffers.harmonics.read(gpu).unwrap(), color.read(gpu).unwrap());
            let coefficients = order.coefficients();
            for i in (0..777).filter(|i| *i != 5) {
                for c in 0..3 {
                    let by = f64::from(correction[i][c]);
                    let expected = f64::from(constant[i][c]) + by / f64::from(SH_DEGREE_0);
                    assert!((f64::from(found[i * coefficients][c]) - expected).abs() < 1e-5, "{order:?} {i}");
                    let expected = (f64::from(look[i][c]) + by).max(0.0);
                    assert!((f64::from(colors[i][c]) - expected).abs() < 1e-6, "{order:?} {i}");
                }
                let rest = i * coefficients + 1..(i + 1) * coefficients;
                assert_eq!(found[rest.clone()], scene.harmonics[rest], "{order:?} {i}");
            }
        }
    });
}

#[test]
fn joined_people_of_both_kinds_give_the_image_of_one_list() {
    on_both(|gpu| {
        let mut rng = StdRng::seed_from_u64(13);
        let camera = random_camera(&mut rng, Lens::PINHOLE, 100, 80);
        let plain = random_scene(&mut rng, 400);
        let isotropic = support::upload(gpu, &plain).unwrap();
        let (one, two) = (
            random_ellipsoids(&mut rng, 300, HarmonicOrder::One),
            random_ellipsoids(&mut rng, 200, HarmonicOrder::Zero),
        );
        let (first, surface) = with_surface(gpu, &mut rng, &one);
        let free = upload(gpu, &two).unwrap();
        let mut join = GaussianJoin::new(gpu).unwrap();
        assert!(join.joined().is_none());
        let people = [Gaussians::from(&isotropic), Gaussians::from(&first), Gaussians::from(&free)];
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        join.encode(gpu, &mut encoder, &people).unwrap();
        gpu.queue.submit([encoder.finish()]);
        let joined = join.joined().unwrap();
        assert_eq!((joined.count(), joined.order()), (900, HarmonicOrder::One));

        // The same people as one list of order one.
        let round = from_isotropic(&mut rng, &plain);
        let spread = |scene: &Ellipsoids| -> Vec<[f32; 4]> {
            let rows = scene.harmonics.chunks(scene.order.coefficients());
            rows.flat_map(|rows| (0..4).map(|k| rows.get(k).copied().unwrap_or_default())).collect()
        };
        let all = |list: fn(&Ellipsoids) -> &Vec<[f32; 4]>| {
            [list(&round), list(&one), list(&two)].map(Vec::as_slice).concat()
        };
        let whole = Ellipsoids {
            center: all(|scene| &scene.center),
            scale_opacity: all(|scene| &scene.scale_opacity),
            rotation: all(|scene| &scene.rotation),
            harmonics: [spread(&round), spread(&one), spread(&two)].concat(),
            order: HarmonicOrder::One,
        };
        let expected = upload(gpu, &whole).unwrap().with_surface(gpu).unwrap();
        let normals = expected.surface.as_ref().unwrap();
        normals.normal.write(gpu, &[plain.normal.as_slice(), &surface.normal, &vec![[0.0; 4]; 200]].concat());
        normals.canonical.write(gpu, &[plain.canonical.as_slice(), &surface.canonical].concat());
        let (ours, reference) = (draw(gpu, joined, &camera, true), draw(gpu, &expected, &camera, true));
        let off = |a: &[[f32; 4]], b: &[[f32; 4]]| {
            a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max)
        };
        assert!(off(&ours.color, &reference.color) < MAX_ERROR, "{}", off(&ours.color, &reference.color));
        assert!(off(&ours.canonical, &reference.canonical) < MAX_ERROR);
        assert!(ours.color.iter().filter(|c| c[3] > 0.5).count() > 500, "something is seen");

        // Other people next.
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        assert_eq!(join.encode(gpu, &mut encoder, &people[..1]).unwrap().count(), 400);
        assert_eq!(join.encode(gpu, &mut encoder, &[]).unwrap().count(), 0);
    });
}
