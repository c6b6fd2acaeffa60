//! Weighted alignment of point sets (Kabsch 1976, Umeyama 1991).

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, RowVector3, Vector3};

use crate::motion::RigidMotion;

/// Ratio of singular values below which points are collinear; the ratio of widths is its root.
const LEAST_RATIO: f64 = 1e-12;
/// Spread of points over the size of their coordinates below which they are coincident.
const LEAST_SPREAD: f64 = 1e-12;

/// Point before and after the motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointPair {
    /// Point before the motion.
    pub from: DVec3,
    /// Point after the motion.
    pub to: DVec3,
    /// Weight of the squared distance; pairs of weight 0 are ignored.
    pub weight: f64,
}

/// Motion that aligns one point set with another, about the sets' centroids.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// 1 for [`align_rigid`].
    pub scale: f64,
    /// Weighted centroid of the points before.
    pub from_centroid: DVec3,
    /// Weighted centroid of the points after.
    pub to_centroid: DVec3,
}

impl Alignment {
    /// Transforms a point.
    #[must_use]
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.to_centroid + self.rotation * ((point - self.from_centroid) * self.scale)
    }

    /// Returns the rigid motion that follows the scaling: `apply(x) == motion.apply(scale * x)`.
    #[must_use]
    pub fn motion(&self) -> RigidMotion {
        let translation = self.to_centroid - self.rotation * (self.from_centroid * self.scale);
        RigidMotion { rotation: self.rotation, translation }
    }
}

/// Returns the rotation and translation with the least weighted sum of squared distances.
///
/// ```
/// use flyrig_solve::{PointPair, align_rigid};
/// use glam::{DQuat, DVec3};
///
/// let turn = DQuat::from_rotation_z(0.4);
/// let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
/// let pairs = points.map(|from| PointPair { from, to: turn * from + DVec3::X, weight: 1.0 });
/// let found = align_rigid(&pairs).unwrap();
/// assert!(found.rotation.angle_between(turn) < 1e-7);
/// assert!(found.apply(DVec3::ZERO).distance(DVec3::X) < 1e-12);
/// assert!(align_rigid(&pairs[..2]).is_none(), "two points leave a rotation open");
/// ```
///
/// `None` when they are not determined (fewer than three pairs of positive weight, coincident or collinear points, a set and a mirror
/// image of it whose best rotation is ambiguous), when a point or weight is not finite, and when a weight is negative. Other
/// mirrored sets get the best proper rotation.
#[must_use]
pub fn align_rigid(pairs: &[PointPair]) -> Option<Alignment> {
    align(pairs, false)
}

/// Returns rotation, translation and scale with the least weighted sum of squared distances; `None` as in
/// [`align_rigid`], and when the best scale is not positive.
#[must_use]
pub fn align_similarity(pairs: &[PointPair]) -> Option<Alignment> {
    align(pairs, true)
}

