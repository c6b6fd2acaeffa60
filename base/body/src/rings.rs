//! Surfaces around parts of the body (skirts, shoes) as rings of vertices from top to bottom.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use crate::{Part, SkinWeights, Template};

/// Returns the direction of vertex `k` of `N` around a ring, x to the left and z (as y) to the front, in the order in which triangles
/// face outwards.
pub(crate) fn direction<const N: usize>(k: usize) -> Vec2 {
    let angle = -TAU * k as f32 / N as f32;
    Vec2::new(angle.cos(), angle.sin())
}

/// Returns the points (x, z) in which triangles cross a height.
pub(crate) fn cut(body: &Template, triangles: &[[u32; 3]], y: f32) -> Vec<Vec2> {
    let mut cut = Vec::new();
    for triangle in triangles {
        for (a, b) in [(0, 1), (1, 2), (2, 0)] {
            let [a, b] = [triangle[a], triangle[b]].map(|v| body.positions[v as usize]);
            if (a.y < y) != (b.y < y) {
                let at = a.lerp(b, (y - a.y) / (b.y - a.y));
                cut.push(Vec2::new(at.x, at.z));
            }
        }
    }
    cut
}

/// Returns the distances from a centre to the convex outline of points, by direction; 0 where there is none.
pub(crate) fn convex_radii<const N: usize>(points: &[Vec2], centre: Vec2) -> [f32; N] {
    // The convex outline's distance in a direction is the least, over all half-planes that hold the points, to their edge.
    let supports: Vec<(Vec2, f32)> = (0..4 * N)
        .map(|k| {
            let angle = TAU * k as f32 / (4 * N) as f32;
            let normal = Vec2::new(angle.cos(), angle.sin());
            (normal, points.iter().map(|point| (*point - centre).dot(normal)).fold(0.0, f32::max))
        })
        .collect();
    std::array::from_fn(|k| {
        let direction = direction::<N>(k);
        supports
            .iter()
            .filter(|(normal, _)| normal.dot(direction) > 0.05)
            .map(|(normal, support)| support / normal.dot(direction))
            .fold(f32::INFINITY, f32::min)
    })
}

/// Returns the template with only these triangles and their vertices.
pub(crate) fn kept(body: &Template, triangles: &[[u32; 3]]) -> Template {
    let mut number = vec![u32::MAX; body.positions.len()];
    let mut used = Vec::new();
    for vertex in triangles.iter().flatten().map(|v| *v as usize) {
        if number[vertex] == u32::MAX {
            number[vertex] = used.len() as u32;
            used.push(vertex);
        }
    }
    Template {
        name: body.name.clone(),
        positions: used.iter().map(|v| body.positions[*v]).collect(),
        normals: used.iter().map(|v| body.normals[*v]).collect(),
        uvs: used.iter().map(|v| body.uvs[*v]).collect(),
        triangles: triangles.iter().map(|triangle| triangle.map(|v| number[v as usize])).collect(),
        skin: used.iter().map(|v| body.skin[*v]).collect(),
        parts: used.iter().map(|v| body.parts[*v]).collect(),
        skeleton: body.skeleton.clone(),
    }
}

/// Adds rings of `N` points each, top first, joined into a surface.
pub(crate) fn add_rings<const N: usize>(
    dressed: &mut Template,
    points: &[Vec3],
    part: Part,
    skin: impl Fn(Vec3) -> SkinWeights,
) {
    let first = dressed.positions.len() as u32;
    let rings = (points.len() / N).saturating_sub(1);
    let at = |ring: usize, k: usize| first + (ring * N + k % N) as u32;
    for ring in 0..rings {
        for k in 0..N {
            let [a, b, c, d] = [at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring + 1, k)];
            dressed.triangles.extend([[a, c, b], [a, d, c]]);
        }
    }
    let mut normals: Vec<Vec3> = Vec::with_capacity(points.len());
    for (index, point) in points.iter().enumerate() {
        let (ring, k) = (index / N, index % N);
        let of = |ring: usize, k: usize| points[ring * N + k % N];
        let down = of((ring + 1).min(rings), k) - of(ring.saturating_sub(1), k);
        let around = of(ring, k + 1) - of(ring, k + N - 1);
        let outwards = direction::<N>(k);
        // The last ring may be a single point.
        let above = if ring > 0 { normals[index - N] } else { Vec3::new(outwards.x, 0.0, outwards.y) };
        normals.push(down.cross(around).try_normalize().unwrap_or(above));
        dressed.skin.push(skin(*point));
        dressed.parts.push(part);
        dressed.uvs.push(Vec2::ZERO);
    }
    dressed.normals.extend(normals);
    dressed.positions.extend(points);
}
