//! A swung skirt, whose outline is out of reach of an image's derivatives.

use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, Skirt, SurfaceGaussians, Template, build_graph, sample_surface,
};
use flyrig_types::{Mask, Pose};
use glam::{DQuat, Quat};

use super::*;
use crate::deform::settings::DeformSettings;
use crate::deform::track::DeformTracker;
use crate::testing::{body, mask_of, ring};

struct Scene {
    template: Template,
    surface: SurfaceGaussians,
    graph: DeformationGraph,
    pose: Pose,
    cameras: Vec<Camera>,
    is_loose: Vec<bool>,
}

impl Scene {
    fn new() -> Self {
        let template = Skirt { length: 0.7, flare: 0.3 }.on(&body()).unwrap();
        let surface = sample_surface(&template, 8000, 1).unwrap();
        let graph = build_graph(&template, &surface, 400, DEFAULT_SIGMA2_M2).unwrap();
        let mut pose = template.skeleton.rest_pose();
        // Stand up: y up to z up.
        pose.joint_rotations[0] = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2) * pose.joint_rotations[0];
        pose.root_translation = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2).as_dquat() * pose.root_translation;
        let is_loose = vec![true; surface.len()];
        Self { template, surface, graph, pose, cameras: ring(3).cameras, is_loose }
    }

    /// Returns how far the true skirt swings at a canonical point, metres: up to 11 cm to the side.
    fn swing(point: Vec3) -> Vec3 {
        Vec3::X * 0.16 * (0.9 - point.y).clamp(0.0, 0.7)
    }

    /// Returns the images: masks of the swung skirt as alpha.
    fn images(&self) -> Vec<Vec<u8>> {
        let mut swung = self.template.clone();
        for position in &mut swung.positions {
            *position += Self::swing(*position);
        }
        self.cameras.iter().map(|camera| rgba(&mask_of(camera, &swung, &self.pose))).collect()
    }

    fn bones(&self) -> Vec<Vec<DMat4>> {
        vec![self.template.skeleton.world_from_canonical(&self.pose)]
    }

    fn views<'a>(&'a self, images: &'a [Vec<u8>]) -> Vec<OutlineView<'a>> {
        let view = |(camera, rgba): (&'a Camera, &'a Vec<u8>)| OutlineView {
            camera,
            size: [800, 800],
            rgba,
            unknown: None,
            instant: 0,
        };
        self.cameras.iter().zip(images).map(view).collect()
    }

    fn term<'a>(&'a self, views: &'a [OutlineView<'a>]) -> OutlineTerm<'a> {
        let points = (self.surface.positions.as_slice(), self.surface.skin.as_slice(), 0.016);
        OutlineTerm::new(points, &self.is_loose, views, self.bones())
    }

    fn tracker(&self) -> DeformTracker {
        DeformTracker::new(&self.graph, &self.surface.skin, DeformSettings::default()).unwrap()
    }
}

fn rgba(mask: &Mask) -> Vec<u8> {
    mask.coverage().iter().flat_map(|&covered| [90, 120, 60, covered]).collect()
}

fn rest(scene: &Scene) -> Vec<[f32; 4]> {
    vec![[0.0; 4]; scene.surface.len()]
}

fn median(mut distances: Vec<f64>) -> f64 {
    distances.iter_mut().for_each(|distance| *distance = distance.abs());
    flyrig_solve::median(&mut distances).unwrap_or(0.0)
}

#[test]
fn a_skirt_follows_its_outline_by_ten_centimetres() {
    let scene = Scene::new();
    let images = scene.images();
    let views = scene.views(&images);
    let mut term = scene.term(&views);
    let mut tracker = scene.tracker();
    let report = tracker.align(&mut term, 6).unwrap();
    assert!(report.accepted >= 3 && report.losses.last().unwrap() < &(0.1 * report.losses[0]), "{report:?}");
    // The sides of the hem, which an outline shows, and the front and back between them, which follow.
    let off = |at: &dyn Fn(Vec3) -> bool| {
        let points = scene.surface.positions.iter().zip(tracker.displacement()).filter(|(p, _)| at(**p));
        let all = points.map(|(p, d)| f64::from((Vec3::new(d[0], d[1], d[2]) - Scene::swing(*p)).x));
        median(all.collect())
    };
    let hem = |p: Vec3| p.y < 0.5 && p.y > 0.4;
    assert!(scene.surface.positions.iter().filter(|p| hem(**p)).count() > 300);
    assert!(off(&hem) < 0.02, "{} m of about 0.07 at the hem", off(&hem));
    let head = |p: Vec3| p.y > 1.5;
    assert!(off(&head) < 0.004, "{} m at the head", off(&head));
}

