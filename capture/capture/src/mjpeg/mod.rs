//! JPEG images from cameras: often without Huffman tables, sometimes padded, sometimes damaged.

mod guard;
mod scan;
mod shifts;
#[cfg(test)]
mod testing;

use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::image_file;

use guard::Guard;

/// Decodes into `rgb`, `3 * width * height` bytes. Strict: damage that a lenient decoder fills with grey, and damage
/// that decodes but shows in the data, is an error, so that a broken image never colours a person.
///
/// # Errors
/// `Corrupt` for any fault in the bytes.
pub(crate) fn decode(
    bytes: &[u8],
    width: usize,
    height: usize,
    rgb: &mut [u8],
    scratch: &mut JpegScratch,
) -> Result<(), CaptureError> {
    let corrupt = |text: String| CaptureError::general(CaptureErrorKind::Corrupt, text);
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return Err(corrupt("is not a JPEG image".to_owned()));
    }
    if !image_file::jpeg_has_end(bytes) {
        return Err(corrupt("is a JPEG image that is cut off".to_owned()));
    }
    let damaged = |error: &dyn std::fmt::Display| corrupt(format!("is a damaged JPEG image ({error})"));
    let whole = if scratch.complete(bytes) { &scratch.completed } else { bytes };
    match &mut scratch.guard {
        Some(guard) => guard.check(whole, segments(whole)).map_err(|damage| damaged(&damage))?,
        None => scan::walk(whole, segments(whole)).map(drop).map_err(|fault| damaged(&fault))?,
    }
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(width)
        .set_max_height(height)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(whole), options);
    if let Err(error) = decoder.decode_headers() {
        return match jpeg_size(bytes) {
            Some(size) if size != (width, height) => Err(other_size(size, width, height)),
            _ => Err(damaged(&error)),
        };
    }
    match decoder.info().map(|info| (usize::from(info.width), usize::from(info.height))) {
        Some(size) if size == (width, height) => {}
        Some(size) => return Err(other_size(size, width, height)),
        None => return Err(damaged(&"no size")),
    }
    if decoder.output_buffer_size() != Some(rgb.len()) {
        return Err(damaged(&"not three colours"));
    }
    decoder.decode_into(rgb).map_err(|error| damaged(&error))
}

fn other_size(size: (usize, usize), width: usize, height: usize) -> CaptureError {
    let text = format!("the JPEG is {}x{}, its frame {width}x{height}", size.0, size.1);
    CaptureError::general(CaptureErrorKind::Corrupt, text)
}

/// Iterates over the marker segments up to and including the first scan header: position and marker.
fn segments(bytes: &[u8]) -> impl Iterator<Item = (usize, u8)> {
    let mut at = Some(2);
    std::iter::from_fn(move || {
        let mut here = at?;
        loop {
            let &[0xff, marker, high, low] = bytes.get(here..here + 4)? else { return None };
            if marker == 0xff {
                here += 1; // fill byte
                continue;
            }
            let is_scan = marker == 0xda;
            at = (!is_scan).then(|| here + 2 + usize::from(u16::from_be_bytes([high, low])));
            return Some((here, marker));
        }
    })
}

/// Returns width and height from the frame header.
pub(crate) fn jpeg_size(bytes: &[u8]) -> Option<(usize, usize)> {
    let (at, _) = segments(bytes).find(|(_, marker)| matches!(marker, 0xc0..=0xc2))?;
    let &[h1, h0, w1, w0] = bytes.get(at + 5..at + 9)? else { return None };
    Some((usize::from(u16::from_be_bytes([w1, w0])), usize::from(u16::from_be_bytes([h1, h0]))))
}

/// Scratch memory that is reused from image to image.
#[derive(Debug, Default)]
pub(crate) struct JpegScratch {
    completed: Vec<u8>,
    guard: Option<Guard>,
}

impl JpegScratch {
    /// Creates scratch memory for the images of one camera in their order, which are compared with each other.
    pub fn of_camera() -> Self {
        Self { guard: Some(Guard::default()), ..Self::default() }
    }

    /// Inserts the standard Huffman tables before the scan of an image without its own: USB cameras omit them. Returns
    /// false where nothing is missing.
    fn complete(&mut self, bytes: &[u8]) -> bool {
        let mut scan = None;
        for (at, marker) in segments(bytes) {
            match marker {
                0xc4 => return false,
                0xda => scan = Some(at),
                _ => {}
            }
        }
        let Some(scan) = scan else { return false };
        let completed = &mut self.completed;
        completed.clear();
        completed.extend_from_slice(&bytes[..scan]);
        for (class, counts, values) in [
            (0x00, DC_LUMA_COUNTS, &DC_VALUES[..]),
            (0x10, AC_LUMA_COUNTS, &AC_LUMA_VALUES[..]),
            (0x01, DC_CHROMA_COUNTS, &DC_VALUES[..]),
            (0x11, AC_CHROMA_COUNTS, &AC_CHROMA_VALUES[..]),
        ] {
            completed.extend([0xff, 0xc4]);
            completed.extend((2 + 1 + 16 + values.len() as u16).to_be_bytes());
            completed.push(class);
            completed.extend(counts);
            completed.extend(values);
        }
        completed.extend_from_slice(&bytes[scan..]);
        true
    }
}