#[allow(clippy::float_cmp)] // a weight of exactly 0
fn align(pairs: &[PointPair], with_scale: bool) -> Option<Alignment> {
    let is_usable = |p: &PointPair| p.from.is_finite() && p.to.is_finite() && p.weight.is_finite() && p.weight >= 0.0;
    if !pairs.iter().all(is_usable) {
        return None;
    }
    let used = || pairs.iter().filter(|pair| pair.weight != 0.0);
    if used().count() < 3 {
        return None;
    }
    let total: f64 = used().map(|pair| pair.weight).sum();
    let from_centroid = used().map(|pair| pair.from * pair.weight).sum::<DVec3>() / total;
    let to_centroid = used().map(|pair| pair.to * pair.weight).sum::<DVec3>() / total;
    let mut covariance = Matrix3::zeros();
    let mut variance = 0.0;
    let mut size = (0.0f64, 0.0f64);
    for pair in used() {
        let (a, b) = (pair.from - from_centroid, pair.to - to_centroid);
        covariance += Vector3::new(b.x, b.y, b.z) * RowVector3::new(a.x, a.y, a.z) * pair.weight;
        variance += a.length_squared() * pair.weight;
        size = (size.0.max(pair.from.length()), size.1.max(pair.to.length()));
    }
    if !covariance.iter().all(|value| value.is_finite()) {
        return None;
    }
    let svd = covariance.try_svd(true, true, 1e-12, 100)?;
    let (u, v_t, values) = (svd.u?, svd.v_t?, svd.singular_values);
    let rounding = total * (LEAST_SPREAD * size.0) * (LEAST_SPREAD * size.1);
    let least = rounding.max(LEAST_RATIO * values[0]);
    let sign = (u * v_t).determinant().signum();
    // For a mirror image the axis of the least singular value is reversed; that is ambiguous where the second is as small.
    let is_open = values[1] <= least || (sign < 0.0 && values[1] - values[2] <= least);
    if is_open {
        return None;
    }
    let mut middle = Matrix3::identity();
    middle[(2, 2)] = sign;
    let rotation = u * middle * v_t;
    let rotation = DMat3::from_cols_array(&std::array::from_fn(|k| rotation[(k % 3, k / 3)]));
    let rotation = DQuat::from_mat3(&rotation).normalize();
    let scale = if with_scale { (values[0] + values[1] + sign * values[2]) / variance } else { 1.0 };
    let is_finite = rotation.is_finite() && from_centroid.is_finite() && to_centroid.is_finite();
    (is_finite && scale > 0.0 && scale.is_finite()).then_some(Alignment { rotation, scale, from_centroid, to_centroid })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rotation::exp_rotation;
    use crate::testing::RandomGeometry as _;
    use flyrig_model::SplitMix64;

    fn pairs(random: &mut SplitMix64, count: usize, place: impl Fn(DVec3) -> DVec3) -> Vec<PointPair> {
        (0..count)
            .map(|_| {
                let from = random.vector();
                PointPair { from, to: place(from), weight: 0.2 + random.signed().abs() }
            })
            .collect()
    }

    fn cost(pairs: &[PointPair], place: impl Fn(DVec3) -> DVec3) -> f64 {
        pairs.iter().map(|p| p.weight * (place(p.from) - p.to).length_squared()).sum()
    }

    #[test]
    fn exact_pairs_give_the_motion_and_scale_back() {
        let mut random = SplitMix64(11);
        for count in [3, 4, 30] {
            for _ in 0..30 {
                let (rotation, shift) = (random.rotation(), random.vector() * 100.0);
                let scale = 1.5 + random.signed();
                let rigid = pairs(&mut random, count, |x| rotation * x + shift);
                let found = align_rigid(&rigid).unwrap();
                assert!(rigid.iter().all(|p| (found.apply(p.from) - p.to).length() < 1e-11), "{count} points");
                assert!(rigid.iter().all(|p| (found.motion().apply(p.from) - p.to).length() < 1e-11));
                let scaled = pairs(&mut random, count, |x| rotation * x * scale + shift);
                let found = align_similarity(&scaled).unwrap();
                assert!((found.scale - scale).abs() < 1e-11, "{} {scale}", found.scale);
                assert!(scaled.iter().all(|p| (found.motion().apply(p.from * found.scale) - p.to).length() < 1e-11));
            }
        }
    }

    #[test]
    fn noisy_pairs_cost_less_than_at_any_motion_nearby_and_weights_count() {
        let mut random = SplitMix64(12);
        for _ in 0..20 {
            let rotation = random.rotation();
            let mut noisy = pairs(&mut random, 9, |x| rotation * x);
            for pair in &mut noisy {
                pair.to += random.vector() * 0.2;
            }
            // A pair without weight changes nothing.
            noisy.push(PointPair { from: DVec3::X, to: DVec3::splat(1e6), weight: 0.0 });
            let rigid = align_rigid(&noisy).unwrap();
            let similar = align_similarity(&noisy).unwrap();
            let (least, least_scaled) = (cost(&noisy, |x| rigid.apply(x)), cost(&noisy, |x| similar.apply(x)));
            assert!(least_scaled <= least);
            for _ in 0..300 {
                let mut near = rigid;
                near.rotation = exp_rotation(random.vector() * 0.05) * near.rotation;
                near.to_centroid += random.vector() * 0.02;
                assert!(cost(&noisy, |x| near.apply(x)) > least);
                let mut near = similar;
                near.rotation = exp_rotation(random.vector() * 0.05) * near.rotation;
                near.scale *= 1.0 + 0.05 * random.signed();
                assert!(cost(&noisy, |x| near.apply(x)) > least_scaled);
            }
        }
    }

    #[test]
    fn flat_and_mirrored_sets_get_a_proper_rotation() {
        let mut random = SplitMix64(13);
        for _ in 0..30 {
            let rotation = random.rotation();
            let flat: Vec<PointPair> = (0..5)
                .map(|_| random.vector().with_z(0.0))
                .map(|from| PointPair { from, to: rotation * from, weight: 1.0 })
                .collect();
            let found = align_rigid(&flat).unwrap();
            assert!(found.rotation.dot(rotation).abs() > 1.0 - 1e-12);
            let mirrored = pairs(&mut random, 12, |x| rotation * (x * DVec3::new(1.0, 1.0, -1.0)));
            let found = align_rigid(&mirrored).unwrap();
            let least = cost(&mirrored, |x| found.apply(x));
            for _ in 0..300 {
                let near = Alignment { rotation: exp_rotation(random.vector()) * found.rotation, ..found };
                assert!(cost(&mirrored, |x| near.apply(x)) >= least);
            }
        }
    }

    #[test]
    fn undetermined_and_poisoned_sets_give_none() {
        let pair = |from: DVec3, to: DVec3, weight: f64| PointPair { from, to, weight };
        let same = |points: &[DVec3]| points.iter().map(|p| pair(*p, *p, 1.0)).collect::<Vec<_>>();
        let axis = DVec3::new(1.0, 2.0, 3.0);
        let corners = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let cube: Vec<DVec3> =
            (0..8).map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2))).collect();
        let mut bad = vec![
            vec![],
            same(&corners[..2]),
            same(&[axis * 1000.0; 6]),
            same(&[axis * 0.1 + axis * 1e5; 3]),
            same(&[DVec3::ZERO, axis, axis * 2.0, axis * -3.5]),
            // Inverted through the centre: all axes fit equally badly.
            cube.iter().map(|p| pair(*p, -*p, 1.0)).collect(),
            // One side collinear.
            corners.iter().map(|p| pair(*p, axis * p.x, 1.0)).collect(),
        ];
        for (point, weight) in
            [(DVec3::NAN, 1.0), (DVec3::INFINITY, 1.0), (DVec3::ONE, f64::NAN), (DVec3::ONE, -1.0), (DVec3::MAX, 1.0)]
        {
            let mut poisoned = same(&corners);
            poisoned.push(pair(point, DVec3::ONE, weight));
            bad.push(poisoned.clone());
            poisoned[4] = pair(DVec3::ONE, point, weight);
            bad.push(poisoned);
        }
        let mut unweighted = same(&corners);
        unweighted[..2].iter_mut().for_each(|pair| pair.weight = 0.0);
        bad.push(unweighted);
        for pairs in bad {
            assert_eq!(align_rigid(&pairs), None, "{pairs:?}");
            assert_eq!(align_similarity(&pairs), None, "{pairs:?}");
        }
    }
}
