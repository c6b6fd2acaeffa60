//! Fan-out of messages to browsers: the newest of each kind, and a bounded queue per browser.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, Mutex, MutexGuard},
};

use flyrig_types::lock;

use bytes::{BufMut as _, Bytes, BytesMut};
use tokio::sync::Notify;

/// Largest number of waiting bytes of changes of colours per browser; beyond it they are dropped, and the browser gets the present colours
/// once there is room.
const COLOR_BYTES: usize = 256 << 10;
/// Largest number of people whose messages are kept.
const MAX_PEOPLE: usize = 32;

/// Kind of a message, its first byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Cameras of the rig, JSON.
    Rig = 0,
    /// Template of a person.
    Template = 1,
    /// Motion of a person.
    Motion = 2,
    /// Layer of a person's colours.
    Colors = 3,
    /// Status of the rig, JSON.
    State = 4,
    /// The rig restarted: the browser forgets all people.
    Forget = 5,
}

/// Assembles a message.
fn message(kind: Kind, person: u32, payload: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(8 + payload.len());
    bytes.put_slice(&[kind as u8, 0, 0, 0]);
    bytes.put_u32_le(person);
    bytes.put_slice(payload);
    bytes.freeze()
}

/// Last messages, and all browsers.
#[derive(Debug, Default)]
pub(crate) struct Hub(Mutex<Inner>);

#[derive(Debug, Default)]
struct Inner {
    rig: Option<Bytes>,
    /// Hash and message of each person's template.
    templates: BTreeMap<u32, (u64, Bytes)>,
    motions: BTreeMap<u32, Bytes>,
    state: Option<Bytes>,
    browsers: BTreeMap<u64, Browser>,
    next: u64,
}

/// Messages that one browser has yet to receive.
#[derive(Debug, Default)]
struct Browser {
    wake: Arc<Notify>,
    forget: Option<Bytes>,
    rig: Option<Bytes>,
    templates: BTreeMap<u32, Bytes>,
    motions: BTreeMap<u32, Bytes>,
    /// Present colours of people, which go before changes.
    whole: VecDeque<Bytes>,
    colors: VecDeque<Bytes>,
    color_bytes: usize,
    /// Whether the present colours are missing.
    wants_whole: bool,
    state: Option<Bytes>,
}

impl Browser {
    /// Takes the next message: those that others depend on first, motion before colours.
    fn take(&mut self) -> Option<Bytes> {
        let first = |map: &mut BTreeMap<u32, Bytes>| map.pop_first().map(|(_, bytes)| bytes);
        let next = self.forget.take().or_else(|| self.rig.take()).or_else(|| first(&mut self.templates));
        let next = next.or_else(|| first(&mut self.motions)).or_else(|| self.state.take());
        next.or_else(|| self.whole.pop_front()).or_else(|| {
            let colors = self.colors.pop_front()?;
            self.color_bytes -= colors.len();
            Some(colors)
        })
    }

    /// Forgets what waits of a person, who gets another template.
    fn forget(&mut self, person: u32) {
        let is_other = |message: &Bytes| message.get(4..8) != Some(person.to_le_bytes().as_slice());
        self.motions.remove(&person);
        self.whole.retain(is_other);
        self.colors.retain(is_other);
        self.color_bytes = self.colors.iter().map(Bytes::len).sum();
    }

    fn push_colors(&mut self, colors: Bytes) {
        if self.color_bytes + colors.len() > COLOR_BYTES && !self.colors.is_empty() {
            // Too slow for changes: the present state replaces them.
            self.colors.clear();
            self.color_bytes = 0;
            self.wants_whole = true;
        }
        self.color_bytes += colors.len();
        self.colors.push_back(colors);
    }

    /// Returns whether the present colours are missing and there is room for them.
    fn is_ready_for_whole(&self) -> bool {
        self.wants_whole && self.whole.is_empty() && self.templates.is_empty()
    }
}

