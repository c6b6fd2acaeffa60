use flyrig_avatar::{Attachment, Bones, PosedAvatar};
use flyrig_body::{Outfit, ShapeParams, Shoes, Skirt, default_template, sample_surface};
use flyrig_renderer::HarmonicOrder;
use glam::DVec3;

use super::*;
use crate::person::drawn_points;
use crate::{MeshOptions, MeshedPerson, OrientedPoints, PersonOptions, PersonReport, mesh_from_points};

const WORN: Skirt = Skirt { length: 0.6, flare: 0.2 };

fn body() -> Template {
    default_template(&ShapeParams::default()).unwrap()
}

fn avatar_of(dressed: &Template) -> Avatar {
    let surface = sample_surface(dressed, 50_000, 5).unwrap();
    Avatar::new(dressed, &surface.inset(), None, &[], HarmonicOrder::Zero).unwrap()
}

fn meshed(avatar: &Avatar, undressed: Option<&Template>) -> (MeshedPerson, PersonReport) {
    let options = PersonOptions { triangles: 40_000, texture_side: 256, ..PersonOptions::default() };
    MeshedPerson::of_avatar(&Avatar { undressed: undressed.cloned(), ..avatar.clone() }, &options).unwrap()
}

/// Returns the winding number of closed triangles, by the sum over all solid angles.
fn winding(mesh: &Template, point: DVec3) -> f64 {
    let angle = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3() - point);
        let (la, lb, lc) = (a.length(), b.length(), c.length());
        2.0 * a.dot(b.cross(c)).atan2(la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb)
    };
    mesh.triangles.iter().map(angle).sum::<f64>() / (2.0 * std::f64::consts::TAU)
}

/// Returns the distance to the nearest of points, metres.
fn nearest(point: DVec3, others: impl Iterator<Item = Vec3>) -> f64 {
    others.map(|other| other.as_dvec3().distance(point)).fold(f64::INFINITY, f64::min)
}

#[test]
fn a_skirt_is_a_closed_shell_with_both_legs_in_it_and_without_a_lid() {
    let body = body();
    let outfit = Outfit { skirt: Some(WORN), shoes: Some(Shoes { sole_m: 0.02 }) };
    let dressed = outfit.on(&body).unwrap();
    let avatar = avatar_of(&dressed);
    let (person, report) = meshed(&avatar, Some(&body));
    let topology = &report.topology;
    assert!(topology.is_closed_manifold() && topology.components == 1, "{topology:?}");
    assert_eq!(topology.self_intersections, 0);
    let shell = report.shell.unwrap();
    assert!(shell.wall_share > 0.1 && shell.hidden_share > 0.02 && report.mesh.hole_share < 0.02, "{report:?}");
    let (solid, before) = meshed(&avatar, None);
    assert!(before.shell.is_none() && before.mesh.hole_share > 0.04, "{}", before.mesh.hole_share);

    let worn = skirt_vertices(&dressed, &body);
    let tube = || dressed.positions.iter().zip(&worn).filter(|(_, worn)| **worn).map(|(p, _)| *p);
    let (hem, band) = (tube().map(|p| p.y).fold(9.0, f32::min), tube().map(|p| p.y).fold(-9.0, f32::max));
    let skin = sample_surface(&body, 40_000, 3).unwrap().positions;
    let sheet: Vec<Vec3> = person.template.positions.clone();
    // A few vertices keep the thickness of the cut; from its middle the nearest vertex is not straight ahead.
    assert!(shell.thick_vertices < 100, "{shell:?}");
    let wall_m = f64::from(0.5 * WALL_VOXELS * report.mesh.settings.voxel_m) + 0.002;
    let (mut empty, mut legs, mut were_solid) = (0, [0, 0], 0);
    for i in 0..1500u32 {
        let fraction = |k: u32| f64::from((i * k) % 1499) / 1499.0;
        let y = f64::from(hem) - 0.03 + fraction(7) * f64::from(band - hem - 0.2);
        let point = DVec3::new(fraction(311) - 0.5, y, 0.8 * (fraction(83) - 0.5));
        let (inside, to_skin) = (winding(&body, point) > 0.5, nearest(point, skin.iter().copied()));
        if nearest(point, sheet.iter().copied()) < wall_m {
            continue;
        }
        let found = winding(&person.template, point);
        assert!((found - found.round()).abs() < 0.01, "{found} at {point}");
        if inside && to_skin > 0.03 {
            assert!(found > 0.5, "no leg at {point}");
            legs[usize::from(point.x > 0.0)] += 1;
        } else if !inside && to_skin > 0.025 {
            // Neither a lid nor a filling, inside of the skirt or outside.
            assert!(found < 0.5, "solid at {point}");
            empty += 1;
            were_solid += usize::from(winding(&solid.template, point) > 0.5);
        }
    }
    assert!(empty > 300 && were_solid > 30 && legs.iter().all(|count| *count > 5), "{empty} {were_solid} {legs:?}");

    // The inner side lies just behind the outer one and moves with it.
    let inner: Vec<usize> = (0..person.template.positions.len())
        .filter(|i| {
            let (p, n) = (person.template.positions[*i], person.template.normals[*i]);
            p.y > hem + 0.05 && p.y < hem + 0.2 && Vec2::new(p.x, p.z).length() > 0.2 && n.dot(p.with_y(0.0)) < 0.0
        })
        .collect();
    let mut off: Vec<f64> = Vec::new();
    for i in inner.iter().step_by(11) {
        let place = person.template.positions[*i];
        let tube_at = (0..worn.len())
            .filter(|k| worn[*k])
            .min_by(|a, b| dressed.positions[*a].distance(place).total_cmp(&dressed.positions[*b].distance(place)));
        let (own, other) = (person.template.skin[*i], dressed.skin[tube_at.unwrap()]);
        let weight = |skin: flyrig_body::SkinWeights, joint: u16| -> f32 {
            skin.joints.iter().zip(skin.weights).filter(|(known, _)| **known == joint).map(|(_, weight)| weight).sum()
        };
        for joint in other.joints {
            assert!((weight(own, joint) - weight(other, joint)).abs() < 0.15, "{own:?} {other:?} at {place}");
        }
        let outwards = place.with_y(0.0).normalize();
        let outer = person.template.positions.iter().zip(&person.template.normals);
        off.push(nearest(place.as_dvec3(), outer.filter(|(_, n)| n.dot(outwards) > 0.5).map(|(p, _)| *p)));
    }
    off.sort_by(f64::total_cmp);
    assert!(off.len() > 20 && off[off.len() / 2] < 0.009, "{off:?}");
}

