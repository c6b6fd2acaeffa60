//! Meshes of Gaussians: known surfaces, units, colours, faults.

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_renderer::{HarmonicOrder, SH_DEGREE_0};
use glam::{DVec3, Quat};

use super::*;
use crate::splats::views::VIEWS;
use crate::{MeshError, Normalization};

const RADIUS: f32 = 0.4;

fn gpu() -> GpuContext {
    GpuContext::new(&AdapterChoice::Best).unwrap().on_processor()
}

fn small() -> SplatOptions<'static> {
    SplatOptions { filter: SplatFilter::Mip, triangles: 6000, texture_side: 256, ..SplatOptions::default() }
}

/// Flat Gaussians on spheres around these points: red above, blue below.
fn spheres(centers: &[Vec3], count: usize) -> AnisotropicSplats {
    let mut splats = AnisotropicSplats::empty(HarmonicOrder::Zero);
    for center in centers {
        for i in 0..count {
            let y = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
            let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
            let normal = Vec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin);
            let spacing = RADIUS * (4.0 * std::f32::consts::PI / count as f32).sqrt();
            splats.center.push((*center + normal * RADIUS).extend(0.0).to_array());
            splats.scale_opacity.push([0.8 * spacing, 0.8 * spacing, 0.05 * spacing, 0.95]);
            splats.rotation.push(Quat::from_rotation_arc(Vec3::Z, normal).to_array());
            let color = if y > 0.0 { [0.8, 0.0, 0.0] } else { [0.0, 0.0, 0.8] };
            splats.harmonics.push([color[0] / SH_DEGREE_0, 0.0, color[2] / SH_DEGREE_0, 0.0]);
        }
    }
    splats
}

#[test]
fn a_sphere_of_gaussians_becomes_a_closed_sphere_with_its_colors() {
    let splats = spheres(&[Vec3::new(0.3, 1.0, -0.2)], 6000);
    let (mesh, report) = mesh_splats(&splats, &gpu(), &small()).unwrap();
    assert!(report.topology.is_closed_manifold(), "{:?}", report.topology);
    assert_eq!((report.topology.components, report.topology.genus()), (1, Some(0)));
    assert_eq!((report.counts.used, report.views[0]), (6000, VIEWS as u32));
    // Tangential discs draw contours outside of the sphere of their centres.
    let drawn = RADIUS + report.drawn_beyond_m;
    let off = |position: &Vec3| (position.distance(Vec3::new(0.3, 1.0, -0.2)) - drawn).abs();
    let worst = mesh.positions.iter().map(off).fold(0.0, f32::max);
    assert!(worst < 0.004, "{worst} m");
    for (position, normal) in mesh.positions.iter().zip(&mesh.normals) {
        let outwards = (*position - Vec3::new(0.3, 1.0, -0.2)).normalize();
        assert!(normal.dot(outwards) > 0.9, "{position}: {normal}");
    }
    // Away from the border of both colours.
    let (mut red, mut blue, mut unused) = (0, 0, 0);
    for (position, uv) in mesh.positions.iter().zip(&mesh.uvs) {
        let [x, y] = (*uv * 256.0).to_array().map(|v| (v as usize).min(255));
        let at = 3 * (y * 256 + x);
        let [r, g, b] = mesh.texture.rgb[at..at + 3] else { panic!("a texel") };
        if [r, g, b] == [128; 3] {
            // A chart without any texel's centre.
            unused += 1;
        } else if position.y > 1.1 {
            assert!(r > 190 && b < 60, "{position}: {r} {b}");
            red += 1;
        } else if position.y < 0.9 {
            assert!(b > 190 && r < 60, "{position}: {r} {b}");
            blue += 1;
        }
    }
    assert!(red > 100 && blue > 100, "{red} {blue}");
    assert!(unused * 50 < mesh.positions.len(), "{unused}");
    // Half a distance of neighbours.
    assert!((0.0..0.009).contains(&report.drawn_beyond_m), "{}", report.drawn_beyond_m);
    assert!(report.unseen_texels * 100 < mesh.texture.covered, "{}", report.unseen_texels);

    // In millimetres, with the unit.
    let mut larger = splats.clone();
    larger.center.iter_mut().for_each(|row| *row = row.map(|v| 1000.0 * v));
    larger.scale_opacity.iter_mut().for_each(|row| (0..3).for_each(|k| row[k] *= 1000.0));
    let (scaled, _) = mesh_splats(&larger, &gpu(), &SplatOptions { unit_m: 0.001, ..small() }).unwrap();
    let worst = scaled.positions.iter().map(off).fold(0.0, f32::max);
    assert!(worst < 0.004, "{worst} m");
    let error = mesh_splats(&larger, &gpu(), &small()).unwrap_err().to_string();
    assert!(error.ends_with("m tall; give --unit mm"), "{error}");
}

