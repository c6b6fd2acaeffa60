//! Images as plain RGB bytes.

use std::borrow::Cow;

use flyrig_types::{Camera, Image, PixelFormat};
use glam::DVec2;

use crate::error::{TrackError, TrackErrorKind};

/// RGB bytes of an image, borrowed where the image already has them.
#[derive(Debug, Clone)]
pub(crate) struct Rgb<'a> {
    pub width: usize,
    pub height: usize,
    pub bytes: Cow<'a, [u8]>,
}

impl<'a> Rgb<'a> {
    /// Reads an image.
    ///
    /// # Errors
    /// Kind `Image` when the format cannot be read.
    pub fn new(image: &'a Image) -> Result<Self, TrackError> {
        let bytes =
            if image.format() == PixelFormat::Rgb8 {
                Cow::Borrowed(image.bytes())
            } else {
                Cow::Owned(flyrig_capture::to_rgb8(image).map_err(|error| {
                    TrackError::new(TrackErrorKind::Image, format!("an image cannot be read: {error}"))
                })?)
            };
        Ok(Self { width: image.width() as usize, height: image.height() as usize, bytes })
    }

    /// Reads an image of a camera.
    ///
    /// # Errors
    /// Kind `Image` names the camera when the size is not that of its calibration, or when the format cannot be read.
    pub fn of_camera(image: &'a Image, camera: &Camera) -> Result<Self, TrackError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if (image.width(), image.height()) == (width, height) {
            return Self::new(image);
        }
        Err(TrackError::new(
            TrackErrorKind::Image,
            format!(
                "camera {}: the image is {}x{} but its calibration is for {width}x{height}",
                camera.id,
                image.width(),
                image.height()
            ),
        ))
    }

    /// Whether the image is uniform except for noise, as with a covered lens.
    pub fn is_blank(&self) -> bool {
        /// Number of compared blocks in each direction, and side of a block, pixels.
        const BLOCKS: usize = 24;
        const SIDE: usize = 6;
        /// Standard deviation of the blocks' means below which an image is blank, levels of 0 to 255.
        const LEAST: f64 = 2.0;
        if self.width < BLOCKS * SIDE || self.height < BLOCKS * SIDE {
            return false;
        }
        let mean = |block: usize| {
            let corner = |index: usize, size: usize| index * (size - SIDE) / (BLOCKS - 1);
            let (x, y) = (corner(block % BLOCKS, self.width), corner(block / BLOCKS, self.height));
            let row = |y: usize| &self.bytes[3 * (y * self.width + x)..][..3 * SIDE];
            let sum: u32 = (y..y + SIDE).flat_map(row).map(|&byte| u32::from(byte)).sum();
            f64::from(sum) / (3 * SIDE * SIDE) as f64
        };
        let means: Vec<f64> = (0..BLOCKS * BLOCKS).map(mean).collect();
        let middle = means.iter().sum::<f64>() / means.len() as f64;
        let variance = means.iter().map(|mean| (mean - middle).powi(2)).sum::<f64>() / means.len() as f64;
        variance < LEAST * LEAST
    }

    /// Returns the bytes of a pixel.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2]]
    }

    /// Samples bilinearly, 0..=255; black outside the image.
    #[inline(always)]
    pub fn bilinear(&self, at: DVec2) -> [f32; 3] {
        if !(at.x > -1.0 && at.y > -1.0 && at.x < self.width as f64 && at.y < self.height as f64) {
            return [0.0; 3];
        }
        // Positive where `as` rounds down: one more than the column and row of the upper left pixel.
        let (right, below) = ((at.x + 1.0) as usize, (at.y + 1.0) as usize);
        let (fx, fy) = ((at.x + 1.0 - right as f64) as f32, (at.y + 1.0 - below as f64) as f32);
        // Four channels fill a vector register; the last one is of the next pixel, or nothing, and dropped.
        let mix = |[a, b, c, d]: [[f32; 4]; 4]| -> [f32; 3] {
            let mixed: [f32; 4] = std::array::from_fn(|k| {
                let top = a[k] + (b[k] - a[k]) * fx;
                let bottom = c[k] + (d[k] - c[k]) * fx;
                top + (bottom - top) * fy
            });
            [mixed[0], mixed[1], mixed[2]]
        };
        if right > 0 && below > 0 && right < self.width && below < self.height {
            // Two pixels of two rows, all inside.
            let row = |y: usize| self.bytes[(y * self.width + right - 1) * 3..].first_chunk::<7>();
            if let (Some(top), Some(bottom)) = (row(below - 1), row(below)) {
                let pixel = |row: &[u8; 7], at: usize| [row[at], row[at + 1], row[at + 2], row[at + 3]].map(f32::from);
                return mix([pixel(top, 0), pixel(top, 3), pixel(bottom, 0), pixel(bottom, 3)]);
            }
        }
        let fetch = |dx: usize, dy: usize| -> [f32; 4] {
            let (x, y) = (right + dx, below + dy);
            let is_inside = x > 0 && y > 0 && x <= self.width && y <= self.height;
            let [r, g, b] = if is_inside { self.pixel(x - 1, y - 1).map(f32::from) } else { [0.0; 3] };
            [r, g, b, 0.0]
        };
        mix([fetch(0, 0), fetch(1, 0), fetch(0, 1), fetch(1, 1)])
    }
}

/// Whether an image is uniform except for noise, as with a covered lens. It contains neither people nor background.
///
/// # Errors
/// Kind `Image` when the format cannot be read.
pub fn is_blank(image: &Image) -> Result<bool, TrackError> {
    Ok(Rgb::new(image)?.is_blank())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covered_lenses_are_blank_and_dark_rooms_are_not() {
        let (width, height) = (320usize, 240usize);
        let image = |level: &dyn Fn(usize, usize) -> f64, noise: f64| {
            let mut state = 9u64;
            let mut bytes = Vec::new();
            for at in 0..width * height {
                for _ in 0..3 {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    let unit = (state >> 40) as f64 / (1u64 << 24) as f64;
                    bytes.push((level(at % width, at / width) + noise * (2.0 * unit - 1.0)).clamp(0.0, 255.0) as u8);
                }
            }
            Image::new(width as u32, height as u32, PixelFormat::Rgb8, bytes).unwrap()
        };
        assert!(is_blank(&image(&|_, _| 0.0, 0.0)).unwrap());
        assert!(is_blank(&image(&|_, _| 12.0, 12.0)).unwrap(), "noise alone");
        assert!(is_blank(&image(&|_, _| 255.0, 0.0)).unwrap(), "overexposed");
        assert!(!is_blank(&image(&|x, _| if x < width / 2 { 8.0 } else { 16.0 }, 8.0)).unwrap(), "a dark room");
        let person = |x: usize, y: usize| {
            let is_inside = (140..180).contains(&x) && (60..200).contains(&y);
            if is_inside { 40.0 } else { 100.0 }
        };
        assert!(!is_blank(&image(&person, 5.0)).unwrap(), "a person before a plain wall");
        let small = Image::new(20, 20, PixelFormat::Rgb8, vec![0; 1200]).unwrap();
        assert!(!is_blank(&small).unwrap(), "too small to say");
    }
}
