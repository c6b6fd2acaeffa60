//! Silhouette of points in an image: a grid of the cells that hold any, and its rim.

use glam::DVec2;

/// Cells around the points that stay free.
const MARGIN: usize = 6;
/// Most cells of a side; a person that is larger is a person that stands in the camera.
const MOST_CELLS: f64 = 4096.0;
/// Cells beyond a rim that must be free.
const CLEAR_CELLS: [f64; 3] = [1.5, 2.5, 3.5];
/// Least distance of the centre of mass around a rim's cell, cells; a straight edge puts it one and a half inside.
const LEAST_INWARDS: f64 = 0.56;

/// Grid over the image, in cells about as wide as the points' distance.
#[derive(Debug)]
pub(super) struct Silhouette {
    low: DVec2,
    cell: f64,
    width: usize,
    height: usize,
    covered: Vec<bool>,
}

/// Point at the rim of a silhouette.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rim {
    /// Index of the point.
    pub point: usize,
    /// Its pixel, and the unit direction away from the silhouette.
    pub at: DVec2,
    pub outwards: DVec2,
}

impl Silhouette {
    /// Marks the cells of `cell` pixels, at least 2, that hold points; `None` without any point in or near the image.
    pub fn new(pixels: &[Option<DVec2>], cell: f64, size: [u32; 2]) -> Option<Self> {
        let cell = cell.max(2.0);
        let [right, bottom] = size.map(f64::from);
        // Far outside of the image nothing is matched.
        let near = |p: &&DVec2| p.x > -right && p.y > -bottom && p.x < 2.0 * right && p.y < 2.0 * bottom;
        let mut bounds = None;
        for pixel in pixels.iter().flatten().filter(near) {
            let (low, high) = bounds.get_or_insert((*pixel, *pixel));
            (*low, *high) = (low.min(*pixel), high.max(*pixel));
        }
        let (low, high) = bounds?;
        let low = low - MARGIN as f64 * cell;
        let cells = ((high - low) / cell).ceil();
        if !cell.is_finite() || cells.max_element() > MOST_CELLS {
            return None;
        }
        let (width, height) = (cells.x as usize + MARGIN + 1, cells.y as usize + MARGIN + 1);
        let mut grid = Self { low, cell, width, height, covered: vec![false; width * height] };
        for pixel in pixels.iter().flatten() {
            if let Some(index) = grid.index(*pixel) {
                grid.covered[index] = true;
            }
        }
        Some(grid)
    }

    /// Returns the side of a cell, pixels.
    pub fn cell_px(&self) -> f64 {
        self.cell
    }

    /// Returns whether a cell holds a point.
    pub fn is_covered(&self, at: DVec2) -> bool {
        self.index(at).is_some_and(|index| self.covered[index])
    }

    fn index(&self, at: DVec2) -> Option<usize> {
        let cell = ((at - self.low) / self.cell).floor();
        let inside = cell.x >= 0.0 && cell.y >= 0.0 && cell.x < self.width as f64 && cell.y < self.height as f64;
        inside.then(|| cell.y as usize * self.width + cell.x as usize)
    }

    /// Returns one point for each cell at the rim: the outermost one. Gaps between points are no rim.
    pub fn rims(&self, pixels: &[Option<DVec2>]) -> Vec<Rim> {
        let mut rims: Vec<Option<(DVec2, f64, usize)>> = vec![None; self.covered.len()];
        let directions: Vec<Option<DVec2>> = (0..self.covered.len()).map(|index| self.outwards(index)).collect();
        for (point, pixel) in pixels.iter().enumerate() {
            let Some((pixel, index)) = pixel.and_then(|pixel| Some((pixel, self.index(pixel)?))) else { continue };
            let Some(outwards) = directions[index] else { continue };
            let along = pixel.dot(outwards);
            if rims[index].is_none_or(|(_, most, _)| along > most) {
                rims[index] = Some((outwards, along, point));
            }
        }
        let rim = |(outwards, _, point): (DVec2, f64, usize)| {
            let at = pixels[point]?;
            let clear = |cells: &f64| !self.is_covered(at + outwards * (cells * self.cell));
            CLEAR_CELLS.iter().all(clear).then_some(Rim { point, at, outwards })
        };
        rims.into_iter().flatten().filter_map(rim).collect()
    }

    /// Returns the direction away from the silhouette of a cell at its rim.
    fn outwards(&self, index: usize) -> Option<DVec2> {
        let (x, y) = (index % self.width, index / self.width);
        let inside = x >= 3 && y >= 3 && x + 3 < self.width && y + 3 < self.height;
        if !inside || !self.covered[index] {
            return None;
        }
        let at = |dx: isize, dy: isize| self.covered[index.wrapping_add_signed(dx + dy * self.width as isize)];
        if at(-1, 0) && at(1, 0) && at(0, -1) && at(0, 1) {
            return None;
        }
        // Centre of mass of the 7x7 cells around.
        let (mut mass, mut moment) = (0.0, DVec2::ZERO);
        for dy in -3..=3 {
            for dx in -3..=3 {
                if at(dx, dy) {
                    mass += 1.0;
                    moment += DVec2::new(dx as f64, dy as f64);
                }
            }
        }
        let inwards = moment / mass;
        (inwards.length() > LEAST_INWARDS).then(|| -inwards.normalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a disc of 60 pixels radius around (200, 150), about 3 pixels apart.
    fn disc() -> Vec<Option<DVec2>> {
        let all = (-30..=30).flat_map(|y| (-30..=30).map(move |x| DVec2::new(f64::from(x), f64::from(y)) * 2.7));
        all.filter(|p| p.length() <= 60.0).map(|p| Some(p + DVec2::new(200.0, 150.0))).collect()
    }

    #[test]
    fn the_rim_of_a_disc_points_away_from_its_middle_all_around() {
        let mut pixels = disc();
        // A gap of a few points in the middle is no rim.
        pixels.retain(|p| p.is_some_and(|p| p.distance(DVec2::new(210.0, 150.0)) > 4.0));
        pixels.push(None);
        let silhouette = Silhouette::new(&pixels, 4.0, [400, 300]).unwrap();
        let rims = silhouette.rims(&pixels);
        assert!(rims.len() > 50, "{}", rims.len());
        let mut sides = [0; 8];
        for rim in &rims {
            let from = rim.at - DVec2::new(200.0, 150.0);
            assert!(from.length() > 50.0, "{rim:?} is inside");
            assert!(from.normalize().dot(rim.outwards) > 0.9, "{rim:?}");
            sides[((from.to_angle() / std::f64::consts::TAU + 1.0) * 8.0) as usize % 8] += 1;
        }
        assert!(sides.iter().all(|count| *count > 3), "{sides:?}");
    }

    #[test]
    fn nothing_far_away_or_not_finite_has_no_silhouette() {
        assert!(Silhouette::new(&[], 4.0, [400, 300]).is_none());
        assert!(Silhouette::new(&[None; 5], 4.0, [400, 300]).is_none());
        assert!(Silhouette::new(&[Some(DVec2::NAN), Some(DVec2::splat(1e30))], 4.0, [400, 300]).is_none());
        assert!(Silhouette::new(&disc(), f64::NAN, [400, 300]).is_some(), "the least cell");
        assert!(Silhouette::new(&disc(), f64::INFINITY, [400, 300]).is_none());
        let mut far = disc();
        far.push(Some(DVec2::splat(1e12)));
        let silhouette = Silhouette::new(&far, 4.0, [400, 300]).unwrap();
        assert!(silhouette.rims(&far).len() > 50);
    }
}
