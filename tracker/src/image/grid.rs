//! One-channel float images: drawing of meshes, distances, box and guided filters (He et al. 2010), connected components.

use flyrig_types::Mask;
use glam::DVec2;
use rayon::prelude::*;

/// Rows per parallel task.
const ROWS_A_TASK: usize = 32;

/// Image of one number per pixel, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Grid {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl Grid {
    /// Returns a grid filled with `value`.
    pub fn new(width: usize, height: usize, value: f32) -> Self {
        Self { width, height, values: vec![value; width * height] }
    }

    /// Iterates over rows and their indices in parallel, in tasks of several rows.
    pub fn rows_mut(&mut self) -> impl IndexedParallelIterator<Item = (usize, &mut [f32])> {
        self.values.par_chunks_mut(self.width.max(1)).enumerate().with_min_len(ROWS_A_TASK)
    }

    /// Sets the pixels whose centre lies in one of the triangles, and the pixels of their corners, to 1. Triangles with an
    /// unplaced vertex are ignored. Places are pixels, centres at integers.
    pub fn fill_mesh(&mut self, places: &[Option<DVec2>], triangles: &[[u32; 3]]) {
        if !self.values.is_empty() {
            flyrig_types::vectorized(FillMesh { grid: self, places, triangles });
        }
    }

    /// Returns the chamfer distance of each pixel (weights 3 and 4, over 3) to the nearest one above one half, pixels.
    pub fn distance_to_set(&self) -> Self {
        flyrig_types::vectorized(Distances(self))
    }

    /// Returns the mean over a square of `2 radius + 1` pixels around each pixel, cut off at the border.
    pub fn box_mean(&self, radius: usize) -> Self {
        if self.values.is_empty() {
            return self.clone();
        }
        flyrig_types::vectorized(BoxMean(self, radius))
    }

    /// Smooths along the edges of `guide` by the guided filter (He et al. 2010) with a window of `2 radius + 1` pixels and
    /// the regularisation `epsilon`.
    pub fn guided(&self, guide: &Self, radius: usize, epsilon: f32) -> Self {
        let product =
            |a: &Self, b: &Self| Self { values: a.values.iter().zip(&b.values).map(|(a, b)| a * b).collect(), ..*a };
        let ((mean_guide, mean_self), (mut slope, mut offset)) = rayon::join(
            || rayon::join(|| guide.box_mean(radius), || self.box_mean(radius)),
            || rayon::join(|| product(guide, self).box_mean(radius), || product(guide, guide).box_mean(radius)),
        );
        for i in 0..slope.values.len() {
            let (g, s) = (mean_guide.values[i], mean_self.values[i]);
            let a = (slope.values[i] - g * s) / ((offset.values[i] - g * g).max(0.0) + epsilon);
            slope.values[i] = a;
            offset.values[i] = s - a * g;
        }
        let (slope, offset) = rayon::join(|| slope.box_mean(radius), || offset.box_mean(radius));
        let values = guide.values.iter().zip(&slope.values).zip(&offset.values).map(|((g, a), b)| a * g + b);
        Self { values: values.collect(), ..*self }
    }

    /// Returns the values as a mask of a larger image, placed at (`x0`, `y0`); `None` when no pixel reaches one half.
    pub fn paste(&self, width: usize, height: usize, x0: usize, y0: usize) -> Option<Mask> {
        if !self.values.iter().any(|v| *v >= 0.5) {
            return None;
        }
        let mut coverage = vec![0u8; width * height];
        for (y, row) in self.values.chunks_exact(self.width).enumerate() {
            let start = (y + y0) * width + x0;
            for (out, value) in coverage[start..start + self.width].iter_mut().zip(row) {
                *out = (value.clamp(0.0, 1.0) * 255.0).round() as u8;
            }
        }
        Mask::new(width as u32, height as u32, coverage).ok()
    }
}

/// [`Grid::fill_mesh`] of a grid with pixels, compiled for the processor's vector instructions.
struct FillMesh<'a> {
    grid: &'a mut Grid,
    places: &'a [Option<DVec2>],
    triangles: &'a [[u32; 3]],
}

