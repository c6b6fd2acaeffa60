//! Distribution of an update's work over time, where a level of effort leaves some of it out.

use crate::settings::effort::Effort;

/// Updates of a newly met person that get all the work.
const FULL_UPDATES: u32 = 10;

/// Work of one update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Work {
    /// Whether the deformation is solved.
    pub solves: bool,
    /// Whether the Gaussians are painted.
    pub paints: bool,
}

/// Count of a person's updates, which decides on the work of the next one.
#[derive(Debug, Default)]
pub(super) struct Schedule {
    updates: u32,
}

impl Schedule {
    /// Returns the work of the next update. A newly met person gets all of it, since everything later builds on it.
    pub fn next(&mut self, effort: Effort) -> Work {
        let turn = self.updates.saturating_sub(FULL_UPDATES);
        self.updates = self.updates.saturating_add(1);
        Work {
            solves: turn.is_multiple_of(effort.solve_every),
            // Half a cycle later, so that neighbouring frame sets cost about the same.
            paints: turn == 0 || (turn + effort.paint_every / 2).is_multiple_of(effort.paint_every),
        }
    }

    /// Starts anew, as for a person who was just met.
    pub fn restart(&mut self) {
        self.updates = 0;
    }

    /// Returns whether the last update got all the work at whatever level of effort.
    pub fn is_new(&self) -> bool {
        (1..=FULL_UPDATES).contains(&self.updates)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_person_gets_all_the_work_and_later_updates_alternate() {
        let effort = Effort { solve_every: 2, paint_every: 2, ..Effort::FULL };
        let mut schedule = Schedule::default();
        assert!(!schedule.is_new(), "no update yet");
        for _ in 0..FULL_UPDATES {
            assert_eq!(schedule.next(effort), Work { solves: true, paints: true });
            assert!(schedule.is_new());
        }
        let later: Vec<(bool, bool)> = (0..5)
            .map(|_| {
                let Work { solves, paints } = schedule.next(effort);
                (solves, paints)
            })
            .collect();
        assert_eq!(later, [(true, true), (false, true), (true, false), (false, true), (true, false)]);
        assert!(!schedule.is_new());
    }
}
