//! Fetcher of templates on a thread of its own, so that a late template delays no motion.

use std::{
    collections::{HashMap, HashSet, VecDeque},
    sync::Arc,
    thread::Builder,
    time::{Duration, Instant},
};

use crossbeam::channel::{Receiver, Sender, bounded};
use flyrig_types::caught;

use crate::{error::TransportError, keys::MAX_PERSON_TOPICS, people::person_stream::PersonSubscription};

/// Time limit of a template, after which the next one has its turn.
const PATIENCE: Duration = Duration::from_secs(30);
/// Pause after a template that did not arrive.
const RETRY: Duration = Duration::from_millis(500);
/// Largest number of waiting templates; further ones are requested again by later motions.
const MAX_WAITING: usize = MAX_PERSON_TOPICS + 1;
/// Largest number and bytes of templates that are kept, so that a person who returns, or wears a coat again, is shown at once.
const MAX_KEPT: usize = 8;
const MAX_KEPT_BYTES: usize = 16 << 20;

type Fetched = (u64, Result<Option<Vec<u8>>, TransportError>);

/// Fetcher of the templates that motions name, each once; made by [`crate::Subscriber::template_fetcher`]. Dropping it does not wait for a
/// fetch under way.
#[derive(Debug)]
pub struct TemplateFetcher {
    wanted: Sender<u64>,
    fetched: Receiver<Fetched>,
    /// People that wait for a template, by its hash.
    waiting: HashMap<u64, HashSet<u32>>,
    /// Time of the last failure of each template.
    failed: HashMap<u64, Instant>,
    /// Templates that have arrived, most recently requested last.
    kept: VecDeque<(u64, Vec<u8>)>,
    /// People and hashes of kept templates requested since.
    ready: VecDeque<(u32, u64)>,
    /// Subscription that fetches the colours of people whose templates were taken.
    people: Option<Arc<PersonSubscription>>,
}

impl TemplateFetcher {
    pub(crate) fn start(people: Arc<PersonSubscription>) -> Result<Self, TransportError> {
        let asked = Arc::clone(&people);
        let fetcher = Self::with(move |hash| asked.ask_template(hash, PATIENCE))?;
        Ok(Self { people: Some(people), ..fetcher })
    }

    fn with(
        ask: impl Fn(u64) -> Result<Option<Vec<u8>>, TransportError> + Send + 'static,
    ) -> Result<Self, TransportError> {
        let (wanted, hashes) = bounded(MAX_WAITING);
        let (answers, fetched) = bounded(MAX_WAITING);
        let work = move || {
            for hash in hashes {
                let answer = caught(|| ask(hash));
                let answer = answer.unwrap_or_else(|panic| Err(TransportError::session("fetching a template", &panic)));
                if answers.send((hash, answer)).is_err() {
                    return;
                }
            }
        };
        // The thread ends when the fetcher is dropped, after the fetch under way.
        Builder::new()
            .name("flyrig-templates".to_owned())
            .spawn(work)
            .map_err(|error| TransportError::session("template thread", &error))?;
        Ok(Self {
            wanted,
            fetched,
            waiting: HashMap::new(),
            failed: HashMap::new(),
            kept: VecDeque::new(),
            ready: VecDeque::new(),
            people: None,
        })
    }

    /// Requests the template of a person, unless it is on its way or failed just now. Never waits.
    pub fn ask(&mut self, person: u32, hash: u64) {
        if self.kept.iter().any(|(kept, _)| *kept == hash) {
            if !self.ready.contains(&(person, hash)) {
                self.ready.push_back((person, hash));
            }
            return;
        }
        if self.failed.get(&hash).is_some_and(|at| at.elapsed() < RETRY) {
            return;
        }
        if let Some(people) = self.waiting.get_mut(&hash) {
            people.insert(person);
        } else if self.wanted.try_send(hash).is_ok() {
            self.waiting.insert(hash, HashSet::from([person]));
        }
    }

    /// Marks a template as unusable, so that motions that name it do not fetch it again at once.
    pub fn refuse(&mut self, hash: u64) {
        self.kept.retain(|(kept, _)| *kept != hash);
        self.failed.insert(hash, Instant::now());
    }

    /// Takes the next template that has arrived; `None` without one. Never waits.
    ///
    /// # Errors
    /// As [`crate::Subscriber::template`]; the next call of [`Self::ask`] requests the template again.
    pub fn take(&mut self) -> Result<Option<FetchedTemplate>, TransportError> {
        let taken = self.take_next();
        if let (Ok(Some(template)), Some(people)) = (&taken, &self.people) {
            people.template_taken(&template.people);
        }
        taken
    }

    fn take_next(&mut self) -> Result<Option<FetchedTemplate>, TransportError> {
        while let Some((person, hash)) = self.ready.pop_front() {
            if let Some(at) = self.kept.iter().position(|(kept, _)| *kept == hash) {
                self.kept.make_contiguous()[at..].rotate_left(1);
                let bytes = self.kept.back().map(|(_, bytes)| bytes.clone()).unwrap_or_default();
                return Ok(Some(FetchedTemplate { people: vec![person], hash, bytes }));
            }
        }
        while let Ok((hash, answer)) = self.fetched.try_recv() {
            let people = self.waiting.remove(&hash).unwrap_or_default();
            self.failed.retain(|_, at| at.elapsed() < RETRY);
            match answer {
                Ok(Some(bytes)) => {
                    self.keep(hash, &bytes);
                    return Ok(Some(FetchedTemplate { people: people.into_iter().collect(), hash, bytes }));
                }
                Ok(None) => self.refuse(hash),
                Err(error) => {
                    self.refuse(hash);
                    return Err(error);
                }
            }
        }
        Ok(None)
    }

