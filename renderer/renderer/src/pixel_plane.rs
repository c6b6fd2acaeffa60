//! Depth and normal of a pixel, from the sums of [`RenderTarget::planes`](crate::RenderTarget::planes), and derivatives back to the sums.

use glam::Vec3;

/// Surface in a pixel: the mean of the planes of the Gaussians that it shows.
///
/// ```
/// use flyrig_renderer::PixelPlane;
///
/// // Half covered by a wall 2 m away that faces the camera.
/// let plane = PixelPlane::new([0.0, 0.0, -0.5, 1.0], 0.5, 0.1);
/// assert_eq!(plane, Some(PixelPlane { depth_m: 2.0, normal: [0.0, 0.0, -1.0] }));
/// assert_eq!(PixelPlane::new([0.0, 0.0, -0.05, 0.1], 0.05, 0.1), None, "too little is covered");
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPlane {
    /// Mean camera-space z of the planes, metres.
    pub depth_m: f32,
    /// Unit normal, camera axes.
    pub normal: [f32; 3],
}

impl PixelPlane {
    /// Normalises the sums of a pixel. `None` where alpha is below `least_alpha` or 0, where the normals cancel, and
    /// where a number is not finite.
    #[must_use]
    pub fn new(sums: [f32; 4], alpha: f32, least_alpha: f32) -> Option<Self> {
        let [x, y, z, depth] = sums;
        let is_covered = alpha > 0.0 && alpha >= least_alpha;
        let (depth_m, normal) = (depth / alpha, Vec3::new(x, y, z).try_normalize()?);
        (is_covered && depth_m.is_finite()).then_some(Self { depth_m, normal: normal.to_array() })
    }

    /// Carries dL/d depth (per metre) and dL/d normal to the sums of the pixel that this plane comes from. Returns dL/d sums, for
    /// [`ImageGradients::planes`](crate::ImageGradients::planes), and dL/d alpha, to be added to that of
    /// [`ImageGradients::color`](crate::ImageGradients::color).
    #[must_use]
    pub fn slopes(&self, sums: [f32; 4], alpha: f32, d_depth: f32, d_normal: [f32; 3]) -> ([f32; 4], f32) {
        let (normal, d_normal) = (Vec3::from(self.normal), Vec3::from(d_normal));
        let length = Vec3::new(sums[0], sums[1], sums[2]).length();
        let across = (d_normal - normal * normal.dot(d_normal)) / length;
        (across.extend(d_depth / alpha).to_array(), -d_depth * self.depth_m / alpha)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_those_of_differences() {
        let (sums, alpha) = ([0.2f32, -0.1, -0.6, 1.7], 0.8f32);
        let (d_depth, d_normal) = (0.7, [0.3, -0.9, 0.4]);
        let loss = |sums: [f32; 4], alpha: f32| {
            let plane = PixelPlane::new(sums, alpha, 0.5).unwrap();
            d_depth * plane.depth_m + Vec3::from(d_normal).dot(Vec3::from(plane.normal))
        };
        let (by_sums, by_alpha) = PixelPlane::new(sums, alpha, 0.5).unwrap().slopes(sums, alpha, d_depth, d_normal);
        let step = 1e-2;
        for (k, slope) in by_sums.into_iter().enumerate() {
            let moved = |by: f32| std::array::from_fn(|i| sums[i] + if i == k { by } else { 0.0 });
            let difference = (loss(moved(step), alpha) - loss(moved(-step), alpha)) / (2.0 * step);
            assert!((difference - slope).abs() < 2e-3, "{k}: {difference} {slope}");
        }
        let difference = (loss(sums, alpha + step) - loss(sums, alpha - step)) / (2.0 * step);
        assert!((difference - by_alpha).abs() < 2e-3, "{difference} {by_alpha}");
    }

    #[test]
    fn uncovered_and_poisoned_pixels_have_no_plane() {
        let sums = [0.0, 0.0, -1.0, 2.0];
        assert!(PixelPlane::new(sums, 1.0, 0.5).is_some());
        for alpha in [0.0, -1.0, 0.4, f32::NAN] {
            assert_eq!(PixelPlane::new(sums, alpha, 0.5), None, "{alpha}");
        }
        assert_eq!(PixelPlane::new(sums, 0.0, 0.0), None);
        assert_eq!(PixelPlane::new([0.0, 0.0, 0.0, 2.0], 1.0, 0.5), None, "normals cancel");
        assert_eq!(PixelPlane::new([f32::NAN, 0.0, 1.0, 2.0], 1.0, 0.5), None);
        assert_eq!(PixelPlane::new([0.0, 0.0, 1.0, f32::INFINITY], 1.0, 0.5), None);
    }
}
