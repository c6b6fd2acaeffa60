//! Triangulation of landmarks of several views, robust against views that disagree.

use flyrig_types::Camera;
use glam::{DMat3, DVec2, DVec3};

use crate::image::view::{Observation, View, observe};
use crate::landmarks::keypoints::{LANDMARK_COUNT, ViewKeypoints};

/// Least angle between two rays that determine a point, radians.
const MIN_PARALLAX: f64 = 0.03;

/// Landmark in the world.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldPoint {
    /// Place in the world, metres.
    pub position: DVec3,
    /// Indices in the rig of the views that agree.
    pub inliers: Vec<usize>,
    /// Root mean square distance of the agreeing views, pixels of the undistorted image.
    pub residual_px: f64,
}

/// Triangulates every landmark that at least two views agree on.
///
/// Pairs of views give candidates; the one that most views agree with (within `inlier_m` metres at its depth) wins and is
/// refined by Gauss-Newton on reprojection residuals with Cauchy weights. `keypoints` are in rig order, `None` for cameras
/// without landmarks. Unusable landmarks and those below the threshold are ignored, so poisoned input gives fewer points,
/// never one that is not finite.
///
/// ```
/// use flyrig_tracker::{Keypoint, LANDMARK_COUNT, triangulate};
/// use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
/// use glam::{DVec2, DVec3};
///
/// let camera = |id: &str, eye: DVec3| Camera {
///     time_offset_nanos: 0,
///     color: Default::default(),
///     id: id.into(),
///     intrinsics: Intrinsics {
///         width: 640,
///         height: 480,
///         focal_px: DVec2::splat(500.0),
///         center_px: DVec2::new(319.5, 239.5),
///         lens: Lens::PINHOLE,
///     },
///     camera_from_world: Isometry::look_at(eye, DVec3::Z, DVec3::Z),
/// };
/// let cameras = [camera("left", DVec3::new(3.0, 0.0, 1.5)), camera("right", DVec3::new(0.0, 3.0, 1.5))];
///
/// // Both cameras see the nose (landmark 0), and nothing else.
/// let nose = DVec3::new(0.1, -0.2, 1.6);
/// let keypoints: Vec<_> = cameras
///     .iter()
///     .map(|camera| {
///         let mut seen = [Keypoint::default(); LANDMARK_COUNT];
///         seen[0] = Keypoint { pixel: camera.project(nose)?, confidence: 0.9, ..Default::default() };
///         Some(seen)
///     })
///     .collect();
/// let points = triangulate(&cameras, &keypoints, 0.3, 0.05);
/// let found = points[0].as_ref().ok_or("the views do not agree")?;
/// assert!(found.position.distance(nose) < 1e-6);
/// assert_eq!(found.inliers, [0, 1]);
/// assert!(points[1].is_none());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[must_use]
pub fn triangulate(
    cameras: &[Camera],
    keypoints: &[Option<ViewKeypoints>],
    confidence_threshold: f64,
    inlier_m: f64,
) -> [Option<WorldPoint>; LANDMARK_COUNT] {
    let views: Vec<View> = cameras.iter().map(View::new).collect();
    let observations: Vec<_> = cameras
        .iter()
        .zip(&views)
        .zip(keypoints)
        .map(|((camera, view), keypoints)| {
            keypoints.as_ref().map(|keypoints| observe(camera, view, keypoints, confidence_threshold))
        })
        .collect();
    std::array::from_fn(|i| {
        let seen: Vec<(usize, Observation)> = observations
            .iter()
            .enumerate()
            .filter_map(|(slot, view)| view.as_ref().and_then(|v| v[i]).map(|o| (slot, o)))
            .collect();
        triangulate_point(&views, &seen, inlier_m)
    })
}

