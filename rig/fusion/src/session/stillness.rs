//! Detection of scenes in which nothing moves.
//!
//! Means of blocks of the images are compared with those at the last movement. While nothing moves, a frame set is processed each time
//! eight times its cost has passed.

use std::time::Duration;

use flyrig_types::{FrameSet, Image};

/// Rows of a block whose mean is compared: enough that the noise of a sensor averages out.
const BLOCK_ROWS: usize = 16;
/// Bytes of each row of a block.
const BLOCK_BYTES: usize = 48;
/// Largest difference of means without movement, levels of 0 to 255. A contour of contrast 60 that moves by a pixel changes a block by 4.
const LIMIT: f32 = 2.0;
/// Frame sets without movement that are processed all the same, until shape and colours have settled.
const SETTLE: u32 = 10;
/// Frame sets without movement that are processed while no person is known, until a search has covered everything.
const SETTLE_SEARCH: u32 = 40;
/// Pause after a frame set that was processed at rest, as a multiple of its cost.
const REST: u32 = 8;

/// Comparison of each frame set's images with those at the last movement.
#[derive(Debug, Clone, Default)]
pub(crate) struct Stillness {
    /// Means of blocks at the last movement, one element per slot; `None` without an image.
    seen: Vec<Option<Vec<f32>>>,
    /// Frame sets since then.
    still: u32,
    /// Time of the next frame set that is processed although nothing moves, nanoseconds.
    next_nanos: i64,
}

impl Stillness {
    /// Returns whether a frame set can be left out: nothing has moved for a while, and the pause is not over.
    pub fn can_skip(&mut self, set: &FrameSet, has_people: bool) -> bool {
        let means: Vec<Option<Vec<f32>>> =
            set.frames.iter().map(|frame| frame.as_ref().map(|frame| block_means(&frame.image))).collect();
        let moved = means.len() != self.seen.len() || means.iter().zip(&self.seen).any(|(now, seen)| differ(now, seen));
        if moved {
            (self.seen, self.still) = (means, 0);
            return false;
        }
        self.still = self.still.saturating_add(1);
        self.still > if has_people { SETTLE } else { SETTLE_SEARCH } && set.master_nanos < self.next_nanos
    }

    /// Notes that a frame set was processed, and how long that took.
    pub fn ingested(&mut self, nanos: i64, cost: Duration) {
        let pause = i64::try_from(cost.as_nanos()).unwrap_or(i64::MAX).saturating_mul(i64::from(REST));
        self.next_nanos = nanos.saturating_add(pause);
    }
}

fn differ(now: &Option<Vec<f32>>, seen: &Option<Vec<f32>>) -> bool {
    match (now, seen) {
        (None, None) => false,
        (Some(now), Some(seen)) => now.len() != seen.len() || now.iter().zip(seen).any(|(a, b)| (a - b).abs() > LIMIT),
        _ => true,
    }
}

