//! SPZ, Niantic's public format of Gaussians, version 2: one frame per file, without harmonics.
//!
//! A gzip stream of a header of 16 bytes and, attribute by attribute, positions (three signed fixed-point numbers of 24 bits),
//! opacities, colours, logarithms of the three standard deviations, and x, y, z of the rotation. A Gaussian here has one standard
//! deviation and a normal: the rotation turns z to the normal.

use std::io::{Read as _, Write as _};

use anyhow::{Context, Result, ensure};
use flate2::{Compression, read::GzDecoder, write::GzEncoder};
use flyrig_renderer::{linear_from_srgb, srgb_from_linear};
use flyrig_stream::Posed;
use glam::{Quat, Vec3};

const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 2;
const HEADER: usize = 16;
/// Fractional bits of a position, as in most files: steps of a quarter of a millimetre.
const FRACTION_BITS: u8 = 12;
/// Bytes of a Gaussian: position, opacity, colour, standard deviations, rotation.
const WIDTHS: [usize; 5] = [9, 1, 3, 3, 3];
/// Factor of a stored colour, the coefficient of the constant harmonic.
const COLOR_FACTOR: f32 = 0.15;
/// Value of the constant harmonic.
const HARMONIC: f32 = 0.282_094_8;
/// Step and offset of stored logarithms.
const LOG_STEP: f32 = 1.0 / 16.0;
const LOG_OFFSET: f32 = -10.0;

/// Encodes centres with standard deviations (metres), unit normals, and linear colours with opacities.
pub fn encode(center_scale: &[[f32; 4]], normals: &[[f32; 4]], colors: &[[f32; 4]]) -> Result<Vec<u8>> {
    let count = center_scale.len();
    ensure!(normals.len() == count && colors.len() == count, "every Gaussian needs a normal and a colour");
    let mut bytes = Vec::with_capacity(HEADER + count * WIDTHS.iter().sum::<usize>());
    for word in [MAGIC, VERSION, u32::try_from(count)?] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend([0, FRACTION_BITS, 0, 0]); // degree of the harmonics, bits, flags, reserved
    let per_metre = f32::from(1u16 << FRACTION_BITS);
    for value in center_scale.iter().flat_map(|splat| &splat[..3]) {
        let fixed = (value * per_metre).round().clamp(-8_388_608.0, 8_388_607.0) as i32;
        bytes.extend(&fixed.to_le_bytes()[..3]);
    }
    bytes.extend(colors.iter().map(|color| byte(color[3] * 255.0)));
    for value in colors.iter().flat_map(|color| &color[..3]) {
        let coefficient = (srgb_from_linear(*value) - 0.5) / HARMONIC;
        bytes.push(byte((coefficient * COLOR_FACTOR + 0.5) * 255.0));
    }
    bytes.extend(center_scale.iter().flat_map(|splat| [byte((splat[3].ln() - LOG_OFFSET) / LOG_STEP); 3]));
    for normal in normals {
        let turn = Quat::from_rotation_arc(Vec3::Z, Vec3::from_slice(&normal[..3]).normalize_or(Vec3::Z));
        let turn = if turn.w < 0.0 { -turn } else { turn };
        bytes.extend([turn.x, turn.y, turn.z].map(|value| byte(value * 127.5 + 127.5)));
    }
    let mut packed = GzEncoder::new(Vec::new(), Compression::default());
    packed.write_all(&bytes)?;
    Ok(packed.finish()?)
}

