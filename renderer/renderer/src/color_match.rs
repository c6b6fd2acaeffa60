//! Colour correction of camera images.

use flyrig_types::{Camera, ColorMatch};
use glam::DVec2;

use crate::color::srgb_from_linear;

/// Entries of the table from linear light to bytes: steps of at most a quarter of a byte, in the shadows.
const CODES: usize = 1 << 14;

/// Applies the [`ColorMatch`] of one camera to its images, from tables.
#[derive(Debug, Clone)]
pub struct ColorMatcher {
    of: ColorMatch,
    center: DVec2,
    /// 1 over the square of half the diagonal.
    scale: f64,
    /// Linear light of each byte in the middle of the image, per channel.
    light: [[f32; 256]; 3],
    /// Corrected bytes in the middle of the image, per channel.
    bytes: [[u8; 256]; 3],
    codes: Vec<u8>,
}

impl ColorMatcher {
    /// Prepares the tables; `None` for a camera without a correction.
    #[must_use]
    pub fn new(camera: &Camera) -> Option<Self> {
        let of = camera.color;
        if of == ColorMatch::NONE {
            return None;
        }
        let mut light = [[0.0; 256]; 3];
        for byte in 0..256 {
            for (table, corrected) in light.iter_mut().zip(of.apply([byte as f64 / 255.0; 3], 0.0)) {
                table[byte] = corrected as f32;
            }
        }
        let code = |light: f32| (srgb_from_linear(light) * 255.0 + 0.5) as u8;
        let [width, height] = camera.size().map(f64::from);
        Some(Self {
            of,
            center: camera.intrinsics.center_px,
            scale: 4.0 / (width * width + height * height),
            bytes: light.map(|table| table.map(code)),
            light,
            codes: (0..CODES).map(|i| code(i as f32 / (CODES - 1) as f32)).collect(),
        })
    }

    /// Returns whether the tables belong to the camera's correction.
    #[must_use]
    pub fn is_of(&self, camera: &Camera) -> bool {
        self.of == camera.color && self.center == camera.intrinsics.center_px
    }

    /// Corrects the first three bytes (sRGB) of every pixel of `channels` bytes, row by row. Pixels for which `skip` is
    /// true are unchanged.
    pub fn correct(&self, pixels: &mut [u8], channels: usize, width: usize, skip: impl Fn(&[u8]) -> bool) {
        let has_falloff = self.of.falloff.iter().any(|share| share.abs() > 0.0);
        for (y, row) in pixels.chunks_exact_mut((channels * width).max(1)).enumerate() {
            for (x, pixel) in row.chunks_exact_mut(channels.max(3)).enumerate().filter(|(_, pixel)| !skip(pixel)) {
                let corner = if has_falloff {
                    let r2 = DVec2::new(x as f64, y as f64).distance_squared(self.center) * self.scale;
                    (r2 * (self.of.falloff[0] + self.of.falloff[1] * r2)).exp() as f32
                } else {
                    1.0
                };
                for (k, byte) in pixel.iter_mut().take(3).enumerate() {
                    let at = usize::from(*byte);
                    *byte = if has_falloff {
                        let light = (self.light[k][at] * corner).min(1.0);
                        self.codes[(light * (CODES - 1) as f32 + 0.5) as usize]
                    } else {
                        self.bytes[k][at]
                    };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;

    fn camera(color: ColorMatch) -> Camera {
        Camera {
            id: "00".into(),
            intrinsics: Intrinsics::pinhole(32, 24, 30.0),
            camera_from_world: Isometry::IDENTITY,
            time_offset_nanos: 0,
            color,
        }
    }

    #[test]
    fn every_pixel_is_corrected_as_defined() {
        for falloff in [[0.0; 2], [0.4, 0.3]] {
            let camera = camera(ColorMatch { gain: [1.3, 0.9, 0.6], exponent: 1.1, falloff });
            let matcher = ColorMatcher::new(&camera).unwrap();
            assert!(matcher.is_of(&camera));
            let before: Vec<u8> = (0..4 * 32 * 24).map(|i| ((i * 7919) % 256) as u8).collect();
            let mut after = before.clone();
            matcher.correct(&mut after, 4, 32, |pixel| pixel[3] < 10);
            for (i, (before, after)) in before.chunks(4).zip(after.chunks(4)).enumerate() {
                assert_eq!(before[3], after[3]);
                if before[3] < 10 {
                    assert_eq!(before, after);
                    continue;
                }
                // By the definition, f64: half the diagonal is 20 pixels, the principal point (15.5, 11.5).
                let (dx, dy) = ((i % 32) as f64 - 15.5, (i / 32) as f64 - 11.5);
                let r2 = (dx * dx + dy * dy) / 400.0;
                for k in 0..3 {
                    let srgb = (f64::from(before[k]) / 255.0).powf(1.1);
                    let light = if srgb <= 0.04045 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) };
                    let light = [1.3, 0.9, 0.6][k] * light * (falloff[0] * r2 + falloff[1] * r2 * r2).exp();
                    let light = light.min(1.0);
                    let srgb = if light <= 0.0031308 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
                    assert!((f64::from(after[k]) - 255.0 * srgb).abs() < 0.8, "{i} {k}: {} {}", after[k], 255.0 * srgb);
                }
            }
        }
    }

    #[test]
    fn nothing_is_done_where_nothing_is_to_do() {
        assert!(ColorMatcher::new(&camera(ColorMatch::NONE)).is_none());
        let matcher = ColorMatcher::new(&camera(ColorMatch { gain: [2.0; 3], ..ColorMatch::NONE })).unwrap();
        matcher.correct(&mut [], 4, 32, |_| false);
        let mut short = [9; 7];
        matcher.correct(&mut short, 3, 32, |_| false);
        assert_eq!(short, [9; 7], "less than a row");
        matcher.correct(&mut short, 3, 0, |_| false);
    }
}
