//! Damage that leaves the structure of a JPEG image intact, found by the levels of its blocks.
//!
//! A block's mean is stored as the difference from the block before. Where damage changes one and the reader finds back
//! into step, all blocks that follow are too bright or too dark by one value. That begins anywhere in a row of blocks: on
//! its right the level jumps against the row above, on its left only the next row does. Edges and lights of a scene follow
//! no such path, and what resembles one is in the camera's image before as well.

use super::scan::{Plane, Scan};

/// Share of the blocks of a stretch that must agree.
const SHARE: f32 = 0.75;
/// Largest share of the blocks beside a stretch that may jump like it: there, a straight edge of the scene goes on.
const BESIDE: f32 = 0.4;
/// Blocks, or MCUs, of the shortest part of a stretch that is evidence.
const SHORTEST: usize = 3;

/// Levels of one component.
#[derive(Debug, Clone, Default, PartialEq)]
struct Levels {
    /// MCUs per row, and their means.
    across: usize,
    means: Vec<f32>,
    /// Blocks per row, and the jumps at the upper edges of MCUs, row by row from the second row of MCUs on.
    width: usize,
    jumps: Vec<f32>,
}

/// Levels of an image's blocks, by component; grey levels.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ImageLevels(Vec<Levels>);

impl ImageLevels {
    /// Computes the levels of an image.
    pub fn new(scan: &Scan) -> Self {
        let levels = |plane: &Plane| Levels {
            across: plane.width / plane.step[0].max(1),
            means: means(plane),
            width: plane.width,
            jumps: jumps(plane),
        };
        Self(scan.planes.iter().map(levels).collect())
    }

    /// Returns whether the levels are shifted from some place on, where those of the image before (`None` for the first
    /// one) are not. Images of another shape are no image before.
    pub fn are_shifted(&self, before: Option<&Self>) -> bool {
        let is_alike = |(a, b): (&Levels, &Levels)| {
            (a.width, a.jumps.len(), a.means.len()) == (b.width, b.jumps.len(), b.means.len())
        };
        let before = before.filter(|b| b.0.len() == self.0.len() && self.0.iter().zip(&b.0).all(is_alike));
        self.0.iter().enumerate().any(|(i, now)| {
            let before = before.map(|before| &before.0[i]);
            has_stretch(now, before) || before.is_some_and(|before| is_changed_from_a_place_on(now, before))
        })
    }
}

/// Returns the mean of each MCU.
fn means(plane: &Plane) -> Vec<f32> {
    let [columns, rows] = plane.step.map(|step| step.max(1));
    let across = plane.width / columns;
    let mut means = vec![0.0; across * (plane.height / rows)];
    for (y, row) in plane.blocks.chunks_exact(plane.width.max(1)).enumerate() {
        let sums = &mut means[y / rows * across..][..across];
        for (sum, blocks) in sums.iter_mut().zip(row.chunks_exact(columns)) {
            *sum += blocks.iter().map(|block| block.mean).sum::<f32>() / (columns * rows) as f32;
        }
    }
    means
}

/// Returns for each upper edge how far the values on both of its sides, extrapolated to it, differ beyond the differences
/// at the edges above and below in the same column.
fn jumps(plane: &Plane) -> Vec<f32> {
    let width = plane.width;
    let rows = plane.height / plane.step[1].max(1);
    let mut raw = Vec::with_capacity(width * rows);
    for row in 1..rows {
        let first = row * plane.step[1] * width;
        let (above, below) = (&plane.blocks[first - width..first], &plane.blocks[first..first + width]);
        let at_edge = |[edge, inner]: [f32; 2]| edge + (edge - inner) / 2.0;
        raw.extend(above.iter().zip(below).map(|(above, below)| at_edge(below.top) - at_edge(above.bottom)));
    }
    let beyond = |i: usize| {
        let upper = if i >= width { raw[i - width] } else { 0.0 };
        let lower = raw.get(i + width).copied().unwrap_or(0.0);
        raw[i] - raw[i].clamp(upper.min(lower), upper.max(lower))
    };
    (0..raw.len()).map(beyond).collect()
}

/// Returns whether a stretch of one row's length jumps one way, in this image and against the image before.
fn has_stretch(now: &Levels, before: Option<&Levels>) -> bool {
    let width = now.width;
    let largest = now.jumps.iter().fold(0f32, |most, jump| most.max(jump.abs()));
    // Jumps of this kind before each edge.
    let mut counts = Vec::with_capacity(now.jumps.len() + 1);
    let mut least = 3.0;
    while least <= largest {
        for sign in [1.0, -1.0] {
            let is_such = |jump: f32| sign * jump >= least;
            counts.clear();
            counts.push(0);
            let mut count = 0u32;
            for (i, jump) in now.jumps.iter().enumerate() {
                count += u32::from(is_such(*jump) && before.is_none_or(|before| is_such(jump - before.jumps[i])));
                counts.push(count);
            }
            // Where many blocks jump, such as in noise, some stretch does by chance.
            let is_rare = count as usize <= width + now.jumps.len() / 6;
            if is_rare && 8 * count as usize >= width && follows_a_row(width, &counts, before.is_some()) {
                return true;
            }
        }
        least *= 1.6;
    }
    false
}