/// Triangulates one landmark; see [`triangulate`].
pub(crate) fn triangulate_point(views: &[View], seen: &[(usize, Observation)], inlier_m: f64) -> Option<WorldPoint> {
    let mut best: Option<(Vec<usize>, f64, DVec3)> = None;
    for a in 0..seen.len() {
        for b in a + 1..seen.len() {
            let Some(point) = intersect(views, &seen[a], &seen[b]) else { continue };
            let mut inliers = Vec::new();
            let mut score = 0.0;
            for (index, (slot, observation)) in seen.iter().enumerate() {
                if let Some(distance_m) = distance_m(&views[*slot], observation, point)
                    && distance_m < inlier_m
                {
                    inliers.push(index);
                    // Truncated quadratic, so that among equal counts the closer agreement wins.
                    score += observation.confidence * (1.0 - 0.5 * (distance_m / inlier_m).powi(2));
                }
            }
            if inliers.len() >= 2 && best.as_ref().is_none_or(|(_, other, _)| score > *other) {
                best = Some((inliers, score, point));
            }
        }
    }
    let (inliers, _, start) = best?;
    let used: Vec<_> = inliers.iter().map(|&index| seen[index]).collect();
    let position = polish(views, &used, start, inlier_m);
    let mut sum = 0.0;
    for (slot, observation) in &used {
        sum += (views[*slot].project(position)? - observation.ideal_px).length_squared();
    }
    let residual_px = (sum / used.len() as f64).sqrt();
    (position.is_finite() && residual_px.is_finite()).then(|| WorldPoint {
        position,
        inliers: used.iter().map(|(slot, _)| *slot).collect(),
        residual_px,
    })
}

/// Returns the reprojection residual of a world point, metres at its depth.
fn distance_m(view: &View, observation: &Observation, point: DVec3) -> Option<f64> {
    let pixel = view.project(point)?;
    Some((pixel - observation.ideal_px).length() / view.px_per_m(point)?)
}

/// Returns the world direction of an undistorted pixel.
fn ray(view: &View, ideal_px: DVec2) -> DVec3 {
    (view.rotation.transpose() * (ideal_px / view.focal_px).extend(1.0)).normalize()
}

/// Returns the midpoint of the shortest line between two rays; `None` for nearly parallel rays and points behind a camera.
fn intersect(views: &[View], a: &(usize, Observation), b: &(usize, Observation)) -> Option<DVec3> {
    let (view_a, view_b) = (&views[a.0], &views[b.0]);
    let (ray_a, ray_b) = (ray(view_a, a.1.ideal_px), ray(view_b, b.1.ideal_px));
    let cosine = ray_a.dot(ray_b);
    let sine2 = 1.0 - cosine * cosine;
    if sine2.is_nan() || sine2 <= MIN_PARALLAX * MIN_PARALLAX {
        return None;
    }
    let between = view_b.center() - view_a.center();
    let along_a = (between.dot(ray_a) - cosine * between.dot(ray_b)) / sine2;
    let along_b = (cosine * between.dot(ray_a) - between.dot(ray_b)) / sine2;
    let point = 0.5 * (view_a.center() + ray_a * along_a + view_b.center() + ray_b * along_b);
    // A pair whose rays pass each other far away proves nothing; the inlier test decides.
    (along_a > 0.0 && along_b > 0.0 && point.is_finite()).then_some(point)
}