#[test]
fn bodies_without_a_skirt_keep_their_mesh_and_short_ones_stay_solid() {
    let body = body();
    let shod = Outfit { skirt: None, shoes: Some(Shoes { sole_m: 0.02 }) }.on(&body).unwrap();
    let avatar = avatar_of(&shod);
    let ((plain, _), (given, report)) = (meshed(&avatar, None), meshed(&avatar, Some(&body)));
    assert!(report.shell.is_none() && plain.template == given.template && plain.texture == given.texture);
    let jacket = avatar_of(&Skirt { length: 0.15, flare: 0.05 }.on(&body).unwrap());
    assert!(meshed(&jacket, Some(&body)).1.shell.is_none());
}

#[test]
fn the_same_bytes_come_out_of_one_thread_and_of_several() {
    let body = body();
    let dressed = avatar_of(&WORN.on(&body).unwrap());
    let avatar = Avatar { undressed: Some(body), ..dressed };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mesh = MeshOptions { voxel_m: Some(0.016), ..MeshOptions::default() };
        let options = PersonOptions { mesh, triangles: 10_000, texture_side: 512 };
        pool.install(|| MeshedPerson::of_avatar(&avatar, &options).unwrap())
    };
    let ((one, first), (other, second)) = (run(1), run(3));
    assert!(one.template == other.template && one.texture == other.texture);
    let thick = |report: &PersonReport| report.shell.unwrap().thick_vertices;
    assert_eq!(thick(&first), thick(&second));
}

