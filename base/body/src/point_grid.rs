//! Grid of points for neighbour queries.

use std::ops::Range;

use glam::{IVec3, Vec3};

/// Largest number of cells; more would cost more memory than they save time.
const MAX_CELLS: f64 = 16e6;
/// Cells of a row that share an entry in the table of first points: most cells are empty, and queries test distances anyway.
const CELLS_A_BLOCK: i32 = 4;

/// Finite points sorted into cubes, for queries of neighbours.
///
/// ```
/// use flyrig_body::PointGrid;
/// use glam::Vec3;
///
/// let points = [Vec3::ZERO, Vec3::X, Vec3::X * 1.1];
/// let grid = PointGrid::new(&points, 0.2);
/// let mut near = Vec::new();
/// grid.within(Vec3::X, 0.2, |index, _| near.push(index));
/// near.sort();
/// assert_eq!(near, [1, 2]);
/// ```
#[derive(Debug)]
pub struct PointGrid {
    origin: Vec3,
    cell: f32,
    size: IVec3,
    /// First point of each block of cells in `sorted`; one element more than blocks.
    starts: Vec<u32>,
    /// Index and place of each point, by cells and then by index.
    sorted: Vec<(u32, Vec3)>,
}

impl PointGrid {
    /// Sorts points into cubes of side `cell`, best the radius of later queries.
    #[must_use]
    pub fn new(points: &[Vec3], cell: f32) -> Self {
        let min = points.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let max = points.iter().copied().reduce(Vec3::max).unwrap_or(Vec3::ZERO);
        let extent = (max - min).max(Vec3::splat(1e-6));
        let cells = |cell: f32| (extent / cell).as_dvec3().ceil().max(glam::DVec3::ONE).element_product();
        let mut cell = cell.max(extent.max_element() * 1e-5).max(1e-6);
        while cells(cell) > MAX_CELLS {
            cell *= 1.3;
        }
        let size = (extent / cell).as_ivec3() + IVec3::ONE;
        let mut grid =
            Self { origin: min, cell, size, starts: Vec::new(), sorted: vec![(0, Vec3::ZERO); points.len()] };
        let blocks = IVec3::new((size.x - 1) / CELLS_A_BLOCK + 1, size.y, size.z).element_product() as usize;
        let mut starts = vec![0u32; blocks + 1];
        for &point in points {
            starts[grid.block(grid.cell_of(point)) + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        for (i, &point) in points.iter().enumerate() {
            let slot = &mut next[grid.block(grid.cell_of(point))];
            grid.sorted[*slot as usize] = (i as u32, point);
            *slot += 1;
        }
        let mut sorted = std::mem::take(&mut grid.sorted);
        for block in starts.windows(2).filter(|block| block[1] > block[0] + 1) {
            sorted[block[0] as usize..block[1] as usize].sort_by_key(|(_, point)| grid.cell_of(*point).x);
        }
        Self { starts, sorted, ..grid }
    }

    /// Returns the indices of the points in the order in which queries visit them: neighbours in space are mostly neighbours.
    #[must_use]
    pub fn order(&self) -> Vec<u32> {
        self.sorted.iter().map(|(index, _)| *index).collect()
    }

    fn cell_of(&self, point: Vec3) -> IVec3 {
        ((point - self.origin) / self.cell).floor().as_ivec3().clamp(IVec3::ZERO, self.size - 1)
    }

    fn block(&self, cell: IVec3) -> usize {
        let in_row = (self.size.x - 1) / CELLS_A_BLOCK + 1;
        ((cell.z * self.size.y + cell.y) * in_row + cell.x / CELLS_A_BLOCK) as usize
    }

    /// Calls `visit(index, squared distance)` for each point within `radius`, in a fixed order.
    pub fn within(&self, centre: Vec3, radius: f32, mut visit: impl FnMut(usize, f32)) {
        self.near_box(centre - radius, centre + radius, |index, point| {
            let squared = point.distance_squared(centre);
            if squared <= radius * radius {
                visit(index, squared);
            }
        });
    }

    /// Calls `visit(place, near)` for the points at these places of [`Self::order`], in turn. `near` holds place and squared distance of
    /// each point within `radius`, itself included, in the order of [`Self::within`]. What is near a block of cells is gathered
    /// once for all its points: a third of the time that a query for each takes.
    pub(crate) fn near_each(&self, places: Range<usize>, radius: f32, mut visit: impl FnMut(usize, &[(u32, f32)])) {
        let mut gathered = Gathered::default();
        let mut first = places.start;
        while first < places.end.min(self.sorted.len()) {
            let block = self.block(self.cell_of(self.sorted[first].1));
            let last = (self.starts[block + 1] as usize).min(places.end);
            let points = &self.sorted[first..last];
            let finite = || points.iter().map(|(_, point)| *point).filter(|point| point.is_finite());
            let low = finite().fold(Vec3::INFINITY, Vec3::min);
            let high = finite().fold(Vec3::NEG_INFINITY, Vec3::max);
            gathered.clear();
            self.for_each_row(low - radius, high + radius, |row| {
                for (place, (_, point)) in row.clone().zip(&self.sorted[row]) {
                    // Differences are rounded as those of the distances are.
                    if point.x - high.x <= radius && low.x - point.x <= radius {
                        gathered.push(place as u32, *point);
                    }
                }
            });
            for (place, (_, centre)) in (first..last).zip(points) {
                visit(place, gathered.within(*centre, radius));
            }
            first = last;
        }
    }

    /// Calls `visit(index, position)` for each point of a box and for some beside it, in a fixed order.
    pub fn near_box(&self, low: Vec3, high: Vec3, mut visit: impl FnMut(usize, Vec3)) {
        self.for_each_row(low, high, |row| {
            self.sorted[row].iter().for_each(|(index, point)| visit(*index as usize, *point));
        });
    }

    /// Calls `visit` with the places of the points of each row of blocks that a box touches, in a fixed order.
    fn for_each_row(&self, low: Vec3, high: Vec3, mut visit: impl FnMut(Range<usize>)) {
        let (low, high) = (self.cell_of(low), self.cell_of(high));
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                // Blocks of a row lie side by side.
                let first = self.starts[self.block(IVec3::new(low.x, y, z))];
                let last = self.starts[self.block(IVec3::new(high.x, y, z)) + 1];
                visit(first as usize..last as usize);
            }
        }
    }
}

