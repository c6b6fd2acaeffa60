//! Conversion of every pixel format to 8-bit sRGB.
//!
//! YUV is the cameras' ITU-R BT.601 with limited range (Y 16 to 235, U and V 16 to 240); the chroma of a pair or a 2x2
//! block applies to all of its pixels.

use std::array::from_fn;

use flyrig_types::{Image, PixelFormat};

use crate::error::{CaptureError, CaptureErrorKind};
use crate::mjpeg::{self, JpegScratch};

/// Converts an image to `width * height` pixels of 3 bytes, sRGB red green blue. Alpha is dropped, grey replicated, YUV
/// is BT.601 with limited range, Bayer is interpolated bilinearly, JPEG decoded.
///
/// # Errors
/// `Corrupt` for a damaged JPEG or one of another size, `Unsupported` for 4:2:2 of odd width and
/// Bayer of less than 2x2.
pub fn to_rgb8(image: &Image) -> Result<Vec<u8>, CaptureError> {
    let mut rgb = Vec::new();
    to_rgb8_into(image, &mut rgb)?;
    Ok(rgb)
}

/// Converts as [`to_rgb8`] into a reusable buffer, whose content is unspecified after an error.
///
/// # Errors
/// As [`to_rgb8`].
pub fn to_rgb8_into(image: &Image, rgb: &mut Vec<u8>) -> Result<(), CaptureError> {
    convert(image, rgb, &mut JpegScratch::default())
}

/// Converts as [`to_rgb8_into`], with the JPEG decoder's scratch memory.
pub(crate) fn convert(image: &Image, rgb: &mut Vec<u8>, scratch: &mut JpegScratch) -> Result<(), CaptureError> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let bytes = image.bytes();
    rgb.resize(width * height * 3, 0);
    let pixels = |bytes_each: usize| bytes.chunks_exact(bytes_each);
    match image.format() {
        PixelFormat::Rgb8 => rgb.copy_from_slice(bytes),
        PixelFormat::Bgr8 => {
            for (p, out) in pixels(3).zip(rgb.chunks_exact_mut(3)) {
                out.copy_from_slice(&[p[2], p[1], p[0]]);
            }
        }
        PixelFormat::Rgba8 => {
            for (p, out) in pixels(4).zip(rgb.chunks_exact_mut(3)) {
                out.copy_from_slice(&p[..3]);
            }
        }
        PixelFormat::Gray8 => {
            for (&y, out) in bytes.iter().zip(rgb.chunks_exact_mut(3)) {
                out.fill(y);
            }
        }
        format @ (PixelFormat::Yuyv | PixelFormat::Uyvy) => {
            if width % 2 != 0 {
                return Err(unsupported(format!("{format:?} needs an even width, not {width}")));
            }
            // Offsets of the two lumas, U and V in a pair of pixels.
            let offsets = if format == PixelFormat::Yuyv { [0, 2, 1, 3] } else { [1, 3, 0, 2] };
            packed_to_rgb(bytes, offsets, rgb);
        }
        PixelFormat::Nv12 => {
            let (luma, chroma) = bytes.split_at(width * height);
            let rows = luma.chunks_exact(width).zip(rgb.chunks_exact_mut(width * 3));
            for (y, (row, out)) in rows.enumerate() {
                let chroma = &chroma[y / 2 * width.div_ceil(2) * 2..];
                let (blocks, rest) = row.as_chunks::<BLOCK>();
                let (colors, rest_out) = out.as_chunks_mut::<{ 3 * BLOCK }>();
                let (chromas, _) = chroma.as_chunks::<BLOCK>();
                for ((luma, uv), out) in blocks.iter().zip(chromas).zip(colors) {
                    let [u, v] = from_fn(|k| from_fn(|i| uv[2 * i + k]));
                    block_of_yuv(luma, &u, &v, out);
                }
                let uv = chroma[blocks.len() * BLOCK..].chunks_exact(2);
                for ((lumas, out), uv) in rest.chunks(2).zip(rest_out.chunks_mut(6)).zip(uv) {
                    let chroma = chroma_of(uv[0], uv[1]);
                    for (&luma, out) in lumas.iter().zip(out.chunks_exact_mut(3)) {
                        out.copy_from_slice(&rgb_of(luma, chroma));
                    }
                }
            }
        }
        format @ (PixelFormat::BayerRggb8
        | PixelFormat::BayerGrbg8
        | PixelFormat::BayerGbrg8
        | PixelFormat::BayerBggr8) => {
            if width < 2 || height < 2 {
                return Err(unsupported(format!("a Bayer mosaic needs at least 2x2 pixels, not {width}x{height}")));
            }
            // Place of the first pixel in a mosaic of rows RG and GB.
            let phase = match format {
                PixelFormat::BayerGrbg8 => (1, 0),
                PixelFormat::BayerGbrg8 => (0, 1),
                PixelFormat::BayerBggr8 => (1, 1),
                _ => (0, 0),
            };
            rgb.clear();
            demosaic(bytes, width, height, phase, rgb);
        }
        PixelFormat::Mjpeg => {
            mjpeg::decode(bytes, width, height, rgb, scratch)?;
        }
    }
    Ok(())
}

