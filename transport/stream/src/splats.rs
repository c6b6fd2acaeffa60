//! The splat stream: the whole state of one instant, quantised.
//!
//! Layout, little-endian: 64 bytes of header, then three planes, each one entry a Gaussian: position
//! (3 x u16 inside the bounding box), standard deviation (u16, of the largest), colour (sRGB red,
//! green, blue, opacity; 4 x u8).
//!
//! Seam: a Gaussian keeps its index over time. A later stream can send canonical positions and
//! skinning once and then only poses and displacements beside this one.
//!
//! The `flags` word of the header is 0 for the first person. Bit 1 says that the header's last four bytes hold the number
//! of another person; a reader refuses other bits, and one older than that bit refuses other persons.
//!
//! No general compressor behind it: deflate at its fastest takes 115k Gaussians to 0.87 of the size, to 0.68
//! when sorted into byte planes, for 24 to 32 ms a state, while encoding takes 3 to 4 ms.

use std::sync::LazyLock;

use crate::{SCHEMA_VERSION, TransportError, header::Reader};

/// Most Gaussians in a state.
pub const MAX_SPLATS: usize = 1 << 22;

/// Persons, the first one aside, whose splats have a topic at a time; beyond it the one that was published longest ago
/// loses its topic.
pub const MAX_PERSON_TOPICS: usize = 16;

const MAGIC: [u8; 4] = *b"FLSP";
const HEADER: usize = 64;
const PER_SPLAT: usize = 12;
/// Flag: the header names a person.
const HAS_PERSON: u16 = 2;

/// Largest encoded state, bytes.
pub(crate) const MAX_BYTES: usize = HEADER + MAX_SPLATS * PER_SPLAT;

/// Gaussians as the renderer keeps them; both vectors have one element a Gaussian.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SplatState {
    /// Which person, 0 for the first; the same number is the same person as long as it is followed.
    pub person: u32,
    /// The rig's frame number.
    pub frame: u64,
    /// Capture time of the frame set, `CLOCK_MONOTONIC` of the capturing host.
    pub capture_nanos: i64,
    /// World position, metres; w: standard deviation, metres.
    pub center_scale: Vec<[f32; 4]>,
    /// Linear RGB in 0..=1; w: opacity in 0..=1.
    pub color: Vec<[f32; 4]>,
    /// Gaussians that were not finite when encoded: they arrive transparent and of size 0, in their place.
    pub invalid: u32,
}

impl SplatState {
    /// Largest error of a coordinate after [`Self::encode`] and [`Self::decode`], metres, an axis each:
    /// half a step of the bounding box and the rounding of `f32`.
    #[must_use]
    pub fn position_error_m(&self) -> [f32; 3] {
        let Bounds { min, max, .. } = Bounds::of(self);
        std::array::from_fn(|axis| {
            let magnitude = min[axis].abs().max(max[axis].abs());
            0.5 * (max[axis] - min[axis]) / LEVELS + 2.0 * f32::EPSILON * magnitude
        })
    }

