//! Pictures as plain RGB bytes.

use std::borrow::Cow;

use flyrig_types::{Image, PixelFormat};
use glam::DVec2;

use crate::{TrackError, TrackErrorKind};

/// RGB bytes of a picture, borrowed where the picture already has them.
#[derive(Debug, Clone)]
pub(crate) struct Rgb<'a> {
    pub width: usize,
    pub height: usize,
    pub bytes: Cow<'a, [u8]>,
}

impl<'a> Rgb<'a> {
    pub fn new(image: &'a Image) -> Result<Self, TrackError> {
        let bytes = if image.format() == PixelFormat::Rgb8 {
            Cow::Borrowed(image.bytes())
        } else {
            Cow::Owned(flyrig_capture::to_rgb8(image).map_err(|error| {
                TrackError::new(TrackErrorKind::Image, format!("a picture cannot be read: {error}"))
            })?)
        };
        Ok(Self { width: image.width() as usize, height: image.height() as usize, bytes })
    }

    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2]]
    }

    /// Bilinear sample, 0..=255; black outside.
    pub fn bilinear(&self, at: DVec2) -> [f32; 3] {
        if !(at.x > -1.0 && at.y > -1.0 && at.x < self.width as f64 && at.y < self.height as f64) {
            return [0.0; 3];
        }
        // Positive where `as` rounds down: one more than the column and row of the upper left pixel.
        let (right, below) = ((at.x + 1.0) as usize, (at.y + 1.0) as usize);
        let (fx, fy) = ((at.x + 1.0 - right as f64) as f32, (at.y + 1.0 - below as f64) as f32);
        let mix = |a: [f32; 3], b: [f32; 3], c: [f32; 3], d: [f32; 3]| {
            std::array::from_fn(|k| {
                let top = a[k] + (b[k] - a[k]) * fx;
                let bottom = c[k] + (d[k] - c[k]) * fx;
                top + (bottom - top) * fy
            })
        };
        if right > 0 && below > 0 && right < self.width && below < self.height {
            // Two pixels of two rows, all inside.
            let row = |y: usize| self.bytes[(y * self.width + right - 1) * 3..].first_chunk::<6>();
            if let (Some(top), Some(bottom)) = (row(below - 1), row(below)) {
                let pixel = |row: &[u8; 6], at: usize| [row[at], row[at + 1], row[at + 2]].map(f32::from);
                return mix(pixel(top, 0), pixel(top, 3), pixel(bottom, 0), pixel(bottom, 3));
            }
        }
        let fetch = |dx: usize, dy: usize| -> [f32; 3] {
            let (x, y) = (right + dx, below + dy);
            let is_inside = x > 0 && y > 0 && x <= self.width && y <= self.height;
            if is_inside { self.pixel(x - 1, y - 1).map(f32::from) } else { [0.0; 3] }
        };
        mix(fetch(0, 0), fetch(1, 0), fetch(0, 1), fetch(1, 1))
    }
}