/// Refines a point by Gauss-Newton on reprojection residuals with Cauchy weights.
fn polish(views: &[View], seen: &[(usize, Observation)], start: DVec3, inlier_m: f64) -> DVec3 {
    let mut point = start;
    for _ in 0..5 {
        let mut normal = DMat3::ZERO;
        let mut gradient = DVec3::ZERO;
        for (slot, observation) in seen {
            let Some((pixel, rows)) = views[*slot].project_with_derivative(point) else { continue };
            let Some(px_per_m) = views[*slot].px_per_m(point) else { continue };
            let error = pixel - observation.ideal_px;
            let relative = error.length() / (0.5 * inlier_m * px_per_m);
            let weight = observation.confidence / (px_per_m * px_per_m * (1.0 + relative * relative));
            for (row, e) in rows.into_iter().zip([error.x, error.y]) {
                normal += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
                gradient += row * (e * weight);
            }
        }
        if normal.determinant().abs() < 1e-12 {
            break;
        }
        let step = normal.inverse() * gradient;
        if !step.is_finite() || step.length() > 1.0 {
            break;
        }
        point -= step;
        if step.length() < 1e-6 {
            break;
        }
    }
    point
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::landmarks::keypoints::Keypoint;
    use crate::testing::{keypoints_of, ring};

    fn points() -> [DVec3; LANDMARK_COUNT] {
        std::array::from_fn(|i| {
            let t = i as f64;
            DVec3::new(0.3 * (t * 1.7).sin(), 0.3 * (t * 0.9).cos(), 1.0 + 0.7 * (t * 0.5).sin())
        })
    }

    #[test]
    fn exact_landmarks_give_the_points_back_through_distortion() {
        let rig = ring(4);
        let keypoints: Vec<_> = rig.cameras.iter().map(|c| Some(keypoints_of(c, &points()))).collect();
        for count in 2..=4 {
            let found = triangulate(&rig.cameras[..count], &keypoints[..count], 0.3, 0.05);
            for (found, truth) in found.iter().zip(points()) {
                let found = found.as_ref().unwrap();
                assert!((found.position - truth).length() < 1e-6, "{} {truth}", found.position);
                assert_eq!(found.inliers.len(), count);
            }
        }
    }

    #[test]
    fn a_view_that_is_far_off_is_left_out() {
        let rig = ring(4);
        let mut keypoints: Vec<_> = rig.cameras.iter().map(|c| Some(keypoints_of(c, &points()))).collect();
        for keypoint in keypoints[1].iter_mut().flatten() {
            keypoint.pixel += DVec2::new(80.0, -40.0);
        }
        for (found, truth) in triangulate(&rig.cameras, &keypoints, 0.3, 0.05).iter().zip(points()) {
            let found = found.as_ref().unwrap();
            assert!((found.position - truth).length() < 1e-6);
            assert_eq!(found.inliers, [0, 2, 3]);
        }
    }

    #[test]
    fn poisoned_landmarks_give_no_point_and_never_nan() {
        let rig = ring(3);
        let good = keypoints_of(&rig.cameras[0], &points());
        let nan = [Keypoint { pixel: DVec2::NAN, confidence: 1.0, ..Default::default() }; LANDMARK_COUNT];
        let unsure = [Keypoint { pixel: DVec2::ZERO, confidence: f64::NAN, ..Default::default() }; LANDMARK_COUNT];
        let far = [Keypoint { pixel: DVec2::splat(1e300), confidence: 1.0, ..Default::default() }; LANDMARK_COUNT];
        for keypoints in [
            vec![None, None, None],
            vec![Some(good), None, None],
            vec![Some(good), Some(nan), None],
            vec![Some(good), Some(unsure), Some(nan)],
            vec![Some(good), Some(far), Some(far)],
            vec![],
        ] {
            for point in triangulate(&rig.cameras, &keypoints, 0.3, 0.05) {
                assert!(point.is_none(), "{point:?}");
            }
        }
    }

    #[test]
    fn points_behind_every_camera_are_refused() {
        let rig = ring(2);
        // Rays that diverge meet behind the cameras.
        let mut keypoints: Vec<_> = rig.cameras.iter().map(|c| Some(keypoints_of(c, &points()))).collect();
        for (view, side) in keypoints.iter_mut().zip([-1.0, 1.0]) {
            for keypoint in view.iter_mut().flatten() {
                keypoint.pixel.x = 400.0 + side * 390.0;
            }
        }
        for point in triangulate(&rig.cameras, &keypoints, 0.3, 0.05).into_iter().flatten() {
            assert!(point.position.is_finite());
        }
    }
}
