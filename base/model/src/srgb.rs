//! Transfer curve of sRGB (IEC 61966-2-1) between linear light and codes, both in 0..=1.
//!
//! The functions exist for `f32` and `f64`, compute in that precision, and take the power function of the caller. They neither
//! clamp nor treat NaN: the linear branch serves everything below its end, and NaN stays NaN.
//!
//! ```
//! use flyrig_model::srgb;
//!
//! let light = srgb::decode(0.5f64, f64::powf);
//! assert!((light - 0.214_041).abs() < 1e-6);
//! assert!((srgb::encode(light, f64::powf) - 0.5).abs() < 1e-12);
//!
//! let light_of_byte: [f32; 256] = srgb::byte_table(f32::powf);
//! assert!(light_of_byte[255] == 1.0 && light_of_byte[0] == 0.0);
//! ```

use core::ops::{Add, Div, Mul, Sub};

/// `srgb_from_linear` for colours in WGSL: one function from linear light in 0..=1 to sRGB, per channel.
pub const WGSL: &str = include_str!("srgb.wgsl");

/// Precision in which the curve is computed, with its constants rounded to it.
pub trait Float:
    Copy + PartialOrd + From<u8> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    /// Largest linear light of the straight part.
    const LINEAR_END: Self;
    /// Largest code of the straight part.
    const CODE_END: Self;
    /// Slope of the straight part, code by linear light.
    const STEEPNESS: Self;
    /// Factor of the power.
    const SCALE: Self;
    /// Distance of the power's curve from the code.
    const OFFSET: Self;
    /// Exponent from code to light.
    const GAMMA: Self;
    /// Exponent from light to code.
    const INVERSE_GAMMA: Self;
    /// Factor and exponent of the power's derivative, code by linear light.
    const SLOPE: [Self; 2];
    /// Slope of the straight part, linear light by code.
    const INVERSE_STEEPNESS: Self;
    /// Factor and exponent of linear light by code, at linear light.
    const INVERSE_SLOPE: [Self; 2];
}

macro_rules! constants {
    ($($float:ty)*) => {$(
        impl Float for $float {
            const LINEAR_END: Self = 0.003_130_8;
            const CODE_END: Self = 0.040_45;
            const STEEPNESS: Self = 12.92;
            const SCALE: Self = 1.055;
            const OFFSET: Self = 0.055;
            const GAMMA: Self = 2.4;
            const INVERSE_GAMMA: Self = 1.0 / 2.4;
            const SLOPE: [Self; 2] = [1.055 / 2.4, 1.0 / 2.4 - 1.0];
            const INVERSE_STEEPNESS: Self = 1.0 / 12.92;
            const INVERSE_SLOPE: [Self; 2] = [2.4 / 1.055, 1.4 / 2.4];
        }
    )*};
}

constants!(f32 f64);

/// Returns the code of linear light.
#[inline]
#[must_use]
pub fn encode<T: Float>(linear: T, powf: impl Fn(T, T) -> T) -> T {
    if linear <= T::LINEAR_END { linear * T::STEEPNESS } else { T::SCALE * powf(linear, T::INVERSE_GAMMA) - T::OFFSET }
}

/// Returns the linear light of a code.
#[inline]
#[must_use]
pub fn decode<T: Float>(code: T, powf: impl Fn(T, T) -> T) -> T {
    if code <= T::CODE_END { code / T::STEEPNESS } else { powf((code + T::OFFSET) / T::SCALE, T::GAMMA) }
}

/// Returns the derivative of [`encode`]: code by linear light, at linear light.
#[inline]
#[must_use]
pub fn slope<T: Float>(linear: T, powf: impl Fn(T, T) -> T) -> T {
    let [factor, exponent] = T::SLOPE;
    if linear <= T::LINEAR_END { T::STEEPNESS } else { factor * powf(linear, exponent) }
}

/// Returns the derivative of [`decode`]: linear light by code, at the linear light of the code.
#[inline]
#[must_use]
pub fn inverse_slope<T: Float>(linear: T, powf: impl Fn(T, T) -> T) -> T {
    let [factor, exponent] = T::INVERSE_SLOPE;
    if linear <= T::LINEAR_END { T::INVERSE_STEEPNESS } else { factor * powf(linear, exponent) }
}