impl Hub {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        lock(&self.0)
    }

    /// Returns the number of browsers.
    pub fn browsers(&self) -> usize {
        self.lock().browsers.len()
    }

    /// Adds a browser, which first receives the last messages; `None` when there are `most` browsers already.
    pub fn join(self: &Arc<Self>, most: usize) -> Option<BrowserPlace> {
        let mut inner = self.lock();
        if inner.browsers.len() >= most {
            return None;
        }
        let number = inner.next;
        inner.next += 1;
        let wake = Arc::<Notify>::default();
        let browser = Browser {
            wake: Arc::clone(&wake),
            rig: inner.rig.clone(),
            templates: inner.templates.iter().map(|(person, (_, bytes))| (*person, bytes.clone())).collect(),
            motions: inner.motions.clone(),
            state: inner.state.clone(),
            wants_whole: true,
            ..Browser::default()
        };
        wake.notify_one();
        inner.browsers.insert(number, browser);
        Some(BrowserPlace { hub: Arc::clone(self), number, wake })
    }

    /// Puts a message into the queues of all browsers.
    fn to_all(inner: &mut Inner, put: impl Fn(&mut Browser)) {
        for browser in inner.browsers.values_mut() {
            put(browser);
            browser.wake.notify_one();
        }
    }

    /// Sends the rig's cameras.
    pub fn rig(&self, json: &[u8]) {
        let bytes = message(Kind::Rig, 0, json);
        let mut inner = self.lock();
        if inner.rig.as_ref() != Some(&bytes) {
            inner.rig = Some(bytes.clone());
            Self::to_all(&mut inner, |browser| browser.rig = Some(bytes.clone()));
        }
    }

    /// Returns whether this is the template of a person.
    pub fn has_template(&self, person: u32, hash: u64) -> bool {
        self.lock().templates.get(&person).is_some_and(|(known, _)| *known == hash)
    }

    /// Sends the template of a person; new people beyond [`MAX_PEOPLE`] are ignored.
    pub fn template(&self, person: u32, hash: u64, payload: &[u8]) {
        let bytes = message(Kind::Template, person, payload);
        let mut inner = self.lock();
        if inner.templates.len() < MAX_PEOPLE || inner.templates.contains_key(&person) {
            let before = inner.templates.insert(person, (hash, bytes.clone()));
            inner.motions.remove(&person);
            let is_another = before.is_some_and(|(before, _)| before != hash);
            Self::to_all(&mut inner, |browser| {
                if is_another {
                    browser.forget(person);
                }
                browser.templates.insert(person, bytes.clone());
            });
        }
    }

    /// Sends the motion of a person, which replaces a waiting one.
    pub fn motion(&self, person: u32, payload: &[u8]) {
        let bytes = message(Kind::Motion, person, payload);
        let mut inner = self.lock();
        if inner.templates.contains_key(&person) {
            inner.motions.insert(person, bytes.clone());
            Self::to_all(&mut inner, |browser| drop(browser.motions.insert(person, bytes.clone())));
        }
    }

    /// Sends a layer of a person's colours.
    pub fn colors(&self, person: u32, payload: &[u8]) {
        let bytes = message(Kind::Colors, person, payload);
        Self::to_all(&mut self.lock(), |browser| browser.push_colors(bytes.clone()));
    }

    /// Returns whether a browser lacks the present colours and has room for them.
    pub fn wants_whole(&self) -> bool {
        self.lock().browsers.values().any(Browser::is_ready_for_whole)
    }

    /// Sends the present colours of all people to the browsers that lack them.
    pub fn whole(&self, people: &[(u32, Vec<Vec<u8>>)]) {
        let of_person = |(person, messages): &(u32, Vec<Vec<u8>>)| {
            messages.iter().map(|payload| message(Kind::Colors, *person, payload)).collect::<Vec<_>>()
        };
        let messages: Vec<Bytes> = people.iter().flat_map(of_person).collect();
        let mut inner = self.lock();
        for browser in inner.browsers.values_mut().filter(|browser| browser.is_ready_for_whole()) {
            // The changes so far are part of the state.
            browser.colors.clear();
            (browser.color_bytes, browser.wants_whole) = (0, false);
            browser.whole.extend(messages.iter().cloned());
            browser.wake.notify_one();
        }
    }

    /// Sends the status of the rig.
    pub fn state(&self, json: &[u8]) {
        let bytes = message(Kind::State, 0, json);
        let mut inner = self.lock();
        if inner.state.as_ref() != Some(&bytes) {
            inner.state = Some(bytes.clone());
            Self::to_all(&mut inner, |browser| browser.state = Some(bytes.clone()));
        }
    }

    /// Forgets all people, because the rig restarted.
    pub fn forget_people(&self) {
        let bytes = message(Kind::Forget, 0, &[]);
        let mut inner = self.lock();
        inner.templates.clear();
        inner.motions.clear();
        Self::to_all(&mut inner, |browser| {
            let (wake, rig, state) = (Arc::clone(&browser.wake), browser.rig.take(), browser.state.take());
            *browser = Browser { wake, rig, state, forget: Some(bytes.clone()), ..Browser::default() };
        });
    }
}

/// Place of a browser, which is removed when it is dropped.
#[derive(Debug)]
pub(crate) struct BrowserPlace {
    hub: Arc<Hub>,
    number: u64,
    wake: Arc<Notify>,
}

