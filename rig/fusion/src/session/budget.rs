//! Budget of time: the level of effort at which frame sets are processed as often as wanted.
//!
//! The smoothed cost of a frame set, its views included, is compared with 0.85 of the period. What is left out first costs the fewest
//! decibels per millisecond (docs/benchmarks/budget.md).

use std::time::Duration;

use flyrig_transport::BudgetStats;

use crate::settings::{budget::BudgetSettings, effort::Effort};

/// Share of the period that work may take; the rest absorbs frame sets that take longer.
const USABLE: f64 = 0.85;
/// Largest expected share of the usable time at which a level with more work is tried.
const SURE: f64 = 0.9;
/// Share of the newest frame set in the smoothed cost.
const NEWEST: f64 = 0.2;
/// Largest cost of one frame set that counts, as a multiple of the smoothed cost: one hiccup is no change.
const HICCUP: f64 = 3.0;
/// Frame sets after a change of level until its cost is known.
const SETTLE: u32 = 6;
/// Frame sets until more work is tried.
const FIRST_WAIT: u32 = 15;
/// Longest wait, in frame sets, to which [`FIRST_WAIT`] doubles after attempts that failed.
const LONGEST_WAIT: u32 = 960;
/// Frame sets after which a level with more work has proven itself.
const PROVEN: u32 = 60;
/// Cost of each level as a share of that of the level before it, until it has been measured.
const EXPECTED_STEP: f64 = 0.9;
const LEVELS: usize = Effort::LEVELS.len();

/// Choice of the level of effort from the cost of past frame sets.
///
/// Less work follows at once, by as many levels as it takes. More work is tried only where its expected cost leaves a margin, and after
/// ever longer waits where that has failed before.
#[derive(Debug, Clone)]
pub struct Budget {
    settings: BudgetSettings,
    level: usize,
    /// Smoothed cost of a frame set, seconds; `None` before the first one at this level.
    cost: Option<f64>,
    /// Frame sets at this level.
    sets: u32,
    /// Cost of each level as a share of that of the level before it.
    steps: [f64; LEVELS],
    /// Level before the last change, and its cost, seconds.
    before: Option<(usize, f64)>,
    /// Frame sets until more work is tried.
    wait: u32,
    /// Cost so far of the frame set under way, seconds; `None` for one that does not count.
    spent: Option<f64>,
}

impl Budget {
    pub(crate) fn new(settings: BudgetSettings) -> Self {
        Self {
            settings,
            level: 0,
            cost: None,
            sets: 0,
            steps: [EXPECTED_STEP; LEVELS],
            before: None,
            wait: FIRST_WAIT,
            spent: Some(0.0),
        }
    }

    /// Returns the wanted number of frame sets per second; `None` without a budget.
    #[must_use]
    pub fn fps(&self) -> Option<f64> {
        (self.settings.fps > 0.0 && self.settings.effort.is_none()).then_some(self.settings.fps)
    }

    /// Returns the level of effort, an index into [`Effort::LEVELS`]; 0 does all the work.
    #[must_use]
    pub fn level(&self) -> usize {
        self.level
    }

    /// Returns the work that the next frame set gets.
    #[must_use]
    pub fn effort(&self) -> Effort {
        self.settings.effort.unwrap_or(Effort::LEVELS[self.level])
    }

    /// Adds time that was spent on the frame set under way.
    pub fn spend(&mut self, time: Duration) {
        if let Some(spent) = &mut self.spent {
            *spent += time.as_secs_f64();
        }
    }

    /// Leaves out the frame set under way, whose cost says nothing about later ones.
    pub(crate) fn leave_out(&mut self) {
        self.spent = None;
    }

    /// Returns the state for statistics; `None` without a budget.
    #[must_use]
    pub fn stats(&self) -> Option<BudgetStats> {
        let set_secs = self.cost.or(self.before.map(|(_, cost)| cost)).unwrap_or(0.0);
        self.fps().map(|fps| BudgetStats { fps, level: self.level as u32, levels: LEVELS as u32, set_secs })
    }

    /// Ends the frame set under way and chooses the level of the next one.
    pub(crate) fn next_set(&mut self) {
        let spent = self.spent.replace(0.0).filter(|spent| *spent > 0.0);
        let Some((fps, spent)) = self.fps().zip(spent) else { return };
        self.sets = self.sets.saturating_add(1);
        let cost = match self.cost {
            None => spent,
            Some(cost) => cost + NEWEST.max(1.0 / f64::from(self.sets)) * (spent.min(HICCUP * cost) - cost),
        };
        self.cost = Some(cost);
        if self.sets < SETTLE {
            return;
        }
        if self.sets == SETTLE {
            self.learn_step(cost);
        }
        if self.sets == PROVEN {
            self.wait = FIRST_WAIT;
        }
        let usable = USABLE / fps;
        if cost > usable {
            if self.before.is_some_and(|(before, _)| before > self.level) && self.sets < PROVEN {
                self.wait = (2 * self.wait).min(LONGEST_WAIT);
            }
            let (mut level, mut expected) = (self.level, cost);
            while level + 1 < LEVELS && expected > usable {
                level += 1;
                expected *= self.steps[level];
            }
            self.change(level, cost);
        } else if self.level > 0 && self.sets >= self.wait && cost / self.steps[self.level] < SURE * usable {
            self.change(self.level - 1, cost);
        }
    }

    fn change(&mut self, level: usize, cost: f64) {
        if level != self.level {
            self.before = Some((self.level, cost));
            (self.level, self.cost, self.sets) = (level, None, 0);
        }
    }

    /// Learns the cost of this level relative to that of the level before the change.
    fn learn_step(&mut self, cost: f64) {
        let Some((before, cost_before)) = self.before else { return };
        let (low, high, ratio) = if before < self.level {
            (before, self.level, cost / cost_before)
        } else {
            (self.level, before, cost_before / cost)
        };
        if high == low + 1 && ratio.is_finite() {
            self.steps[high] = ratio.clamp(0.3, 1.0);
        }
    }
}

#[cfg(test)]
#[path = "budget_tests.rs"]
mod tests;