fn unsupported(message: String) -> CaptureError {
    CaptureError::general(CaptureErrorKind::Unsupported, message)
}

/// Converts BT.601 with limited range in 16-bit fixed point: `R = 255/219 (Y-16) + 2 (1-Kr) 255/224 (V-128)` and so on
/// with Kr = 0.299, Kb = 0.114. Nothing here can overflow; checks for it would prevent vectorisation.
#[inline]
fn rgb_of(y: u8, chroma: [i32; 3]) -> [u8; 3] {
    chroma.map(|c| level(scaled_luma(y).wrapping_add(c)))
}

/// Returns the contribution of luma to red, green and blue, with half a level for rounding.
#[inline]
fn scaled_luma(y: u8) -> i32 {
    i32::from(y).wrapping_sub(16).wrapping_mul(76_309).wrapping_add(1 << 15)
}

/// Rounds a colour in fixed point to its level.
#[inline]
fn level(fixed: i32) -> u8 {
    (fixed >> 16).clamp(0, 255) as u8
}

/// Returns the contributions of chroma to red, green and blue.
#[inline]
fn chroma_of(u: u8, v: u8) -> [i32; 3] {
    let (u, v) = (i32::from(u).wrapping_sub(128), i32::from(v).wrapping_sub(128));
    let green = u.wrapping_mul(-25_675).wrapping_sub(v.wrapping_mul(53_279));
    [v.wrapping_mul(104_597), green, u.wrapping_mul(132_201)]
}

/// Pixels per block, whose arithmetic the compiler vectorises; even, so that it ends with a whole pair.
const BLOCK: usize = 32;

/// Converts pairs of pixels with common chroma, whose four bytes are [luma, luma, U, V] at these offsets.
fn packed_to_rgb(bytes: &[u8], [first, second, u, v]: [usize; 4], rgb: &mut [u8]) {
    let (blocks, rest) = bytes.as_chunks::<{ 2 * BLOCK }>();
    let (colors, rest_out) = rgb.as_chunks_mut::<{ 3 * BLOCK }>();
    for (bytes, out) in blocks.iter().zip(colors) {
        let luma = from_fn(|i| bytes[4 * (i / 2) + if i % 2 == 0 { first } else { second }]);
        block_of_yuv(&luma, &from_fn(|i| bytes[4 * i + u]), &from_fn(|i| bytes[4 * i + v]), out);
    }
    for (bytes, out) in rest.chunks_exact(4).zip(rest_out.chunks_exact_mut(6)) {
        let chroma = chroma_of(bytes[u], bytes[v]);
        out[..3].copy_from_slice(&rgb_of(bytes[first], chroma));
        out[3..].copy_from_slice(&rgb_of(bytes[second], chroma));
    }
}

/// Applies [`rgb_of`] to a block of pixels, two per chroma sample.
#[inline]
fn block_of_yuv(luma: &[u8; BLOCK], u: &[u8; BLOCK / 2], v: &[u8; BLOCK / 2], out: &mut [u8; 3 * BLOCK]) {
    // One simple loop a step, and planes first: anything else is computed pixel by pixel.
    let luma = luma.map(scaled_luma);
    let mut chroma = [[0i32; BLOCK]; 3];
    for i in 0..BLOCK {
        let pixel = chroma_of(u[i / 2], v[i / 2]);
        (chroma[0][i], chroma[1][i], chroma[2][i]) = (pixel[0], pixel[1], pixel[2]);
    }
    let planes: [[u8; BLOCK]; 3] = from_fn(|c| from_fn(|i| level(luma[i].wrapping_add(chroma[c][i]))));
    for i in 0..BLOCK {
        (out[3 * i], out[3 * i + 1], out[3 * i + 2]) = (planes[0][i], planes[1][i], planes[2][i]);
    }
}