    fn keep(&mut self, hash: u64, bytes: &[u8]) {
        if bytes.len() > MAX_KEPT_BYTES {
            return;
        }
        self.kept.push_back((hash, bytes.to_vec()));
        let size = |kept: &VecDeque<(u64, Vec<u8>)>| kept.iter().map(|(_, bytes)| bytes.len()).sum::<usize>();
        while self.kept.len() > MAX_KEPT || size(&self.kept) > MAX_KEPT_BYTES {
            self.kept.pop_front();
        }
    }
}

/// Template that has arrived.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FetchedTemplate {
    /// People that were waiting for it.
    pub people: Vec<u32>,
    /// Hash of the bytes.
    pub hash: u64,
    /// Bytes for [`flyrig_stream::StreamTemplate::decode`].
    pub bytes: Vec<u8>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn next_within(
        fetcher: &mut TemplateFetcher,
        patience: Duration,
    ) -> Option<Result<FetchedTemplate, TransportError>> {
        let end = Instant::now() + patience;
        while Instant::now() < end {
            if let Some(next) = fetcher.take().transpose() {
                return Some(next);
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        None
    }

    #[test]
    fn a_late_template_is_fetched_once_for_all_and_delays_no_call() {
        let (release, held) = bounded::<()>(0);
        let (count, asked) = bounded(9);
        let mut fetcher = TemplateFetcher::with(move |hash| {
            count.send(hash).unwrap();
            if hash == 1 {
                held.recv().unwrap();
            }
            Ok(Some(vec![hash as u8]))
        })
        .unwrap();
        for person in [4, 7, 4] {
            fetcher.ask(person, 1);
        }
        fetcher.ask(5, 2);
        // It is held up: asking and looking come back at once all the same.
        assert_eq!(fetcher.take().unwrap(), None);
        release.send(()).unwrap();
        let mut first = next_within(&mut fetcher, Duration::from_secs(90)).unwrap().unwrap();
        first.people.sort_unstable();
        assert_eq!(first, FetchedTemplate { people: vec![4, 7], hash: 1, bytes: vec![1] });
        let second = next_within(&mut fetcher, Duration::from_secs(90)).unwrap().unwrap();
        assert_eq!((second.people, second.hash), (vec![5], 2));
        assert_eq!(asked.try_iter().collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn failures_panics_and_missing_answers_are_retried_after_a_pause() {
        let turn = std::sync::atomic::AtomicU32::new(0);
        let fetcher = TemplateFetcher::with(move |_| match turn.fetch_add(1, std::sync::atomic::Ordering::Relaxed) {
            0 => Ok(None),
            1 => Err(TransportError::session("line", &"cut")),
            2 => panic!("out of luck"),
            _ => Ok(Some(Vec::new())),
        });
        let mut fetcher = fetcher.unwrap();
        let (mut errors, end) = (Vec::new(), Instant::now() + Duration::from_secs(90));
        let start = Instant::now();
        let fetched = loop {
            assert!(Instant::now() < end);
            fetcher.ask(0, 9);
            match fetcher.take() {
                Ok(Some(template)) => break template,
                Ok(None) => std::thread::sleep(Duration::from_millis(2)),
                Err(error) => errors.push(error.to_string()),
            }
        };
        assert_eq!((fetched.people, errors.len()), (vec![0], 2), "{errors:?}");
        assert!(errors[0].contains("cut") && errors[1].contains("out of luck"), "{errors:?}");
        assert!(start.elapsed() >= 3 * RETRY);
    }

    #[test]
    fn templates_that_came_are_kept_within_bounds_and_not_fetched_again() {
        let (count, asked) = bounded(999);
        let mut fetcher = TemplateFetcher::with(move |hash| {
            count.send(hash).unwrap();
            // The last one is larger than all that is kept.
            Ok(Some(vec![hash as u8; if hash == 99 { MAX_KEPT_BYTES + 1 } else { 3 }]))
        })
        .unwrap();
        let mut fetch = |person: u32, hash: u64| {
            fetcher.ask(person, hash);
            fetcher.ask(person, hash);
            let found = next_within(&mut fetcher, Duration::from_secs(90)).unwrap().unwrap();
            assert_eq!((&found.people, found.hash, found.bytes[0]), (&vec![person], hash, hash as u8));
            assert_eq!(fetcher.take().unwrap(), None);
        };
        for hash in 1..=MAX_KEPT as u64 {
            fetch(7, hash);
        }
        // The first template is requested again, also for another person, so the second is the one to be forgotten.
        fetch(7, 1);
        fetch(8, 1);
        assert_eq!(asked.try_iter().count(), MAX_KEPT);
        fetch(7, 50);
        fetch(7, 1);
        fetch(7, 2);
        assert_eq!(asked.try_iter().collect::<Vec<_>>(), [50, 2]);
        // A template too large to keep, and one marked as unusable, are fetched anew.
        fetch(7, 99);
        fetch(7, 99);
        fetcher.ask(7, 1);
        fetcher.refuse(1);
        assert_eq!(fetcher.take().unwrap(), None);
        assert!(asked.try_iter().filter(|hash| *hash == 99).count() == 2 && fetcher.kept.len() <= MAX_KEPT);
    }

    #[test]
    fn no_more_wait_than_there_is_room_for() {
        let (_release, held) = bounded::<()>(0);
        let mut fetcher = TemplateFetcher::with(move |_| {
            let _ = held.recv();
            Ok(None)
        })
        .unwrap();
        for hash in 0..10_000 {
            fetcher.ask(0, hash);
        }
        assert!(fetcher.waiting.len() <= MAX_WAITING + 1, "{}", fetcher.waiting.len());
    }
}