impl BrowserPlace {
    /// Waits for the next message of this browser.
    pub async fn next(&self) -> Bytes {
        loop {
            if let Some(bytes) = self.hub.lock().browsers.get_mut(&self.number).and_then(Browser::take) {
                return bytes;
            }
            self.wake.notified().await;
        }
    }
}

impl Drop for BrowserPlace {
    fn drop(&mut self) {
        self.hub.lock().browsers.remove(&self.number);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Takes all messages that wait for a browser.
    fn drain(place: &BrowserPlace) -> Vec<(u8, u32, Vec<u8>)> {
        let mut inner = place.hub.lock();
        let browser = inner.browsers.get_mut(&place.number).unwrap();
        let part = |bytes: Bytes| (bytes[0], u32::from_le_bytes(bytes[4..8].try_into().unwrap()), bytes[8..].to_vec());
        std::iter::from_fn(|| browser.take()).map(part).collect()
    }

    #[test]
    fn a_slow_browser_gets_the_newest_and_what_it_depends_on_first() {
        let hub = Arc::<Hub>::default();
        let place = hub.join(1).unwrap();
        assert!(hub.join(1).is_none());
        hub.motion(3, b"nobody knows this person yet");
        hub.colors(3, b"c1");
        hub.state(b"s1");
        hub.template(3, 7, b"t");
        assert!(hub.has_template(3, 7) && !hub.has_template(3, 8) && !hub.has_template(4, 7));
        for motion in [b"m1", b"m2", b"m3"] {
            hub.motion(3, motion);
        }
        hub.rig(b"r");
        hub.rig(b"r");
        hub.colors(3, b"c2");
        let text = |bytes: &[u8]| bytes.to_vec();
        let expected = [
            (0, 0, text(b"r")),
            (1, 3, text(b"t")),
            (2, 3, text(b"m3")),
            (4, 0, text(b"s1")),
            (3, 3, text(b"c1")),
            (3, 3, text(b"c2")),
        ];
        assert_eq!(drain(&place), expected);
        assert!(drain(&place).is_empty());
        drop(place);
        // A later browser starts with the messages that are not repeated, and with the present colours once.
        let late = hub.join(1).unwrap();
        hub.colors(3, b"part of the whole");
        assert!(!hub.wants_whole(), "the template comes first");
        assert_eq!(drain(&late)[..4], expected[..4]);
        assert!(hub.wants_whole());
        hub.colors(3, b"part of the whole as well");
        hub.whole(&[(3, vec![b"w0".to_vec(), b"w1".to_vec()])]);
        hub.colors(3, b"c3");
        assert!(!hub.wants_whole());
        assert_eq!(drain(&late), [(3, 3, text(b"w0")), (3, 3, text(b"w1")), (3, 3, text(b"c3"))]);
        // Of a template before nothing is sent after the new one.
        hub.motion(3, b"m4");
        hub.colors(3, b"c4");
        hub.colors(5, b"of somebody else");
        hub.template(3, 8, b"t2");
        hub.colors(3, b"c5");
        assert_eq!(drain(&late), [(1, 3, text(b"t2")), (3, 5, text(b"of somebody else")), (3, 3, text(b"c5"))]);
        hub.motion(3, b"m5");
        hub.forget_people();
        assert_eq!(drain(&late), [(5, 0, Vec::new())]);
        assert_eq!(hub.browsers(), 1);
    }

    #[test]
    fn what_waits_is_bounded() {
        let hub = Arc::<Hub>::default();
        let place = hub.join(9).unwrap();
        let layer = vec![1u8; 60_000];
        for _ in 0..100 {
            hub.colors(0, &layer);
        }
        for person in 0..100 {
            hub.template(person, 1, b"t");
            hub.motion(person, b"m");
        }
        let waiting = drain(&place);
        let count = |kind: u8| waiting.iter().filter(|(of, ..)| *of == kind).count();
        assert_eq!((count(1), count(2)), (MAX_PEOPLE, MAX_PEOPLE));
        assert!(count(3) * layer.len() <= COLOR_BYTES && count(3) > 0, "{}", count(3));
        // The lost colours are replaced by the present ones, once.
        assert!(hub.wants_whole());
        hub.whole(&[(0, vec![layer.clone()])]);
        hub.whole(&[(0, vec![layer.clone()])]);
        assert_eq!(drain(&place).len(), 1);
        // One message beyond the bound still comes.
        hub.colors(0, &vec![1u8; 2 * COLOR_BYTES]);
        assert_eq!(drain(&place).len(), 1);
    }
}