/// Interpolates a Bayer mosaic bilinearly: a missing colour is the mean of the neighbours of that colour; the border is
/// mirrored about the outermost pixel, which preserves the mosaic's phase.
fn demosaic(mosaic: &[u8], width: usize, height: usize, phase: (usize, usize), rgb: &mut Vec<u8>) {
    let mirror = |i: usize, n: usize| [if i == 0 { 1 } else { i - 1 }, if i + 1 == n { n - 2 } else { i + 1 }];
    for y in 0..height {
        let [up, down] = mirror(y, height).map(|y| &mosaic[y * width..][..width]);
        let row = &mosaic[y * width..][..width];
        for x in 0..width {
            let [left, right] = mirror(x, width);
            let own = row[x];
            let mean2 = |a: u8, b: u8| (u16::from(a) + u16::from(b)).div_ceil(2) as u8;
            let mean4 =
                |[a, b, c, d]: [u8; 4]| ((u16::from(a) + u16::from(b) + u16::from(c) + u16::from(d) + 2) / 4) as u8;
            let cross = || mean4([row[left], row[right], up[x], down[x]]);
            let corners = || mean4([up[left], up[right], down[left], down[right]]);
            let (sides, ends) = (mean2(row[left], row[right]), mean2(up[x], down[x]));
            rgb.extend(match ((y + phase.1) % 2, (x + phase.0) % 2) {
                (0, 0) => [own, cross(), corners()],
                (0, _) => [sides, own, ends],
                (_, 0) => [ends, own, sides],
                _ => [corners(), cross(), own],
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn rgb_of_yuv(y: u8, u: u8, v: u8) -> [u8; 3] {
        rgb_of(y, chroma_of(u, v))
    }

    fn noise(length: usize) -> Vec<u8> {
        let mut state = 3u64;
        let step = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as u8
        };
        std::iter::repeat_with(step).take(length).collect()
    }

    fn convert(width: u32, height: u32, format: PixelFormat, bytes: Vec<u8>) -> Result<Vec<u8>, CaptureError> {
        to_rgb8(&Image::new(width, height, format, bytes).unwrap())
    }

    /// Converts by the definition of BT.601 instead of its usual constants.
    fn reference(y: u8, u: u8, v: u8) -> [f64; 3] {
        let (kr, kb) = (0.299, 0.114);
        let y = (f64::from(y) - 16.0) / 219.0;
        let (pb, pr) = ((f64::from(u) - 128.0) / 224.0, (f64::from(v) - 128.0) / 224.0);
        let (r, b) = (y + 2.0 * (1.0 - kr) * pr, y + 2.0 * (1.0 - kb) * pb);
        [r, (y - kr * r - kb * b) / (1.0 - kr - kb), b].map(|c| 255.0 * c.clamp(0.0, 1.0))
    }

    fn close(found: &[u8], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
            assert!((f64::from(*found) - expected).abs() <= 0.51, "byte {i}: {found} for {expected}");
        }
    }

    #[test]
    fn every_yuv_triple_is_within_half_a_step_of_the_definition() {
        for y in 0..=255 {
            for u in (0..=255).step_by(5) {
                for v in (0..=255).step_by(3) {
                    close(&rgb_of_yuv(y, u, v), &reference(y, u, v));
                }
            }
        }
        assert_eq!([rgb_of_yuv(16, 128, 128), rgb_of_yuv(235, 128, 128)], [[0; 3], [255; 3]]);
        assert_eq!(rgb_of_yuv(81, 90, 240), [254, 0, 0], "a broadcast red bar");
    }

    #[test]
    fn packed_yuv_has_its_bytes_in_order() {
        // Blocks and a rest; a rest alone.
        for (width, height) in [(6, 4), (54, 3), (64, 1)] {
            let bytes = noise(width * height * 2);
            let (width, height) = (width as u32, height as u32);
            let expected: Vec<f64> = bytes
                .chunks(4)
                .flat_map(|p| [reference(p[0], p[1], p[3]), reference(p[2], p[1], p[3])])
                .flatten()
                .collect();
            close(&convert(width, height, PixelFormat::Yuyv, bytes.clone()).unwrap(), &expected);
            let swapped = bytes.chunks(2).flat_map(|p| [p[1], p[0]]).collect();
            close(&convert(width, height, PixelFormat::Uyvy, swapped).unwrap(), &expected);
        }
        assert_eq!(convert(3, 1, PixelFormat::Yuyv, noise(6)).unwrap_err().kind, CaptureErrorKind::Unsupported);
    }

    #[test]
    fn nv12_of_even_and_odd_size() {
        for (width, height) in [(6usize, 4usize), (5, 3), (1, 1), (64, 2), (99, 5)] {
            let chroma_width = width.div_ceil(2);
            let bytes = noise(width * height + chroma_width * height.div_ceil(2) * 2);
            let mut expected = Vec::new();
            for y in 0..height {
                for x in 0..width {
                    let uv = width * height + ((y / 2) * chroma_width + x / 2) * 2;
                    expected.extend(reference(bytes[y * width + x], bytes[uv], bytes[uv + 1]));
                }
            }
            close(&convert(width as u32, height as u32, PixelFormat::Nv12, bytes).unwrap(), &expected);
        }
    }

    #[test]
    fn bayer_is_the_mean_of_the_neighbours_of_a_colour() {
        let phases = [
            (PixelFormat::BayerRggb8, [[0, 1], [1, 2]]),
            (PixelFormat::BayerGrbg8, [[1, 0], [2, 1]]),
            (PixelFormat::BayerGbrg8, [[1, 2], [0, 1]]),
            (PixelFormat::BayerBggr8, [[2, 1], [1, 0]]),
        ];
        let sizes = [(2i64, 2i64), (7, 5), (6, 8)];
        for ((format, colors), (width, height)) in phases.into_iter().flat_map(|p| sizes.map(|size| (p, size))) {
            let mosaic = noise((width * height) as usize);
            let mirror = |i: i64, n: i64| {
                if i < 0 {
                    -i
                } else if i >= n {
                    2 * n - 2 - i
                } else {
                    i
                }
            };
            let color = |x: i64, y: i64| colors[(y % 2) as usize][(x % 2) as usize];
            let mut expected = Vec::new();
            for y in 0..height {
                for x in 0..width {
                    for channel in 0..3 {
                        if color(x, y) == channel {
                            expected.push(f64::from(mosaic[(y * width + x) as usize]));
                            continue;
                        }
                        let (mut sum, mut count) = (0.0, 0.0);
                        for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
                            let (nx, ny) = (mirror(x + dx, width), mirror(y + dy, height));
                            // Green sits on the cross, the other colour of a corner on the diagonal.
                            if color(nx, ny) == channel {
                                sum += f64::from(mosaic[(ny * width + nx) as usize]);
                                count += 1.0;
                            }
                        }
                        expected.push(sum / count);
                    }
                }
            }
            close(&convert(width as u32, height as u32, format, mosaic).unwrap(), &expected);
        }
        assert_eq!(convert(1, 4, PixelFormat::BayerRggb8, noise(4)).unwrap_err().kind, CaptureErrorKind::Unsupported);
    }

    #[test]
    fn plain_formats_move_bytes() {
        assert_eq!(convert(2, 1, PixelFormat::Rgb8, vec![1, 2, 3, 4, 5, 6]).unwrap(), [1, 2, 3, 4, 5, 6]);
        assert_eq!(convert(2, 1, PixelFormat::Bgr8, vec![1, 2, 3, 4, 5, 6]).unwrap(), [3, 2, 1, 6, 5, 4]);
        assert_eq!(convert(1, 2, PixelFormat::Rgba8, vec![1, 2, 3, 0, 4, 5, 6, 9]).unwrap(), [1, 2, 3, 4, 5, 6]);
        assert_eq!(convert(1, 2, PixelFormat::Gray8, vec![7, 8]).unwrap(), [7, 7, 7, 8, 8, 8]);
    }

    #[test]
    fn mjpeg_is_decoded_or_refused() {
        let picture = image::RgbImage::from_pixel(16, 8, image::Rgb([200, 40, 90]));
        let mut jpeg = Cursor::new(Vec::new());
        picture.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        let jpeg = jpeg.into_inner();
        let rgb = convert(16, 8, PixelFormat::Mjpeg, jpeg.clone()).unwrap();
        assert!(rgb.iter().zip(picture.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 6));
        let error = convert(8, 8, PixelFormat::Mjpeg, jpeg.clone()).unwrap_err();
        assert_eq!(error.to_string(), "the JPEG is 16x8, its frame 8x8");
        let cut = convert(16, 8, PixelFormat::Mjpeg, jpeg[..jpeg.len() - 2].to_vec()).unwrap_err();
        assert_eq!(
            (cut.kind, cut.to_string().as_str()),
            (CaptureErrorKind::Corrupt, "is a JPEG image that is cut off")
        );
        assert_eq!(convert(16, 8, PixelFormat::Mjpeg, vec![]).unwrap_err().kind, CaptureErrorKind::Corrupt);
    }
}
