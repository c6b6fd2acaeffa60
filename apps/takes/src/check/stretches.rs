//! Frame sets that a check looks at: few enough for a minute on two cores.

/// Images that are looked at, over all cameras.
const MOST_IMAGES: f64 = 240.0;
/// Least and most footage that is looked at, seconds.
const LOOKED_S: (f64, f64) = (1.0, 3.0);
/// Frame sets per second: faster footage is thinned.
const RATE: f64 = 30.0;
/// Part of a take in which frame sets are chosen, seconds: what lies behind need not be decoded.
const REACH_S: f64 = 8.0;
/// Number of stretches that the footage is spread over: time offsets need consecutive frames, poses need a person in several places.
const COUNT: usize = 3;

/// Stretches of consecutive frame sets.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Stretches {
    /// Beginning and end of each stretch, seconds after the first frame set.
    stretches: Vec<(f64, f64)>,
    last: Option<f64>,
}

impl Stretches {
    /// Chooses stretches of a take of a duration (seconds, `None` if unknown) for a number of cameras.
    pub fn spread(secs: Option<f64>, cameras: usize) -> Self {
        let looked = (MOST_IMAGES / (RATE * cameras.max(1) as f64)).clamp(LOOKED_S.0, LOOKED_S.1);
        let reach = secs.filter(|secs| secs.is_finite()).unwrap_or(REACH_S).clamp(0.0, REACH_S);
        if reach <= looked * 1.2 {
            return Self { stretches: vec![(0.0, reach.max(looked))], last: None };
        }
        let each = looked / COUNT as f64;
        let begin = |i: usize| (reach - each) * i as f64 / (COUNT - 1) as f64;
        Self { stretches: (0..COUNT).map(|i| (begin(i), begin(i) + each)).collect(), last: None }
    }

    /// Returns the end of the last stretch, seconds.
    pub fn end(&self) -> f64 {
        self.stretches.last().map_or(0.0, |(_, end)| *end)
    }

    /// Returns whether a frame set is looked at; times must not decrease.
    pub fn is_chosen(&mut self, secs: f64) -> bool {
        let inside = self.stretches.iter().any(|(begin, end)| (*begin..=*end).contains(&secs));
        // Half of a period is the jitter of timestamps.
        let chosen = inside && self.last.is_none_or(|last| secs - last > 0.75 / RATE);
        if chosen {
            self.last = Some(secs);
        }
        chosen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(secs: Option<f64>, cameras: usize, fps: f64, frames: u32) -> Vec<f64> {
        let mut instants = Stretches::spread(secs, cameras);
        (0..frames).map(|i| f64::from(i) / fps).filter(|secs| instants.is_chosen(*secs)).collect()
    }

    #[test]
    fn short_takes_are_used_whole_and_long_ones_in_stretches() {
        assert_eq!(chosen(Some(2.0), 4, 30.0, 60).len(), 60);
        assert_eq!(chosen(Some(1.7), 4, 60.0, 100).len(), 50, "thinned to 30 per second");
        let long = chosen(Some(60.0), 4, 30.0, 1800);
        assert!((60..=66).contains(&long.len()), "{}", long.len());
        assert!(long[0] < 0.01 && long.last().is_some_and(|last| (7.0..=8.0).contains(last)), "{long:?}");
        let gaps = long.windows(2).filter(|pair| pair[1] - pair[0] > 0.5).count();
        assert_eq!(gaps, 2);
        assert!(chosen(None, 4, 30.0, 1800).len() >= 60);
        assert!(chosen(Some(60.0), 60, 30.0, 1800).len() >= 30, "many cameras are looked at for a second");
        assert!(chosen(Some(f64::NAN), 0, 30.0, 10).len() == 10);
    }
}
