//! Decoding of image files: upright as their EXIF orientation says, with detection of truncated ones.

use std::{io::Cursor, path::Path};

use flyrig_types::{Image, MAX_IMAGE_SIDE, PixelFormat};
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits, metadata::Orientation};

use crate::error::{CaptureError, CaptureErrorKind};

/// Extensions of image files, lower case.
pub(crate) const IMAGE_ENDINGS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Decodes a whole JPEG or PNG and turns it upright. The error text contains no file name.
pub(crate) fn decode(bytes: &[u8]) -> Result<DynamicImage, CaptureError> {
    let format = format_of(bytes)?;
    // The decoder paints what is missing grey and says nothing.
    if format == ImageFormat::Jpeg && !jpeg_has_end(bytes) {
        return Err(corrupt("is a JPEG image that is cut off"));
    }
    let (decoder, orientation) = open(bytes, format)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(|error| damaged(&error))?;
    image.apply_orientation(orientation);
    Ok(image)
}

/// Reads width and height of a JPEG or PNG from its header, pixels, as [`decode`] returns it.
fn dimensions(bytes: &[u8]) -> Result<(u32, u32), CaptureError> {
    let (decoder, orientation) = open(bytes, format_of(bytes)?)?;
    let (width, height) = decoder.dimensions();
    Ok(if is_quarter_turn(orientation) { (height, width) } else { (width, height) })
}

fn corrupt(text: impl Into<String>) -> CaptureError {
    CaptureError::general(CaptureErrorKind::Corrupt, text)
}

fn damaged(error: &image::ImageError) -> CaptureError {
    corrupt(format!("is a damaged or cut off image ({error})"))
}

fn format_of(bytes: &[u8]) -> Result<ImageFormat, CaptureError> {
    let format = image::guess_format(bytes).ok().filter(|f| [ImageFormat::Jpeg, ImageFormat::Png].contains(f));
    format.ok_or_else(|| corrupt("is neither a JPEG nor a PNG image"))
}

/// Reads the header: decoder and orientation. Orientations that EXIF does not define are upright, as in OpenCV.
fn open(bytes: &[u8], format: ImageFormat) -> Result<(impl ImageDecoder, Orientation), CaptureError> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_IMAGE_SIDE);
    limits.max_image_height = Some(MAX_IMAGE_SIDE);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(|error| damaged(&error))?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok((decoder, orientation))
}

/// Returns whether an orientation swaps width and height.
pub(crate) fn is_quarter_turn(orientation: Orientation) -> bool {
    !matches!(
        orientation,
        Orientation::NoTransforms | Orientation::Rotate180 | Orientation::FlipHorizontal | Orientation::FlipVertical
    )
}

/// Reads and decodes a file; the error names it.
pub(crate) fn read(path: &Path) -> Result<DynamicImage, CaptureError> {
    of_file(path, decode)
}

/// Reads a JPEG or PNG file of a camera as `Rgb8`, upright as its EXIF orientation says.
///
/// # Errors
/// `Corrupt` names the file that cannot be read or is damaged, cut off or of another format.
pub fn read_image(path: &Path) -> Result<Image, CaptureError> {
    let picture = read(path)?.into_rgb8();
    let (width, height) = picture.dimensions();
    Image::new(width, height, PixelFormat::Rgb8, picture.into_raw())
        .map_err(|error| corrupt(format!("{} {error}", path.display())))
}

/// Reads width and height of a file from its header, pixels, as [`read_image`] returns it.
pub(crate) fn read_dimensions(path: &Path) -> Result<(u32, u32), CaptureError> {
    of_file(path, dimensions)
}

fn of_file<T>(path: &Path, read: impl Fn(&[u8]) -> Result<T, CaptureError>) -> Result<T, CaptureError> {
    let bytes = std::fs::read(path).map_err(|error| corrupt(format!("{} cannot be read: {error}", path.display())))?;
    read(&bytes).map_err(|error| CaptureError { message: format!("{} {}", path.display(), error.message), ..error })
}

/// Returns whether an end-of-image marker follows the first scan.
pub(crate) fn jpeg_has_end(bytes: &[u8]) -> bool {
    jpeg_length(bytes).is_some()
}

