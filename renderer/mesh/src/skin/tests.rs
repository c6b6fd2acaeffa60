use flyrig_body::{ShapeParams, default_template};
use glam::{DVec3, Vec3};

use super::{inpaint::inpaint, laplacian::Laplacian, *};
use crate::triangle::closest_on_triangle;

/// Square sheet of `side` x `side` vertices, 1 cm apart, in the plane z = 0.
fn sheet(side: usize) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let at = |x: usize, y: usize| (y * side + x) as u32;
    let positions = (0..side * side).map(|i| Vec3::new((i % side) as f32, (i / side) as f32, 0.0) * 0.01).collect();
    let mut triangles = Vec::new();
    for y in 0..side - 1 {
        for x in 0..side - 1 {
            triangles.push([at(x, y), at(x + 1, y), at(x + 1, y + 1)]);
            triangles.push([at(x, y), at(x + 1, y + 1), at(x, y + 1)]);
        }
    }
    (positions, triangles)
}

fn of_two(share: f32) -> SkinWeights {
    SkinWeights::strongest(&[(3, 1.0 - share), (7, share)]).unwrap()
}

fn weight(skin: &SkinWeights, joint: u16) -> f32 {
    skin.joints.iter().zip(skin.weights).filter(|(known, _)| **known == joint).map(|(_, weight)| weight).sum()
}

#[test]
fn closest_points_are_those_of_a_plain_search() {
    let triangle = [Vec3::new(0.1, 0.2, 0.0), Vec3::new(1.1, 0.1, 0.3), Vec3::new(0.4, 0.9, -0.2)];
    let mut state = 1u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32 * 3.0 - 1.0
    };
    for _ in 0..200 {
        let p = Vec3::new(random(), random(), random());
        let weights = closest_on_triangle(p, triangle);
        assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-5 && weights.iter().all(|w| *w >= -1e-6));
        let place: Vec3 = triangle.iter().zip(weights).map(|(corner, weight)| *corner * weight).sum();
        let mut plain = f64::INFINITY;
        let n = 120;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                let [a, b, c] = triangle.map(Vec3::as_dvec3);
                let point: DVec3 = a * (1.0 - u - v) + b * u + c * v;
                plain = plain.min(point.distance(p.as_dvec3()));
            }
        }
        let found = f64::from(place.distance(p));
        assert!(found <= plain + 1e-6 && found > plain - 0.01, "{found} {plain}");
    }
}