#[test]
fn poisoned_inputs_are_refused_or_left_out() {
    let body = body();
    let mut avatar = avatar_of(&WORN.on(&body).unwrap());
    let fails = |avatar: &Avatar, body: &Template| {
        let avatar = Avatar { undressed: Some(body.clone()), ..avatar.clone() };
        let options = PersonOptions { texture_side: 256, ..PersonOptions::default() };
        MeshedPerson::of_avatar(&avatar, &options).unwrap_err().to_string()
    };
    let mut damaged = body.clone();
    damaged.positions[7].x = f32::NAN;
    let error = fails(&avatar, &damaged);
    assert!(error.contains("body below the clothes") && error.contains("not a finite number"), "{error}");
    let mut empty = body.clone();
    empty.triangles.clear();
    fails(&avatar, &empty);

    let points = |avatar: &Avatar| -> Vec<OrientedPoint> {
        let row = |place: &Vec3| OrientedPoint { position: *place, normal: *place, weight: 1.0, uncertainty_m: 0.0 };
        avatar.places.iter().map(row).collect()
    };
    let mut bad = points(&avatar);
    for (i, point) in bad.iter_mut().enumerate().step_by(3) {
        point.position.x = if i % 2 == 0 { f32::NAN } else { f32::INFINITY };
        point.normal = Vec3::ZERO;
    }
    let hollow = Hollow::of(&avatar, &body, &bad, 0.01).unwrap();
    for point in [Vec3::NAN, Vec3::INFINITY, Vec3::splat(1e30), Vec3::new(0.0, f32::NAN, 0.0)] {
        assert!(!hollow.is_empty(point), "{point}");
        assert_eq!(hollow.side(point, Vec3::NAN), Side::Seen);
    }
    for voxel_m in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(Hollow::of(&avatar, &body, &points(&avatar), voxel_m).is_none(), "{voxel_m}");
    }
    assert!(Hollow::of(&avatar, &body, &[], 0.01).is_none());
    avatar.attachments.fill(Attachment { triangle: u32::MAX, barycentric: [1.0, 0.0, 0.0] });
    assert!(Hollow::of(&avatar, &body, &points(&avatar), 0.01).is_none(), "no point belongs to the skirt");
}

#[test]
fn a_waistband_that_hangs_in_front_of_the_body_leaves_no_gap_below_it() {
    let body = body();
    let dressed = WORN.on(&body).unwrap();
    let worn = skirt_vertices(&dressed, &body);
    // From 5 cm below its upper border the skirt hangs 2 cm farther out, as its tracked nodes may.
    let band = (0..worn.len()).filter(|i| worn[*i]).map(|i| dressed.positions[i].y).fold(-9.0, f32::max);
    let mut hanging = dressed.clone();
    for i in (0..worn.len()).filter(|i| worn[*i]) {
        let below = ((band - dressed.positions[i].y) / 0.05).clamp(0.0, 1.0);
        hanging.positions[i] += 0.02 * below * dressed.normals[i].with_y(0.0).normalize_or_zero();
    }
    let avatar = avatar_of(&hanging);
    let mut posed = PosedAvatar::default();
    avatar.pose(&Bones::at_rest(&hanging.skeleton), None, &mut posed);
    let points = drawn_points(&posed);
    let covered = covered(&avatar, &body, &points);
    let rows = || points.iter().zip(&avatar.attachments).zip(&covered);
    let count = rows().filter(|(_, covered)| **covered).count();
    assert!(count > 100, "{count}");
    for ((point, attachment), _) in rows().filter(|(_, covered)| **covered) {
        let corners = hanging.triangles[attachment.triangle as usize];
        assert!(corners.iter().all(|i| !worn[*i as usize] && !is_arm(hanging.parts[*i as usize])));
        assert!(point.position.y < band && point.position.y > band - 0.09, "{point:?} {band}");
    }
    // The fused surface follows the skirt; with the strip it has another one behind it.
    let of_skirt =
        |attachment: &Attachment| hanging.triangles[attachment.triangle as usize].iter().all(|i| worn[*i as usize]);
    let sheet: Vec<Vec3> = rows().filter(|((_, of), _)| of_skirt(of)).map(|((point, _), _)| point.position).collect();
    let in_strip = |p: &Vec3| (band - 0.07..band - 0.03).contains(&p.y) && Vec2::new(p.x, p.z).length() < 0.25;
    let behind = |points: &[OrientedPoint]| -> f64 {
        let points = OrientedPoints::from_rows(points.iter().copied());
        let (fused, _) = mesh_from_points(points, &MeshOptions::default()).unwrap();
        let near = || fused.positions.iter().filter(|p| in_strip(p));
        let off = near().map(|p| nearest(p.as_dvec3(), sheet.iter().copied()));
        off.filter(|off| *off > 0.007).count() as f64 / near().count() as f64
    };
    let mut kept = points.clone();
    kept.iter_mut().zip(&covered).filter(|(_, covered)| **covered).for_each(|(point, _)| point.weight = 0.0);
    let (with, without) = (behind(&kept), behind(&points));
    assert!(with < 0.02 && without > 0.2, "{with} {without}");
    // Poison is not covered, and a body without a skirt covers nothing.
    let mut broken = points.clone();
    broken[0].position = Vec3::NAN;
    broken[1].normal = Vec3::ZERO;
    assert_eq!(super::covered(&avatar, &body, &broken).len(), points.len());
    assert!(!super::covered(&avatar_of(&body), &body, &points).contains(&true));
}
