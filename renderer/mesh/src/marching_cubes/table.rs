//! Triangles of a cube by the signs of its corners, computed from the rule for its faces.
//!
//! Corner `x + 2y + 4z` lies at `(x, y, z)`. On every face the inside corners are cut off separately, run by run: both cubes
//! at a face see the same four signs and draw the same segments, so that surfaces are closed. A cut edge lies in two faces
//! of a cube and therefore on one polygon, so that the polygons around a vertex form a single fan. Polygons are split only
//! along diagonals through the cube's interior: a diagonal in an ambiguous face could be the neighbour's as well, and then
//! belong to four triangles.

use std::sync::LazyLock;

/// Edges of a cube: lower corner and axis.
pub const EDGES: [(u8, u8); 12] =
    [(0, 0), (2, 0), (4, 0), (6, 0), (0, 1), (1, 1), (4, 1), (5, 1), (0, 2), (1, 2), (2, 2), (3, 2)];

/// Triangles as edges, by the bits of the corners that lie inside; counter-clockwise from outside.
pub static TRIANGLES: LazyLock<Vec<Vec<[u8; 3]>>> = LazyLock::new(|| {
    let faces = faces();
    let masks = face_masks(&faces);
    (0..256)
        .map(|inside| polygons(inside, &faces).iter().flat_map(|polygon| split(polygon, &masks)).collect())
        .collect()
});

/// Returns the corners of the six faces, counter-clockwise from outside.
fn faces() -> [[u8; 4]; 6] {
    std::array::from_fn(|face| {
        let (axis, side) = (face / 2, face % 2);
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut corners =
            [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(x, y)| (side << axis) as u8 | (x << u) as u8 | (y << v) as u8);
        if side == 0 {
            corners.reverse();
        }
        corners
    })
}

/// Returns the edge between two neighbouring corners.
fn edge(a: u8, b: u8) -> u8 {
    let wanted = (a.min(b), (a ^ b).trailing_zeros() as u8);
    EDGES.iter().position(|edge| *edge == wanted).unwrap_or_default() as u8
}

/// Returns the bits of the faces that each edge lies in.
fn face_masks(faces: &[[u8; 4]; 6]) -> [u8; 12] {
    let mut masks = [0; 12];
    for (face, corners) in faces.iter().enumerate() {
        for i in 0..4 {
            masks[edge(corners[i], corners[(i + 1) % 4]) as usize] |= 1 << face;
        }
    }
    masks
}

/// Returns the polygons that separate inside from outside, as edges.
fn polygons(inside: u32, faces: &[[u8; 4]; 6]) -> Vec<Vec<u8>> {
    let is_inside = |corner: u8| inside >> corner & 1 == 1;
    // Each segment leads from the edge where a walk around the face enters the inside to the one where it leaves.
    let mut next = [None; 12];
    for corners in faces {
        for i in 0..4 {
            if is_inside(corners[i]) || !is_inside(corners[(i + 1) % 4]) {
                continue;
            }
            let last = (i + 1..i + 4).take_while(|at| is_inside(corners[at % 4])).last().unwrap_or(i + 1);
            let leaves = edge(corners[last % 4], corners[(last + 1) % 4]);
            next[edge(corners[i], corners[(i + 1) % 4]) as usize] = Some(leaves);
        }
    }
    let mut polygons = Vec::new();
    for start in 0..12 {
        let mut polygon = Vec::new();
        let mut at = start;
        while let Some(following) = next[at].take() {
            polygon.push(at as u8);
            at = following as usize;
        }
        if !polygon.is_empty() {
            polygons.push(polygon);
        }
    }
    polygons
}

/// Splits a polygon into triangles with the shortest diagonals through the interior.
fn split(polygon: &[u8], masks: &[u8; 12]) -> Vec<[u8; 3]> {
    best(polygon, masks, 0, polygon.len() - 1).map(|(_, triangles)| triangles).unwrap_or_default()
}

/// Returns total squared length of the diagonals and triangles of the part of a polygon from corner `i` to `j`.
fn best(polygon: &[u8], masks: &[u8; 12], i: usize, j: usize) -> Option<(u32, Vec<[u8; 3]>)> {
    if j <= i + 1 {
        return Some((0, Vec::new()));
    }
    let cost = |a: usize, b: usize| match b == a + 1 || (a == 0 && b == polygon.len() - 1) {
        true => Some(0),
        false => (masks[polygon[a] as usize] & masks[polygon[b] as usize] == 0).then(|| gap(polygon[a], polygon[b])),
    };
    let through = |k: usize| {
        let own = cost(i, k)? + cost(k, j)?;
        let ((left, mut triangles), (right, more)) = (best(polygon, masks, i, k)?, best(polygon, masks, k, j)?);
        triangles.extend(more);
        triangles.push([polygon[i], polygon[k], polygon[j]]);
        Some((own + left + right, triangles))
    };
    (i + 1..j).filter_map(through).min_by_key(|(cost, _)| *cost)
}

/// Returns the squared distance between the middles of two edges, in half sides of the cube.
fn gap(a: u8, b: u8) -> u32 {
    let middle = |at: u8| {
        let (corner, axis) = EDGES[at as usize];
        [0, 1, 2].map(|k| if k == i32::from(axis) { 1 } else { 2 * i32::from(corner >> k & 1) })
    };
    middle(a).iter().zip(middle(b)).map(|(a, b)| (a - b).unsigned_abs().pow(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cut_edge_lies_on_one_polygon_that_can_be_split() {
        let faces = faces();
        let masks = face_masks(&faces);
        assert!(masks.iter().all(|mask| mask.count_ones() == 2));
        for inside in 0..256u32 {
            let polygons = polygons(inside, &faces);
            let mut cut: Vec<u8> = polygons.concat();
            cut.sort_unstable();
            let expected: Vec<u8> = (0..12)
                .filter(|edge| {
                    let (corner, axis) = EDGES[*edge as usize];
                    (inside >> corner & 1) != (inside >> (corner | 1 << axis) & 1)
                })
                .collect();
            assert_eq!(cut, expected, "{inside}");
            let triangles: usize = polygons.iter().map(|polygon| polygon.len() - 2).sum();
            assert_eq!(TRIANGLES[inside as usize].len(), triangles, "{inside}");
        }
    }

    #[test]
    fn no_diagonal_lies_in_a_face() {
        let faces = faces();
        let masks = face_masks(&faces);
        for inside in 0..256u32 {
            let polygons = polygons(inside, &faces);
            let is_side = |a: u8, b: u8| {
                polygons
                    .iter()
                    .any(|polygon| (0..polygon.len()).any(|i| polygon[i] == a && polygon[(i + 1) % polygon.len()] == b))
            };
            for triangle in &TRIANGLES[inside as usize] {
                for i in 0..3 {
                    let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
                    assert!(is_side(a, b) || masks[a as usize] & masks[b as usize] == 0, "{inside} {a} {b}");
                }
            }
        }
    }
}
