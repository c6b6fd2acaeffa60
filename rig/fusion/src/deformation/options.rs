//! Options of the deformation: solver, resolution and number of Gaussians.

use flyrig_body::Part;
use flyrig_renderer::WantedImage;
use flyrig_tracker::DeformSettings;

/// Fewest Gaussians that are compared, even where the person is a few pixels high.
const LEAST_GAUSSIANS: f64 = 2000.0;
/// λ_color of the paper's Eq. 3.
pub const PAPER_COLOR_WEIGHT: f32 = 2.0;

/// Options of the deformation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeformOptions {
    /// Steps, weights and limits.
    pub solver: DeformSettings,
    /// Number of Gaussians that are compared with the images; the others follow.
    pub gaussians: usize,
    /// Largest number of compared Gaussians per pixel that the person's whole surface would take in the finest view.
    pub gaussians_a_pixel: f64,
    /// λ_color of Eq. 3, for the sum of squared differences (linear light, 0..=1) over all pixels.
    pub color_weight: f32,
    /// Largest number of times that an image is halved, while a pixel stays finer than the compared Gaussians' spacing.
    pub max_level: u32,
    /// Largest number of compared views, those from the most different directions; 0: all.
    pub views: usize,
    /// Whether head, hands and feet are stiffer than the rest.
    pub stiff_parts: bool,
    /// Most steps of a skirt towards the outlines of the masks before the images are compared, whose derivatives reach a pixel or
    /// two: it swings farther between two frame sets. With 0, none.
    pub outline_steps: usize,
}

impl DeformOptions {
    /// Compares every Gaussian with every pixel, as in the paper.
    pub fn full(solver: DeformSettings) -> Self {
        Self {
            gaussians: usize::MAX,
            gaussians_a_pixel: f64::INFINITY,
            color_weight: PAPER_COLOR_WEIGHT,
            max_level: 0,
            views: 0,
            stiff_parts: false,
            outline_steps: 0,
            ..Self::coarse(solver)
        }
    }

    /// Compares all chosen Gaussians at full resolution, however little that adds.
    #[must_use]
    pub fn without_level_of_detail(self) -> Self {
        Self { gaussians_a_pixel: f64::INFINITY, max_level: 0, ..self }
    }

    /// Returns how many times stiffer than clothes a part is. Three outlines leave a skull or a heel much freedom: where they err, it
    /// grew horns.
    pub fn stiffness(&self, part: Part) -> f64 {
        match part {
            Part::Head if self.stiff_parts => 30.0,
            Part::LeftHand | Part::RightHand | Part::LeftFoot | Part::RightFoot if self.stiff_parts => 10.0,
            _ => 1.0,
        }
    }

    /// Returns the number of compared Gaussians of a surface of `area_m2`, where a pixel of the finest view covers `pixel_m` metres of the
    /// person.
    pub fn compared(&self, area_m2: f64, pixel_m: f64) -> usize {
        let useful = (self.gaussians_a_pixel * area_m2 / (pixel_m * pixel_m)).max(LEAST_GAUSSIANS);
        if useful < self.gaussians as f64 { useful as usize } else { self.gaussians }
    }

    /// Compares no finer than the result needs (measured in docs/benchmarks/deform.md).
    pub fn coarse(solver: DeformSettings) -> Self {
        Self {
            solver,
            gaussians: 30_000,
            gaussians_a_pixel: 2.0,
            // With more the colours, which are painted anew every frame, push the surface along itself.
            color_weight: 0.1 * PAPER_COLOR_WEIGHT,
            max_level: WantedImage::MAX_LEVEL,
            views: 0,
            stiff_parts: true,
            outline_steps: 2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_gaussians_than_pixels_can_tell_apart() {
        let coarse = DeformOptions::coarse(DeformSettings::default());
        assert_eq!(coarse.compared(1.8, 0.002), 30_000);
        assert_eq!(coarse.compared(1.8, 0.015), 16_000);
        assert_eq!(coarse.compared(1.8, 10.0), 2000);
        assert_eq!(DeformOptions { gaussians: 500, ..coarse }.compared(1.8, 10.0), 500);
        assert_eq!(coarse.without_level_of_detail().compared(1.8, 10.0), 30_000);
        for nothing in [f64::NAN, 0.0, f64::INFINITY] {
            assert!((2000..=30_000).contains(&coarse.compared(1.8, nothing)));
        }
    }
}
