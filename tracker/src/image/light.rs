//! sRGB and linear light.

use std::sync::LazyLock;

use flyrig_model::srgb;

/// Linear light of each sRGB byte, 0..=1.
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| srgb::byte_table(f32::powf));

/// Returns linear light, 0..=1, of an sRGB value, 0..=255: that of the two bytes next to it, interpolated.
pub(crate) fn linear(code: f32) -> f32 {
    let value = code.clamp(0.0, 255.0);
    let byte = (value as usize).min(254);
    let (low, high) = (LINEAR[byte], LINEAR[byte + 1]);
    low + (high - low) * (value - byte as f32)
}

/// Returns linear light of a pixel.
pub(crate) fn linear_of_bytes(rgb: [u8; 3]) -> [f32; 3] {
    rgb.map(|byte| LINEAR[usize::from(byte)])
}

/// Returns the sRGB byte of linear light; black for numbers that are not finite.
pub(crate) fn byte(linear: f32) -> u8 {
    let value = if linear.is_finite() { linear.clamp(0.0, 1.0) } else { 0.0 };
    (srgb::encode(value, f32::powf) * 255.0).round() as u8
}

/// Returns the linear light of one sRGB step at a linear value: sRGB noise of one step is as large as this in light.
pub(crate) fn step(linear: f32) -> f32 {
    srgb::inverse_slope(linear.clamp(0.0, 1.0), f32::powf) / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_returns_and_poison_is_black() {
        for value in 0..=255u8 {
            assert_eq!(byte(linear_of_bytes([value; 3])[0]), value);
        }
        assert_eq!([byte(f32::NAN), byte(-1.0), byte(7.0)], [0, 0, 255]);
    }

    #[test]
    fn between_bytes_the_curve_is_followed() {
        for i in 0..=2550u16 {
            let code = f32::from(i) * 0.1;
            assert!((linear(code) - srgb::decode(code / 255.0, f32::powf)).abs() < 1e-5, "{code}");
        }
        assert!(linear(-5.0).abs() < 1e-6 && (linear(900.0) - 1.0).abs() < 1e-6);
        assert!(linear(f32::NAN).is_nan());
    }

    #[test]
    fn a_step_is_the_difference_between_neighbouring_bytes() {
        for value in [3.0f32, 20.0, 100.0, 200.0] {
            let difference = linear(value + 0.5) - linear(value - 0.5);
            assert!((step(linear(value)) / difference - 1.0).abs() < 0.02, "{value}");
        }
    }
}