/// On a sheet whose left and right are known, the smoothest weights are a straight line where the known ones are.
#[test]
fn unknown_weights_go_on_as_the_known_ones_begin() {
    let (positions, triangles) = sheet(31);
    let share = |x: usize| 0.1 + 0.8 * x as f32 / 30.0;
    let known: Vec<Option<SkinWeights>> =
        (0..31 * 31).map(|i| Some(i % 31).filter(|x| *x <= 8 || *x >= 22).map(|x| of_two(share(x)))).collect();
    let filled = inpaint(&positions, &triangles, &known);
    let mut worst = 0.0f32;
    for (i, skin) in filled.iter().enumerate() {
        assert_eq!(skin.is_some(), known[i].is_none());
        if let Some(skin) = skin {
            worst = worst.max((weight(skin, 7) - share(i % 31)).abs());
            assert!((skin.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }
    assert!(worst < 0.02, "{worst}");
}

/// The plain solution in double precision: the normal equations of the bi-Laplacian, by elimination.
#[test]
fn the_solution_is_that_of_plain_elimination() {
    let (positions, triangles) = sheet(12);
    let is_known = |i: usize| !(3..9).contains(&(i % 12)) || i / 12 < 2;
    let share = |i: usize| (0.5 + 0.5 * ((i * i) as f32 * 0.37).sin()).clamp(0.0, 1.0);
    let known: Vec<Option<SkinWeights>> = (0..144).map(|i| is_known(i).then(|| of_two(share(i)))).collect();
    let laplacian = Laplacian::new(&positions, &triangles);
    let dense = |row: usize| {
        let mut line = vec![0.0; 144];
        for (next, weight) in &laplacian.rows[row] {
            line[row] += weight;
            line[*next as usize] -= weight;
        }
        line
    };
    let lines: Vec<Vec<f64>> = (0..144).map(dense).collect();
    let free: Vec<usize> = (0..144).filter(|i| !is_known(*i)).collect();
    let energy = |i: usize, j: usize| -> f64 { (0..144).map(|k| lines[k][i] * lines[k][j] / laplacian.area[k]).sum() };
    let mut system: Vec<Vec<f64>> = free
        .iter()
        .map(|i| {
            let mut line: Vec<f64> = free.iter().map(|j| energy(*i, *j)).collect();
            line.push(-(0..144).filter(|j| is_known(*j)).map(|j| energy(*i, j) * f64::from(share(j))).sum::<f64>());
            line
        })
        .collect();
    let n = free.len();
    for k in 0..n {
        let pivot = (k..n).max_by(|a, b| system[*a][k].abs().total_cmp(&system[*b][k].abs())).unwrap();
        system.swap(k, pivot);
        for i in (0..n).filter(|i| *i != k) {
            let factor = system[i][k] / system[k][k];
            let row = system[k].clone();
            system[i].iter_mut().zip(&row).for_each(|(a, b)| *a -= factor * b);
        }
    }
    let filled = inpaint(&positions, &triangles, &known);
    let mut compared = 0;
    for (k, i) in free.iter().enumerate() {
        let expected = system[k][n] / system[k][k];
        // Weights beyond 0..=1 are cut off, and the rest is scaled to the sum 1.
        if (0.02..0.98).contains(&expected) {
            let found = f64::from(weight(&filled[*i].unwrap(), 7));
            assert!((found - expected).abs() < 2e-3, "{i}: {found}, expected {expected}");
            compared += 1;
        }
    }
    assert!(compared > n / 2, "{compared} of {n}");
}

#[test]
fn a_thicker_body_has_the_weights_of_the_body_below() {
    let template = default_template(&ShapeParams::default()).unwrap();
    let thick: Vec<Vec3> = template.positions.iter().zip(&template.normals).map(|(p, n)| *p + *n * 0.004).collect();
    let (weights, report) =
        skin_weights((&thick, &template.normals), &template.triangles, &template, SkinSettings::default());
    assert_eq!(weights.len(), thick.len());
    assert!(report.taken > thick.len() * 95 / 100, "{report:?}");
    let mut off: Vec<f32> = weights
        .iter()
        .zip(&template.skin)
        .map(|(found, known)| {
            let known_weight = |joint: u16| weight(known, joint);
            let joints: std::collections::BTreeSet<u16> = found.joints.into_iter().chain(known.joints).collect();
            joints.iter().map(|joint| (weight(found, *joint) - known_weight(*joint)).abs()).sum::<f32>()
        })
        .collect();
    off.sort_by(f32::total_cmp);
    assert!(off[off.len() / 2] < 0.02, "median {}", off[off.len() / 2]);
    assert!(off[off.len() * 95 / 100] < 0.3, "95 % {}", off[off.len() * 95 / 100]);
}

#[test]
fn hair_hangs_with_the_vertices_that_it_grows_from() {
    let template = default_template(&ShapeParams::default()).unwrap();
    // A strip that leaves the crown of the head, straight up, and a part far from everything.
    let top = template.positions.iter().copied().max_by(|a, b| a.y.total_cmp(&b.y)).unwrap();
    let head = template.positions.iter().position(|p| *p == top).unwrap();
    let (mut positions, mut triangles) = (template.positions.clone(), template.triangles.clone());
    let mut normals = template.normals.clone();
    let mut last = [template.triangles.iter().find(|t| t.contains(&(head as u32))).unwrap()[0], head as u32];
    for k in 1..20 {
        let first = positions.len() as u32;
        for side in [-0.01, 0.01] {
            positions.push(top + Vec3::new(side, 0.01 * k as f32, 0.0));
            normals.push(Vec3::Z);
        }
        triangles.push([last[0], first, last[1]]);
        triangles.push([last[1], first, first + 1]);
        last = [first, first + 1];
    }
    let far = positions.len() as u32;
    positions.extend([Vec3::splat(3.0), Vec3::new(3.1, 3.0, 3.0), Vec3::new(3.0, 3.1, 3.0), Vec3::NAN]);
    normals.extend([Vec3::Z; 4]);
    triangles.extend([[far, far + 1, far + 2], [far, far + 3, 1_000_000]]);
    let (weights, report) = skin_weights((&positions, &normals), &triangles, &template, SkinSettings::default());
    assert!(weights.iter().all(|skin| (skin.weights.iter().sum::<f32>() - 1.0).abs() < 1e-4));
    let joint = template.skin[head].joints[0];
    for k in [5, 12, 18] {
        let tip = weight(&weights[template.positions.len() + 2 * k], joint);
        assert!(tip > 0.8, "{k}: {tip}");
    }
    assert_eq!(report.isolated, 4, "{report:?}");
    assert_eq!(report.taken + report.inpainted + report.isolated, positions.len());
}

#[test]
fn poisoned_input_gives_weights_of_the_root() {
    let template = default_template(&ShapeParams::default()).unwrap();
    let settings = SkinSettings::default();
    assert!(skin_weights((&[], &[]), &[], &template, settings).0.is_empty());
    let empty = Template::empty("none", template.skeleton.clone());
    let (weights, report) = skin_weights((&[Vec3::ZERO, Vec3::NAN], &[]), &[[0, 1, 9]], &empty, settings);
    assert_eq!((weights, report.isolated), (vec![root(); 2], 2));
    let wild = SkinSettings { distance_m: f32::NAN, angle_rad: f32::INFINITY };
    let (weights, _) = skin_weights((&[Vec3::Y, Vec3::splat(1e30)], &[Vec3::NAN; 2]), &[], &template, wild);
    assert!(weights.iter().all(|skin| (skin.weights.iter().sum::<f32>() - 1.0).abs() < 1e-4));
}
