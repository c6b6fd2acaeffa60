//! Splat state: all Gaussians of a person at one instant, quantised.
//!
//! Layout, little-endian: a header of 64 bytes, then three planes with one entry per Gaussian: position (3 x u16 inside the bounding
//! box), standard deviation (u16, relative to the largest), colour (sRGB red, green, blue, opacity; 4 x u8). A Gaussian keeps its
//! index over time.
//!
//! The `flags` word of the header is 0 for person 0. Bit 1 says that the last four bytes of the header hold the number of another
//! person. A reader refuses unknown bits, so a reader older than bit 1 refuses all persons but the first.
//!
//! There is no general compressor behind it: on 115k Gaussians, deflate at its fastest level reaches 0.87 of the size, and 0.68 when
//! the bytes are sorted into planes, but takes 24 to 32 ms per state; encoding takes 3 to 4 ms.

use alloc::{borrow::ToOwned as _, format, string::String, vec::Vec};
use core::fmt;

use flyrig_model::srgb;

/// Largest number of Gaussians in a state.
pub const MAX_SPLATS: usize = 1 << 22;

/// Version of the layout.
const VERSION: u16 = 1;
const MAGIC: [u8; 4] = *b"FLSP";
const HEADER: usize = 64;
const PER_SPLAT: usize = 12;
/// Flag: the header names a person.
const HAS_PERSON: u16 = 2;

/// Largest encoded state, bytes.
pub const MAX_SPLAT_BYTES: usize = HEADER + MAX_SPLATS * PER_SPLAT;

/// Error of encoding or decoding a [`SplatState`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SplatError {
    /// The state cannot be encoded.
    State(String),
    /// The bytes have another version of the layout.
    Version(u16),
    /// The bytes are damaged, or are no splat state.
    Malformed(String),
}

impl fmt::Display for SplatError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::State(problem) | Self::Malformed(problem) => f.write_str(problem),
            Self::Version(found) => write!(
                f,
                "speaks schema version {found}, this program knows version {VERSION}; run the same flyrig on both sides"
            ),
        }
    }
}

impl core::error::Error for SplatError {}

/// Takes fixed-size pieces off the front of a byte slice.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], SplatError> {
        let short = || SplatError::Malformed("the splat header is cut short".to_owned());
        let (piece, rest) = self.0.split_first_chunk::<N>().ok_or_else(short)?;
        self.0 = rest;
        Ok(*piece)
    }
}

/// Gaussians of one person in the world; both vectors have one element per Gaussian.
///
/// ```
/// use flyrig_stream::SplatState;
///
/// let state = SplatState {
///     center_scale: vec![[0.0, 0.0, 1.0, 0.004], [0.1, 0.0, 1.2, 0.002]],
///     color: vec![[0.5, 0.2, 0.1, 1.0]; 2],
///     ..SplatState::default()
/// };
/// let found = SplatState::decode(&state.encode()?)?;
/// assert!((found.center_scale[1][2] - 1.2).abs() <= state.position_error_m()[2]);
/// # Ok::<(), flyrig_stream::SplatError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SplatState {
    /// Number of the person, 0 for the first; it stays the same while the person is tracked.
    pub person: u32,
    /// Frame number of the rig.
    pub frame: u64,
    /// Capture time of the frame set, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
    /// World position, metres; w: standard deviation, metres.
    pub center_scale: Vec<[f32; 4]>,
    /// Linear RGB in 0..=1; w: opacity in 0..=1.
    pub color: Vec<[f32; 4]>,
    /// Number of Gaussians that were not finite when encoded: they arrive transparent and of size 0, at their index.
    pub invalid: u32,
}

impl SplatState {
    /// Returns the largest coordinate error after [`Self::encode`] and [`Self::decode`], metres per axis: half a step of the bounding
    /// box plus the rounding of `f32`.
    #[must_use]
    pub fn position_error_m(&self) -> [f32; 3] {
        let Bounds { min, max, .. } = Bounds::of(self);
        core::array::from_fn(|axis| {
            let magnitude = min[axis].abs().max(max[axis].abs());
            0.5 * (max[axis] - min[axis]) / LEVELS + 2.0 * f32::EPSILON * magnitude
        })
    }

