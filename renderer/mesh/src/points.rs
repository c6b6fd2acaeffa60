//! Oriented surface points.

use glam::Vec3;

/// One surface point before validation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedPoint {
    /// Position in the world, metres.
    pub position: Vec3,
    /// Outward normal of any length.
    pub normal: Vec3,
    /// Weight, at least 0: opacity, or confidence of a depth pixel.
    pub weight: f32,
    /// Standard deviation of the position along the normal, metres.
    pub uncertainty_m: f32,
}

/// Numbers of rows dropped by [`OrientedPoints::from_rows`] and [`OrientedPoints::drop_distant`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Rows with a value that is not finite, or a negative uncertainty.
    pub not_finite: usize,
    /// Rows with a zero normal.
    pub no_normal: usize,
    /// Rows with a weight of zero or below.
    pub no_weight: usize,
    /// Rows far from all others.
    pub distant: usize,
}

impl Dropped {
    /// Returns the number of dropped rows.
    #[must_use]
    pub fn total(&self) -> usize {
        self.not_finite + self.no_normal + self.no_weight + self.distant
    }
}

/// Returns for each position whether it lies near the others: within the largest extent of their central 98 %, beyond which it lies
/// along no axis.
pub(crate) fn near_others(positions: &[Vec3]) -> Vec<bool> {
    if positions.is_empty() {
        return Vec::new();
    }
    let ranges: [(f64, f64); 3] = std::array::from_fn(|axis| {
        let mut values: Vec<f32> = positions.iter().map(|position| position[axis]).collect();
        let at = values.len() / 100;
        let low = *values.select_nth_unstable_by(at, f32::total_cmp).1;
        let last = values.len() - 1 - at;
        let high = *values.select_nth_unstable_by(last, f32::total_cmp).1;
        (f64::from(low), f64::from(high))
    });
    let extent = ranges.iter().map(|(low, high)| high - low).fold(0.0, f64::max);
    let near = |position: &Vec3| {
        (0..3).all(|axis| {
            let value = f64::from(position[axis]);
            (ranges[axis].0 - extent..=ranges[axis].1 + extent).contains(&value)
        })
    };
    positions.iter().map(near).collect()
}

/// Valid surface points as columns of equal length: finite positions in metres, unit outward normals, positive weights.
///
/// ```
/// use flyrig_mesh::{OrientedPoint, OrientedPoints};
/// use glam::Vec3;
///
/// let row = OrientedPoint { position: Vec3::ZERO, normal: Vec3::Z * 2.0, weight: 1.0, uncertainty_m: 0.001 };
/// let points = OrientedPoints::from_rows([row, OrientedPoint { normal: Vec3::ZERO, ..row }]);
/// assert_eq!((points.len(), points.dropped().no_normal), (1, 1));
/// assert_eq!(points.normals(), [Vec3::Z]);
/// ```
#[derive(Debug, Clone, Default)]
pub struct OrientedPoints {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    weights: Vec<f32>,
    uncertainties: Vec<f32>,
    dropped: Dropped,
}

impl OrientedPoints {
    /// Keeps the valid rows with normals of unit length, and counts the others by reason.
    #[must_use]
    pub fn from_rows(rows: impl IntoIterator<Item = OrientedPoint>) -> Self {
        let mut points = Self::default();
        for row in rows {
            points.push(row);
        }
        points
    }

    fn push(&mut self, row: OrientedPoint) {
        let finite = row.position.is_finite() && row.normal.is_finite() && row.weight.is_finite();
        if !finite || !row.uncertainty_m.is_finite() || row.uncertainty_m < 0.0 {
            self.dropped.not_finite += 1;
            return;
        }
        // In f64 no finite length overflows or vanishes.
        let normal = row.normal.as_dvec3();
        let length = normal.length();
        if length <= 0.0 {
            self.dropped.no_normal += 1;
        } else if row.weight <= 0.0 {
            self.dropped.no_weight += 1;
        } else {
            self.positions.push(row.position);
            self.normals.push((normal / length).as_vec3());
            self.weights.push(row.weight);
            self.uncertainties.push(row.uncertainty_m);
        }
    }

    /// Drops and counts points that lie further outside the central 98 % of the points, along any axis, than the largest
    /// extent of these: a few stray Gaussians must not decide on the size of the grid.
    pub fn drop_distant(&mut self) {
        let keep = near_others(&self.positions);
        self.dropped.distant += self.keep(&keep);
    }

    /// Drops the points that are not to be kept, and returns their number.
    fn keep(&mut self, keep: &[bool]) -> usize {
        retain(&mut self.positions, keep);
        retain(&mut self.normals, keep);
        retain(&mut self.weights, keep);
        retain(&mut self.uncertainties, keep);
        keep.iter().filter(|kept| !**kept).count()
    }

    /// Returns the number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns whether no point is left.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Returns the positions, metres.
    #[must_use]
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// Returns the unit outward normals.
    #[must_use]
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// Returns the weights, above 0.
    #[must_use]
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Returns the standard deviations along the normals, metres.
    #[must_use]
    pub fn uncertainties(&self) -> &[f32] {
        &self.uncertainties
    }

    /// Returns the numbers of dropped rows.
    #[must_use]
    pub fn dropped(&self) -> Dropped {
        self.dropped
    }
}

fn retain<T>(column: &mut Vec<T>, keep: &[bool]) {
    let mut kept = keep.iter();
    column.retain(|_| kept.next().copied().unwrap_or(false));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_dropped_by_reason() {
        let row = OrientedPoint { position: Vec3::ONE, normal: Vec3::X * 1e30, weight: 0.5, uncertainty_m: 0.0 };
        let rows = [
            row,
            OrientedPoint { position: Vec3::new(0.0, f32::NAN, 0.0), ..row },
            OrientedPoint { normal: Vec3::splat(f32::INFINITY), ..row },
            OrientedPoint { normal: Vec3::ZERO, ..row },
            OrientedPoint { normal: Vec3::Y * 1e-40, ..row },
            OrientedPoint { weight: 0.0, ..row },
            OrientedPoint { weight: -1.0, ..row },
            OrientedPoint { weight: f32::NAN, ..row },
            OrientedPoint { uncertainty_m: -1.0, ..row },
        ];
        let points = OrientedPoints::from_rows(rows);
        assert_eq!(points.normals(), [Vec3::X, Vec3::Y]);
        assert_eq!(points.dropped(), Dropped { not_finite: 4, no_normal: 1, no_weight: 2, distant: 0 });
        assert_eq!(points.dropped().total() + points.len(), rows.len());
    }

    #[test]
    fn distant_points_are_dropped_and_counted() {
        let row = OrientedPoint { position: Vec3::ZERO, normal: Vec3::X, weight: 1.0, uncertainty_m: 0.0 };
        let cloud = (0..1000).map(|i| OrientedPoint { position: Vec3::new(i as f32 * 0.001, 0.0, 0.0), ..row });
        let stray = [Vec3::splat(1e30), Vec3::new(0.0, -5.0, 0.0)].map(|position| OrientedPoint { position, ..row });
        let mut points = OrientedPoints::from_rows(cloud.chain(stray));
        points.drop_distant();
        assert_eq!((points.len(), points.dropped().distant), (1000, 2));
        OrientedPoints::default().drop_distant();
    }
}
