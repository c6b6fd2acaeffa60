//! Sensor and encoder of a camera.

use std::sync::OnceLock;

use glam::Vec2;
use image::ImageEncoder as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::SimError;
use crate::error::check;
use crate::texture::linear_from_srgb;

/// Sensor of a camera; the default changes nothing.
///
/// Light (linear, 1 is the brightest sRGB value) is multiplied by `exposure`, falls off towards the corners, is
/// converted to electrons with their noise, amplified by `gain` and `white_balance`, clipped, and encoded as sRGB to
/// the power of `gamma`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorConfig {
    /// Exposure relative to the rendered image.
    pub exposure: f64,
    /// Amplification after the noise.
    pub gain: f64,
    /// Exponent on the coded value in 0..=1: 1 is sRGB, above it darkens the middle tones.
    pub gamma: f64,
    /// Factors of red, green and blue.
    pub white_balance: [f64; 3],
    /// Fraction of the light that is lost in the corners, growing with the fourth power of the distance from the
    /// centre.
    pub vignetting: f64,
    /// Electrons at light 1: the variance of the shot noise, in electrons, is their number (drawn as a Gaussian).
    /// `None` disables noise.
    pub full_well_electrons: Option<f64>,
    /// Standard deviation of the read noise, electrons.
    pub read_noise_electrons: f64,
    /// Quality of a JPEG round trip, 1 to 100; none when `None`.
    pub jpeg_quality: Option<u8>,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self {
            exposure: 1.0,
            gain: 1.0,
            gamma: 1.0,
            white_balance: [1.0; 3],
            vignetting: 0.0,
            full_well_electrons: None,
            read_noise_electrons: 0.0,
            jpeg_quality: None,
        }
    }
}

impl SensorConfig {
    pub(crate) fn validate(&self) -> Result<(), SimError> {
        check("sensors.exposure", self.exposure, 0.0, 64.0, "0 to 64")?;
        check("sensors.gain", self.gain, 0.0, 64.0, "0 to 64")?;
        check("sensors.gamma", self.gamma, 0.1, 10.0, "0.1 to 10")?;
        for factor in self.white_balance {
            check("sensors.white_balance", factor, 0.0, 8.0, "factors from 0 to 8")?;
        }
        check("sensors.vignetting", self.vignetting, 0.0, 1.0, "a share from 0 to 1")?;
        if let Some(electrons) = self.full_well_electrons {
            check("sensors.full_well_electrons", electrons, 10.0, 1e7, "10 to 10000000 electrons")?;
        } else if self.read_noise_electrons > 0.0 {
            let expected = "0 without full_well_electrons, which scales electrons to light";
            check("sensors.read_noise_electrons", self.read_noise_electrons, 0.0, 0.0, expected)?;
        }
        check("sensors.read_noise_electrons", self.read_noise_electrons, 0.0, 1e5, "0 to 100000 electrons")?;
        check("sensors.jpeg_quality", self.jpeg_quality.unwrap_or(50).into(), 1.0, 100.0, "1 to 100")
    }

    /// Converts light (halves: linear RGB and a fourth channel) to RGB bytes; `key` seeds the noise.
    pub(crate) fn develop(&self, light: &[[u16; 4]], width: u32, height: u32, key: u64) -> Result<Vec<u8>, SimError> {
        let row = width as usize;
        let mut bytes = vec![0u8; row * height as usize * 3];
        if *self == Self::default() {
            let codes = codes_of_halves();
            bytes.par_chunks_mut(row * 3).zip(light.par_chunks(row)).for_each(|(to, from)| {
                for (to, from) in to.chunks_exact_mut(3).zip(from) {
                    to.copy_from_slice(&[from[0], from[1], from[2]].map(|half| codes[usize::from(half)]));
                }
            });
            return Ok(bytes);
        }
        let coder = Coder::new(self.gamma as f32);
        let size = Vec2::new(width as f32, height as f32);
        bytes.par_chunks_mut(row * 3).zip(light.par_chunks(row)).enumerate().for_each(|(y, (to, from))| {
            for (x, (to, from)) in to.chunks_exact_mut(3).zip(from).enumerate() {
                let from_middle = (Vec2::new(x as f32, y as f32) + 0.5 - size * 0.5) / (size * 0.5).length();
                let fall = 1.0 - self.vignetting as f32 * from_middle.length_squared().powi(2);
                for channel in 0..3 {
                    let light = linear_of_half(from[channel]) * self.exposure as f32 * fall;
                    let read = self.read(light, key, ((y * row + x) * 3 + channel) as u64);
                    to[channel] = coder.code(read * self.gain as f32 * self.white_balance[channel] as f32);
                }
            }
        });
        match self.jpeg_quality {
            None => Ok(bytes),
            Some(quality) => through_jpeg(&bytes, width, height, quality),
        }
    }

