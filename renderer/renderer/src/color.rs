//! sRGB on the outside, linear light inside, and the way between.

use flyrig_model::srgb;

/// sRGB value (0..=1) of a linear one (IEC 61966-2-1); clamps, NaN becomes 0.
#[must_use]
pub fn srgb_from_linear(linear: f32) -> f32 {
    srgb::encode(unit(linear), f32::powf)
}

/// Linear value of an sRGB one (0..=1); clamps, NaN becomes 0.
#[must_use]
pub fn linear_from_srgb(code: f32) -> f32 {
    srgb::decode(unit(code), f32::powf)
}

/// Clamped to 0..=1; NaN fails the comparison.
fn unit(value: f32) -> f32 {
    if value > 0.0 { value.min(1.0) } else { 0.0 }
}

/// Nearest 8-bit value of 0..=1; clamps, NaN becomes 0.
fn byte(value: f32) -> u8 {
    // `as` saturates and maps NaN to 0.
    (value * 255.0 + 0.5) as u8
}

/// Converts premultiplied linear colour to straight-alpha sRGB (RGBA, 8 bits), as in
/// [`RenderTarget::color`](crate::RenderTarget::color). Where alpha is 0 (or not finite) all four bytes are 0.
///
/// The colour is un-premultiplied in linear light and then encoded, so that multiplying the sRGB bytes by alpha gives
/// the image on black as an ordinary 8-bit compositor (and our evaluation) computes it.
///
/// # Examples
/// ```
/// use flyrig_renderer::rgba8_from_target;
///
/// // Half-covered white, premultiplied.
/// assert_eq!(rgba8_from_target(&[[0.5, 0.5, 0.5, 0.5]]), [255, 255, 255, 128]);
/// ```
#[must_use]
pub fn rgba8_from_target(color: &[[f32; 4]]) -> Vec<u8> {
    use rayon::prelude::*;
    let mut out = vec![0; color.len() * 4];
    out.par_chunks_mut(4 * 4096).zip(color.par_chunks(4096)).for_each(|(out, color)| {
        for (to, &[r, g, b, a]) in out.chunks_exact_mut(4).zip(color) {
            let alpha = byte(a);
            if alpha > 0 && a.is_finite() {
                let encode = |c: f32| byte(srgb_from_linear(c / a));
                to.copy_from_slice(&[encode(r), encode(g), encode(b), alpha]);
            }
        }
    });
    out
}

/// Composites straight-alpha RGBA over an RGB background on the sRGB values, as an 8-bit compositor does; returns RGB
/// bytes. A background shorter than the image counts as black.
#[must_use]
pub fn composite_over(rgba: &[u8], background_rgb: &[u8]) -> Vec<u8> {
    let mut out = vec![0; rgba.len() / 4 * 3];
    let behind = background_rgb.chunks_exact(3).chain(std::iter::repeat([0u8; 3].as_slice()));
    for ((to, from), behind) in out.chunks_exact_mut(3).zip(rgba.chunks_exact(4)).zip(behind) {
        let alpha = u32::from(from[3]);
        for c in 0..3 {
            let mixed = u32::from(from[c]) * alpha + u32::from(behind[c]) * (255 - alpha);
            to[c] = ((mixed + 127) / 255) as u8;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_survives_the_way_to_linear_and_back() {
        for value in 0..=255u8 {
            assert_eq!(byte(srgb_from_linear(linear_from_srgb(f32::from(value) / 255.0))), value);
        }
        assert!((linear_from_srgb(0.5) - 0.214_041_14).abs() < 1e-6);
        for poison in [f32::NAN, -1.0, f32::NEG_INFINITY] {
            assert_eq!(byte(srgb_from_linear(poison)), 0);
        }
        assert_eq!(byte(srgb_from_linear(f32::INFINITY)), 255);
    }

    #[test]
    fn half_covered_colour_stays_the_same_colour() {
        let linear = linear_from_srgb(200.0 / 255.0);
        let half = [linear * 0.5, 0.0, linear * 0.25, 0.5];
        let expected_blue = byte(srgb_from_linear(linear * 0.5));
        assert_eq!(rgba8_from_target(&[half]), vec![200, 0, expected_blue, 128]);
        let empty = [[0.0; 4], [1.0, 1.0, 1.0, 0.0], [f32::NAN; 4], [1.0, 0.0, 0.0, f32::INFINITY]];
        assert!(rgba8_from_target(&empty).iter().all(|&b| b == 0));
    }

    #[test]
    fn compositing_mixes_bytes() {
        assert_eq!(
            composite_over(&[255, 0, 100, 255, 255, 0, 100, 0], &[1, 2, 3, 4, 5, 6]),
            vec![255, 0, 100, 4, 5, 6]
        );
        assert_eq!(composite_over(&[200, 0, 100, 128], &[0, 100, 100]), vec![100, 50, 100]);
        assert_eq!(composite_over(&[200, 0, 100, 255], &[]), vec![200, 0, 100]);
    }
}
