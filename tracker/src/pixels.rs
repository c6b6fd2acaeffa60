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
        let (x0, y0) = (at.x.floor(), at.y.floor());
        let (fx, fy) = ((at.x - x0) as f32, (at.y - y0) as f32);
        let fetch = |x: f64, y: f64| -> [f32; 3] {
            if x < 0.0 || y < 0.0 || x >= self.width as f64 || y >= self.height as f64 {
                return [0.0; 3];
            }
            self.pixel(x as usize, y as usize).map(f32::from)
        };
        let (a, b) = (fetch(x0, y0), fetch(x0 + 1.0, y0));
        let (c, d) = (fetch(x0, y0 + 1.0), fetch(x0 + 1.0, y0 + 1.0));
        std::array::from_fn(|k| {
            let top = a[k] + (b[k] - a[k]) * fx;
            let bottom = c[k] + (d[k] - c[k]) * fx;
            top + (bottom - top) * fy
        })
    }
}