// ITU-T T.81, tables K.3 to K.6: number of codes of each length, and the values in the order of their codes.
const DC_LUMA_COUNTS: [u8; 16] = [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0];
const DC_CHROMA_COUNTS: [u8; 16] = [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0];
const DC_VALUES: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
const AC_LUMA_COUNTS: [u8; 16] = [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7d];
const AC_CHROMA_COUNTS: [u8; 16] = [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77];
#[rustfmt::skip]
const AC_LUMA_VALUES: [u8; 162] = [
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
    0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
    0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
    0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
    0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
    0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
    0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];
#[rustfmt::skip]
const AC_CHROMA_VALUES: [u8; 162] = [
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
    0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
    0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
    0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
    0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
    0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];

#[cfg(test)]
mod tests {
    use std::{io::Cursor, panic::catch_unwind};

    use super::*;

    fn jpeg(width: u32, height: u32) -> Vec<u8> {
        let picture =
            image::RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * 5) as u8, (y * 7) as u8, (x * y) as u8]));
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
        bytes.into_inner()
    }

    fn decoded(bytes: &[u8], width: usize, height: usize) -> Result<Vec<u8>, CaptureError> {
        let mut rgb = vec![0; width * height * 3];
        decode(bytes, width, height, &mut rgb, &mut JpegScratch::default()).map(|()| rgb)
    }

    fn without_tables(jpeg: &[u8]) -> Vec<u8> {
        let mut bare = jpeg[..2].to_vec();
        let starts: Vec<(usize, u8)> = segments(jpeg).collect();
        for pair in starts.windows(2).filter(|pair| pair[0].1 != 0xc4) {
            bare.extend(&jpeg[pair[0].0..pair[1].0]);
        }
        bare.extend(&jpeg[starts[starts.len() - 1].0..]);
        bare
    }

    #[test]
    fn an_image_without_tables_is_the_same_image() {
        let whole = jpeg(48, 32);
        let bare = without_tables(&whole);
        assert!(bare.len() + 400 < whole.len(), "the tables were not there to begin with");
        assert_eq!(decoded(&bare, 48, 32).unwrap(), decoded(&whole, 48, 32).unwrap());
        let mut padded = bare;
        padded.extend([0; 300]);
        assert!(decoded(&padded, 48, 32).is_ok(), "cameras pad");
    }

    #[test]
    fn a_grey_image_has_three_equal_colours() {
        let mut bytes = Cursor::new(Vec::new());
        image::GrayImage::from_pixel(16, 16, image::Luma([77])).write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
        assert!(decoded(&bytes.into_inner(), 16, 16).unwrap().iter().all(|&c| c.abs_diff(77) <= 1));
    }

    /// Decodes many images with every kind of damage: none panics, and none with a truncated scan is accepted.
    fn damage(rounds: usize) -> (usize, usize) {
        let whole = jpeg(48, 32);
        let sources = [without_tables(&whole), whole];
        let mut state = 11u64;
        let mut random = |n: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n.max(1)
        };
        let mut rgb = vec![0; 48 * 32 * 3];
        let (mut refused, mut taken) = (0, 0);
        let mut scratch = JpegScratch::default();
        for round in 0..rounds {
            let mut bytes = sources[round % 2].clone();
            match random(5) {
                0 => bytes.truncate(random(bytes.len())),
                1 => {
                    let at = random(bytes.len());
                    bytes.drain(at..(at + 1 + random(64)).min(bytes.len()));
                }
                2 => {
                    let at = random(bytes.len());
                    bytes.splice(at..at, (0..1 + random(64)).map(|i| i as u8 ^ 0xd9).collect::<Vec<_>>());
                }
                _ => {
                    for _ in 0..1 + random(8) {
                        let at = random(bytes.len());
                        bytes[at] = random(256) as u8;
                    }
                }
            }
            let is_cut = !image_file::jpeg_has_end(&bytes);
            let result = catch_unwind(std::panic::AssertUnwindSafe(|| decode(&bytes, 48, 32, &mut rgb, &mut scratch)));
            match result.expect("a damaged image made the decoder panic") {
                Ok(()) => {
                    assert!(!is_cut, "an image without its end came through");
                    taken += 1;
                }
                Err(error) => {
                    assert_eq!(error.kind, CaptureErrorKind::Corrupt);
                    refused += 1;
                }
            }
        }
        (refused, taken)
    }

    #[test]
    fn damaged_images_never_panic() {
        let (refused, taken) = damage(20_000);
        assert!(refused > 5_000, "{refused} refused, {taken} taken");
    }

    #[test]
    #[ignore = "a million images: `make test-long`"]
    fn a_million_damaged_images_never_panic() {
        let (refused, taken) = damage(1_000_000);
        println!("of 1000000 damaged JPEG images {refused} were refused, {taken} decoded to some image, none panicked");
    }
}