/// Points by axis, so that distances are computed side by side.
#[derive(Default)]
struct Gathered {
    places: Vec<u32>,
    axes: [Vec<f32>; 3],
    squared: Vec<f32>,
    near: Vec<(u32, f32)>,
}

impl Gathered {
    fn clear(&mut self) {
        self.places.clear();
        self.axes.iter_mut().for_each(Vec::clear);
    }

    fn push(&mut self, place: u32, point: Vec3) {
        self.places.push(place);
        self.axes.iter_mut().zip(point.to_array()).for_each(|(axis, value)| axis.push(value));
    }

    /// Returns place and squared distance of each point within `radius`.
    fn within(&mut self, centre: Vec3, radius: f32) -> &[(u32, f32)] {
        let [xs, ys, zs] = &self.axes;
        self.squared.clear();
        let squared = xs.iter().zip(ys).zip(zs).map(|((x, y), z)| Vec3::new(*x, *y, *z).distance_squared(centre));
        self.squared.extend(squared);
        // Without a branch, which the processor would often predict wrongly.
        self.near.resize(self.places.len() + 1, (0, 0.0));
        let mut count = 0;
        for found in self.places.iter().copied().zip(self.squared.iter().copied()) {
            self.near[count] = found;
            count += usize::from(found.1 <= radius * radius);
        }
        &self.near[..count]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn the_grid_finds_what_a_plain_search_finds() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(5);
        let points: Vec<Vec3> = (0..500).map(|_| Vec3::from_array(rng.random::<[f32; 3]>()) * 2.0 - 1.0).collect();
        for (cell, radius) in [(0.1, 0.1), (0.01, 0.3), (5.0, 0.2), (1e-9, 0.1)] {
            let grid = PointGrid::new(&points, cell);
            for &centre in &[points[7], Vec3::splat(0.9), Vec3::splat(-40.0)] {
                let mut found = Vec::new();
                grid.within(centre, radius, |i, _| found.push(i));
                found.sort_unstable();
                let plain: Vec<usize> = (0..500).filter(|&i| points[i].distance(centre) <= radius).collect();
                assert_eq!(found, plain, "cell {cell} radius {radius} centre {centre}");
            }
        }
        PointGrid::new(&[], 1.0).within(Vec3::ZERO, 1.0, |_, _| panic!("no points"));
    }

