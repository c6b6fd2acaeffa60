//! Brightness of a matte surface by the direction that it faces.
//!
//! A polynomial of second degree in the world's normal describes the irradiance from distant lamps (Ramamoorthi and Hanrahan
//! 2001). Shadows that parts of a body cast on others are not in it.
//!
//! ```
//! use flyrig_model::light;
//!
//! // A lamp overhead: half as bright again for surfaces that face up (z).
//! let mut terms = light::UNIFORM;
//! terms[3] = [0.5; 3];
//! assert_eq!(light::shade(&terms, [0.0, 0.0, 1.0]), [1.5; 3]);
//! assert_eq!(light::shade(&terms, [0.0, 0.0, -1.0]), [0.5; 3]);
//! ```

use core::ops::RangeInclusive;

/// Number of terms of the polynomial.
pub const TERMS: usize = 9;

/// Coefficients: red, green and blue of each term 1, x, y, z, xy, yz, 3zz - 1, xz, xx - yy of the unit normal.
pub type Terms = [[f32; 3]; TERMS];

/// Smallest and largest factor, against the light of the mean direction.
pub const SHADE: RangeInclusive<f32> = 0.05..=4.0;

/// Light of factor 1 from all directions.
pub const UNIFORM: Terms = {
    let mut terms = [[0.0; 3]; TERMS];
    terms[0] = [1.0; 3];
    terms
};

/// Returns the values of the terms for a world normal. A normal that is not finite counts as zero.
#[inline]
#[must_use]
pub fn basis(normal: [f32; 3]) -> [f32; TERMS] {
    let [x, y, z] = if normal.iter().all(|value| value.is_finite()) { normal } else { [0.0; 3] };
    [1.0, x, y, z, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y]
}

/// Returns the polynomial's red, green and blue for the values of its terms ([`basis`]), before [`bounded`].
#[inline]
#[must_use]
pub fn sum(terms: &Terms, basis: [f32; TERMS]) -> [f32; 3] {
    core::array::from_fn(|k| terms.iter().zip(basis).map(|(term, value)| term[k] * value).sum())
}

/// Returns the factors within [`SHADE`].
#[inline]
#[must_use]
pub fn bounded(sum: [f32; 3]) -> [f32; 3] {
    sum.map(|value| value.clamp(*SHADE.start(), *SHADE.end()))
}

/// Returns the factors of red, green and blue for a surface with this world normal, within [`SHADE`].
#[inline]
#[must_use]
pub fn shade(terms: &Terms, normal: [f32; 3]) -> [f32; 3] {
    bounded(sum(terms, basis(normal)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SplitMix64;

    /// The formula as it stood in the crate `stream`, whose test for finite normals adds the components.
    fn of_stream(light: &Terms, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let [x, y, z] = if (x + y + z).is_finite() { [x, y, z] } else { [0.0; 3] };
        let basis = [1.0, x, y, z, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y];
        core::array::from_fn(|k| {
            let sum: f32 = light.iter().zip(basis).map(|(term, value)| term[k] * value).sum();
            sum.clamp(0.05, 4.0)
        })
    }

    #[test]
    fn every_bit_is_that_of_the_written_out_formula() {
        let mut random = SplitMix64(7);
        for i in 0..200_000 {
            let mut number = || random.signed() as f32;
            let terms = core::array::from_fn(|_| core::array::from_fn(|_| 2.0 * number()));
            let mut normal: [f32; 3] = core::array::from_fn(|_| number());
            if i % 10 == 0 {
                normal[i / 10 % 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.0][i / 30 % 4];
            }
            let (ours, theirs) = (shade(&terms, normal), of_stream(&terms, normal));
            assert_eq!(ours.map(f32::to_bits), theirs.map(f32::to_bits), "{terms:?} {normal:?}");
        }
    }

    #[test]
    fn infinite_directions_have_no_light_of_their_own() {
        let terms = [[f32::MAX; 3]; TERMS];
        assert!(shade(&terms, [f32::NAN; 3]).iter().all(|shade| SHADE.contains(shade)));
        assert!(
            shade(&UNIFORM, [f32::INFINITY, f32::NEG_INFINITY, 0.0]).iter().all(|shade| (shade - 1.0).abs() <= 0.0)
        );
    }
}