#[test]
fn balls_without_a_shortest_axis_become_a_closed_sphere() {
    let mut splats = spheres(&[Vec3::ZERO], 6000);
    for (i, (row, rotation)) in splats.scale_opacity.iter_mut().zip(&mut splats.rotation).enumerate() {
        // Nearly alike, the shortest one of them anywhere.
        let scale = row[0];
        (row[0], row[1], row[2]) = (scale, 1.02 * scale, 0.98 * scale);
        *rotation = Quat::from_euler(glam::EulerRot::XYZ, i as f32, 2.3 * i as f32, 0.7 * i as f32).to_array();
    }
    let (mesh, report) = mesh_splats(&splats, &gpu(), &small()).unwrap();
    assert!(report.topology.is_closed_manifold(), "{:?}", report.topology);
    assert_eq!((report.topology.components, report.topology.genus()), (1, Some(0)));
    // Balls draw about two of their deviations beyond their centres.
    let scale = splats.scale_opacity[0][0];
    let radii: Vec<f32> = mesh.positions.iter().map(|position| position.length() - RADIUS).collect();
    let mean = radii.iter().sum::<f32>() / radii.len() as f32;
    assert!((0.0..3.0 * scale).contains(&mean), "{mean} m, balls of {scale} m");
    assert!(radii.iter().all(|radius| (radius - mean).abs() < 0.01), "{radii:?}");
    assert!(report.mesh.hole_share < 0.02, "{}", report.mesh.hole_share);
}

#[test]
fn reruns_and_any_number_of_threads_give_the_same_mesh() {
    let splats = spheres(&[Vec3::ZERO], 3000);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| mesh_splats(&splats, &gpu(), &small()).unwrap().0)
    };
    let first = on(1);
    assert_eq!(on(3), first);
}

#[test]
fn faults_are_counted_or_refused() {
    let gpu = gpu();
    let refused = |splats: &AnisotropicSplats| mesh_splats(splats, &gpu, &small()).unwrap_err();
    assert_eq!(refused(&spheres(&[Vec3::ZERO], 10)).to_string(), "10 Gaussians; at least 1000 are needed");
    let two = refused(&spheres(&[Vec3::ZERO, Vec3::X * 1.5], 2500));
    assert!(two.to_string().starts_with("2 separate bodies"), "{two}");
    let mut one_place = spheres(&[Vec3::ZERO], 1500);
    one_place.center.fill([0.5; 4]);
    assert!(matches!(refused(&one_place), SplatError::Mesh(MeshError::Coincident { count: 1500 })));
    let mut absurd = spheres(&[Vec3::ZERO], 1500);
    absurd.center.iter_mut().for_each(|row| *row = row.map(|v| v * 1e30));
    assert!(refused(&absurd).to_string().contains("splat-transform IN.ply -s"));

    let mut poisoned = spheres(&[Vec3::ZERO], 3000);
    poisoned.center[5][1] = f32::NAN;
    poisoned.scale_opacity[70][0] = f32::INFINITY;
    poisoned.rotation[900] = [0.0; 4];
    poisoned.harmonics[2000][2] = f32::NAN;
    poisoned.scale_opacity[2500][3] = 0.0;
    poisoned.center[2900][0] = 1e20;
    let (mesh, report) = mesh_splats(&poisoned, &gpu, &small()).unwrap();
    let SplatCounts { used, not_finite, transparent, distant, .. } = report.counts;
    assert_eq!((used, not_finite, transparent, distant), (2994, 4, 1, 1));
    assert!(mesh.positions.iter().all(|position| (position.length() - RADIUS).abs() < 0.01));
}

/// Surface points and empty space against a plain f64 reference: rays through a sphere.
#[test]
fn views_see_the_surface_and_what_lies_in_front() {
    let splats = spheres(&[Vec3::ZERO], 6000);
    let prepared = prepare(&splats, 1.0).unwrap();
    let (views, points) = render(&gpu(), &prepared, SplatFilter::Mip).unwrap();
    assert!(points.len() > 64 * 500, "{}", points.len());
    let mut off: Vec<f64> = points.iter().map(|point| (f64::from(point.position.length()) - 0.4).abs()).collect();
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() * 99 / 100] < 0.004, "{}", off[off.len() * 99 / 100]);
    let unit: Normalization = prepared.unit;
    let margin = 0.02 / unit.scale_m() as f32;
    for (k, view) in views.iter().enumerate().step_by(9) {
        let y = 1.0 - (2 * k + 1) as f64 / VIEWS as f64;
        let (sin, cos) = (std::f64::consts::PI * (3.0 - 5f64.sqrt()) * k as f64).sin_cos();
        let towards = DVec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin);
        let sees = |place: DVec3| view.sees_through(unit.normalized(place.as_vec3()).as_vec3(), margin);
        let across = towards.any_orthonormal_vector();
        assert!(sees(towards * 0.45) && sees(across * 0.5 - towards * 0.2), "in front and beside");
        assert!(!sees(towards * 0.39) && !sees(-towards * 0.5) && !sees(DVec3::ZERO), "on, behind, inside");
        assert!(!view.sees_through(Vec3::NAN, margin) && !sees(DVec3::splat(1e9)), "outside of the image");
    }
}
