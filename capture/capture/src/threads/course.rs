//! Counts and sequence numbers that persist while a camera's source is reopened.

use flyrig_types::Frame;

use crate::source::{NetworkHealth, SourceHealth};

/// Continuation of sequence numbers and counts across sources, each of which starts at 0.
#[derive(Debug, Default)]
pub(super) struct Course {
    /// Totals of the previous sources.
    before: Option<SourceHealth>,
    /// Sequence number after the last frame.
    next_sequence: u64,
    /// Offset of the current source's numbers; `None` before its first frame.
    offset: Option<u64>,
}

impl Course {
    /// Begins the next source after one with these counts.
    pub fn restart(&mut self, health: SourceHealth) {
        (self.before, self.offset) = (Some(health), None);
    }

    /// Renumbers a frame to follow those of the previous sources.
    pub fn number(&mut self, frame: &mut Frame) {
        let next = self.next_sequence;
        let offset = *self.offset.get_or_insert_with(|| match self.before {
            Some(_) => next.saturating_sub(frame.sequence),
            None => 0,
        });
        frame.sequence = frame.sequence.saturating_add(offset);
        self.next_sequence = frame.sequence.saturating_add(1);
    }

    /// Adds the totals of the previous sources.
    pub fn health(&self, now: SourceHealth) -> SourceHealth {
        let Some(before) = &self.before else { return now };
        SourceHealth {
            lost_by_driver: before.lost_by_driver.saturating_add(now.lost_by_driver),
            reconnects: before.reconnects.saturating_add(now.reconnects),
            silences: before.silences.saturating_add(now.silences),
            stamps_replaced: before.stamps_replaced.saturating_add(now.stamps_replaced),
            mode: now.mode,
            network: match (before.network, now.network) {
                (Some(before), Some(now)) => Some(network(before, now)),
                (before, now) => now.or(before),
            },
        }
    }
}

fn network(before: NetworkHealth, now: NetworkHealth) -> NetworkHealth {
    NetworkHealth {
        overtaken_before: before.overtaken_before.saturating_add(now.overtaken_before),
        lost_on_the_way: before.lost_on_the_way.saturating_add(now.lost_on_the_way),
        overtaken_here: before.overtaken_here.saturating_add(now.overtaken_here),
        refused: before.refused.saturating_add(now.refused),
        before_clock: before.before_clock.saturating_add(now.before_clock),
        ..now
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, PixelFormat};

    use super::*;

    #[test]
    fn numbers_and_counts_go_on() {
        let mut course = Course::default();
        let number = |course: &mut Course, sequence| {
            let image = Image::new(1, 1, PixelFormat::Gray8, vec![0]).unwrap();
            let mut frame =
                Frame { camera: "a".into(), sequence, capture_nanos: 0, exposure_nanos: None, image, mask: None };
            course.number(&mut frame);
            frame.sequence
        };
        assert_eq!([7, 9].map(|sequence| number(&mut course, sequence)), [7, 9]);
        let network = |lost_on_the_way, clock_drift_ppb| {
            Some(NetworkHealth { lost_on_the_way, clock_drift_ppb, ..NetworkHealth::default() })
        };
        let health = |lost_by_driver, network| SourceHealth { lost_by_driver, network, ..SourceHealth::default() };
        let first = course.health(health(2, network(3, 100)));
        course.restart(first);
        assert_eq!([0, 1, 4].map(|sequence| number(&mut course, sequence)), [10, 11, 14]);
        assert_eq!(course.health(health(5, network(1, 90))), health(7, network(4, 90)));
        assert_eq!(course.health(health(0, None)), health(2, network(3, 100)));
        // One that counts on by itself is left alone.
        course.restart(SourceHealth::default());
        assert_eq!(number(&mut course, 40), 40);
    }
}
