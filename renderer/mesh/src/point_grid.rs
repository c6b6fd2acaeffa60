//! Hashed cells of points for neighbour queries.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use glam::Vec3;
use rayon::prelude::*;

/// Integer coordinates of a cell in the order z, y, x.
type Cell = [i32; 3];

/// Multiplicative hash of a cell; the table is only ever looked up, never iterated, so its order does not matter.
#[derive(Debug, Default)]
pub struct CellHasher(u64);

impl Hasher for CellHasher {
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 29)
    }

    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_u32(u32::from(*byte));
        }
    }

    fn write_u32(&mut self, value: u32) {
        self.0 = (self.0.rotate_left(5) ^ u64::from(value)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }

    fn write_i32(&mut self, value: i32) {
        self.write_u32(value.cast_unsigned());
    }

    fn write_usize(&mut self, value: usize) {
        self.write_u32(value as u32);
    }
}

/// Points sorted into cubes, which are held sparsely: any extent is allowed.
#[derive(Debug)]
pub struct PointGrid {
    origin: Vec3,
    cell: f32,
    /// First and last row in `order`, exclusive, per occupied cell.
    cells: HashMap<Cell, (u32, u32), BuildHasherDefault<CellHasher>>,
    /// Indices and positions of the points by cell and then by index.
    order: Vec<(u32, Vec3)>,
}

impl PointGrid {
    /// Sorts points into cubes of side `cell` metres, best about the radius of later queries; at least `1e-6`.
    pub fn new(positions: &[Vec3], cell: f32) -> Self {
        let origin = positions.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let mut grid = Self { origin, cell: cell.max(1e-6), cells: HashMap::default(), order: Vec::new() };
        let mut rows: Vec<(Cell, u32)> =
            positions.par_iter().enumerate().map(|(i, position)| (grid.cell_of(*position), i as u32)).collect();
        rows.par_sort_unstable();
        let mut start = 0;
        while let Some((cell, _)) = rows.get(start) {
            let end = start + rows[start..].partition_point(|(other, _)| other == cell);
            grid.cells.insert(*cell, (start as u32, end as u32));
            start = end;
        }
        grid.order = rows.into_iter().map(|(_, index)| (index, positions[index as usize])).collect();
        grid
    }

    fn cell_of(&self, point: Vec3) -> Cell {
        // The conversion saturates.
        let cell = ((point - self.origin) / self.cell).floor().as_ivec3();
        [cell.z, cell.y, cell.x]
    }

    /// Calls `visit` with index and position of each point in cells that touch the box, in a fixed order.
    pub fn in_box(&self, low: Vec3, high: Vec3, mut visit: impl FnMut(usize, Vec3)) {
        let (low, high) = (self.cell_of(low), self.cell_of(high));
        for z in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for x in low[2]..=high[2] {
                    if let Some(&(start, end)) = self.cells.get(&[z, y, x]) {
                        let rows = &self.order[start as usize..end as usize];
                        rows.iter().for_each(|(index, position)| visit(*index as usize, *position));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;

    #[test]
    fn the_grid_finds_all_points_of_a_box() {
        let mut random = StdRng::seed_from_u64(5);
        let mut points: Vec<Vec3> = (0..500).map(|_| Vec3::from_array(random.random::<[f32; 3]>()) - 0.5).collect();
        points.push(Vec3::splat(1e30));
        points.push(Vec3::splat(-1e30));
        for cell in [0.05, 0.3] {
            let grid = PointGrid::new(&points[..500], cell);
            let (low, high) = (Vec3::new(-0.2, -0.3, 0.0), Vec3::new(0.1, 0.3, 0.2));
            let inside = |index: &usize| points[*index].cmpge(low).all() && points[*index].cmple(high).all();
            let mut found = Vec::new();
            grid.in_box(low, high, |index, position| {
                assert_eq!(position, points[index]);
                found.push(index);
            });
            found.retain(inside);
            found.sort_unstable();
            assert_eq!(found, (0..500).filter(inside).collect::<Vec<_>>());
        }
        let mut seen = 0;
        PointGrid::new(&points, 0.1).in_box(Vec3::splat(1e30), Vec3::splat(1e30), |_, _| seen += 1);
        assert!(seen >= 1);
        PointGrid::new(&[], 0.1).in_box(Vec3::ZERO, Vec3::ONE, |_, _| panic!("no points"));
    }
}