/// Decodes a file of [`encode`].
///
/// # Errors
/// Says what is wrong with the bytes.
pub fn decode(packed: &[u8]) -> Result<(Posed, Vec<[f32; 4]>)> {
    let mut bytes = Vec::new();
    GzDecoder::new(packed).read_to_end(&mut bytes).context("no gzip stream")?;
    let (header, mut rest) = bytes.split_at_checked(HEADER).context("the header is cut short")?;
    let word = |at: usize| header[at..at + 4].iter().rev().fold(0u32, |word, &byte| word << 8 | u32::from(byte));
    ensure!(word(0) == MAGIC && word(4) == VERSION, "no SPZ file of version {VERSION}");
    ensure!(header[12] == 0 && header[13] < 24, "harmonics or {} bits behind the point", header[13]);
    let count = word(8) as usize;
    ensure!(Some(rest.len()) == count.checked_mul(WIDTHS.iter().sum()), "{} bytes for {count} Gaussians", rest.len());
    let [positions, opacities, colors, scales, rotations] = WIDTHS.map(|width| {
        let (own, others) = rest.split_at(width * count);
        rest = others;
        own
    });
    let metres = 1.0 / (1u32 << header[13]) as f32;
    let fixed = |bytes: &[u8]| (i32::from_le_bytes([0, bytes[0], bytes[1], bytes[2]]) >> 8) as f32 * metres;
    let center_scale = positions.chunks_exact(9).zip(scales.chunks_exact(3)).map(|(place, scale)| {
        let deviation = (f32::from(scale[0]) * LOG_STEP + LOG_OFFSET).exp();
        [fixed(&place[..3]), fixed(&place[3..6]), fixed(&place[6..]), deviation]
    });
    let normal = rotations.chunks_exact(3).map(|bytes| {
        let axis = Vec3::from_array([0, 1, 2].map(|axis| f32::from(bytes[axis]) / 127.5 - 1.0));
        let w = (1.0 - axis.length_squared()).max(0.0).sqrt();
        let normal = Quat::from_xyzw(axis.x, axis.y, axis.z, w).normalize() * Vec3::Z;
        normal.extend(0.0).to_array()
    });
    let posed = Posed { center_scale: center_scale.collect(), normal: normal.collect() };
    let colors = colors.chunks_exact(3).zip(opacities).map(|(color, &opacity)| {
        let [red, green, blue] = [0, 1, 2].map(|channel| {
            let coefficient = (f32::from(color[channel]) / 255.0 - 0.5) / COLOR_FACTOR;
            linear_from_srgb(0.5 + HARMONIC * coefficient)
        });
        [red, green, blue, f32::from(opacity) / 255.0]
    });
    Ok((posed, colors.collect()))
}

/// Rounds to the nearest byte; `as` saturates.
fn byte(value: f32) -> u8 {
    value.round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_come_back_within_the_steps_of_the_format() {
        let wave = |k: usize| (k as f32 * 12.9898).sin();
        let normal = |i: usize| Vec3::new(wave(i), wave(i + 7), wave(2 * i + 1)).normalize();
        let normals: Vec<[f32; 4]> = (0..500).map(|i| normal(i).extend(0.0).to_array()).collect();
        let splats: Vec<[f32; 4]> =
            (0..500).map(|i| [3.0 * wave(i), -1e3 * wave(3 * i), wave(5 * i), 0.001 + 0.02 * wave(i).abs()]).collect();
        let colors: Vec<[f32; 4]> =
            (0..500).map(|i| [wave(i).abs(), wave(2 * i).abs(), wave(3 * i).abs(), wave(i + 1).abs()]).collect();
        let bytes = encode(&splats, &normals, &colors).unwrap();
        let (posed, back) = decode(&bytes).unwrap();
        assert_eq!((posed.center_scale.len(), posed.normal.len(), back.len()), (500, 500, 500));
        for (i, ((splat, color), back)) in splats.iter().zip(&colors).zip(&back).enumerate() {
            let found = posed.center_scale[i];
            for axis in 0..3 {
                assert!((found[axis] - splat[axis]).abs() <= 0.5 / 4096.0 + 1e-4);
                let codes = 255.0 * (srgb_from_linear(back[axis]) - srgb_from_linear(color[axis]));
                assert!(codes.abs() < 0.5 * HARMONIC / COLOR_FACTOR + 0.01, "{codes} codes of 255");
            }
            assert!((found[3] / splat[3]).ln().abs() <= 0.5 * LOG_STEP + 1e-3);
            assert!((back[3] - color[3]).abs() <= 0.5 / 255.0 + 1e-6);
            // w is the root of a small difference where the rotation is by nearly half a turn.
            let turned = Vec3::from_slice(&posed.normal[i][..3]);
            assert!(turned.dot(normal(i)) > 0.98, "{turned} for {}", normal(i));
        }
    }

    #[test]
    fn damaged_files_are_refused() {
        let good = encode(&[[1.0, 2.0, 3.0, 0.01]], &[[0.0, 0.0, -1.0, 0.0]], &[[0.5; 4]]).unwrap();
        assert!(decode(&good).is_ok());
        assert!(decode(&good[..good.len() / 2]).is_err() && decode(&[]).is_err());
        let pack = |bytes: &[u8]| {
            let mut packed = GzEncoder::new(Vec::new(), Compression::fast());
            packed.write_all(bytes).unwrap();
            packed.finish().unwrap()
        };
        let mut bytes = Vec::new();
        GzDecoder::new(good.as_slice()).read_to_end(&mut bytes).unwrap();
        assert!(decode(&pack(&bytes)).is_ok());
        for (at, value) in [(0, 0), (4, 9), (8, 2), (11, 255), (12, 3), (13, 200)] {
            let mut other = bytes.clone();
            other[at] = value;
            assert!(decode(&pack(&other)).is_err(), "byte {at} is {value}");
        }
        assert!(decode(&pack(&bytes[..12])).is_err());
        assert!(encode(&[[0.0; 4]], &[], &[]).is_err());
    }
}
