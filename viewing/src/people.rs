//! Everybody of a stream.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use flyrig_stream::{StreamError, Template, stamp_of};

use crate::StreamPerson;

/// Most people that are kept; one more replaces the person of the lowest number.
pub const MAX_PEOPLE: usize = 32;
/// Messages that wait for their template.
const MAX_WAITING: usize = 64;

/// What became of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// It changed its person.
    Applied,
    /// It waits for the template of this hash; [`People::meet`] applies it.
    Needs(u64),
}

/// A message whose template is on its way.
#[derive(Debug, Clone)]
struct Waiting {
    person: u32,
    is_motion: bool,
    bytes: Vec<u8>,
    arrived: f64,
}

/// People by their number.
#[derive(Debug, Default)]
pub struct People {
    by_number: BTreeMap<u32, StreamPerson>,
    waiting: VecDeque<Waiting>,
}

impl People {
    /// Takes in a motion or a message of colours that came at `now`, seconds of the viewer's clock.
    ///
    /// # Errors
    /// [`StreamError`] for damaged bytes.
    pub fn take(&mut self, person: u32, is_motion: bool, bytes: &[u8], now: f64) -> Result<Taken, StreamError> {
        match self.apply(person, is_motion, bytes, now) {
            Ok(()) => Ok(Taken::Applied),
            Err(StreamError::OtherTemplate { .. }) => {
                let template = stamp_of(bytes)?.template;
                self.waiting.push_back(Waiting { person, is_motion, bytes: bytes.to_vec(), arrived: now });
                while self.waiting.len() > MAX_WAITING {
                    self.waiting.pop_front();
                }
                Ok(Taken::Needs(template))
            }
            Err(error) => Err(error),
        }
    }

    fn apply(&mut self, person: u32, is_motion: bool, bytes: &[u8], now: f64) -> Result<(), StreamError> {
        let Some(person) = self.by_number.get_mut(&person) else {
            return Err(StreamError::OtherTemplate { what: "message" });
        };
        if is_motion { person.take_motion(bytes, now) } else { person.take_colors(bytes).map(drop) }
    }

    /// Gives a person a template, and applies the messages that waited for it.
    pub fn meet(&mut self, person: u32, template: Arc<Template>) {
        if self.by_number.len() >= MAX_PEOPLE && !self.by_number.contains_key(&person) {
            self.by_number.pop_first();
        }
        let hash = template.hash;
        self.by_number.insert(person, StreamPerson::new(template));
        let (ours, others) = std::mem::take(&mut self.waiting).into_iter().partition(|waiting| {
            waiting.person == person && stamp_of(&waiting.bytes).is_ok_and(|stamp| stamp.template == hash)
        });
        self.waiting = others;
        let ours: VecDeque<Waiting> = ours;
        for waiting in ours {
            // A damaged message is one that did not come.
            drop(self.apply(person, waiting.is_motion, &waiting.bytes, waiting.arrived));
        }
    }

    /// Forgets everybody.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Whether nobody's template has come.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.by_number.is_empty()
    }

    /// A person.
    #[must_use]
    pub fn get(&self, number: u32) -> Option<&StreamPerson> {
        self.by_number.get(&number)
    }

    /// A person.
    pub fn get_mut(&mut self, number: u32) -> Option<&mut StreamPerson> {
        self.by_number.get_mut(&number)
    }

    /// People by growing number.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &StreamPerson)> {
        self.by_number.iter().map(|(&number, person)| (number, person))
    }
}