/// Returns the length up to and including the end-of-image marker after the first scan. Segments before it are skipped,
/// since an embedded thumbnail has an end marker of its own.
pub(crate) fn jpeg_length(bytes: &[u8]) -> Option<usize> {
    const SCAN: u8 = 0xda;
    let mut at = 2;
    while let Some(&[0xff, marker, high, low]) = bytes.get(at..at + 4) {
        if marker == 0xff {
            at += 1; // fill byte
            continue;
        }
        at += 2 + usize::from(u16::from_be_bytes([high, low]));
        if marker == SCAN {
            return bytes.get(at..)?.windows(2).position(|pair| pair == [0xff, 0xd9]).map(|end| at + end + 2);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoded(format: ImageFormat) -> Vec<u8> {
        let picture = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([x as u8 * 6, y as u8 * 8, 77]));
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn every_cut_of_an_image_is_noticed() {
        for (format, tail) in [(ImageFormat::Jpeg, 0), (ImageFormat::Png, 16)] {
            let whole = encoded(format);
            assert_eq!(decode(&whole).unwrap().width(), 40);
            // A PNG is whole without its end chunk (12 bytes) and the last checksum.
            for length in 0..whole.len() - tail {
                let error = decode(&whole[..length]).unwrap_err();
                assert_eq!(error.kind, CaptureErrorKind::Corrupt, "{format:?} cut at {length}");
            }
        }
        let mut padded = encoded(ImageFormat::Jpeg);
        padded.extend([0; 100]);
        assert!(decode(&padded).is_ok(), "cameras pad JPEG images");
        assert_eq!(jpeg_length(&padded), Some(padded.len() - 100));
    }

    /// Inserts an EXIF block that states an orientation, little or big endian, behind the start marker or header.
    fn turned(format: ImageFormat, exif_orientation: u8, is_big: bool) -> Vec<u8> {
        let number = |value: u32, bytes: usize| {
            let little = value.to_le_bytes()[..bytes].to_vec();
            if is_big { little.into_iter().rev().collect() } else { little }
        };
        // A header, one entry (tag 0x112, SHORT, one value) and the end of the list.
        let mut exif = if is_big { b"MM".to_vec() } else { b"II".to_vec() };
        for (value, bytes) in [(42, 2), (8, 4), (1, 2), (0x112, 2), (3, 2), (1, 4)] {
            exif.extend(number(value, bytes));
        }
        exif.extend(number(u32::from(exif_orientation), 2));
        exif.extend([0; 6]);
        let whole = encoded(format);
        let (at, segment) = if format == ImageFormat::Jpeg {
            let length = (2 + 6 + exif.len() as u16).to_be_bytes();
            (2, [&[0xff, 0xe1], &length[..], b"Exif\0\0", &exif].concat())
        } else {
            let body = [b"eXIf", &exif[..]].concat();
            let crc = body.iter().fold(u32::MAX, |crc, byte| {
                (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
            });
            (33, [&(exif.len() as u32).to_be_bytes(), &body[..], &(!crc).to_be_bytes()].concat())
        };
        [&whole[..at], &segment, &whole[at..]].concat()
    }

    /// As OpenCV's `imread`: where the pixel at (x, y) of the upright image is stored.
    #[test]
    fn every_orientation_of_a_photograph_is_turned_upright() {
        let stored = |orientation: u8, x: u32, y: u32| match orientation {
            2 => (39 - x, y),
            3 => (39 - x, 29 - y),
            4 => (x, 29 - y),
            5 => (y, x),
            6 => (y, 29 - x),
            7 => (39 - y, 29 - x),
            8 => (39 - y, x),
            _ => (x, y),
        };
        for format in [ImageFormat::Jpeg, ImageFormat::Png] {
            let flat = decode(&encoded(format)).unwrap().into_rgb8();
            for orientation in 0..=9u8 {
                let bytes = turned(format, orientation, orientation % 2 == 0);
                let (width, height) = if (5..=8).contains(&orientation) { (30, 40) } else { (40, 30) };
                assert_eq!(dimensions(&bytes).unwrap(), (width, height), "{format:?} {orientation}");
                let upright = decode(&bytes).unwrap().into_rgb8();
                assert_eq!(upright.dimensions(), (width, height), "{format:?} {orientation}");
                for (x, y, pixel) in upright.enumerate_pixels() {
                    let (u, v) = stored(orientation, x, y);
                    assert_eq!(pixel, flat.get_pixel(u, v), "{format:?} {orientation}: {x} {y}");
                }
            }
        }
    }

    #[test]
    fn flipped_bytes_never_panic() {
        let mut state = 7u64;
        for format in [ImageFormat::Jpeg, ImageFormat::Png] {
            let whole = encoded(format);
            for _ in 0..300 {
                let mut bytes = whole.clone();
                for _ in 0..3 {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    let at = (state >> 33) as usize % bytes.len();
                    bytes[at] = (state >> 20) as u8;
                }
                let _ = decode(&bytes);
            }
        }
    }

    #[test]
    fn other_formats_are_refused_in_words() {
        assert_eq!(decode(b"GIF89a").unwrap_err().to_string(), "is neither a JPEG nor a PNG image");
    }
}
