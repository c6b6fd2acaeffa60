//! Shapes for tests.

use std::collections::HashMap;
use std::f32::consts::TAU;

use glam::Vec3;

use crate::TriMesh;

/// Returns a closed sphere with bumps, about 1 m wide, of 20 * `cells`^2 triangles.
pub(crate) fn bumpy_sphere(cells: u32) -> TriMesh {
    let ratio = 0.5 * (1.0 + 5f32.sqrt());
    let corners: Vec<Vec3> = (0..12)
        .map(|i| {
            let (a, b) = (if i & 1 == 0 { 1.0 } else { -1.0 }, if i & 2 == 0 { ratio } else { -ratio });
            [Vec3::new(0.0, a, b), Vec3::new(a, b, 0.0), Vec3::new(b, 0.0, a)][i / 4]
        })
        .collect();
    let near = |a: usize, b: usize| (corners[a] - corners[b]).length() < 2.1;
    let mut mesh = TriMesh::default();
    // Key: weights of the corners of the icosahedron.
    let mut index: HashMap<[u32; 12], u32> = HashMap::new();
    for (a, b, c) in (0..12).flat_map(|a| (a + 1..12).flat_map(move |b| (b + 1..12).map(move |c| (a, b, c)))) {
        if !(near(a, b) && near(b, c) && near(c, a)) {
            continue;
        }
        let is_outward = (corners[b] - corners[a]).cross(corners[c] - corners[a]).dot(corners[a]) > 0.0;
        let (b, c) = if is_outward { (b, c) } else { (c, b) };
        let mut at = |i: u32, j: u32| {
            let mut weights = [0; 12];
            (weights[a], weights[b], weights[c]) = (cells - i - j, i, j);
            *index.entry(weights).or_insert_with(|| {
                let d = weights.iter().zip(&corners).map(|(w, corner)| *w as f32 * *corner).sum::<Vec3>().normalize();
                let bump = 1.0 + 0.15 * (5.0 * d.x + 1.0).sin() * (4.0 * d.y).cos() + 0.1 * (6.0 * d.z).sin();
                mesh.positions.push(0.5 * bump * d + Vec3::new(0.0, 0.9, 0.0));
                mesh.positions.len() as u32 - 1
            })
        };
        for i in 0..cells {
            for j in 0..cells - i {
                mesh.triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < cells {
                    mesh.triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
    mesh
}

/// Returns two linked tori of `around` times `across` quads each, 1.4 m and 0.1 m wide.
pub(crate) fn two_tori(around: u32, across: u32) -> TriMesh {
    let mut mesh = TriMesh::default();
    for torus in 0..2 {
        let base = mesh.positions.len() as u32;
        for i in 0..around {
            for j in 0..across {
                let (u, v) = (TAU * i as f32 / around as f32, TAU * j as f32 / across as f32);
                let radius = 0.6 + 0.1 * v.cos();
                let p = Vec3::new(radius * u.cos(), 0.1 * v.sin(), -radius * u.sin());
                mesh.positions.push(if torus == 0 { p } else { Vec3::new(p.x + 0.6, -p.z, p.y) });
                let at = |i: u32, j: u32| base + i % around * across + j % across;
                mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
    }
    mesh
}

/// Returns the unit normals of a mesh, weighted by area.
pub(crate) fn normals(mesh: &TriMesh) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; mesh.positions.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|i| mesh.positions[i as usize]);
        triangle.iter().for_each(|i| sums[*i as usize] += (b - a).cross(c - a));
    }
    sums.into_iter().map(|n| n.normalize_or(Vec3::Y)).collect()
}

/// Returns six times the enclosed volume.
pub(crate) fn volume(mesh: &TriMesh) -> f32 {
    let solid = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
        a.dot(b.cross(c))
    };
    mesh.triangles.iter().map(solid).sum()
}