    /// Returns the light as read from the sensor: with noise, clipped at the full well.
    fn read(&self, light: f32, key: u64, pixel: u64) -> f32 {
        let Some(full) = self.full_well_electrons else { return light };
        let full = full as f32;
        let electrons = (light * full).min(full);
        let sigma = (electrons + (self.read_noise_electrons as f32).powi(2)).sqrt();
        (electrons + sigma * gaussian(key, pixel)) / full
    }
}

/// Encoder to the nearest byte of the sRGB code to the power of a gamma.
struct Coder {
    /// Light above which the next byte is nearer.
    thresholds: Vec<f32>,
    /// Lower bound of the byte for light in steps of 1 / 1024.
    starts: Vec<u8>,
}

impl Coder {
    fn new(gamma: f32) -> Self {
        let thresholds: Vec<f32> =
            (0..255).map(|byte| linear_from_srgb(((byte as f32 + 0.5) / 255.0).powf(1.0 / gamma))).collect();
        let starts =
            (0..1024).map(|i| thresholds.partition_point(|&t| t <= i as f32 / 1024.0).min(255) as u8).collect();
        Self { thresholds, starts }
    }

    fn code(&self, light: f32) -> u8 {
        // NaN, which no sensor reads, would become 0.
        let mut byte = self.starts[((light.clamp(0.0, 1.0) * 1024.0) as usize).min(1023)];
        while byte < 255 && light >= self.thresholds[usize::from(byte)] {
            byte += 1;
        }
        byte
    }
}

/// Converts a half-precision number (IEEE 754 binary16).
pub(crate) fn linear_of_half(half: u16) -> f32 {
    static TABLE: OnceLock<Vec<f32>> = OnceLock::new();
    TABLE.get_or_init(|| {
        (0..=u16::MAX)
            .map(|bits| {
                let (exponent, fraction) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023) / 1024.0);
                let magnitude = match exponent {
                    0 => fraction * 2f32.powi(-14),
                    31 => 65504.0,
                    _ => (1.0 + fraction) * 2f32.powi(exponent - 15),
                };
                if bits >> 15 == 0 { magnitude } else { -magnitude }
            })
            .collect()
    })[usize::from(half)]
}

/// Returns the sRGB bytes of all halves.
fn codes_of_halves() -> &'static [u8] {
    static TABLE: OnceLock<Vec<u8>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let coder = Coder::new(1.0);
        (0..=u16::MAX).map(|half| coder.code(linear_of_half(half))).collect()
    })
}

/// Encodes and decodes an image as JPEG.
fn through_jpeg(rgb: &[u8], width: u32, height: u32, quality: u8) -> Result<Vec<u8>, SimError> {
    let mut code = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut code, quality);
    encoder.write_image(rgb, width, height, image::ExtendedColorType::Rgb8)?;
    let decoded = image::load_from_memory_with_format(&code, image::ImageFormat::Jpeg)?;
    Ok(decoded.into_rgb8().into_raw())
}

/// Hashes two numbers with full avalanche (SplitMix64's finaliser).
pub(crate) fn hash(key: u64, index: u64) -> u64 {
    flyrig_model::mix(key ^ index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

/// Returns a uniform number in 0..1, never 0.
pub(crate) fn uniform(key: u64, index: u64) -> f64 {
    ((hash(key, index) >> 11) as f64 + 0.5) / (1u64 << 53) as f64
}

/// Returns a standard normal number (Box and Muller's transform).
pub(crate) fn gaussian(key: u64, index: u64) -> f32 {
    let h = hash(key, index);
    let (a, b) = ((h >> 32) as f32 + 0.5, (h & 0xffff_ffff) as f32);
    const SPAN: f32 = 4_294_967_296.0;
    (-2.0 * (a / SPAN).ln()).max(0.0).sqrt() * (b / SPAN * std::f32::consts::TAU).cos()
}