#[test]
fn derivatives_are_those_of_the_loss() {
    let scene = Scene::new();
    let images = scene.images();
    let views = scene.views(&images);
    let mut term = scene.term(&views);
    let mut out = Vec::new();
    let displacement = rest(&scene);
    let loss = term.derivatives(&displacement, &mut out).unwrap();
    assert!((term.loss(&displacement).unwrap() - loss).abs() < 1e-9 * loss, "matches are kept");
    let bones = &scene.bones()[0];
    let matched: Vec<usize> = (0..displacement.len()).filter(|&g| out[0].gradient[g][3] > 0.0).collect();
    assert!(matched.len() > 60, "{}", matched.len());
    for &g in matched.iter().step_by(7) {
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            // A canonical step that moves the Gaussian along one axis of the world.
            let to_world = flyrig_body::skin_jacobian_f64(bones, &scene.surface.skin[g]);
            let step_m = 1e-3;
            let step = (to_world.inverse() * axis * step_m).as_vec3();
            let at = |sign: f32| {
                let mut moved = displacement.clone();
                moved[g] = (step * sign).extend(0.0).to_array();
                term_loss(&term, &moved)
            };
            let by_steps = (at(1.0) - at(-1.0)) / (2.0 * step_m);
            let [x, y, z, _] = out[0].gradient[g].map(f64::from);
            let ours = DVec3::new(x, y, z).dot(axis);
            let size = DVec3::new(x, y, z).length();
            // Float steps of 1 mm carry 1e-4 of it; the loss bends by less over them than this bound.
            assert!((ours - by_steps).abs() < 1e-2 * size + 1.0, "Gaussian {g}: {ours} and {by_steps}");
        }
    }
}

/// Plain sum of the loss in f64.
fn term_loss(term: &OutlineTerm<'_>, displacement: &[[f32; 4]]) -> f64 {
    let mut sum = 0.0;
    for found in &term.matches {
        let [x, y, z, _] = displacement[found.gaussian].map(f64::from);
        let point = term.points[found.gaussian].as_dvec3() + DVec3::new(x, y, z);
        let skin = &term.skin[found.gaussian];
        let mut world = DVec3::ZERO;
        for (joint, weight) in skin.joints.iter().zip(skin.weights) {
            world += term.bones[0][usize::from(*joint)].transform_point3(point) * f64::from(weight);
        }
        let camera = found.view.rotation * world + found.view.translation;
        let pixel = DVec2::new(camera.x, camera.y) / camera.z * found.view.focal_px;
        let distance = (pixel.dot(found.normal) - found.offset) / found.px_per_m;
        let (linear, beyond) = (0.03, (distance.abs() - 0.01).max(0.0));
        sum += found.weight * if beyond < linear { beyond.powi(2) } else { linear * (2.0 * beyond - linear) };
    }
    sum
}

#[test]
fn a_body_on_its_outline_stays_and_no_image_or_a_wrong_one_moves_nothing() {
    let scene = Scene::new();
    let own: Vec<Vec<u8>> =
        scene.cameras.iter().map(|camera| rgba(&mask_of(camera, &scene.template, &scene.pose))).collect();
    let moved = |images: &[Vec<u8>], unknown: Option<[u8; 4]>| {
        let mut views = scene.views(images);
        views.iter_mut().for_each(|view| view.unknown = unknown);
        let mut tracker = scene.tracker();
        let report = tracker.align(&mut scene.term(&views), 4).unwrap();
        let most = tracker.translations().iter().map(|t| t.length()).fold(0.0, f64::max);
        (most, report.accepted)
    };
    assert!(moved(&own, None).0 < 0.01, "{:?}", moved(&own, None));
    let filled = |alpha: u8| vec![[90, 120, 60, alpha].repeat(800 * 800); 3];
    for images in [filled(0), filled(255), vec![vec![]; 3], Vec::new()] {
        assert_eq!(moved(&images, None).1, 0);
    }
    // A mask of something else, and a person hidden by pixels that say nothing.
    let mut other = filled(0);
    for image in &mut other {
        image.chunks_exact_mut(4).take(100 * 800).for_each(|pixel| pixel[3] = 255);
    }
    assert_eq!(moved(&other, None).1, 0);
    let unknown = vec![[0, 0, 1, 0].repeat(800 * 800); 3];
    assert_eq!(moved(&unknown, Some([0, 0, 1, 0])).1, 0);
}

#[test]
fn poison_and_points_behind_the_camera_change_nothing() {
    let scene = Scene::new();
    let images = scene.images();
    let views = scene.views(&images);
    let (no_points, no_skin): (&[Vec3], &[SkinWeights]) = (&[], &[]);
    let mut out = Vec::new();
    let mut empty = OutlineTerm::new((no_points, no_skin, f64::NAN), &[], &views, Vec::new());
    assert_eq!(empty.derivatives(&[], &mut out), Ok(0.0));
    assert!(out.is_empty());
    for bad in [f32::NAN, f32::INFINITY, 1e30] {
        let mut displacement = rest(&scene);
        displacement.iter_mut().step_by(3).for_each(|d| *d = [bad; 4]);
        let mut term = scene.term(&views);
        let loss = term.derivatives(&displacement, &mut out).unwrap();
        assert!(loss.is_finite() && out[0].gradient.iter().flatten().all(|g| g.is_finite()), "{bad}: {loss}");
        let matched = out[0].gradient.iter().filter(|g| g[3] > 0.0).count();
        assert!(matched > 0, "the others still count");
        assert!(term.loss(&vec![[bad; 4]; scene.surface.len()]).unwrap().is_infinite());
    }
    // Behind all cameras there is nothing to see.
    let mut behind = scene.pose.clone();
    behind.root_translation.z += 1e4;
    let bones = vec![scene.template.skeleton.world_from_canonical(&behind)];
    let mut term =
        OutlineTerm::new((&scene.surface.positions, &scene.surface.skin, 0.016), &scene.is_loose, &views, bones);
    assert_eq!(term.derivatives(&rest(&scene), &mut out), Ok(0.0));
}