    /// Quantises and encodes the state.
    ///
    /// # Errors
    /// [`SplatError::State`] when the two vectors differ in length or hold more than [`MAX_SPLATS`].
    pub fn encode(&self) -> Result<Vec<u8>, SplatError> {
        let count = self.center_scale.len();
        if self.color.len() != count {
            let colors = self.color.len();
            return Err(SplatError::State(format!("{count} positions but {colors} colours")));
        }
        if count > MAX_SPLATS {
            return Err(SplatError::State(format!("{count} Gaussians, at most {MAX_SPLATS}")));
        }
        let bounds = Bounds::of(self);
        let mut bytes = Vec::with_capacity(HEADER + count * PER_SPLAT);
        bytes.extend_from_slice(&MAGIC);
        bytes.extend_from_slice(&VERSION.to_le_bytes());
        let flags = if self.person == 0 { 0 } else { HAS_PERSON };
        bytes.extend_from_slice(&flags.to_le_bytes());
        bytes.extend_from_slice(&self.frame.to_le_bytes());
        bytes.extend_from_slice(&self.capture_nanos.to_le_bytes());
        bytes.extend_from_slice(&(count as u32).to_le_bytes());
        bytes.extend_from_slice(&bounds.invalid.to_le_bytes());
        for value in bounds.min.into_iter().chain(bounds.max).chain([bounds.max_scale]) {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        bytes.extend_from_slice(&self.person.to_le_bytes());
        bytes.resize(HEADER + count * PER_SPLAT, 0);

        let srgb = SrgbTable::new();
        let per_metre = bounds.extent().map(|extent| if extent > 0.0 { LEVELS / extent } else { 0.0 });
        let per_scale = if bounds.max_scale > 0.0 { LEVELS / bounds.max_scale } else { 0.0 };
        let (positions, rest) = bytes[HEADER..].split_at_mut(count * 6);
        let (scales, colors) = rest.split_at_mut(count * 2);
        let targets = positions.chunks_exact_mut(6).zip(scales.chunks_exact_mut(2)).zip(colors.chunks_exact_mut(4));
        for (((position, scale), rgba), (splat, color)) in targets.zip(self.center_scale.iter().zip(&self.color)) {
            if !is_valid(splat, color) {
                continue; // zeros: transparent, of size 0
            }
            for axis in 0..3 {
                let level = libm::roundf((splat[axis] - bounds.min[axis]) * per_metre[axis]) as u16;
                position[2 * axis..2 * axis + 2].copy_from_slice(&level.to_le_bytes());
            }
            scale.copy_from_slice(&(libm::roundf(splat[3].max(0.0) * per_scale) as u16).to_le_bytes());
            for channel in 0..3 {
                rgba[channel] = srgb.encode(color[channel]);
            }
            rgba[3] = libm::roundf(color[3].clamp(0.0, 1.0) * 255.0) as u8;
        }
        Ok(bytes)
    }

    /// Decodes a state.
    ///
    /// # Errors
    /// [`SplatError::Version`], or [`SplatError::Malformed`] when counts, sizes or numbers do not fit; nothing is allocated before the
    /// count is known to fit the bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, SplatError> {
        let malformed = |message: String| SplatError::Malformed(message);
        let mut reader = Reader(bytes);
        if reader.take::<4>() != Ok(MAGIC) {
            return Err(malformed("not a splat state: wrong first four bytes".to_owned()));
        }
        let version = u16::from_le_bytes(reader.take()?);
        if version != VERSION {
            return Err(SplatError::Version(version));
        }
        let flags = u16::from_le_bytes(reader.take()?);
        if flags & !HAS_PERSON != 0 {
            return Err(malformed(format!("flags {flags:#x} are not known to this version")));
        }
        let frame = u64::from_le_bytes(reader.take()?);
        let capture_nanos = i64::from_le_bytes(reader.take()?);
        let count = u32::from_le_bytes(reader.take()?) as usize;
        let invalid = u32::from_le_bytes(reader.take()?);
        let mut numbers = [0.0f32; 7];
        for number in &mut numbers {
            *number = f32::from_le_bytes(reader.take()?);
        }
        let person = u32::from_le_bytes(reader.take()?);
        // Without the flag these bytes mean nothing.
        let person = if flags == HAS_PERSON { person } else { 0 };
        if count > MAX_SPLATS {
            return Err(malformed(format!("claims {count} Gaussians, at most {MAX_SPLATS}")));
        }
        let planes = reader.0;
        if planes.len() != count * PER_SPLAT {
            let found = planes.len();
            return Err(malformed(format!("{count} Gaussians need {} bytes, found {found}", count * PER_SPLAT)));
        }
        let [x0, y0, z0, x1, y1, z1, max_scale] = numbers;
        let bounds = Bounds { min: [x0, y0, z0], max: [x1, y1, z1], max_scale, invalid };
        let ordered = bounds.extent().iter().all(|extent| *extent >= 0.0 && extent.is_finite());
        if !numbers.iter().all(|n| n.is_finite()) || !ordered || max_scale < 0.0 || invalid as usize > count {
            return Err(malformed(
                "bounding box, largest scale or count of invalid Gaussians makes no sense".to_owned(),
            ));
        }

        let (positions, rest) = planes.split_at(count * 6);
        let (scales, colors) = rest.split_at(count * 2);
        let linear = SrgbTable::linear();
        let step = bounds.extent().map(|extent| extent / LEVELS);
        let level = |pair: &[u8]| f32::from(u16::from(pair[0]) | u16::from(pair[1]) << 8);
        let center_scale = positions
            .chunks_exact(6)
            .zip(scales.chunks_exact(2))
            .map(|(p, s)| {
                let at = |axis: usize| bounds.min[axis] + step[axis] * level(&p[2 * axis..]);
                [at(0), at(1), at(2), level(s) / LEVELS * max_scale]
            })
            .collect();
        let color = colors
            .chunks_exact(4)
            .map(|c| {
                let [r, g, b] = [c[0], c[1], c[2]].map(|code| linear[usize::from(code)]);
                [r, g, b, f32::from(c[3]) / 255.0]
            })
            .collect();
        Ok(Self { person, frame, capture_nanos, center_scale, color, invalid })
    }
}

