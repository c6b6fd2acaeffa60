//! Exposure and white balance of an image relative to a plate.

use flyrig_solve::median;

use crate::image::pixels::Rgb;

/// Least standard deviation of the noise, sRGB steps.
const MIN_NOISE: f32 = 2.0;
/// Stride of the pixels at which the gain is measured.
const GAIN_STEP: usize = 17;
/// Values of a channel that measure a gain: others are clipped or mostly noise.
const GAIN_RANGE: std::ops::RangeInclusive<f32> = 16.0..=245.0;
/// Limits of a gain.
const GAIN_LIMITS: (f32, f32) = (0.6, 1.6);
/// Samples needed for a gain.
const GAIN_SAMPLES: usize = 40;

/// Exposure of an image relative to a plate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Drift {
    /// Ratio of image to plate, by channel.
    pub gain: [f32; 3],
    /// Standard deviation of the background after the gain, sRGB steps.
    pub noise: f32,
}

impl Drift {
    /// Measures gain and noise robustly (by medians) at pixels where `is_background`. `plate` holds three sRGB values per
    /// pixel.
    pub fn new(picture: &Rgb, plate: &[f32], is_background: &dyn Fn(usize) -> bool) -> Self {
        let away: Vec<usize> =
            (0..picture.width * picture.height).step_by(GAIN_STEP).filter(|at| is_background(*at)).collect();
        let ratio = |k: usize| {
            let pairs = away.iter().map(|at| (f32::from(picture.bytes[3 * at + k]), plate[3 * at + k]));
            let usable = pairs.filter(|(now, plate)| GAIN_RANGE.contains(now) && GAIN_RANGE.contains(plate));
            let mut ratios: Vec<f64> = usable.map(|(now, plate)| f64::from(now / plate)).collect();
            let enough = ratios.len() >= GAIN_SAMPLES;
            median(&mut ratios).filter(|_| enough).map(|gain| (gain as f32).clamp(GAIN_LIMITS.0, GAIN_LIMITS.1))
        };
        let gains: [Option<f32>; 3] = std::array::from_fn(ratio);
        // A channel that is dark or clipped everywhere drifts as the others do.
        let known: Vec<f32> = gains.iter().flatten().copied().collect();
        let mean = if known.is_empty() { 1.0 } else { known.iter().sum::<f32>() / known.len() as f32 };
        let gain = gains.map(|gain| gain.unwrap_or(mean));
        let difference =
            |at: usize, k: usize| (f32::from(picture.bytes[3 * at + k]) - gain[k] * plate[3 * at + k]).abs();
        let mut differences: Vec<f64> =
            away.iter().flat_map(|&at| (0..3).map(move |k| f64::from(difference(at, k)))).collect();
        let noise = (1.48 * median(&mut differences).unwrap_or(0.0) as f32).clamp(MIN_NOISE, 8.0);
        Self { gain, noise }
    }
}
