//! File of the learnt person, written in a thread of its own: a slow disk holds up no frame set.

use std::{
    path::{Path, PathBuf},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, anyhow};
use flyrig_fusion::PersonMemory;
use flyrig_types::caught;

/// Interval at which the person is saved.
const SAVE_EVERY: Duration = Duration::from_secs(60);
/// Name of the thread.
const NAME: &str = "person-saver";

/// Saver of one person. A file that cannot be written is reported and tried again; the rig goes on.
#[derive(Debug)]
pub(super) struct PersonSaver {
    path: PathBuf,
    /// Time of the last start.
    started: Instant,
    writing: Option<JoinHandle<Result<()>>>,
    failures: u64,
}

impl PersonSaver {
    /// Saves to this file, for the first time after a minute.
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), started: Instant::now(), writing: None, failures: 0 }
    }

    /// Returns whether the person is to be saved now. Reports a file that could not be written.
    pub fn is_due(&mut self) -> bool {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished) {
            self.report_last();
        }
        self.writing.is_none() && self.started.elapsed() >= SAVE_EVERY
    }

    /// Starts to write the file; without a person, waits for another minute.
    pub fn start(&mut self, memory: Option<PersonMemory>) {
        self.started = Instant::now();
        let Some(memory) = memory else { return };
        let path = self.path.clone();
        let write =
            move || caught(|| memory.save(&path)).map_err(|panic| anyhow!("panic: {panic}"))?.map_err(Into::into);
        match std::thread::Builder::new().name(NAME.to_owned()).spawn(write) {
            Ok(thread) => self.writing = Some(thread),
            Err(error) => self.report(&anyhow!("cannot start the thread {NAME}: {error}")),
        }
    }

    /// Waits for the file that is being written, and writes the last one.
    ///
    /// # Errors
    /// The last file cannot be written; the one before is untouched.
    pub fn finish(mut self, memory: Option<&PersonMemory>) -> Result<()> {
        self.report_last();
        memory.map_or(Ok(()), |memory| memory.save(&self.path)).context("the person is not saved")
    }

    fn report_last(&mut self) {
        let Some(thread) = self.writing.take() else { return };
        match thread.join() {
            Ok(Ok(())) => self.failures = 0,
            Ok(Err(error)) => self.report(&error),
            // Its panics are caught inside.
            Err(_) => {}
        }
    }

    fn report(&mut self, error: &anyhow::Error) {
        self.failures += 1;
        if self.failures.is_power_of_two() {
            tracing::warn!(times = self.failures, "{error:#}; the file before stays as it is");
        }
    }
}

impl Drop for PersonSaver {
    /// Lets no half-written file stay behind.
    fn drop(&mut self) {
        self.report_last();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use flyrig_avatar::Avatar;
    use flyrig_body::{ShapeParams, default_template, sample_surface};
    use flyrig_renderer::HarmonicOrder;

    use super::*;

    fn memory() -> PersonMemory {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 300, 1).unwrap();
        let avatar = Avatar::new(&template, &surface, None, &[], HarmonicOrder::Zero).unwrap();
        PersonMemory::of_avatar(Arc::new(avatar))
    }

    #[test]
    fn a_file_that_cannot_be_written_is_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gone").join("anna.person");
        let mut saver = PersonSaver::new(&path);
        assert!(!saver.is_due(), "the first file comes after a minute");
        for failures in 1..=2 {
            saver.start(Some(memory()));
            assert!(!saver.is_due());
            saver.report_last();
            assert_eq!(saver.failures, failures);
        }
        std::fs::create_dir(folder.path().join("gone")).unwrap();
        saver.start(Some(memory()));
        saver.report_last();
        assert_eq!(saver.failures, 0);
        PersonMemory::load(&path).unwrap();
    }

    #[test]
    fn the_last_file_is_written_whole_or_its_error_ends_the_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("anna.person");
        let mut saver = PersonSaver::new(&path);
        saver.start(Some(memory()));
        saver.finish(None).unwrap();
        PersonMemory::load(&path).unwrap();

        let lost = PersonSaver::new(&folder.path().join("gone/anna.person"));
        let error = format!("{:#}", lost.finish(Some(&memory())).unwrap_err());
        assert!(error.contains("not saved") && error.contains("gone/anna.person"), "{error}");
    }
}