/// Returns the linear light of each sRGB byte.
#[must_use]
pub fn byte_table<T: Float>(powf: impl Fn(T, T) -> T) -> [T; 256] {
    core::array::from_fn(|byte| decode(T::from(byte as u8) / T::from(255), &powf))
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;

    /// The formulas as they stood in the crates before they were united, in one precision.
    macro_rules! copies {
        ($name:ident, $float:ident) => {
            mod $name {
                pub fn encode(x: $float, powf: fn($float, $float) -> $float) -> $float {
                    if x <= 0.003_130_8 { x * 12.92 } else { 1.055 * powf(x, 1.0 / 2.4) - 0.055 }
                }

                pub fn decode(x: $float, powf: fn($float, $float) -> $float) -> $float {
                    if x <= 0.040_45 { x / 12.92 } else { powf((x + 0.055) / 1.055, 2.4) }
                }

                pub fn slope(x: $float, powf: fn($float, $float) -> $float) -> $float {
                    if x <= 0.003_130_8 { 12.92 } else { 1.055 / 2.4 * powf(x, 1.0 / 2.4 - 1.0) }
                }

                pub fn inverse_slope(x: $float, powf: fn($float, $float) -> $float) -> $float {
                    if x <= 0.003_130_8 { 1.0 / 12.92 } else { 2.4 / 1.055 * powf(x, 1.4 / 2.4) }
                }
            }
        };
    }

    copies!(single, f32);
    copies!(double, f64);

    #[test]
    fn every_bit_is_that_of_the_written_out_formula_in_f32() {
        // Each 997th number of both signs, with the infinities and NaN.
        for bits in (0..=u32::MAX).step_by(997) {
            let x = f32::from_bits(bits);
            for powf in [f32::powf, libm::powf] {
                let ours = [encode(x, powf), decode(x, powf), slope(x, powf), inverse_slope(x, powf)];
                let theirs = [
                    single::encode(x, powf),
                    single::decode(x, powf),
                    single::slope(x, powf),
                    single::inverse_slope(x, powf),
                ];
                let same = |(a, b): (&f32, &f32)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
                assert!(ours.iter().zip(&theirs).all(same), "{x}: {ours:?} {theirs:?}");
            }
        }
    }

    #[test]
    fn every_bit_is_that_of_the_written_out_formula_in_f64() {
        let steps = (0..=400_000).map(|i| f64::from(i) / 200_000.0 - 0.5);
        let bytes = (0..=1020).map(|i| f64::from(i) / 1020.0);
        let edges = [0.003_130_8, 0.040_45].into_iter().flat_map(|edge: f64| [edge.next_down(), edge, edge.next_up()]);
        for x in steps.chain(bytes).chain(edges).chain([f64::INFINITY, f64::NEG_INFINITY, f64::NAN, -0.0]) {
            for powf in [f64::powf, libm::pow] {
                let ours = [encode(x, powf), decode(x, powf), slope(x, powf), inverse_slope(x, powf)];
                let theirs = [
                    double::encode(x, powf),
                    double::decode(x, powf),
                    double::slope(x, powf),
                    double::inverse_slope(x, powf),
                ];
                let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
                assert!(ours.iter().zip(&theirs).all(same), "{x}: {ours:?} {theirs:?}");
            }
        }
    }

    #[test]
    fn directions_and_slopes_fit_each_other() {
        for i in 1..=2000 {
            let code = f64::from(i) / 2000.0;
            let linear = decode(code, f64::powf);
            assert!((encode(linear, f64::powf) - code).abs() < 1e-6, "{code}");
            let (up, down) = (slope(linear, f64::powf), inverse_slope(linear, f64::powf));
            assert!((up * down - 1.0).abs() < 1e-12, "{code}: {up} {down}");
            let step = 1e-7 * linear;
            let moved = (encode(linear + step, f64::powf) - encode(linear - step, f64::powf)) / (2.0 * step);
            // The parts of the curve do not meet exactly.
            assert!((moved / up - 1.0).abs() < 1e-5 || (code - 0.040_45).abs() < 1e-3, "{code}: {moved} {up}");
        }
    }

    #[test]
    fn table_holds_the_light_of_each_byte() {
        let table: Vec<f32> = byte_table(f32::powf).into();
        for (byte, light) in table.iter().enumerate() {
            let expected = single::decode(byte as f32 / 255.0, f32::powf);
            assert_eq!(light.to_bits(), expected.to_bits());
        }
    }
}