impl pulp::NullaryFnOnce for FillMesh<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { grid: Grid { width, height, values }, places, triangles } = self;
        let (width, height) = (*width, *height);
        let end = DVec2::new(width as f64, height as f64);
        let place = |vertex: u32| places.get(vertex as usize).copied().flatten();
        for &[a, b, c] in triangles {
            let (Some(a), Some(b), Some(c)) = (place(a), place(b), place(c)) else { continue };
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            // Ignores triangles that are not finite, too.
            if !(high.x >= 0.0 && high.y >= 0.0 && low.x < end.x && low.y < end.y) {
                continue;
            }
            for corner in [a, b, c] {
                if corner.x >= 0.0 && corner.y >= 0.0 && corner.x < end.x && corner.y < end.y {
                    values[corner.y as usize * width + corner.x as usize] = 1.0;
                }
            }
            let (first, last) = (low.ceil().max(DVec2::ZERO), (high.floor() + 1.0).min(end));
            let (columns, rows) = (first.x as usize..last.x as usize, first.y as usize..last.y as usize);
            // Most triangles of a body lie between the centres of pixels, or behind others that are filled.
            let is_full = |y: usize| values[y * width..][columns.clone()].iter().all(|value| *value > 0.5);
            if columns.is_empty() || rows.clone().all(is_full) {
                continue;
            }
            let turned = if (b - a).perp_dot(c - a) < 0.0 { -1.0 } else { 1.0 };
            let sides = [(a, (b - a) * turned), (b, (c - b) * turned), (c, (a - c) * turned)];
            for y in rows {
                let from = sides.map(|(from, side)| side.x * (y as f64 - from.y) + side.y * from.x);
                let inside = |x: usize| (0..3).all(|k| from[k] - sides[k].1.y * x as f64 >= 0.0);
                let Some(first) = columns.clone().find(|x| inside(*x)) else { continue };
                for x in (first..columns.end).take_while(|x| inside(*x)) {
                    values[y * width + x] = 1.0;
                }
            }
        }
    }
}

/// [`Grid::distance_to_set`], compiled for the processor's vector instructions.
struct Distances<'a>(&'a Grid);

impl pulp::NullaryFnOnce for Distances<'_> {
    type Output = Grid;

    #[inline(always)]
    fn call(self) -> Grid {
        // In thirds of pixels: sums of whole numbers are exact and take a processor less time than those of `f32`.
        const SIDE: u32 = 3;
        const DIAGONAL: u32 = 4;
        // From the row before: no pixel depends on its neighbour, so that this is vectorised.
        let across = |row: &mut [u32], before: &[u32]| {
            let step = |d: &mut u32, before: &u32, step: u32| *d = (*d).min(before.wrapping_add(step));
            row.iter_mut().zip(before).for_each(|(d, before)| step(d, before, SIDE));
            row.iter_mut().skip(1).zip(before).for_each(|(d, before)| step(d, before, DIAGONAL));
            row.iter_mut().zip(before.iter().skip(1)).for_each(|(d, before)| step(d, before, DIAGONAL));
        };
        let along = |last: u32, d: &mut u32| {
            *d = (*d).min(last.wrapping_add(SIDE));
            *d
        };
        let Grid { width, height, values } = self.0;
        let (width, height) = (*width, *height);
        // Small enough for any sum of steps.
        let far = ((width + height) as u32).saturating_mul(2 * SIDE).min(u32::MAX / 2);
        let mut thirds: Vec<u32> = values.iter().map(|value| if *value > 0.5 { 0 } else { far }).collect();
        for y in 0..height {
            let (above, rest) = thirds.split_at_mut(y * width);
            let row = &mut rest[..width];
            across(row, &above[above.len().saturating_sub(width)..]);
            row.iter_mut().fold(far, along);
        }
        for y in (0..height).rev() {
            let (rest, below) = thirds.split_at_mut((y + 1) * width);
            let row = &mut rest[y * width..];
            across(row, &below[..width.min(below.len())]);
            row.iter_mut().rev().fold(far, along);
        }
        Grid { width, height, values: thirds.into_iter().map(|thirds| thirds as f32 / 3.0).collect() }
    }
}

/// [`Grid::box_mean`] of a grid with pixels, compiled for the processor's vector instructions.
struct BoxMean<'a>(&'a Grid, usize);

