//! Input images of one person: sRGB with the person's coverage as alpha, on both sides of the bus.

use flyrig_capture::to_rgb8;
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{ColorMatcher, UNKNOWN_RGBA};
use flyrig_tracker::EdgeColor;
use flyrig_types::{Camera, Image, Mask, PixelFormat, Pose};

use crate::error::FusionError;

/// Coverage by other people from which a pixel is marked as unknown for this person.
const OTHERS_COVER: u8 = 128;

/// One image of a frame set with one person's mask.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputView<'a> {
    pub camera: &'a Camera,
    pub image: &'a Image,
    pub mask: &'a Mask,
    /// Foreground colours along the mask's outline, free of the background's share.
    pub edge_colors: &'a [EdgeColor],
    /// Coverage by other people.
    pub others: Option<&'a Mask>,
    /// Pose at the image's own time, where it differs from the frame set's.
    pub pose: Option<&'a Pose>,
}

impl InputView<'_> {
    /// Checks that the masks have the image's size.
    fn check_masks(&self) -> Result<(), FusionError> {
        let image = (self.image.width(), self.image.height());
        for mask in std::iter::once(self.mask).chain(self.others) {
            let mask = (mask.width(), mask.height());
            if mask != image {
                return Err(FusionError::MaskSize { camera: self.camera.id.clone(), mask, image });
            }
        }
        Ok(())
    }
}

/// Image as the kernels read it.
#[derive(Debug)]
pub(super) struct InputImage {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// sRGB with the person's coverage as alpha, row by row.
    pub rgba: Vec<u8>,
    /// Copy of `rgba` on the GPU, one element per pixel.
    pub words: StorageBuffer<u32>,
    /// Colour correction of the image's camera; `None` where its colours stay as they are.
    matcher: Option<ColorMatcher>,
}

impl InputImage {
    fn new(gpu: &GpuContext, view: &InputView<'_>, size: [u32; 2]) -> Result<Self, FusionError> {
        let label = format!("the image of camera {}", view.camera.id);
        let words = StorageBuffer::zeroed(gpu, &label, size[0] as usize * size[1] as usize)?;
        Ok(Self { size, rgba: Vec::new(), words, matcher: None })
    }

    /// Converts a view's image to RGB with coverage, corrects its colours and uploads it.
    fn fill(&mut self, gpu: &GpuContext, view: &InputView<'_>) -> Result<(), FusionError> {
        let converted;
        let rgb = if view.image.format() == PixelFormat::Rgb8 {
            view.image.bytes()
        } else {
            converted = to_rgb8(view.image)?;
            &converted
        };
        let rgba = &mut self.rgba;
        rgba.clear();
        rgba.extend(rgb.chunks_exact(3).zip(view.mask.coverage()).flat_map(|(c, &a)| [c[0], c[1], c[2], a]));
        for EdgeColor { pixel, rgb } in view.edge_colors {
            if let Some(pixel) = rgba.get_mut(4 * *pixel as usize..).and_then(<[u8]>::first_chunk_mut::<3>) {
                *pixel = *rgb;
            }
        }
        if self.matcher.as_ref().is_none_or(|matcher| !matcher.is_of(view.camera)) {
            self.matcher = ColorMatcher::new(view.camera);
        }
        if let Some(matcher) = &mut self.matcher {
            matcher.correct(rgba, 4, self.size[0] as usize, |pixel| pixel[3] == 0);
        }
        if let Some(others) = view.others {
            for (pixel, others) in rgba.chunks_exact_mut(4).zip(others.coverage()) {
                if *others >= OTHERS_COVER {
                    pixel.copy_from_slice(&UNKNOWN_RGBA);
                }
            }
        }
        self.words.write_bytes(gpu, rgba);
        Ok(())
    }
}

/// Images of a person's last update, in the order of its views. Buffers are kept from one update to the next.
#[derive(Debug, Default)]
pub(super) struct Inputs {
    images: Vec<InputImage>,
}

impl Inputs {
    /// Converts and uploads each view's image once: RGB with the mask as alpha, without the background along its outline.
    pub fn upload(&mut self, gpu: &GpuContext, views: &[InputView<'_>]) -> Result<(), FusionError> {
        for (i, view) in views.iter().enumerate() {
            view.check_masks()?;
            let size = [view.image.width(), view.image.height()];
            if self.images.get(i).is_none_or(|input| input.size != size) {
                let image = InputImage::new(gpu, view, size)?;
                if i < self.images.len() {
                    self.images[i] = image;
                } else {
                    self.images.push(image);
                }
            }
            self.images[i].fill(gpu, view)?;
        }
        Ok(())
    }

    /// Returns the images, at least one per view of the last update.
    pub fn images(&self) -> &[InputImage] {
        &self.images
    }
}
