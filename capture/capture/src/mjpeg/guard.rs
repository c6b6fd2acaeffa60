//! Decision whether a camera's JPEG image is damaged, with what its images before were like.

use super::fault::Fault;
use super::scan::{Scan, Tables, walk};
use super::shifts::ImageLevels;

/// Fault of an image that a decoder does not notice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Damage {
    /// The data contradict the format.
    Scan(Fault),
    /// Tables that are like those of the image before, or of the standard, but for a few entries.
    Tables,
    /// Levels that are shifted from some block on.
    Shift,
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Scan(fault) => fault.fmt(f),
            Self::Tables => f.write_str("its tables differ from the camera's in a few places"),
            Self::Shift => f.write_str("it is too bright or too dark from some place on"),
        }
    }
}

/// Weight of an image with an oddity against one without.
const ODD: u32 = 4;
/// Weighted number of odd images from which oddities are a habit of the camera: eight in a row.
const HABIT: u32 = 8 * ODD;

/// Examiner of the images of one camera.
#[derive(Debug, Clone, Default)]
pub(crate) struct Guard {
    /// Levels of the last two images that were used, the newer one first: a slight shift in one of them may have been
    /// missed.
    used: [Option<ImageLevels>; 2],
    /// Levels of the last image that was refused for them.
    shifted: Option<ImageLevels>,
    /// Tables of the last image that was used, and of the last that was refused for them.
    tables: Option<Tables>,
    refused_tables: Option<Tables>,
    /// Recent images with an oddity, weighted.
    odd: u32,
}

impl Guard {
    /// Examines an image, whose segments up to the scan have these positions and markers. What is refused in two images
    /// in a row is how the camera or its scene is now, and used from then on.
    ///
    /// # Errors
    /// The damage.
    pub fn check(&mut self, bytes: &[u8], segments: impl Iterator<Item = (usize, u8)>) -> Result<(), Damage> {
        let Some(scan) = walk(bytes, segments).map_err(Damage::Scan)? else { return Ok(()) };
        self.check_oddity(&scan)?;
        self.check_tables(&scan)?;
        let levels = ImageLevels::new(&scan);
        // A restart marker ends a shift.
        let rows = scan.planes.first().map_or(1, |plane| plane.width / plane.step[0].max(1));
        let is_restarted = (1..=2 * rows).contains(&scan.restart_interval);
        let [newer, older] = &self.used;
        let is_shifted_too = |other: &Option<ImageLevels>| other.as_ref().is_none_or(|o| levels.are_shifted(Some(o)));
        if !is_restarted && levels.are_shifted(newer.as_ref()) && is_shifted_too(older) && is_shifted_too(&self.shifted)
        {
            self.shifted = Some(levels);
            return Err(Damage::Shift);
        }
        self.used.swap(0, 1);
        (self.used[0], self.shifted) = (Some(levels), None);
        Ok(())
    }

    fn check_oddity(&mut self, scan: &Scan) -> Result<(), Damage> {
        let Some(fault) = scan.oddity else {
            self.odd = self.odd.saturating_sub(1);
            return Ok(());
        };
        self.odd = (self.odd + ODD).min(2 * HABIT);
        if self.odd < HABIT { Err(Damage::Scan(fault)) } else { Ok(()) }
    }

    fn check_tables(&mut self, scan: &Scan) -> Result<(), Damage> {
        let tables = &scan.tables;
        if self.tables.as_ref() != Some(tables) {
            let is_doubtful = match &self.tables {
                Some(before) => !is_other_quality(before, tables) || (is_standard(before) && !is_standard(tables)),
                None => tables.quantisation.iter().any(is_almost_standard),
            };
            if is_doubtful && self.refused_tables.as_ref() != Some(tables) {
                self.refused_tables = Some(tables.clone());
                return Err(Damage::Tables);
            }
            self.tables = Some(tables.clone());
        }
        self.refused_tables = None;
        Ok(())
    }
}

/// Entries that damage changes at most; an encoder that changes its quality changes more, or these by little.
const FEW: usize = 12;

/// Returns whether tables are those of another quality: all entries that differ are larger, or all are smaller.
fn is_other_quality(before: &Tables, now: &Tables) -> bool {
    if before.selectors != now.selectors || before.quantisation.len() != now.quantisation.len() {
        return false;
    }
    let pairs = before.quantisation.iter().flatten().zip(now.quantisation.iter().flatten());
    let changed: Vec<(u16, u16)> = pairs.map(|(a, b)| (*a, *b)).filter(|(a, b)| a != b).collect();
    let is_one_way = changed.iter().all(|(a, b)| a < b) || changed.iter().all(|(a, b)| a > b);
    let is_little = || changed.iter().all(|(a, b)| a.abs_diff(*b) <= (a / 5).max(1));
    changed.len() >= 2 && is_one_way && (changed.len() > FEW || is_little())
}

