//! Convex hulls of silhouettes on the undistorted image plane; a line is tangent to a silhouette if it is tangent to its hull.

use flyrig_types::{Camera, Mask};
use glam::{DVec2, DVec3};

/// Value of a half-covered pixel.
const HALF: f64 = 127.5;

/// Corner of the convex hull of a silhouette.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HullCorner {
    /// Unit direction.
    pub ray: DVec3,
    /// Whether the corner lies on the image border, where the silhouette may continue.
    pub is_cut: bool,
}

/// Returns the convex hull of a mask's half-coverage contour, as directions in the camera's axes.
#[must_use]
pub fn silhouette_hull(camera: &Camera, mask: &Mask) -> Vec<HullCorner> {
    let rotation = camera.camera_from_world.rotation;
    let mut points: Vec<(DVec2, bool)> = outline(mask)
        .into_iter()
        .filter_map(|(pixel, is_cut)| {
            let ray = rotation * camera.ray(pixel)?;
            (ray.z > 1e-3).then(|| (ray.truncate() / ray.z, is_cut))
        })
        .collect();
    points.sort_by(|(a, _), (b, _)| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let mut hull = half_hull(points.iter());
    hull.extend(half_hull(points.iter().rev()));
    hull.into_iter().map(|(point, is_cut)| HullCorner { ray: point.extend(1.0).normalize(), is_cut }).collect()
}

/// Returns the half-coverage contour, interpolated between neighbouring pixels, and covered pixels on the image border; true on the
/// border.
fn outline(mask: &Mask) -> Vec<(DVec2, bool)> {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let at = |x: usize, y: usize| f64::from(mask.coverage()[y * width + x]);
    let mut points = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let (here, place) = (at(x, y), DVec2::new(x as f64, y as f64));
            let (on_side, on_end) = (x == 0 || x + 1 == width, y == 0 || y + 1 == height);
            let mut crossing = |there: f64, to: DVec2, is_cut: bool| {
                if (here < HALF) != (there < HALF) {
                    points.push((place + to * ((HALF - here) / (there - here)), is_cut));
                }
            };
            if x + 1 < width {
                crossing(at(x + 1, y), DVec2::X, on_end);
            }
            if y + 1 < height {
                crossing(at(x, y + 1), DVec2::Y, on_side);
            }
            if here >= HALF && (on_side || on_end) {
                points.push((place, true));
            }
        }
    }
    points
}

/// Returns half of the convex hull of sorted points, without its last point (Andrew 1979).
fn half_hull<'a>(points: impl Iterator<Item = &'a (DVec2, bool)>) -> Vec<(DVec2, bool)> {
    let mut hull: Vec<(DVec2, bool)> = Vec::new();
    for point in points {
        while let [.., (a, _), (b, _)] = hull.as_slice()
            && (*b - *a).perp_dot(point.0 - *b) <= 0.0
        {
            hull.pop();
        }
        hull.push(*point);
    }
    hull.pop();
    hull
}
