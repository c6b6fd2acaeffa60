//! The loop of a running rig: steps, recordings of its results, and the lines that it prints.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::{CameraStats, Recorder};
use flyrig_fusion::{Health, LiveRig, LiveStep, Outcome, PersonId, resident_mib};
use flyrig_monitor::{Monitor, effort, ended_by_itself};
use flyrig_report::stop;
use signal_hook::consts::SIGUSR1;

use super::person_saver::PersonSaver;
use crate::{config::Config, recording::RigRecording};

/// Longest wait of a step for a frame set before health and Ctrl-C are checked.
const STEP: Duration = Duration::from_millis(200);
/// Interval between lines with rates.
const PRINT_EVERY: Duration = Duration::from_secs(5);

/// Running rig.
pub(super) struct LiveRun<'a> {
    config: &'a Config,
    rig: LiveRig,
    recorder: Option<&'a Recorder>,
    recording: Option<RigRecording>,
    /// Set by SIGUSR1: people are measured again.
    measure: Arc<AtomicBool>,
    started: Instant,
    /// Saver of the person, if the configuration names a file.
    saver: Option<PersonSaver>,
    /// Time of the last line with rates, and the frame sets until then; `None` if a table shows them.
    printed: Option<(Instant, u64)>,
}

impl<'a> LiveRun<'a> {
    /// Starts the run of a rig and listens for SIGUSR1.
    pub fn new(
        config: &'a Config,
        rig: LiveRig,
        recorder: Option<&'a Recorder>,
        recording: Option<RigRecording>,
        prints_rates: bool,
    ) -> Result<Self> {
        let started = Instant::now();
        let measure = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGUSR1, Arc::clone(&measure)).context("cannot listen for SIGUSR1")?;
        Ok(Self {
            config,
            rig,
            recorder,
            recording,
            measure,
            started,
            saver: config.body.person_file().map(PersonSaver::new),
            printed: prints_rates.then_some((started, 0)),
        })
    }

    /// Steps the rig until its cameras end or it is asked to stop.
    pub fn run_until_end(&mut self, monitor: &mut Monitor) -> Result<()> {
        while !stop::requested() && !self.rig.ended() {
            if self.measure.swap(false, Ordering::Relaxed) {
                self.measure_again();
            }
            let step = self.rig.step(STEP, None)?;
            if step.is_some() {
                monitor.stepped();
            }
            monitor.report(|| (self.rig.health(), self.recorder.map(Recorder::state)));
            let Some(step) = step else { continue };
            self.record(&step)?;
            self.save_person()?;
            self.print_rates();
        }
        Ok(())
    }

    /// Ends the rig, prints its counts, and saves the person.
    pub fn finish(mut self) -> Result<()> {
        eprintln!("run: {} frame sets in {:.1} s", self.rig.frames(), self.started.elapsed().as_secs_f64());
        eprint!("{}", self.rig.session.stages.table());
        for (place, count) in self.rig.drops().into_iter().filter(|(_, count)| *count > 0) {
            eprintln!("dropped: {count} {place}");
        }
        let stats = camera_stats(self.rig.health());
        let (frames, seen) = (self.rig.frames(), self.rig.session.has_people());
        let saved = self.save_last();
        self.rig.finish()?;
        saved?;
        ensure!(
            seen || frames == 0 || stop::requested(),
            "no person was seen in {frames} frame sets: check that people stand in view of two cameras, and the calibration"
        );
        // A recording ends; live cameras do not.
        if self.config.source.kind.is_live() && !stop::requested() {
            return Err(ended_by_itself(&stats));
        }
        Ok(())
    }

    fn measure_again(&mut self) {
        if self.rig.session.measure_again() {
            eprintln!("run: SIGUSR1, all people are measured again");
        } else {
            eprintln!(
                "run: SIGUSR1, but no person is measured: perception.shape is \"given\", or there is only one camera"
            );
        }
    }

    /// Records the events and the pose of a step.
    fn record(&mut self, step: &LiveStep) -> Result<()> {
        let (Some(recording), session) = (&mut self.recording, &self.rig.session) else { return Ok(()) };
        if let Some(event) = &step.watched {
            recording.record_watch(event, session.rig())?;
        }
        if !matches!(step.outcome, Outcome::Held(_))
            && let Some(subject) = session.subject(PersonId::default())
            && let Some(pose) = subject.pose()
        {
            recording.poses.record(&subject.template().skeleton, pose, step.set.master_nanos);
        }
        Ok(())
    }

    /// Starts to save the person when it is time.
    fn save_person(&mut self) -> Result<()> {
        let Some(saver) = &mut self.saver else { return Ok(()) };
        if saver.is_due() {
            saver.start(self.rig.snapshot()?.get(&PersonId::default()).cloned());
        }
        Ok(())
    }

    fn save_last(&mut self) -> Result<()> {
        let Some(saver) = self.saver.take() else { return Ok(()) };
        saver.finish(self.rig.snapshot()?.get(&PersonId::default()))
    }

    fn print_rates(&mut self) {
        let frames = self.rig.frames();
        let Some((last, printed)) = &mut self.printed else { return };
        if last.elapsed() < PRINT_EVERY {
            return;
        }
        let rate = (frames - *printed) as f64 / last.elapsed().as_secs_f64();
        let memory = resident_mib().map_or_else(String::new, |mib| format!(", {mib:.0} MiB"));
        let session = &self.rig.session;
        let lost = session.counts.lost;
        let effort = session.budget.stats().map_or_else(String::new, |budget| format!(", {}", effort(budget)));
        eprintln!("run: {frames} frame sets, {rate:.1} per second, {lost} lost{memory}{effort}");
        (*last, *printed) = (Instant::now(), frames);
    }
}

fn camera_stats(health: Health) -> Vec<CameraStats> {
    health.cameras.into_iter().map(|camera| camera.stats).collect()
}