    #[test]
    fn what_is_near_each_point_is_what_a_query_for_it_finds_in_the_same_order() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(8);
        let points: Vec<Vec3> = (0..3000).map(|_| Vec3::from_array(rng.random::<[f32; 3]>()) * 2.0 - 1.0).collect();
        for (cell, radius) in [(0.1, 0.1), (0.03, 0.12), (5.0, 0.2)] {
            let grid = PointGrid::new(&points, cell);
            let order = grid.order();
            let mut visited = 0;
            for places in [0..1, 1..1700, 1700..9000] {
                grid.near_each(places, radius, |place, near| {
                    assert_eq!(place, visited);
                    visited += 1;
                    let mut expected = Vec::new();
                    grid.within(points[order[place] as usize], radius, |j, squared| expected.push((j as u32, squared)));
                    let near: Vec<(u32, f32)> = near.iter().map(|&(j, squared)| (order[j as usize], squared)).collect();
                    assert_eq!(near, expected, "cell {cell} radius {radius}");
                });
            }
            assert_eq!(visited, points.len());
        }
        PointGrid::new(&[], 1.0).near_each(0..5, 1.0, |_, _| panic!("no points"));
    }

    #[test]
    fn the_grid_finds_all_points_of_a_box() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(5);
        let mut points: Vec<Vec3> = (0..500).map(|_| Vec3::from_array(rng.random::<[f32; 3]>()) - 0.5).collect();
        let (low, high) = (Vec3::new(-0.2, -0.3, 0.0), Vec3::new(0.1, 0.3, 0.2));
        for (stray, cell) in [(false, 0.05), (false, 0.3), (true, 0.1)] {
            if stray {
                points.extend([Vec3::splat(1e30), Vec3::splat(-1e30), Vec3::splat(f32::MAX)]);
            }
            let grid = PointGrid::new(&points, cell);
            let inside = |index: &usize| points[*index].cmpge(low).all() && points[*index].cmple(high).all();
            let mut found = Vec::new();
            grid.near_box(low, high, |index, position| {
                assert_eq!(position, points[index]);
                found.push(index);
            });
            found.retain(inside);
            found.sort_unstable();
            assert_eq!(found, (0..points.len()).filter(inside).collect::<Vec<_>>());
        }
        PointGrid::new(&[], 0.1).near_box(Vec3::ZERO, Vec3::ONE, |_, _| panic!("no points"));
    }

    #[test]
    fn the_order_holds_every_point_once_and_mostly_beside_its_neighbours() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(6);
        let points: Vec<Vec3> = (0..2000).map(|_| Vec3::from_array(rng.random::<[f32; 3]>())).collect();
        let order = PointGrid::new(&points, 0.1).order();
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.into_iter().eq(0..2000));
        let length = |order: &mut dyn Iterator<Item = u32>| {
            let places: Vec<Vec3> = order.map(|index| points[index as usize]).collect();
            places.windows(2).map(|pair| pair[0].distance(pair[1])).sum::<f32>()
        };
        let (in_order, as_given) = (length(&mut order.into_iter()), length(&mut (0..2000)));
        assert!(in_order < 0.3 * as_given, "{in_order} of {as_given}");
        assert!(PointGrid::new(&[], 1.0).order().is_empty());
    }
}
