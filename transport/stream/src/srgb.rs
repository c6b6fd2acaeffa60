//! sRGB curve by tables.

use alloc::{boxed::Box, vec::Vec};

use flyrig_model::srgb;

/// Steps of linear light in the table of codes.
const LINEAR_STEPS: usize = 4096;
/// Steps of codes in the table of linear light, four per code of 0..=255.
const CODE_STEPS: usize = 1020;

/// Both directions of the sRGB curve (IEC 61966-2-1) on 0..=1, without a power at each value.
#[derive(Debug, Clone)]
pub(crate) struct Srgb {
    /// Code at each step, and the difference to the next step.
    code: Box<[[f32; 2]; LINEAR_STEPS + 1]>,
    linear: Vec<f32>,
}

impl Srgb {
    pub fn new() -> Self {
        let at_step = |i: usize| 255.0 * srgb::encode((i as f32 / LINEAR_STEPS as f32).min(1.0), libm::powf);
        Self {
            code: Box::new(core::array::from_fn(|i| [at_step(i), at_step(i + 1) - at_step(i)])),
            linear: (0..=CODE_STEPS).map(|i| srgb::decode(i as f32 / CODE_STEPS as f32, libm::powf)).collect(),
        }
    }

    /// Returns the code, 0..=255 and not rounded, of linear light; 0 for NaN.
    pub fn code(&self, linear: f32) -> f32 {
        // The maximum takes NaN to 0.
        let at = (linear.max(0.0) * LINEAR_STEPS as f32).min(LINEAR_STEPS as f32);
        let below = (at as u16).min(LINEAR_STEPS as u16);
        let [code, further] = self.code[usize::from(below)];
        code + further * (at - f32::from(below))
    }

    /// Returns the linear light of a code, to a quarter of a code.
    pub fn linear(&self, code: f32) -> f32 {
        let at = code * (CODE_STEPS as f32 / 255.0) + 0.5;
        // The cast takes negative numbers and NaN to 0.
        self.linear[(at as usize).min(CODE_STEPS)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tables_agree_with_the_curve() {
        let table = Srgb::new();
        for i in 0..=100_000 {
            let code = f64::from(i) / 100_000.0;
            let linear = if code <= 0.04045 { code / 12.92 } else { ((code + 0.055) / 1.055).powf(2.4) };
            let found = f64::from(table.code(linear as f32));
            assert!((found - 255.0 * code).abs() < 0.12, "{linear}: {found} {}", 255.0 * code);
            let back = f64::from(table.code(table.linear(255.0 * code as f32)));
            assert!((back - 255.0 * code).abs() < 0.26, "{code}: {back}");
        }
        let ends = [f32::NAN, -1.0, f32::NEG_INFINITY, 0.0].map(|linear| table.code(linear));
        assert!(ends.iter().all(|code| code.to_bits() == 0), "{ends:?}");
        assert!((table.code(f32::INFINITY) - 255.0).abs() < 1e-3);
        assert_eq!(table.linear(f32::NAN).to_bits(), 0);
        assert!((table.linear(1e9) - 1.0).abs() < 1e-6);
    }
}