fn block_means(image: &Image) -> Vec<f32> {
    let row_bytes = (image.bytes().len() / image.height().max(1) as usize).max(1);
    let rows: Vec<&[u8]> = image.bytes().chunks_exact(row_bytes).collect();
    let mut means = Vec::new();
    for rows in rows.chunks(BLOCK_ROWS) {
        let mut sums = vec![0u32; row_bytes.div_ceil(BLOCK_BYTES)];
        for row in rows {
            for (sum, block) in sums.iter_mut().zip(row.chunks(BLOCK_BYTES)) {
                *sum += block.iter().map(|&byte| u32::from(byte)).sum::<u32>();
            }
        }
        let sizes = (0..row_bytes).step_by(BLOCK_BYTES).map(|x| rows.len() * (row_bytes - x).min(BLOCK_BYTES));
        // Smaller blocks at the border are noisier: they count less.
        means.extend(
            sums.iter().zip(sizes).map(|(&sum, size)| sum as f32 / ((size * BLOCK_ROWS * BLOCK_BYTES) as f32).sqrt()),
        );
    }
    means
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use flyrig_types::{Frame, PixelFormat};

    use super::*;

    const COST: Duration = Duration::from_millis(100);
    const PERIOD: i64 = 33_000_000;

    /// A disc of contrast 60 at `x` on noise of ±`noise` levels, in `cameras` images of 90x70 pixels.
    fn set(index: u64, cameras: usize, x: f32, noise: i32) -> FrameSet {
        let mut state = 77u32.wrapping_add(index as u32 * 7919);
        let mut bytes = Vec::new();
        for at in 0..70 * 90 {
            let (px, py) = ((at % 90) as f32, (at / 90) as f32);
            let disc = if (px - x).hypot(py - 35.0) < 12.0 { 160 } else { 100 };
            for _ in 0..3 {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                bytes.push((disc + (state >> 16) as i32 % (2 * noise + 1) - noise) as u8);
            }
        }
        let master_nanos = index as i64 * PERIOD;
        let frame = |i: usize| Frame {
            camera: format!("{i}").into(),
            sequence: index,
            capture_nanos: master_nanos,
            exposure_nanos: None,
            image: Image::new(90, 70, PixelFormat::Rgb8, bytes.clone()).unwrap(),
            mask: None,
        };
        FrameSet { index, master_nanos, frames: (0..cameras).map(|i| Some(Arc::new(frame(i)))).collect() }
    }

    /// Returns the indices of the frame sets that are processed.
    fn taken(stillness: &mut Stillness, sets: impl IntoIterator<Item = FrameSet>, has_people: bool) -> Vec<u64> {
        let mut taken = Vec::new();
        for set in sets {
            if !stillness.can_skip(&set, has_people) {
                stillness.ingested(set.master_nanos, COST);
                taken.push(set.index);
            }
        }
        taken
    }

    #[test]
    fn a_noisy_still_scene_costs_an_eighth_of_the_time_and_movement_everything() {
        let mut stillness = Stillness::default();
        let still = taken(&mut stillness, (0..300).map(|i| set(i, 2, 40.0, 10)), true);
        assert_eq!(still[..=SETTLE as usize], (0..=u64::from(SETTLE)).collect::<Vec<_>>());
        // 290 sets are 9.6 s; a set of 0.1 s every 0.8 s.
        assert!((SETTLE as usize + 10..=SETTLE as usize + 14).contains(&still.len()), "{still:?}");
        let moving = taken(&mut stillness, (300..330).map(|i| set(i, 2, 40.0 + (i - 299) as f32, 10)), true);
        assert_eq!(moving.len(), 30);
    }

    #[test]
    fn slow_movement_adds_up_and_ends_the_rest() {
        let mut stillness = Stillness::default();
        let x = |i: u64| 40.0 + 0.05 * i.saturating_sub(100) as f32;
        let taken = taken(&mut stillness, (0..200).map(|i| set(i, 1, x(i), 0)), true);
        let moves = taken.windows(2).filter(|pair| pair[0] > 100 && pair[1] == pair[0] + 1).count();
        assert!(moves > 40, "{taken:?}");
    }

    #[test]
    fn a_camera_that_goes_or_comes_and_another_size_are_movement() {
        let mut stillness = Stillness::default();
        assert!(taken(&mut stillness, (0..30).map(|i| set(i, 2, 40.0, 0)), true).len() < 20);
        let mut without = set(30, 2, 40.0, 0);
        without.frames[1] = None;
        assert!(!stillness.can_skip(&without, true), "a camera went");
        assert!(!stillness.can_skip(&set(31, 2, 40.0, 0), true), "a camera came");
        assert!(!stillness.can_skip(&set(32, 3, 40.0, 0), true), "another number of cameras");
        assert!(!stillness.can_skip(&FrameSet { index: 33, master_nanos: 0, frames: Vec::new() }, true));
    }

    #[test]
    fn a_search_gets_more_sets_and_sets_without_images_and_absurd_costs_are_harmless() {
        let mut stillness = Stillness::default();
        let search = taken(&mut stillness, (0..60).map(|i| set(i, 1, 40.0, 0)), false);
        assert!(search.contains(&u64::from(SETTLE_SEARCH)) && search.len() < 50, "{search:?}");
        stillness.ingested(i64::MAX, Duration::MAX);
        assert!(stillness.can_skip(&set(61, 1, 40.0, 0), false));
    }
}
