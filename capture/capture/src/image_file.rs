//! Decoding of image files, with detection of truncated ones.

use std::{io::Cursor, path::Path};

use flyrig_types::MAX_IMAGE_SIDE;
use image::{DynamicImage, ImageFormat, ImageReader, Limits};

use crate::error::{CaptureError, CaptureErrorKind};

/// Extensions of image files, lower case.
pub(crate) const IMAGE_ENDINGS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Decodes a whole JPEG or PNG. The error text contains no file name.
pub(crate) fn decode(bytes: &[u8]) -> Result<DynamicImage, CaptureError> {
    let corrupt = |text: String| CaptureError::general(CaptureErrorKind::Corrupt, text);
    let format = image::guess_format(bytes).ok().filter(|f| [ImageFormat::Jpeg, ImageFormat::Png].contains(f));
    let Some(format) = format else { return Err(corrupt("is neither a JPEG nor a PNG image".to_owned())) };
    // The decoder paints what is missing grey and says nothing.
    if format == ImageFormat::Jpeg && !jpeg_has_end(bytes) {
        return Err(corrupt("is a JPEG image that is cut off".to_owned()));
    }
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_IMAGE_SIDE);
    limits.max_image_height = Some(MAX_IMAGE_SIDE);
    reader.limits(limits);
    reader.decode().map_err(|error| corrupt(format!("is a damaged or cut off image ({error})")))
}

/// Reads and decodes a file; the error names it.
pub(crate) fn read(path: &Path) -> Result<DynamicImage, CaptureError> {
    let bytes = std::fs::read(path).map_err(|error| {
        CaptureError::general(CaptureErrorKind::Corrupt, format!("{} cannot be read: {error}", path.display()))
    })?;
    decode(&bytes).map_err(|error| CaptureError { message: format!("{} {}", path.display(), error.message), ..error })
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
