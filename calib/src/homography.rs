//! Homographies of a plane, and focal length and pose from them.

use flyrig_solve::RigidMotion;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::DMatrix;

/// Fewest points, and least spread relative to their largest extent, that determine a homography.
const LEAST_POINTS: usize = 4;
const LEAST_SPREAD: f64 = 1e-3;

/// Returns `H` with `to ~ H (from, 1)` by the normalised direct linear transform; `None` for fewer than four points, collinear
/// ones, and numbers that are not finite.
pub(crate) fn homography(pairs: &[(DVec2, DVec2)]) -> Option<DMat3> {
    if pairs.len() < LEAST_POINTS || !pairs.iter().all(|(a, b)| a.is_finite() && b.is_finite()) {
        return None;
    }
    let from = normalisation(pairs.iter().map(|pair| pair.0))?;
    let to = normalisation(pairs.iter().map(|pair| pair.1))?;
    let mut normal = DMatrix::<f64>::zeros(9, 9);
    for (a, b) in pairs {
        let (a, b) = ((from * a.extend(1.0)).truncate(), (to * b.extend(1.0)).truncate());
        for row in [
            [a.x, a.y, 1.0, 0.0, 0.0, 0.0, -b.x * a.x, -b.x * a.y, -b.x],
            [0.0, 0.0, 0.0, a.x, a.y, 1.0, -b.y * a.x, -b.y * a.y, -b.y],
        ] {
            for (i, value) in row.iter().enumerate() {
                for (j, other) in row.iter().enumerate() {
                    normal[(i, j)] += value * other;
                }
            }
        }
    }
    let eigen = normal.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    // A second direction without cost: the points lie on a line.
    if eigen.eigenvalues[order[1]] < 1e-9 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let normalised = DMat3::from_cols_array(&[h[0], h[3], h[6], h[1], h[4], h[7], h[2], h[5], h[8]]);
    let result = to.inverse() * normalised * from;
    result.is_finite().then_some(result)
}

/// Returns the similarity that moves points to mean 0 and mean distance √2.
fn normalisation(points: impl Iterator<Item = DVec2> + Clone) -> Option<DMat3> {
    let count = points.clone().count() as f64;
    let center = points.clone().sum::<DVec2>() / count;
    let spread = points.map(|p| p.distance(center)).sum::<f64>() / count;
    if spread.is_nan() || spread <= 0.0 {
        return None;
    }
    let scale = 2f64.sqrt() / spread;
    Some(DMat3::from_cols(DVec3::X * scale, DVec3::Y * scale, (-center * scale).extend(1.0)))
}

/// Returns the focal length in pixels that explains homographies from planes of equal units to pixels about the
/// principal point (Zhang 2000, with square pixels and a known centre); `None` where they leave it undetermined, as
/// boards without tilt do.
pub(crate) fn focal_length(homographies: &[DMat3]) -> Option<f64> {
    // Of w = 1/f²: a w = b, for each view twice.
    let (mut aa, mut ab) = (0.0, 0.0);
    for h in homographies {
        let norm = (h.x_axis.length() * h.y_axis.length()).max(f64::MIN_POSITIVE);
        let (p, q) = (h.x_axis, h.y_axis);
        for (a, b) in [
            ((p.x * q.x + p.y * q.y) / norm, -p.z * q.z / norm),
            ((p.x * p.x + p.y * p.y - q.x * q.x - q.y * q.y) / norm, -(p.z * p.z - q.z * q.z) / norm),
        ] {
            aa += a * a;
            ab += a * b;
        }
    }
    let focal = (aa / ab).sqrt();
    (focal.is_finite() && focal > 0.0).then_some(focal)
}

/// Returns the motion from the plane's axes to those of a camera with focal length 1 (`h` maps the plane to its ideal
/// plane), and the one with the plane's tilt mirrored about the line of sight: a small image cannot distinguish them.
pub(crate) fn plane_poses(h: &DMat3) -> Option<[RigidMotion; 2]> {
    let scale = 2.0 / (h.x_axis.length() + h.y_axis.length());
    let scale = if h.z_axis.z < 0.0 { -scale } else { scale };
    let (x, y, translation) = (h.x_axis * scale, h.y_axis * scale, h.z_axis * scale);
    // The nearest pair of orthogonal unit vectors.
    let (sum, difference) =
        ((x.normalize_or_zero() + y.normalize_or_zero()), (x.normalize_or_zero() - y.normalize_or_zero()));
    let (sum, difference) = (sum.try_normalize()?, difference.try_normalize()?);
    let half = 0.5f64.sqrt();
    let (x, y) = ((sum + difference) * half, (sum - difference) * half);
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, x.cross(y))).normalize();
    let pose = RigidMotion { rotation, translation };
    let sight = translation.try_normalize()?;
    let normal = x.cross(y);
    let normal = if normal.dot(sight) < 0.0 { -normal } else { normal };
    let mirrored = 2.0 * normal.dot(sight) * sight - normal;
    let turn = DQuat::from_rotation_arc(normal, mirrored.try_normalize()?);
    let other = RigidMotion { rotation: (turn * rotation).normalize(), translation };
    let usable = rotation.is_finite() && translation.is_finite() && other.rotation.is_finite();
    usable.then_some([pose, other])
}

/// Returns whether points spread over a plane instead of along a line.
pub(crate) fn spread_out(points: &[DVec2]) -> bool {
    let count = points.len() as f64;
    let center = points.iter().sum::<DVec2>() / count.max(1.0);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        let d = *p - center;
        (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
    }
    let (mean, difference) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    points.len() >= LEAST_POINTS && mean - difference > LEAST_SPREAD * (mean + difference)
}