impl pulp::NullaryFnOnce for BoxMean<'_> {
    type Output = Grid;

    #[inline(always)]
    fn call(self) -> Grid {
        let Self(grid, radius) = self;
        let (width, height) = (grid.width, grid.height);
        let mut across = grid.clone();
        let shares: Vec<f64> =
            (0..width).map(|x| 1.0 / ((x + radius + 1).min(width) - x.saturating_sub(radius)) as f64).collect();
        // Several rows side by side: one alone would wait for each of its sums. Zeros before and after enter and leave.
        let mut columns = vec![[0.0f32; ROWS_AT_ONCE]; width + 2 * radius + 1];
        let block = ROWS_AT_ONCE * width;
        for (from, to) in grid.values.chunks(block).zip(across.values.chunks_mut(block)) {
            for (row, from) in from.chunks_exact(width).enumerate() {
                columns[radius + 1..].iter_mut().zip(from).for_each(|(column, value)| column[row] = *value);
            }
            let mut sums = [0.0f64; ROWS_AT_ONCE];
            for column in &columns[radius + 1..2 * radius + 1] {
                sums.iter_mut().zip(column).for_each(|(sum, entering)| *sum += f64::from(*entering));
            }
            // Column `x` is read for the last time before its mean is written there.
            for (x, share) in shares.iter().enumerate() {
                let (entering, leaving) = (columns[x + 2 * radius + 1], columns[x]);
                columns[x] = std::array::from_fn(|row| {
                    sums[row] = sums[row] + f64::from(entering[row]) - f64::from(leaving[row]);
                    (sums[row] * share) as f32
                });
            }
            for (row, to) in to.chunks_exact_mut(width).enumerate() {
                to.iter_mut().zip(&columns).for_each(|(mean, column)| *mean = column[row]);
            }
            columns[..radius + 1].fill([0.0; ROWS_AT_ONCE]);
        }
        // All columns at once, row by row.
        let mut out = across.clone();
        let mut sums = vec![0.0f64; width];
        let nothing = vec![0.0f32; width];
        let row = |y: usize| &across.values[y * width..(y + 1) * width];
        for y in 0..radius.min(height) {
            sums.iter_mut().zip(row(y)).for_each(|(sum, entering)| *sum += f64::from(*entering));
        }
        for (y, means) in out.values.chunks_exact_mut(width).enumerate() {
            let entering = if y + radius < height { row(y + radius) } else { &nothing };
            let leaving = if y > radius { row(y - radius - 1) } else { &nothing };
            let share = 1.0 / ((y + radius + 1).min(height) - y.saturating_sub(radius)) as f64;
            for (((mean, sum), entering), leaving) in means.iter_mut().zip(&mut sums).zip(entering).zip(leaving) {
                *sum = *sum + f64::from(*entering) - f64::from(*leaving);
                *mean = (*sum * share) as f32;
            }
        }
        out
    }
}

/// Rows whose running means are computed together.
const ROWS_AT_ONCE: usize = 8;

/// Finds the connected components (4 neighbours) of the pixels that `keep` accepts; calls `each` with the pixels of each.
pub(crate) fn components(grid: &Grid, keep: impl Fn(f32) -> bool, mut each: impl FnMut(&[usize])) {
    let (width, height) = (grid.width, grid.height);
    let mut done = vec![false; width * height];
    let mut stack = Vec::new();
    let mut component = Vec::new();
    for start in 0..done.len() {
        if done[start] || !keep(grid.values[start]) {
            continue;
        }
        component.clear();
        stack.push(start);
        done[start] = true;
        while let Some(at) = stack.pop() {
            component.push(at);
            let (x, y) = (at % width, at / width);
            let mut visit = |next: usize| {
                if !done[next] && keep(grid.values[next]) {
                    done[next] = true;
                    stack.push(next);
                }
            };
            if x > 0 {
                visit(at - 1);
            }
            if x + 1 < width {
                visit(at + 1);
            }
            if y > 0 {
                visit(at - width);
            }
            if y + 1 < height {
                visit(at + width);
            }
        }
        each(&component);
    }
}

