//! Surfaces of random and analytic fields.

use glam::{IVec3, Vec3};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

use crate::field::Field;
use crate::topology::Topology;

use super::marching_cubes;

/// Signed distance by position, metres.
type Shape<'a> = &'a (dyn Fn(Vec3) -> f32 + Sync);

/// Checks that the surface of a field of random values is closed and manifold, with outward triangles.
fn check(values: &[f32], side: i32, name: &str) {
    let value = |place: IVec3| values[((place.z * side + place.y) * side + place.x) as usize];
    let mesh = marching_cubes(&Field::from_values(side / 8, 0.01, value));
    let topology = Topology::measure(&mesh);
    assert!(topology.is_closed_manifold(), "{name}: {topology:?}");
    assert_eq!((topology.degenerate_triangles, topology.vertices), (0, mesh.positions.len()), "{name}");
    let inner = (0..side * side * side).filter(|at| {
        let place = IVec3::new(at % side, at / side % side, at / (side * side));
        place.min_element() > 0 && place.max_element() < side - 1 && value(place) < 0.0
    });
    if topology.triangles > 0 {
        assert!(topology.volume_m3 > 0.0, "{name}: {topology:?}");
    } else {
        assert_eq!(inner.count(), 0, "{name}");
    }
}

#[test]
fn random_fields_have_closed_manifold_surfaces() {
    let mut random = StdRng::seed_from_u64(11);
    for round in 0..2000 {
        let side = if round % 50 == 0 { 16 } else { 8 };
        let share = [0.5f32, 0.2, 0.8, 0.03][round % 4];
        let values: Vec<f32> = (0..side * side * side)
            .map(|_| {
                let sign = if random.random::<f32>() < share { -1.0 } else { 1.0 };
                match round % 3 {
                    0 => sign,
                    1 => sign * random.random::<f32>(),
                    // A third of the values is an exact zero of either sign, others are tiny or huge.
                    _ => sign * [0.0, 1e-30, 1e30][(random.random::<f32>() * 2.99) as usize],
                }
            })
            .collect();
        check(&values, side, &format!("round {round}"));
    }
}

#[test]
fn checkerboards_have_closed_manifold_surfaces() {
    for (period, side) in [(1, 8), (1, 16), (2, 16), (3, 16)] {
        for sign in [1.0, -1.0] {
            let values: Vec<f32> = (0..side * side * side)
                .map(|at: i32| {
                    let sum = at % side / period + at / side % side / period + at / (side * side) / period;
                    if sum % 2 == 0 { sign } else { -sign }
                })
                .collect();
            check(&values, side, &format!("period {period}"));
        }
    }
}

#[test]
fn all_cubes_of_all_cases_fit_together() {
    for inside in 0..256 {
        let values: Vec<f32> = (0..512)
            .map(|at| {
                let place = IVec3::new(at % 8, at / 8 % 8, at / 64) - 3;
                let corner = place.x + 2 * place.y + 4 * place.z;
                let in_cube = place.min_element() >= 0 && place.max_element() <= 1;
                if in_cube && inside >> corner & 1 == 1 { -1.0 } else { 1.0 }
            })
            .collect();
        check(&values, 8, &format!("case {inside}"));
    }
}

#[test]
fn spheres_and_tori_have_their_genus_and_accuracy() {
    let center = Vec3::splat(0.32);
    let torus = |place: Vec3| {
        let offset = place - center;
        let ring = (offset.x * offset.x + offset.y * offset.y).sqrt() - 0.2;
        (ring * ring + offset.z * offset.z).sqrt() - 0.07
    };
    let sphere = |place: Vec3| place.distance(center) - 0.2;
    let shapes: [(Shape, i64, f64); 2] = [
        (&torus, 1, 2.0 * (0.07f64 * std::f64::consts::PI).powi(2) * 0.2),
        (&sphere, 0, 4.0 / 3.0 * 0.2f64.powi(3) * std::f64::consts::PI),
    ];
    for (shape, genus, volume) in shapes {
        let mesh = marching_cubes(&Field::from_values(8, 0.01, |place| shape(place.as_vec3() * 0.01)));
        let origin = -Vec3::splat(0.01 + 2.0 * 0.01);
        let error = mesh.positions.iter().map(|p| shape(*p - origin).abs()).sum::<f32>() / mesh.positions.len() as f32;
        assert!(error < 0.0002, "{error}");
        let topology = Topology::measure(&mesh);
        assert_eq!((topology.genus(), topology.components, topology.self_intersections), (Some(genus), 1, 0));
        assert!((topology.volume_m3 / volume - 1.0).abs() < 0.01, "{topology:?} {volume}");
        assert!(mesh.from_hole.iter().all(|hole| !hole));
        // Normals point outwards.
        for (position, normal) in mesh.positions.iter().zip(mesh.normals()) {
            assert!(shape(*position - origin + normal * 0.02) > 0.0);
        }
    }
}
