//! JPEG compression of uncompressed images, for the network and the disk.

use flyrig_types::{Frame, Image, PixelFormat};
use turbojpeg::{Compressor, Subsamp};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::mjpeg::JpegScratch;
use crate::rgb;
use crate::stage::FrameStage;

/// Stage that compresses a camera's frames; frames that are JPEG already pass unchanged.
#[derive(Debug)]
pub struct JpegEncoding {
    quality: i32,
    /// Encoder; made with the first image, since making it can fail.
    compressor: Option<Compressor>,
    rgb: Vec<u8>,
    scratch: JpegScratch,
}

impl JpegEncoding {
    /// Creates a stage with a quality from 1 to 100 (libjpeg's scale).
    #[must_use]
    pub fn new(quality: u8) -> Self {
        let quality = i32::from(quality.clamp(1, 100));
        Self { quality, compressor: None, rgb: Vec::new(), scratch: JpegScratch::default() }
    }

    /// Compresses an image, with half as many samples of colour in each direction as of brightness (4:2:0).
    ///
    /// # Errors
    /// `Unsupported` and `Corrupt` for images that cannot be converted to RGB or compressed.
    pub fn encode(&mut self, image: &Image) -> Result<Image, CaptureError> {
        let corrupt = |text: String| CaptureError::general(CaptureErrorKind::Corrupt, text);
        rgb::convert(image, &mut self.rgb, &mut self.scratch)?;
        let (width, height) = (image.width(), image.height());
        let jpeg = self
            .jpeg(width as usize, height as usize)
            .map_err(|error| corrupt(format!("cannot be compressed: {error}")))?;
        Image::new(width, height, PixelFormat::Mjpeg, jpeg).map_err(|error| corrupt(error.to_string()))
    }

    fn jpeg(&mut self, width: usize, height: usize) -> turbojpeg::Result<Vec<u8>> {
        let compressor = match &mut self.compressor {
            Some(compressor) => compressor,
            none => {
                let mut compressor = Compressor::new()?;
                compressor.set_quality(self.quality)?;
                compressor.set_subsamp(Subsamp::Sub2x2)?;
                none.insert(compressor)
            }
        };
        compressor.compress_to_vec(turbojpeg::Image {
            pixels: &self.rgb,
            width,
            pitch: 3 * width,
            height,
            format: turbojpeg::PixelFormat::RGB,
        })
    }
}

impl FrameStage for JpegEncoding {
    fn process(&mut self, frame: Frame) -> Result<Frame, CaptureError> {
        if frame.image.format() == PixelFormat::Mjpeg {
            return Ok(frame);
        }
        let image = self.encode(&frame.image)?;
        Ok(Frame { image, ..frame })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rgb::to_rgb8;

    fn frame(format: PixelFormat, bytes: Vec<u8>) -> Frame {
        let image = Image::new(48, 32, format, bytes).unwrap();
        Frame { camera: "a".into(), sequence: 4, capture_nanos: 9, exposure_nanos: Some(7), image, mask: None }
    }

    #[test]
    fn an_image_survives_but_for_what_jpeg_takes() {
        let rgb: Vec<u8> =
            (0..32u32).flat_map(|y| (0..48u32).flat_map(move |x| [x as u8 * 5, y as u8 * 7, 90])).collect();
        let mut stage = JpegEncoding::new(95);
        let made = stage.process(frame(PixelFormat::Rgb8, rgb.clone())).unwrap();
        assert_eq!((made.image.format(), made.sequence, made.exposure_nanos), (PixelFormat::Mjpeg, 4, Some(7)));
        assert!(made.image.bytes().len() < rgb.len() / 2);
        let found = to_rgb8(&made.image).unwrap();
        let mean = found.iter().zip(&rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / rgb.len() as f64;
        assert!(mean < 3.0, "red for blue? {mean}");
        // As it came, so it passes.
        let bytes = made.image.bytes().to_vec();
        assert_eq!(stage.process(made).unwrap().image.bytes(), bytes);
        let header = turbojpeg::read_header(&bytes).unwrap();
        assert_eq!(header.subsamp, Subsamp::Sub2x2);
        let coarse = JpegEncoding::new(30).process(frame(PixelFormat::Rgb8, rgb)).unwrap();
        assert!(coarse.image.bytes().len() < bytes.len());
        // Another size and another format.
        let small = Image::new(16, 8, PixelFormat::Rgb8, vec![200; 16 * 8 * 3]).unwrap();
        let small = stage.encode(&small).unwrap();
        assert!(small.width() == 16 && to_rgb8(&small).unwrap().iter().all(|c| c.abs_diff(200) <= 2));
        let yuyv = stage.process(frame(PixelFormat::Yuyv, vec![128; 48 * 32 * 2])).unwrap();
        assert!(to_rgb8(&yuyv.image).unwrap().iter().all(|c| c.abs_diff(130) <= 2));
    }
}