/// Steps of a 16-bit code.
const LEVELS: f32 = 65_535.0;

/// Largest coordinate, metres; a Gaussian beyond it counts as not finite, since its bounding box would leave no precision to the others.
const MAX_COORDINATE_M: f32 = 1e4;

fn is_valid(splat: &[f32; 4], color: &[f32; 4]) -> bool {
    splat.iter().all(|value| value.abs() <= MAX_COORDINATE_M) && color.iter().all(|value| value.is_finite())
}

struct Bounds {
    min: [f32; 3],
    max: [f32; 3],
    max_scale: f32,
    invalid: u32,
}

impl Bounds {
    fn of(state: &SplatState) -> Self {
        let mut bounds = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3], max_scale: 0.0, invalid: 0 };
        for (splat, color) in state.center_scale.iter().zip(&state.color) {
            if !is_valid(splat, color) {
                bounds.invalid += 1;
                continue;
            }
            for (axis, value) in splat[..3].iter().enumerate() {
                bounds.min[axis] = bounds.min[axis].min(*value);
                bounds.max[axis] = bounds.max[axis].max(*value);
            }
            bounds.max_scale = bounds.max_scale.max(splat[3]);
        }
        if bounds.min[0] > bounds.max[0] {
            (bounds.min, bounds.max) = ([0.0; 3], [0.0; 3]);
        }
        bounds
    }

    fn extent(&self) -> [f32; 3] {
        core::array::from_fn(|axis| self.max[axis] - self.min[axis])
    }
}

