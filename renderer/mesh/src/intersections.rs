//! Self-intersections of triangle meshes.

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;

use crate::mesh::TriMesh;

/// Cells that a triangle covers on average, at most.
const CELLS_A_TRIANGLE: f64 = 16.0;
/// Cells from which a triangle is compared with all others instead.
const LARGE: f64 = 4096.0;
/// Largest number of such triangles.
const MAX_LARGE: usize = 64;

/// Box around a triangle, in cells.
type Range = (I64Vec3, I64Vec3);
/// Cell in the order z, y, x, and a triangle that touches it.
type Row = ([i64; 3], u32);

/// Counts the pairs of triangles that intersect and share no vertex. Pairs in one plane are not counted, triangles with
/// coordinates that are not finite are ignored.
#[must_use]
pub fn self_intersections(mesh: &TriMesh) -> usize {
    intersecting(mesh).len()
}

/// Returns the pairs that [`self_intersections`] counts, in an order that depends on the mesh alone.
pub(crate) fn intersecting(mesh: &TriMesh) -> Vec<[u32; 2]> {
    let boxes: Vec<Option<(DVec3, DVec3)>> = (0..mesh.triangles.len())
        .map(|i| {
            let [a, b, c] = mesh.corners(i);
            let finite = a.is_finite() && b.is_finite() && c.is_finite();
            finite.then(|| (a.min(b).min(c), a.max(b).max(c)))
        })
        .collect();
    let Some(grid) = Grid::new(&boxes) else { return Vec::new() };
    let overlap = |i: usize, j: usize| {
        boxes[i].zip(boxes[j]).is_some_and(|((a, b), (c, d))| a.cmple(d).all() && c.cmple(b).all())
    };
    let (large, mut rows) = (grid.large(), Vec::new());
    for (i, (low, high)) in grid.ranges.iter().enumerate().filter_map(|(i, range)| Some((i, (*range)?))) {
        if large.binary_search(&i).is_ok() {
            continue;
        }
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                rows.extend((low.x..=high.x).map(|x| ([z, y, x], i as u32)));
            }
        }
    }
    rows.par_sort_unstable();
    let cells: Vec<&[Row]> = rows.chunk_by(|a, b| a.0 == b.0).collect();
    let in_cell = |rows: &&[Row]| {
        let pairs = rows.iter().enumerate().flat_map(|(at, row)| rows[at + 1..].iter().map(move |other| (row, other)));
        let hit = |((place, i), (_, j)): &(&Row, &Row)| {
            let (i, j) = (*i as usize, *j as usize);
            // A pair counts in the first cell that both touch.
            let first = grid.ranges[i].zip(grid.ranges[j]).map(|((a, _), (b, _))| a.max(b));
            let is_first = first.is_some_and(|first| [first.z, first.y, first.x] == *place);
            is_first && overlap(i, j) && intersect(mesh, i, j)
        };
        pairs.filter(hit).map(|((_, i), (_, j))| [*i, *j]).collect::<Vec<_>>()
    };
    let with_large = |i: &usize| {
        // A pair of large triangles counts for the first of them.
        let others = (0..boxes.len()).filter(|j| *j > *i || large.binary_search(j).is_err());
        let hits = others.filter(|j| overlap(*i, *j) && intersect(mesh, *i, *j));
        hits.map(|j| [*i as u32, j as u32]).collect::<Vec<_>>()
    };
    let small = cells.par_iter().flat_map_iter(in_cell);
    small.chain(large.par_iter().flat_map_iter(with_large)).collect()
}

/// Cells that the boxes of triangles touch.
struct Grid {
    ranges: Vec<Option<Range>>,
}

