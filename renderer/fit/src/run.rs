//! Course of a fit: its number of steps, given or measured, and the tasks that are due between them.

use std::time::{Duration, Instant};

use crate::checkpoint::FitProgress;
use crate::descent::Fit;
use crate::error::FitError;
use crate::model::Model;

/// Number of steps from which the time of a step is measured.
const MEASURED_STEPS: u64 = 20;
/// Steps between updates of the progress.
const SHOW_EVERY: u64 = 20;
/// Steps and time between two checkpoints.
const SAVE_STEPS: u64 = 500;
const SAVE_EVERY: Duration = Duration::from_secs(30);
/// Number of pictures during a fit.
const PICTURES: u64 = 10;

/// Length of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Length {
    /// Number of steps: the same number and seed give the same bytes.
    Steps(u64),
    /// Minutes; their number of steps is known after the first few.
    Minutes(f64),
}

/// Tasks that are due after a step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Due {
    /// Mean PSNR of the images since it was shown last, decibels.
    pub decibels: Option<f64>,
    /// Whether to write a checkpoint.
    pub checkpoint: bool,
    /// Whether to draw a picture of the model.
    pub picture: bool,
}

/// Course of one fit.
///
/// ```no_run
/// use flyrig_fit::{Fit, FitError, Length, Model, Run};
///
/// fn fit_for_a_minute<M: Model>(mut fit: Fit<M>) -> Result<M, FitError> {
///     let mut run = Run::new(Length::Minutes(1.0), None);
///     while !run.is_done() {
///         if let Some(decibels) = run.step(&mut fit)?.decibels {
///             println!("{} of {:?} steps, {decibels:.1} dB", run.done(), run.total());
///         }
///     }
///     Ok(fit.into_model())
/// }
/// ```
#[derive(Debug)]
pub struct Run {
    length: Length,
    done: u64,
    total: Option<u64>,
    started: Instant,
    /// Number of steps before this run.
    resumed_at: u64,
    saved: (Instant, u64),
    pictures: u64,
    /// Sum of decibels since they were shown last, and their number.
    shown: (f64, u32),
}

impl Run {
    /// Starts the course of a fit, or goes on after the progress of a checkpoint.
    #[must_use]
    pub fn new(length: Length, resumed: Option<&FitProgress>) -> Self {
        let steps = if let Length::Steps(steps) = length { Some(steps) } else { None };
        let (done, total) = resumed.map_or((0, steps), |progress| (progress.done, Some(progress.total)));
        let now = Instant::now();
        Self { length, done, total, started: now, resumed_at: done, saved: (now, done), pictures: 0, shown: (0.0, 0) }
    }

    /// Whether all steps are done.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.total.is_some_and(|total| self.done >= total)
    }

    /// Returns the number of steps so far, those before this run included.
    #[must_use]
    pub fn done(&self) -> u64 {
        self.done
    }

    /// Returns the number of all steps; `None` until it is known.
    #[must_use]
    pub fn total(&self) -> Option<u64> {
        self.total
    }

    /// Returns the time of this run, seconds.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Returns the mean time of a step in this run, seconds.
    #[must_use]
    pub fn step_seconds(&self) -> f64 {
        self.seconds() / (self.done - self.resumed_at).max(1) as f64
    }

    /// Descends by one step and returns what is due after it.
    ///
    /// # Errors
    /// Those of [`Fit::step`].
    pub fn step<M: Model>(&mut self, fit: &mut Fit<M>) -> Result<Due, FitError> {
        let progress = self.total.map_or(0.0, |total| self.done as f32 / total as f32);
        let decibels = fit.step(progress)?.decibels;
        Ok(self.after(decibels))
    }

    /// Counts a step whose image has a PSNR, and returns what is due.
    fn after(&mut self, decibels: f64) -> Due {
        self.done += 1;
        if let (Length::Minutes(minutes), None) = (self.length, self.total)
            && self.done == MEASURED_STEPS
        {
            self.total = Some(((minutes * 60.0 / self.step_seconds()) as u64).max(self.done));
        }
        let Some(total) = self.total else { return Due { decibels: self.show(decibels), ..Due::default() } };
        let checkpoint = self.done >= self.saved.1 + SAVE_STEPS || self.saved.0.elapsed() > SAVE_EVERY;
        if checkpoint {
            self.saved = (Instant::now(), self.done);
        }
        let pictures = PICTURES * self.done / total;
        let picture = pictures > self.pictures;
        self.pictures = pictures;
        Due { decibels: self.show(decibels), checkpoint, picture }
    }

    /// Adds a PSNR to the mean and returns it where it is due.
    fn show(&mut self, decibels: f64) -> Option<f64> {
        let (sum, count) = (self.shown.0 + decibels, self.shown.1 + 1);
        let is_due = self.done.is_multiple_of(SHOW_EVERY);
        self.shown = if is_due { (0.0, 0) } else { (sum, count) };
        is_due.then(|| sum / f64::from(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs until the end, with a PSNR of 1, 2, 3 and so on; returns what was due after each step.
    fn course(mut run: Run) -> Vec<Due> {
        let mut all = Vec::new();
        while !run.is_done() {
            all.push(run.after(run.done as f64 + 1.0));
            assert!(all.len() < 10_000, "it ends");
        }
        all
    }

    #[test]
    fn pictures_means_and_checkpoints_are_due_at_their_steps() {
        let all = course(Run::new(Length::Steps(1005), None));
        assert_eq!(all.len(), 1005);
        assert_eq!(all.iter().filter(|due| due.picture).count(), 10);
        assert!(all[1004].picture && all[100].picture && !all[99].picture, "the last one shows the result");
        assert_eq!(all.iter().filter(|due| due.checkpoint).count(), 2);
        assert_eq!(all[19].decibels, Some(10.5));
        assert_eq!(all[39].decibels, Some(30.5));
        assert_eq!(all.iter().filter(|due| due.decibels.is_some()).count(), 50);
    }

    #[test]
    fn a_resumed_fit_goes_on_after_its_steps_whatever_length_is_asked_for() {
        let progress = FitProgress { settings: String::new(), done: 90, total: 100 };
        let run = Run::new(Length::Minutes(5.0), Some(&progress));
        assert_eq!((run.done(), run.total()), (90, Some(100)));
        assert_eq!(course(run).len(), 10);
        let done = FitProgress { done: 100, ..progress };
        assert!(Run::new(Length::Steps(7), Some(&done)).is_done());
    }

    #[test]
    fn minutes_become_steps_after_the_first_few() {
        let mut run = Run::new(Length::Minutes(0.0), None);
        for step in 1..=MEASURED_STEPS {
            assert!(!run.is_done() && run.total().is_none());
            let due = run.after(30.0);
            assert!(!due.checkpoint && due.decibels.is_some() == (step == SHOW_EVERY));
        }
        assert!(run.is_done());
        assert_eq!(run.total(), Some(MEASURED_STEPS));
    }
}