/// sRGB (IEC 61966-2-1) by tables: a first guess by 4096 equal steps, then the exact boundary.
struct SrgbTable {
    /// Linear value from which code `i + 1` is nearer in sRGB than code `i`.
    boundary: [f32; 255],
    /// Code at the start of each of 4096 equal steps of linear light.
    guess: Vec<u8>,
}

/// Returns the linear value of a code in 0..=255.
fn linear(code: f64) -> f32 {
    srgb::decode(code / 255.0, libm::pow) as f32
}

impl SrgbTable {
    const STEPS: usize = 4096;

    /// Returns the linear value of each code.
    fn linear() -> [f32; 256] {
        core::array::from_fn(|code| linear(code as f64))
    }

    fn new() -> Self {
        let boundary: [f32; 255] = core::array::from_fn(|code| linear(code as f64 + 0.5));
        let guess = (0..Self::STEPS)
            .map(|step| boundary.partition_point(|edge| *edge <= step as f32 / Self::STEPS as f32) as u8)
            .collect();
        Self { boundary, guess }
    }

    fn encode(&self, linear: f32) -> u8 {
        // `as` takes NaN and negative numbers to 0 and large ones to the end.
        let step = ((linear * Self::STEPS as f32) as usize).min(Self::STEPS - 1);
        let mut code = self.guess[step];
        while code < 255 && linear >= self.boundary[code as usize] {
            code += 1;
        }
        code
    }
}

#[cfg(test)]
mod tests {
    use std::{string::ToString as _, vec};

    use super::*;

    #[test]
    fn srgb_table_agrees_with_the_formula() {
        let table = SrgbTable::new();
        for i in 0..=100_000 {
            let linear = i as f64 / 100_000.0;
            let srgb = if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
            let code = f64::from(table.encode(linear as f32));
            assert!((code - srgb * 255.0).abs() < 0.5 + 1e-3, "{linear}: {code} {}", srgb * 255.0);
        }
        assert_eq!((table.encode(-1.0), table.encode(7.0), table.encode(f32::NAN)), (0, 255, 0));
    }

    #[test]
    fn a_person_travels_and_the_first_one_changes_no_byte() {
        let state = SplatState { center_scale: vec![[1.0; 4]], color: vec![[0.5; 4]], ..SplatState::default() };
        let first = state.encode().unwrap();
        assert_eq!((&first[6..8], &first[60..64]), (&[0; 2][..], &[0; 4][..]));
        for person in [1, u32::MAX] {
            let mut bytes = SplatState { person, ..state.clone() }.encode().unwrap();
            assert_eq!(SplatState::decode(&bytes).unwrap().person, person);
            // Older readers refuse the flag in words.
            assert_eq!(bytes[6..8], [2, 0]);
            (bytes[6], bytes[60], bytes[61], bytes[62], bytes[63]) = (0, 0, 0, 0, 0);
            assert_eq!(bytes, first);
        }
        let mut unknown = first;
        unknown[6] = 6;
        assert!(SplatState::decode(&unknown).unwrap_err().to_string().contains("flags 0x6 are not known"));
    }

    #[test]
    fn every_colour_code_survives() {
        let table = SrgbTable::new();
        for (code, linear) in (0..=255u8).zip(SrgbTable::linear()) {
            assert_eq!(table.encode(linear), code);
        }
    }

    /// The power of `libm` and that of the system differ at most in the last bit of `f64`, which the rounding to `f32` hides.
    #[test]
    fn the_tables_are_those_of_the_standard_library() {
        let of_std = |srgb: f64| if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) };
        for half in 0..=510 {
            let code = f64::from(half) / 2.0;
            assert_eq!(linear(code).to_bits(), (of_std(code / 255.0) as f32).to_bits(), "{half}");
        }
    }
}