impl Grid {
    /// Chooses cells of about the size of a triangle, larger if the triangles would touch too many. Returns `None` if all
    /// boxes are empty.
    fn new(boxes: &[Option<(DVec3, DVec3)>]) -> Option<Self> {
        let mut sizes: Vec<f64> =
            boxes.iter().flatten().map(|(low, high)| (*high - *low).max_element()).filter(|size| *size > 0.0).collect();
        let middle = sizes.len() / 2;
        let mut cell = (!sizes.is_empty()).then(|| *sizes.select_nth_unstable_by(middle, f64::total_cmp).1 * 1.5)?;
        let origin = boxes.iter().flatten().map(|(low, _)| *low).reduce(DVec3::min)?;
        loop {
            // The conversion saturates.
            let at = |point: DVec3| ((point - origin) / cell).floor().as_i64vec3();
            let ranges = boxes.iter().map(|bounds| bounds.map(|(low, high)| (at(low), at(high)))).collect();
            let grid = Self { ranges };
            let covered: f64 = grid.ranges.iter().flatten().map(cells).filter(|cells| *cells <= LARGE).sum();
            if covered <= CELLS_A_TRIANGLE * boxes.len() as f64 && grid.large().len() <= MAX_LARGE {
                return Some(grid);
            }
            cell *= 1.5;
        }
    }

    /// Returns the triangles that touch too many cells, ascending.
    fn large(&self) -> Vec<usize> {
        let is_large = |range: &Option<Range>| range.as_ref().is_some_and(|range| cells(range) > LARGE);
        (0..self.ranges.len()).filter(|i| is_large(&self.ranges[*i])).collect()
    }
}

/// Returns the number of cells of a box.
fn cells((low, high): &Range) -> f64 {
    (high.as_dvec3() - low.as_dvec3() + 1.0).element_product()
}

fn intersect(mesh: &TriMesh, i: usize, j: usize) -> bool {
    if mesh.triangles[i].iter().any(|vertex| mesh.triangles[j].contains(vertex)) {
        return false;
    }
    let (a, b) = (mesh.corners(i), mesh.corners(j));
    let crosses = |sides: [DVec3; 3], triangle: [DVec3; 3]| {
        (0..3).any(|side| segment_crosses(sides[side], sides[(side + 1) % 3], triangle))
    };
    crosses(a, b) || crosses(b, a)
}

/// Returns whether a segment passes through a triangle (Möller and Trumbore); `false` if parallel to it.
fn segment_crosses(start: DVec3, end: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    let (direction, u, v) = (end - start, b - a, c - a);
    let normal = direction.cross(v);
    let determinant = u.dot(normal);
    if determinant.abs() <= 1e-12 * direction.length() * u.length() * v.length() {
        return false;
    }
    let offset = start - a;
    let p = offset.dot(normal) / determinant;
    let turned = offset.cross(u);
    let q = direction.dot(turned) / determinant;
    let along = v.dot(turned) / determinant;
    p >= 0.0 && q >= 0.0 && p + q <= 1.0 && (0.0..=1.0).contains(&along)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn the_grid_finds_the_pairs_of_a_plain_search() {
        let mut random = StdRng::seed_from_u64(9);
        let mut place = |size: f32| (Vec3::from_array(random.random::<[f32; 3]>()) - 0.5) * size;
        let mut mesh = TriMesh::default();
        for i in 0..300u32 {
            let (center, size) = (place(1.0), if i % 50 == 0 { 2.0 } else { 0.2 });
            mesh.positions.extend([center + place(size), center + place(size), center + place(size)]);
            mesh.triangles.push([3 * i, 3 * i + 1, 3 * i + 2]);
        }
        let plain = |mesh: &TriMesh| {
            (0..300).flat_map(|i| (0..i).map(move |j| (i, j))).filter(|(i, j)| intersect(mesh, *i, *j)).count()
        };
        assert!(plain(&mesh) > 20);
        assert_eq!(self_intersections(&mesh), plain(&mesh));
        // Few triangles are much larger than all others.
        mesh.positions.iter_mut().take(9).for_each(|position| *position *= 1e3);
        assert_eq!(self_intersections(&mesh), plain(&mesh));
        mesh.positions[900 - 1] = Vec3::NAN;
        mesh.positions[0] = Vec3::splat(1e30);
        assert!(self_intersections(&mesh) < 300 * 300);
    }
}