/// Returns the entry of a standard table at a quality from 1 to 100, by the scale of the Independent JPEG Group, which
/// most encoders use.
fn scaled(base: u8, quality: u32) -> u16 {
    let scale = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
    ((u32::from(base) * scale + 50) / 100).clamp(1, 255) as u16
}

/// Returns whether every table is a standard one of some quality.
fn is_standard(tables: &Tables) -> bool {
    tables.quantisation.iter().all(|table| {
        let is_of = |standard: &[u8; 64], quality| standard.iter().zip(table).all(|(b, v)| scaled(*b, quality) == *v);
        STANDARD.iter().any(|standard| (1..=100).any(|quality| is_of(standard, quality)))
    })
}

/// Returns whether a table is a standard one of some quality, but for up to three entries.
fn is_almost_standard(table: &[u16; 64]) -> bool {
    let others = |standard: &[u8; 64], quality| {
        let entries = standard.iter().zip(table).map(|(base, value)| scaled(*base, quality).abs_diff(*value));
        entries.filter(|difference| *difference > 0).fold((0, 0), |(count, most), d| (count + 1, d.max(most)))
    };
    let best = STANDARD.iter().flat_map(|standard| (1..=100).map(|quality| others(standard, quality))).min();
    // Encoders that round in another way differ by one.
    best.is_some_and(|(count, most)| (1..=3).contains(&count) && most > 1)
}

/// ITU-T T.81, tables K.1 and K.2, in zigzag order.
#[rustfmt::skip]
const STANDARD: [[u8; 64]; 2] = [[
    16, 11, 12, 14, 12, 10, 16, 14, 13, 14, 18, 17, 16, 19, 24, 40, 26, 24, 22, 22, 24, 49, 35, 37, 29, 40, 58, 51, 61, 60,
    57, 51, 56, 55, 64, 72, 92, 78, 64, 68, 87, 69, 55, 56, 80, 109, 81, 87, 95, 98, 103, 104, 103, 62, 77, 113, 121, 112,
    100, 120, 92, 101, 103, 99,
], [
    17, 18, 18, 24, 21, 24, 47, 26, 26, 47, 99, 66, 56, 66, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99,
]];

#[cfg(test)]
mod tests {
    use super::super::{segments, testing::encoded};
    use super::*;

    fn check(guard: &mut Guard, bytes: &[u8]) -> Result<(), Damage> {
        guard.check(bytes, segments(bytes))
    }

    #[test]
    fn a_camera_that_always_adds_bytes_is_used_after_a_while() {
        let odd = |shift| {
            let bytes = encoded(96, 64, 0, shift);
            [&bytes[..bytes.len() - 2], &[0, 1, 0xff, 0xd9]].concat()
        };
        let mut guard = Guard::default();
        let used: Vec<bool> = (0..20).map(|i| check(&mut guard, &odd(i)).is_ok()).collect();
        assert_eq!(used.iter().position(|is_used| *is_used), Some(7));
        assert!(used[7..].iter().all(|is_used| *is_used));
        // One now and then is damage.
        let mut guard = Guard::default();
        for i in 0..200 {
            let is_odd = i % 10 == 9;
            let bytes = if is_odd { odd(i) } else { encoded(96, 64, 0, i) };
            assert_eq!(check(&mut guard, &bytes).is_err(), is_odd, "{i}");
        }
    }

    #[test]
    fn another_quality_is_no_damage() {
        for base in [STANDARD[0], [40; 64]] {
            let of = |percent: u32| Tables {
                quantisation: vec![base.map(|b| ((u32::from(b) * percent + 50) / 100).clamp(1, 255) as u16); 2],
                selectors: vec![[1, 0], [2, 1]],
            };
            for (before, now) in [(100, 50), (20, 100), (100, 101), (30, 40)] {
                assert!(of(before) == of(now) || is_other_quality(&of(before), &of(now)), "{before} {now}");
            }
            let mut damaged = of(100);
            damaged.quantisation[1][5] += 30;
            assert!(!is_other_quality(&of(100), &damaged));
            for i in 0..40 {
                damaged.quantisation[0][i] = (i * 37 % 255 + 1) as u16;
            }
            assert!(!is_other_quality(&of(100), &damaged));
        }
    }

    #[test]
    fn tables_that_change_in_one_entry_are_refused_unless_they_stay() {
        let bytes = encoded(96, 64, 0, 0);
        let at = segments(&bytes).find(|(_, marker)| *marker == 0xdb).unwrap().0 + 5 + 20;
        let mut other = bytes.clone();
        other[at] ^= 0x10;
        let mut guard = Guard::default();
        assert_eq!(check(&mut guard, &other), Err(Damage::Tables), "like a standard table");
        let mut guard = Guard::default();
        assert_eq!(check(&mut guard, &bytes), Ok(()));
        assert_eq!(check(&mut guard, &other), Err(Damage::Tables));
        assert_eq!(check(&mut guard, &bytes), Ok(()));
        assert_eq!(check(&mut guard, &other), Err(Damage::Tables));
        assert_eq!(check(&mut guard, &other), Ok(()), "twice in a row");
    }
}
