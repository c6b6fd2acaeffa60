//! Colour histograms of clothes, which distinguish people who come back.

use flyrig_capture::to_rgb8;
use flyrig_types::{FrameSet, Mask};

/// Bins of each colour channel.
const BINS: usize = 4;
/// Number of bins: those of the upper half of the body, then those of the lower.
const COUNT: usize = 2 * BINS * BINS * BINS;
/// Pixels from one sample to the next, along rows and columns.
const STEP: usize = 3;
/// Least coverage at which a pixel is the person's own.
const INSIDE: u8 = 250;

/// Shares of colours in the upper and the lower half of a person, over all views of a frame set.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ClothesColors {
    shares: [f64; COUNT],
}

impl ClothesColors {
    /// Samples the pixels inside of a person's masks, one per slot; `None` without any.
    pub fn of(set: &FrameSet, masks: &[Option<&Mask>]) -> Option<Self> {
        let mut shares = [0.0; COUNT];
        for (slot, frame) in set.present() {
            let Some(mask) = masks.get(slot).copied().flatten() else { continue };
            let Ok(rgb) = to_rgb8(&frame.image) else { continue };
            let width = mask.width() as usize;
            if rgb.len() != 3 * width * mask.height() as usize {
                continue;
            }
            let rows: Vec<usize> =
                (0..mask.height() as usize).filter(|y| mask.coverage()[y * width..][..width].contains(&255)).collect();
            let (Some(&first), Some(&last)) = (rows.first(), rows.last()) else { continue };
            for y in (first..=last).step_by(STEP) {
                let half = usize::from(2 * y > first + last);
                for x in (0..width).step_by(STEP).filter(|x| mask.coverage()[y * width + x] >= INSIDE) {
                    let pixel = &rgb[3 * (y * width + x)..][..3];
                    let bin = pixel.iter().fold(half, |bin, c| bin * BINS + usize::from(*c) * BINS / 256);
                    shares[bin] += 1.0;
                }
            }
        }
        for half in shares.chunks_exact_mut(COUNT / 2) {
            let sum: f64 = half.iter().sum();
            if sum <= 0.0 {
                return None;
            }
            half.iter_mut().for_each(|share| *share /= 2.0 * sum);
        }
        Some(Self { shares })
    }

    /// Returns the share of the colours that both have, 0..=1.
    pub fn likeness(&self, other: &Self) -> f64 {
        self.shares.iter().zip(&other.shares).map(|(a, b)| a.min(*b)).sum()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use flyrig_types::{CameraId, Frame, Image, PixelFormat};

    use super::*;

    const SIDE: u32 = 24;

    /// Returns a frame set of one camera that sees trousers of one colour under a shirt of another.
    fn set(shirt: [u8; 3], trousers: [u8; 3]) -> FrameSet {
        let bytes = (0..SIDE).flat_map(|y| (0..SIDE).flat_map(move |_| if y < SIDE / 2 { shirt } else { trousers }));
        let image = Image::new(SIDE, SIDE, PixelFormat::Rgb8, bytes.collect::<Vec<_>>()).unwrap();
        let frame = Frame {
            camera: CameraId::from("00"),
            sequence: 0,
            capture_nanos: 0,
            exposure_nanos: None,
            image,
            mask: None,
        };
        FrameSet { index: 0, master_nanos: 0, frames: vec![Some(Arc::new(frame))] }
    }

    fn full(value: u8) -> Mask {
        Mask::new(SIDE, SIDE, vec![value; (SIDE * SIDE) as usize]).unwrap()
    }

    #[test]
    fn clothes_are_told_apart_by_colour_and_by_where_they_are() {
        let mask = full(255);
        let of = |shirt, trousers| ClothesColors::of(&set(shirt, trousers), &[Some(&mask)]).unwrap();
        let red_blue = of([200, 20, 20], [20, 20, 200]);
        assert!((red_blue.likeness(&red_blue) - 1.0).abs() < 1e-9);
        assert!(
            (red_blue.likeness(&of([210, 30, 10], [10, 30, 210])) - 1.0).abs() < 1e-9,
            "a little light changes nothing"
        );
        let half = red_blue.likeness(&of([200, 20, 20], [20, 200, 20]));
        assert!((half - 0.5).abs() < 0.1, "{half}");
        assert!(red_blue.likeness(&of([20, 20, 200], [200, 20, 20])) < 0.1, "the same colours, but upside down");
    }

    #[test]
    fn no_mask_an_empty_one_and_one_of_another_size_say_nothing() {
        let set = set([1; 3], [2; 3]);
        assert_eq!(ClothesColors::of(&set, &[]), None);
        assert_eq!(ClothesColors::of(&set, &[None]), None);
        assert_eq!(ClothesColors::of(&set, &[Some(&full(0))]), None);
        assert_eq!(ClothesColors::of(&set, &[Some(&Mask::new(2, 2, vec![255; 4]).unwrap())]), None);
    }
}