/// Returns whether a stretch goes from some block to the end of its row and on below the blocks before it.
fn follows_a_row(width: usize, counts: &[u32], has_before: bool) -> bool {
    let rows = (counts.len() - 1) / width.max(1);
    // Of blocks `from..to` of a row; `None` for the rows beyond the first and the last.
    let share = |row: Option<usize>, from: usize, to: usize| {
        let first = row.filter(|row| *row < rows)? * width;
        Some((counts[first + to] - counts[first + from]) as f32 / (to - from) as f32)
    };
    let is_such = |inside: Option<f32>, beside: Option<f32>| {
        inside.is_some_and(|share| share >= SHARE) && beside.is_some_and(|share| share <= BESIDE)
    };
    let half = 16.max(width / 2);
    let in_row = |row: Option<usize>| {
        row.filter(|row| *row < rows).map(|row| (counts[(row + 1) * width] - counts[row * width]) as f32)
    };
    (0..=rows).any(|next| {
        let row = next.checked_sub(1);
        // Most rows have too few at all.
        let is_possible = match (in_row(row), in_row(Some(next))) {
            (Some(upper), Some(lower)) => upper + lower >= SHARE * width as f32,
            (upper, lower) => upper.or(lower).is_some_and(|count| has_before && count >= SHARE * half as f32),
        };
        if !is_possible {
            return false;
        }
        (SHORTEST..=width.saturating_sub(SHORTEST)).any(|column| {
            let right = share(row, column, width);
            let left = share(Some(next), 0, column);
            let right_is_such = || is_such(right, share(row, 0, column));
            let left_is_such = || is_such(left, share(Some(next), column, width));
            match (right, left) {
                (Some(_), Some(_)) => right_is_such() && left_is_such(),
                // The first and the last row have half of the evidence.
                (None, _) => has_before && column >= half && left_is_such(),
                (_, None) => has_before && width - column >= half && right_is_such(),
            }
        })
    })
}

/// Returns whether all MCUs behind some place are brighter, or darker, than in the image before by about one value, and
/// those before it as they were.
fn is_changed_from_a_place_on(now: &Levels, before: &Levels) -> bool {
    let changes: Vec<f32> = now.means.iter().zip(&before.means).map(|(now, before)| now - before).collect();
    let (mut counts, mut jumps) = (Vec::with_capacity(changes.len() + 1), Vec::new());
    let mut sorted = changes.clone();
    sorted.sort_unstable_by(f32::total_cmp);
    let below = |value: f32| sorted.partition_point(|change| *change < value);
    // Anywhere in a row, or by precisely one value and with a sharp edge at its ends as well: a light that was switched on
    // between two rows changes each thing by a value of its own.
    let wide = [2.0f32, 4.0, 8.0, 16.0, 32.0, 64.0].into_iter().map(|least| (least, 2.5 * least, false));
    let narrow = (5u8..=200).map(f32::from).map(|value| (value - 1.5, value + 1.5, true));
    wide.chain(narrow).any(|(least, most, is_narrow)| {
        [1.0, -1.0].iter().any(|sign| {
            // Without most of a row behind the place and of a quarter before it, there is none.
            let changed = if *sign > 0.0 { below(most) - below(least) } else { below(-least) - below(-most) };
            let unchanged = below(least / 2.0) - below(-least / 2.0);
            if (changed as f32) < SHARE * now.across as f32 || (unchanged as f32) < SHARE * (now.across / 4) as f32 {
                return false;
            }
            // MCUs before each one that changed so, and that did not change.
            let mut sums = [0u32; 2];
            counts.clear();
            counts.push(sums);
            for change in changes.iter().map(|change| sign * change) {
                sums[0] += u32::from((least..=most).contains(&change));
                sums[1] += u32::from(change.abs() <= least / 2.0);
                counts.push(sums);
            }
            // Upper edges before each one that jump by at least half of it.
            jumps.clear();
            if is_narrow {
                let mut sum = 0u32;
                jumps.push(sum);
                jumps.extend(now.jumps.iter().map(|jump| {
                    sum += u32::from(2.0 * sign * jump >= least);
                    sum
                }));
            }
            is_split(now, &counts, &jumps)
        })
    })
}

