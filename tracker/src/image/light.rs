//! sRGB and linear light.

use std::sync::LazyLock;

/// Linear light of each sRGB byte, 0..=1.
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|byte| linear_of_byte(byte as f32)));

fn linear_of_byte(byte: f32) -> f32 {
    let value = byte / 255.0;
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Returns linear light, 0..=1, of an sRGB value, 0..=255: that of the two bytes next to it, interpolated.
pub(crate) fn linear(srgb: f32) -> f32 {
    let value = srgb.clamp(0.0, 255.0);
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
    let srgb = if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 };
    (srgb * 255.0).round() as u8
}

/// Returns the linear light of one sRGB step at a linear value: sRGB noise of one step is as large as this in light.
pub(crate) fn step(linear: f32) -> f32 {
    let value = linear.clamp(0.0, 1.0);
    let slope = if value <= 0.003_130_8 { 1.0 / 12.92 } else { 2.4 / 1.055 * value.powf(1.4 / 2.4) };
    slope / 255.0
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
            let srgb = f32::from(i) * 0.1;
            assert!((linear(srgb) - linear_of_byte(srgb)).abs() < 1e-5, "{srgb}");
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
