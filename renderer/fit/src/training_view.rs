//! Images of a take, cropped to the person.

use std::sync::Arc;

use flyrig_types::Camera;

use crate::image_error::Photograph;
use crate::known_surface::KnownSurface;
use crate::outline::mixed;

/// Margin around the person, pixels.
const MARGIN_PX: u32 = 12;
/// Divisor of the sides of crops, pixels: buffers are allocated for each size, so few sizes are wanted.
const SIDE_PX: u32 = 64;

/// Image cropped to the person. Copies share its pixels.
#[derive(Debug, Clone)]
pub struct TrainingView {
    pub(crate) frame: usize,
    pub(crate) camera: Camera,
    /// sRGB and mask.
    rgba: Arc<[u8]>,
    /// Pixels whose colour is mixed with the background.
    mixed: Arc<[bool]>,
    /// First column and row of the crop, and width and height of the image that it is cut from, pixels.
    left_top: [u32; 2],
    whole: [u32; 2],
    pub(crate) surface: Option<KnownSurface>,
}

impl TrainingView {
    /// Crops an image, sRGB with the mask as alpha, to the person. `None` without a person, or for bytes that do not
    /// match the camera's size.
    #[must_use]
    pub fn cut(frame: usize, camera: &Camera, rgba: &[u8]) -> Option<Self> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if width == 0 || rgba.len() != width as usize * height as usize * 4 {
            return None;
        }
        let (mut least, mut most) = ([u32::MAX; 2], [0; 2]);
        for (y, row) in (0u32..).zip(rgba.chunks_exact(4 * width as usize)) {
            for (x, _) in (0u32..).zip(row.chunks_exact(4)).filter(|(_, pixel)| pixel[3] > 127) {
                least = [least[0].min(x), least[1].min(y)];
                most = [most[0].max(x), most[1].max(y)];
            }
        }
        if least[0] > most[0] {
            return None;
        }
        // A cut as large as its class of size, moved into the image.
        let range = |k: usize, whole: u32| {
            let wanted = most[k] - least[k] + 1 + 2 * MARGIN_PX;
            let side = wanted.next_multiple_of(SIDE_PX).min(whole);
            let first = (least[k] + most[k] + 1).saturating_sub(side) / 2;
            (first.min(whole - side), side)
        };
        let ((left, columns), (top, rows)) = (range(0, width), range(1, height));
        let mut cut = Vec::with_capacity(columns as usize * rows as usize * 4);
        for y in top..top + rows {
            let first = (y as usize * width as usize + left as usize) * 4;
            cut.extend(&rgba[first..first + 4 * columns as usize]);
        }
        let mixed = mixed(&cut, columns as usize);
        let mut camera = camera.clone();
        camera.intrinsics.center_px -= glam::DVec2::new(f64::from(left), f64::from(top));
        (camera.intrinsics.width, camera.intrinsics.height) = (columns, rows);
        let (left_top, whole) = ([left, top], [width, height]);
        Some(Self { frame, camera, rgba: cut.into(), mixed: mixed.into(), left_top, whole, surface: None })
    }

    /// Returns the view with the surface that the depths of its image show of the person: camera-space z in metres for each pixel of the
    /// whole image, row by row, where what is not finite or not above 0 is unknown. A list of another length changes nothing.
    #[must_use]
    pub fn with_depths(self, depths_m: &[f32]) -> Self {
        let [width, height] = self.whole.map(|side| side as usize);
        if depths_m.len() != width * height {
            return self;
        }
        let ([left, top], [columns, rows]) =
            (self.left_top.map(|at| at as usize), self.size().map(|side| side as usize));
        let row = |y: usize| depths_m[y * width + left..][..columns].iter().copied();
        let cut: Vec<f32> = (top..top + rows).flat_map(row).collect();
        let surface = KnownSurface::of_depths(&self.camera, &cut, |at| self.rgba[4 * at + 3] > 127);
        Self { surface, ..self }
    }

    /// Returns whether depths show a surface of the person in this view.
    #[must_use]
    pub fn has_surface(&self) -> bool {
        self.surface.is_some()
    }

    /// Returns the number of its frame among those of the fit.
    #[must_use]
    pub fn frame(&self) -> usize {
        self.frame
    }

    /// Returns the same image as one of another frame.
    #[must_use]
    pub fn of_frame(self, frame: usize) -> Self {
        Self { frame, ..self }
    }

    /// Returns the camera of the crop.
    #[must_use]
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Returns the pixels of the crop: sRGB with the mask as alpha.
    #[must_use]
    pub fn rgba(&self) -> &[u8] {
        &self.rgba
    }

    /// Returns width and height, pixels.
    #[must_use]
    pub fn size(&self) -> [u32; 2] {
        [self.camera.intrinsics.width, self.camera.intrinsics.height]
    }

    /// Returns the number of the person's pixels, partly covered ones by their share.
    pub(crate) fn person(&self) -> f64 {
        self.rgba.chunks_exact(4).map(|pixel| f64::from(pixel[3]) / 255.0).sum()
    }

    /// Returns the pixels to compare with.
    #[must_use]
    pub fn photograph(&self) -> Photograph<'_> {
        Photograph { rgba: &self.rgba, mixed: &self.mixed }
    }
}