/// Keeps the largest component above one half and those at least a fifth as large (an arm cut off by a strap), and fills
/// holes smaller than a disc of `hole_radius` pixels.
pub(crate) fn clean(grid: &mut Grid, hole_radius: usize) {
    let mut sizes = Vec::new();
    components(grid, |v| v >= 0.5, |pixels| sizes.push(pixels.len()));
    let largest = sizes.iter().copied().max().unwrap_or(0);
    let mut drop = Vec::new();
    components(
        grid,
        |v| v >= 0.5,
        |pixels| {
            if pixels.len() * 5 < largest {
                drop.extend_from_slice(pixels);
            }
        },
    );
    for at in drop {
        grid.values[at] = 0.0;
    }
    let small = 3 * hole_radius * hole_radius;
    let mut fill = Vec::new();
    let (width, height) = (grid.width, grid.height);
    components(
        grid,
        |v| v < 0.5,
        |pixels| {
            let border = pixels
                .iter()
                .any(|at| at % width == 0 || at % width == width - 1 || *at < width || *at >= width * (height - 1));
            if pixels.len() <= small && !border {
                fill.extend_from_slice(pixels);
            }
        },
    );
    for at in fill {
        grid.values[at] = 1.0;
    }
    // Soft rims of dropped components: clears everything far from a sure pixel.
    let distance = grid.distance_to_set();
    for (value, d) in grid.values.iter_mut().zip(&distance.values) {
        if *d > 2.0 {
            *value = 0.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use super::*;

    fn square(width: usize, height: usize, x: Range<usize>, y: Range<usize>) -> Grid {
        let mut grid = Grid::new(width, height, 0.0);
        for y in y {
            for x in x.clone() {
                grid.values[y * width + x] = 1.0;
            }
        }
        grid
    }

    #[test]
    fn box_mean_equals_the_plain_sum() {
        for (width, height, radius) in [(7, 5, 2), (1, 1, 3), (9, 24, 1), (40, 19, 12), (3, 16, 7), (0, 4, 1)] {
            let value = |i: usize| ((i * 7919) % 13) as f32;
            let grid = Grid { width, height, values: (0..width * height).map(value).collect() };
            let mean = grid.box_mean(radius);
            for (at, mean) in mean.values.iter().enumerate() {
                let (x, y) = (at % width, at / width);
                let (mut sum, mut count) = (0.0, 0.0);
                for v in y.saturating_sub(radius)..(y + radius + 1).min(height) {
                    for u in x.saturating_sub(radius)..(x + radius + 1).min(width) {
                        sum += f64::from(grid.values[v * width + u]);
                        count += 1.0;
                    }
                }
                assert!((f64::from(*mean) - sum / count).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn poison_enters_means_with_its_rows_and_distances_stay_finite() {
        for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut grid = Grid::new(20, 20, 1.0);
            grid.values[15 * 20 + 10] = poison;
            let mean = grid.box_mean(3);
            assert!(mean.values[..12 * 20].iter().all(|mean| (mean - 1.0).abs() < 1e-6));
            grid.values.iter_mut().filter(|value| value.is_finite()).for_each(|value| *value = 0.0);
            let found = grid.distance_to_set();
            assert!(found.values.iter().all(|d| d.is_finite()));
            assert_eq!(found.values[15 * 20 + 10] < 0.5, poison > 0.5);
        }
    }

    #[test]
    fn an_outline_beside_the_guides_edge_snaps_to_it() {
        let guide = square(40, 40, 10..30, 10..30);
        let beside = square(40, 40, 8..28, 11..31).box_mean(3);
        let snapped = beside.guided(&guide, 6, 1e-4);
        let wrong =
            |grid: &Grid| grid.values.iter().zip(&guide.values).filter(|(a, b)| (**a >= 0.5) != (**b >= 0.5)).count();
        assert!(wrong(&beside) > 60 && wrong(&snapped) < wrong(&beside) / 3, "{} {}", wrong(&snapped), wrong(&beside));
    }

    #[test]
    fn cleaning_keeps_the_large_piece_and_fills_its_small_hole() {
        let mut grid = square(60, 60, 5..45, 5..45);
        grid.values[20 * 60 + 20] = 0.0;
        for (x, y) in [(55, 55), (56, 55), (55, 56)] {
            grid.values[y * 60 + x] = 1.0;
        }
        clean(&mut grid, 3);
        assert_eq!(grid, square(60, 60, 5..45, 5..45));
    }

    fn fill(grid: &mut Grid, corners: [DVec2; 3]) {
        grid.fill_mesh(&corners.map(Some), &[[0, 1, 2]]);
    }

    #[test]
    fn a_triangle_and_the_distance_to_it() {
        let mut grid = Grid::new(20, 20, 0.0);
        fill(&mut grid, [DVec2::new(2.0, 2.0), DVec2::new(12.0, 2.0), DVec2::new(2.0, 12.0)]);
        assert!(grid.values[4 * 20 + 4] > 0.5 && grid.values[11 * 20 + 11] < 0.5);
        let distance = grid.distance_to_set();
        assert!((distance.values[2 * 20 + 17] - 5.0).abs() < 0.1);
        // Nothing set: far, not infinite. Corners outside do not matter.
        fill(&mut grid, [DVec2::splat(-50.0), DVec2::new(1e9, 3.0), DVec2::NAN]);
        assert!(Grid::new(3, 3, 0.0).distance_to_set().values.iter().all(|d| d.is_finite()));
    }

    #[test]
    fn distances_are_those_of_the_shortest_paths() {
        for (width, height) in [(1, 1), (1, 9), (9, 1), (17, 12)] {
            let value = |i: usize| if (i * 7919) % 23 == 3 { 1.0 } else { 0.2 };
            let grid = Grid { width, height, values: (0..width * height).map(value).collect() };
            // Paths of steps to neighbours, made shorter until none is.
            let far = (width + height) as f64 * 2.0;
            let mut plain: Vec<f64> = grid.values.iter().map(|v| if *v > 0.5 { 0.0 } else { far }).collect();
            for _ in 0..width + height {
                for at in 0..plain.len() {
                    let (x, y) = (at % width, at / width);
                    for v in y.saturating_sub(1)..(y + 2).min(height) {
                        for u in x.saturating_sub(1)..(x + 2).min(width) {
                            let step = if u != x && v != y { 4.0 / 3.0 } else { 1.0 };
                            plain[at] = plain[at].min(plain[v * width + u] + step);
                        }
                    }
                }
            }
            for (found, expected) in grid.distance_to_set().values.iter().zip(plain) {
                assert!((f64::from(*found) - expected).abs() < 1e-4, "{width}x{height}: {found} {expected}");
            }
        }
    }

    #[test]
    fn a_triangle_of_either_winding_holds_the_pixels_between_its_sides() {
        // Over several tasks' rows.
        let corners = [DVec2::new(2.3, 1.1), DVec2::new(16.8, 36.4), DVec2::new(5.5, 77.2)];
        let cross = |a: DVec2, b: DVec2, p: DVec2| (b - a).perp_dot(p - a);
        for [a, b, c] in [corners, [corners[1], corners[0], corners[2]]] {
            let mut grid = Grid::new(20, 80, 0.0);
            grid.fill_mesh(&[Some(a), Some(b), Some(c), None], &[[0, 1, 2], [0, 1, 3], [0, 1, 4]]);
            for at in 0..1600 {
                let p = DVec2::new((at % 20) as f64, (at / 20) as f64);
                let sides = [cross(a, b, p), cross(b, c, p), cross(c, a, p)];
                let inside = sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0);
                let is_corner = corners.iter().any(|corner| corner.floor() == p);
                assert_eq!(grid.values[at] > 0.5, inside || is_corner, "{p}");
            }
        }
    }

    #[test]
    fn many_triangles_are_filled_as_one_by_one_and_poisoned_ones_are_left_out() {
        let coordinate = |i: usize| ((i * 7919) % 4513) as f64 / 4513.0 * 60.0 - 10.0;
        let mut places: Vec<Option<DVec2>> =
            (0..300).map(|i| Some(DVec2::new(coordinate(2 * i), coordinate(2 * i + 1)))).collect();
        places.extend([f64::NAN, f64::INFINITY, f64::NEG_INFINITY].map(|poison| Some(DVec2::new(20.0, poison))));
        places.push(None);
        let small = |i: u32| [i, (i + 57) % 300, (i + 111) % 300];
        let triangles: Vec<[u32; 3]> = (0..40).map(|i| small(i * 7)).chain((300..305).map(|bad| [1, 2, bad])).collect();
        let mut grid = Grid::new(40, 37, 0.0);
        grid.fill_mesh(&places, &triangles);
        let cross = |a: DVec2, b: DVec2, p: DVec2| (b - a).perp_dot(p - a);
        for at in 0..40 * 37 {
            let p = DVec2::new((at % 40) as f64, (at / 40) as f64);
            let holds = |&[a, b, c]: &[u32; 3]| {
                let [a, b, c] = [a, b, c].map(|corner| places[corner as usize].unwrap());
                let sides = [cross(a, b, p), cross(b, c, p), cross(c, a, p)];
                let inside = sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0);
                inside || [a, b, c].iter().any(|corner| corner.floor() == p)
            };
            assert_eq!(grid.values[at] > 0.5, triangles[..40].iter().any(holds), "{p}");
        }
    }

    #[test]
    fn an_empty_grid_is_no_mask() {
        assert!(Grid::new(4, 4, 0.2).paste(8, 8, 2, 2).is_none());
        assert_eq!(Grid::new(4, 4, 1.0).paste(8, 8, 2, 2).unwrap().area_px(), 16);
    }
}
