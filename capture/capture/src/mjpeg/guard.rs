//! Decision whether a camera's JPEG image is damaged, with what its images before were like.

use super::scan::{Fault, Scan, walk};
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
    /// Levels of the last image that was used, and of the last that was refused for them.
    used: Option<ImageLevels>,
    shifted: Option<ImageLevels>,
    /// Tables of the last image that was used, and of the last that was refused for them.
    tables: Option<Vec<u8>>,
    refused_tables: Option<Vec<u8>>,
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
        if !is_restarted
            && levels.are_shifted(self.used.as_ref())
            && self.shifted.as_ref().is_none_or(|shifted| levels.are_shifted(Some(shifted)))
        {
            self.shifted = Some(levels);
            return Err(Damage::Shift);
        }
        (self.used, self.shifted) = (Some(levels), None);
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
        if self.tables.as_ref() != Some(&scan.tables) && self.refused_tables.as_ref() != Some(&scan.tables) {
            let is_near = |before: &Vec<u8>| {
                let others = before.iter().zip(&scan.tables).filter(|(a, b)| a != b).count();
                before.len() == scan.tables.len() && others <= FEW
            };
            let is_doubtful = match &self.tables {
                Some(before) if is_near(before) => true,
                _ => scan.quantisation.iter().any(is_almost_standard),
            };
            if is_doubtful {
                self.refused_tables = Some(scan.tables.clone());
                return Err(Damage::Tables);
            }
        }
        if self.tables.as_ref() != Some(&scan.tables) {
            self.tables = Some(scan.tables.clone());
        }
        self.refused_tables = None;
        Ok(())
    }
}

/// Entries that damage changes; a camera that changes its quality changes most of them.
const FEW: usize = 12;

/// Returns whether a table in zigzag order is like a standard one of some quality, but for a few entries.
fn is_almost_standard(table: &[u16; 64]) -> bool {
    STANDARD.iter().any(|standard| {
        let others = (1..=100).map(|quality: u32| {
            // The scale of the Independent JPEG Group, which most encoders use.
            let scale = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
            let entry = |base: u8| ((u32::from(base) * scale + 50) / 100).clamp(1, 255) as u16;
            standard.iter().zip(table).filter(|(base, value)| entry(**base) != **value).count()
        });
        // A table of the lowest qualities is like its neighbours.
        others.min().is_some_and(|others| (1..=FEW).contains(&others))
    })
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
