//! Lenses for images of another size than those of the calibration.

use std::fmt;

use flyrig_types::Intrinsics;
use glam::DVec2;

/// Margin below which images were only scaled, pixels: scaled sizes are rounded, to even numbers in videos.
const SCALED_PX: f64 = 1.0;
/// Largest ratio of two aspect ratios that cropping explains.
const MOST_CROP: f64 = 1.5;

/// Relation of images to those of their calibration, where the aspect ratio differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Crop {
    /// They fill their area: the longer direction was cut off evenly at both ends.
    Cropped,
    /// They show all of the calibrated images, and more at both ends of the other direction.
    Extended,
}

/// Change from the calibrated images to others, for the user.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resize {
    /// Pixels of the images over those of the calibration.
    pub scale: f64,
    /// Pixels that were added at each end, x and y; negative ones were cut off.
    pub added: DVec2,
    from: [u32; 2],
    to: [u32; 2],
}

impl Resize {
    /// Returns whether the aspect ratio is the same, so that nothing but the scale is assumed.
    #[must_use]
    pub fn is_scaled_only(&self) -> bool {
        self.added.abs().max_element() <= SCALED_PX
    }
}

impl fmt::Display for Resize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([from_x, from_y], [to_x, to_y]) = (self.from, self.to);
        write!(f, "calibrated at {from_x}x{from_y}, images are {to_x}x{to_y}: scaled by {:.4}", self.scale)?;
        if self.is_scaled_only() {
            return Ok(());
        }
        let (pixels, ends) = if self.added.x.abs() > self.added.y.abs() {
            (self.added.x, "left and right")
        } else {
            (self.added.y, "top and bottom")
        };
        let done = if pixels < 0.0 { "cut off" } else { "added" };
        write!(f, ", {:.1} px {done} at {ends}", pixels.abs())
    }
}

/// Returns the lens of images that were scaled, and cropped or extended about the middle, from those of the calibration. `size` is
/// width and height, pixels.
///
/// # Errors
/// The sizes say that the images were turned by a quarter, or are of another camera mode.
pub fn resize_lens(lens: &Intrinsics, size: (u32, u32), crop: Crop) -> Result<(Intrinsics, Resize), String> {
    let from = DVec2::new(f64::from(lens.width), f64::from(lens.height));
    let to = DVec2::new(f64::from(size.0), f64::from(size.1));
    let [(from_x, from_y), (to_x, to_y)] = [(lens.width, lens.height), size];
    let sizes = format!("calibrated at {from_x}x{from_y}, images are {to_x}x{to_y}");
    if from.min_element() < 1.0 || to.min_element() < 1.0 {
        return Err(format!("{sizes}: a size is 0"));
    }
    let ratios = to / from;
    let mismatch = ratios.max_element() / ratios.min_element();
    if mismatch > MOST_CROP {
        let turned = DVec2::new(to.y, to.x) / from;
        let is_turned = turned.max_element() / turned.min_element() < mismatch;
        let cause = if is_turned {
            "one of them is turned by a quarter; turn the video, or calibrate again with images like these"
        } else {
            "cropping does not explain it; calibrate at this size"
        };
        return Err(format!("{sizes}: {cause}"));
    }
    let scale = match crop {
        Crop::Cropped => ratios.max_element(),
        Crop::Extended => ratios.min_element(),
    };
    let added = 0.5 * (to - scale * from);
    // Pixel centres lie at integers, edges at halves.
    let center_px = scale * (lens.center_px + 0.5) - 0.5 + added;
    let resized =
        Intrinsics { width: size.0, height: size.1, focal_px: scale * lens.focal_px, center_px, lens: lens.lens };
    Ok((resized, Resize { scale, added, from: [from_x, from_y], to: [to_x, to_y] }))
}

#[cfg(test)]
mod tests {
    use flyrig_types::Lens;
    use glam::DVec3;

    use super::*;
    use crate::projection::project;

    fn lens() -> Intrinsics {
        let lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [1e-3, -2e-3] };
        Intrinsics { lens, center_px: DVec2::new(951.0, 540.0), ..Intrinsics::pinhole(1920, 1080, 1500.0) }
    }

    #[test]
    fn points_land_where_the_scaled_and_cropped_image_has_them() {
        let point = DVec3::new(0.3, -0.2, 2.0);
        let before = project(&lens(), point).unwrap();
        for (size, crop, scale, added, words) in [
            ((960, 540), Crop::Cropped, 0.5, DVec2::ZERO, "scaled by 0.5000"),
            ((1440, 1080), Crop::Cropped, 1.0, DVec2::new(-240.0, 0.0), "240.0 px cut off at left and right"),
            ((1440, 1080), Crop::Extended, 0.75, DVec2::new(0.0, 135.0), "135.0 px added at top and bottom"),
        ] {
            let (resized, resize) = resize_lens(&lens(), size, crop).unwrap();
            let expected = scale * (before + 0.5) - 0.5 + added;
            assert!(project(&resized, point).unwrap().distance(expected) < 1e-9, "{size:?}");
            assert_eq!((resized.width, resized.height), size);
            assert!(resize.to_string().ends_with(words), "{resize}");
        }
    }

    #[test]
    fn a_size_that_differs_by_a_row_is_scaled_and_others_are_refused() {
        let (_, resize) = resize_lens(&lens(), (960, 541), Crop::Cropped).unwrap();
        assert!(resize.is_scaled_only(), "{resize}");
        assert!(resize_lens(&lens(), (1080, 1920), Crop::Cropped).unwrap_err().contains("turned by a quarter"));
        assert!(resize_lens(&lens(), (1920, 400), Crop::Cropped).unwrap_err().contains("calibrate at this size"));
        assert!(resize_lens(&lens(), (0, 5), Crop::Cropped).unwrap_err().contains("a size is 0"));
    }
}