/// Returns whether MCUs did not change before some place and did behind it; by `counts` of those that did and did not.
/// `jumps` are the upper edges that jump, without which places at the ends of rows are no evidence.
fn is_split(now: &Levels, counts: &[[u32; 2]], jumps: &[u32]) -> bool {
    let (across, width, count) = (now.across, now.width, counts.len() - 1);
    let most = |which: usize, from: usize, to: usize| {
        (counts[to][which] - counts[from][which]) as f32 >= SHARE * (to - from) as f32
    };
    let is_sharp = |start: usize, column: usize| {
        let Some(row) = (start / across).checked_sub(1).filter(|row| (row + 1) * width < jumps.len()) else {
            return false;
        };
        let (from, to) = (row * width + column * (width / across), (row + 1) * width);
        2 * (jumps[to] - jumps[from]) as usize >= to - from
    };
    // Too little remains behind places of the last row to differ by much.
    (across / 4..count.saturating_sub(across)).any(|place| {
        let column = place % across;
        let start = place - column;
        let end = start + across;
        let is_inside = (SHORTEST..=across.saturating_sub(SHORTEST)).contains(&column);
        (is_inside
            || is_sharp(if 2 * column > across { end } else { start }, if 2 * column > across { 0 } else { column }))
            && most(0, place, count)
            && most(1, 0, place)
            && most(0, place, end)
            && most(1, start, place)
            && most(0, end, end + column)
    })
}

#[cfg(test)]
mod tests {
    use super::super::scan::BlockMeans;
    use super::*;

    /// Size in MCUs of 2 by 2 blocks.
    const ACROSS: usize = 20;
    const DOWN: usize = 16;

    /// Levels of an image of which each row has these levels, `noise` aside, and `added` by MCU in the order of the file.
    fn levels(seed: u64, row: impl Fn(usize, f32) -> f32, added: impl Fn(usize) -> f32) -> ImageLevels {
        let mut state = seed;
        let mut noise = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
        };
        let (width, height) = (2 * ACROSS, 2 * DOWN);
        let blocks = (0..width * height).map(|i| {
            let (column, line) = (i % width, i / width);
            let shift = added(line / 2 * ACROSS + column / 2) + 1.5 * noise();
            let at = |y: f32| row(column, line as f32 + y / 8.0) + shift;
            BlockMeans { mean: at(3.5), top: [at(0.0), at(1.0)], bottom: [at(7.0), at(6.0)] }
        });
        let plane = Plane { width, height, step: [2, 2], blocks: blocks.collect() };
        ImageLevels::new(&Scan { planes: vec![plane], ..Scan::default() })
    }

    /// A wall, a floor, and a table's straight edge on half of the width.
    fn room(column: usize, line: f32) -> f32 {
        let floor = if line >= 20.0 { -60.0 } else { 40.0 };
        floor + if column < 20 && (8.0..12.0).contains(&line) { -70.0 } else { 0.0 } + 2.0 * line
    }

    #[test]
    fn a_shift_from_a_place_on_is_found() {
        let before = levels(1, room, |_| 0.0);
        for (shift, first) in [(6.0, 30), (-6.0, 130), (12.0, 212), (-40.0, 90), (25.0, 277), (-9.0, 60), (15.0, 59)] {
            let now = levels(2, room, |mcu| if mcu >= first { shift } else { 0.0 });
            assert!(now.are_shifted(Some(&before)), "{shift} from {first} on");
        }
        // Without an image before, only a shift that begins inside of a row.
        for first in [30, 150, 252] {
            let now = levels(2, room, |mcu| if mcu >= first { 12.0 } else { 0.0 });
            assert!(now.are_shifted(None), "from {first} on");
        }
    }

    #[test]
    fn scenes_and_lights_are_no_shift() {
        let before = levels(1, room, |_| 0.0);
        let dark = levels(1, |column, line| 0.2 * room(column, line), |_| 0.0);
        let row = |mcu: usize| mcu / ACROSS;
        let cases: [(&str, ImageLevels); 6] = [
            ("nothing", levels(3, room, |_| 0.0)),
            ("light", levels(3, |column, line| 1.5 * room(column, line) + 20.0, |_| 0.0)),
            (
                "a person",
                levels(3, room, |mcu| if (6..11).contains(&(mcu % ACROSS)) && row(mcu) > 3 { -50.0 } else { 0.0 }),
            ),
            ("another scene", levels(9, |column, line| (column as f32 * 3.0 - line * 4.0).sin() * 60.0, |_| 0.0)),
            (
                "a flash of some rows",
                levels(3, |c, l| room(c, l) + if l >= 17.3 { 0.4 * (room(c, l) + 128.0) } else { 0.0 }, |_| 0.0),
            ),
            ("all brighter", levels(3, room, |_| 9.0)),
        ];
        for (name, now) in cases {
            assert!(!now.are_shifted(Some(&before)), "{name}");
            assert!(!now.are_shifted(Some(&dark)), "{name}, from the dark");
            assert!(!now.are_shifted(None), "{name}, first");
        }
    }

    #[test]
    fn empty_and_tiny_images_are_no_shift() {
        for size in [0, 1, 2, 3] {
            let blocks = vec![BlockMeans { mean: f32::NAN, ..BlockMeans::default() }; size * size];
            let plane = Plane { width: size, height: size, step: [1, 1], blocks };
            let levels = ImageLevels::new(&Scan { planes: vec![plane], ..Scan::default() });
            assert!(!levels.are_shifted(None));
            assert!(!levels.are_shifted(Some(&levels)));
        }
    }
}