    /// Quantises the state.
    ///
    /// # Errors
    /// `Config` when the two vectors differ in length or hold more than [`MAX_SPLATS`].
    pub fn encode(&self) -> Result<Vec<u8>, TransportError> {
        let count = self.center_scale.len();
        if self.color.len() != count {
            let colors = self.color.len();
            return Err(TransportError::config("splats", format!("{count} positions but {colors} colours")));
        }
        if count > MAX_SPLATS {
            return Err(TransportError::config("splats", format!("{count} Gaussians, at most {MAX_SPLATS}")));
        }
        let bounds = Bounds::of(self);
        let mut bytes = Vec::with_capacity(HEADER + count * PER_SPLAT);
        bytes.extend_from_slice(&MAGIC);
        bytes.extend_from_slice(&SCHEMA_VERSION.to_le_bytes());
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
                let level = ((splat[axis] - bounds.min[axis]) * per_metre[axis]).round() as u16;
                position[2 * axis..2 * axis + 2].copy_from_slice(&level.to_le_bytes());
            }
            scale.copy_from_slice(&((splat[3].max(0.0) * per_scale).round() as u16).to_le_bytes());
            for channel in 0..3 {
                rgba[channel] = SRGB.encode(color[channel]);
            }
            rgba[3] = (color[3].clamp(0.0, 1.0) * 255.0).round() as u8;
        }
        Ok(bytes)
    }

    /// The state out of its bytes.
    ///
    /// # Errors
    /// `UnknownVersion`, or `Malformed` when counts, sizes or numbers do not fit; nothing is allocated before
    /// the count is known to fit the bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, TransportError> {
        let malformed = |message: String| TransportError::malformed("splats", message);
        let short = || malformed("the splat header is cut short".to_owned());
        let mut reader = Reader(bytes);
        if reader.take::<4>() != Some(MAGIC) {
            return Err(malformed("not a splat state: wrong first four bytes".to_owned()));
        }
        let version = reader.take().map(u16::from_le_bytes).ok_or_else(short)?;
        if version != SCHEMA_VERSION {
            return Err(TransportError::version("splats", version));
        }
        let flags = reader.take().map(u16::from_le_bytes).ok_or_else(short)?;
        if flags & !HAS_PERSON != 0 {
            return Err(malformed(format!("flags {flags:#x} are not known to this version")));
        }
        let frame = u64::from_le_bytes(reader.take().ok_or_else(short)?);
        let capture_nanos = i64::from_le_bytes(reader.take().ok_or_else(short)?);
        let count = u32::from_le_bytes(reader.take().ok_or_else(short)?) as usize;
        let invalid = u32::from_le_bytes(reader.take().ok_or_else(short)?);
        let mut numbers = [0.0f32; 7];
        for number in &mut numbers {
            *number = f32::from_le_bytes(reader.take().ok_or_else(short)?);
        }
        let person = u32::from_le_bytes(reader.take().ok_or_else(short)?);
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
                [
                    SRGB.linear[c[0] as usize],
                    SRGB.linear[c[1] as usize],
                    SRGB.linear[c[2] as usize],
                    f32::from(c[3]) / 255.0,
                ]
            })
            .collect();
        Ok(Self { person, frame, capture_nanos, center_scale, color, invalid })
    }
}

/// Steps of a 16-bit code.
const LEVELS: f32 = 65_535.0;

/// Positions beyond this are treated as not finite: their box would leave nothing to the others.
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
        std::array::from_fn(|axis| self.max[axis] - self.min[axis])
    }
}

/// sRGB (IEC 61966-2-1) by tables: a first guess by 4096 equal steps, then the exact boundary.
struct SrgbTable {
    /// Linear value of each code.
    linear: [f32; 256],
    /// Linear value from which code `i + 1` is nearer in sRGB than code `i`.
    boundary: [f32; 255],
    /// Code at the start of each of 4096 equal steps of linear light.
    guess: Vec<u8>,
}

static SRGB: LazyLock<SrgbTable> = LazyLock::new(SrgbTable::new);

fn linear_from_srgb(srgb: f64) -> f64 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

impl SrgbTable {
    const STEPS: usize = 4096;

    fn new() -> Self {
        let linear = std::array::from_fn(|code| linear_from_srgb(code as f64 / 255.0) as f32);
        let boundary: [f32; 255] = std::array::from_fn(|code| linear_from_srgb((code as f64 + 0.5) / 255.0) as f32);
        let guess = (0..Self::STEPS)
            .map(|step| boundary.partition_point(|edge| *edge <= step as f32 / Self::STEPS as f32) as u8)
            .collect();
        Self { linear, boundary, guess }
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
    use super::*;

    #[test]
    fn srgb_table_agrees_with_the_formula() {
        for i in 0..=100_000 {
            let linear = i as f64 / 100_000.0;
            let srgb = if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
            let code = f64::from(SRGB.encode(linear as f32));
            assert!((code - srgb * 255.0).abs() < 0.5 + 1e-3, "{linear}: {code} {}", srgb * 255.0);
        }
        assert_eq!((SRGB.encode(-1.0), SRGB.encode(7.0), SRGB.encode(f32::NAN)), (0, 255, 0));
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
        for code in 0..=255u8 {
            assert_eq!(SRGB.encode(SRGB.linear[code as usize]), code);
        }
    }
}
