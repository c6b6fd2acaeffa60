//! All people of a stream.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use flyrig_stream::{StreamError, StreamTemplate, stamp_of};

use crate::person::StreamPerson;

/// Largest number of people; one more replaces the person of the lowest number.
pub const MAX_PEOPLE: usize = 32;
/// Largest number of messages that wait for their template.
const MAX_WAITING: usize = 64;
/// Time for which a person with a new template is shown as before, until the new colours have arrived, seconds.
const PATIENCE_SECS: f64 = 2.0;

/// Outcome of ingesting a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ingested {
    /// The message was applied to its person.
    Applied,
    /// The message waits for the template of this hash; [`People::set_template`] applies it.
    Needs(u64),
}

/// Message whose template is on its way.
#[derive(Debug, Clone)]
struct Waiting {
    person: u32,
    is_motion: bool,
    bytes: Vec<u8>,
    arrived: f64,
}

/// Person with a new template, before it replaces the one of the same number.
#[derive(Debug)]
struct Successor {
    person: StreamPerson,
    /// Arrival of its first message, seconds of the viewer's clock.
    since: Option<f64>,
}

/// People by their number, and messages that wait for templates.
#[derive(Debug, Default)]
pub struct People {
    by_number: BTreeMap<u32, StreamPerson>,
    successors: BTreeMap<u32, Successor>,
    waiting: VecDeque<Waiting>,
}

impl People {
    /// Ingests a motion or a message of colours that arrived at `now`, seconds of the viewer's clock.
    ///
    /// # Errors
    /// [`StreamError`] for damaged bytes.
    pub fn ingest(&mut self, person: u32, is_motion: bool, bytes: &[u8], now: f64) -> Result<Ingested, StreamError> {
        match self.apply(person, is_motion, bytes, now) {
            Ok(()) => {
                self.promote(person, now);
                Ok(Ingested::Applied)
            }
            Err(StreamError::OtherTemplate { .. }) => {
                let template = stamp_of(bytes)?.template;
                self.waiting.push_back(Waiting { person, is_motion, bytes: bytes.to_vec(), arrived: now });
                while self.waiting.len() > MAX_WAITING {
                    self.waiting.pop_front();
                }
                Ok(Ingested::Needs(template))
            }
            Err(error) => Err(error),
        }
    }

    /// Applies a message to the person that is shown, or to its successor. Late messages of the former template are no return to it.
    fn apply(&mut self, person: u32, is_motion: bool, bytes: &[u8], now: f64) -> Result<(), StreamError> {
        let Some(shown) = self.by_number.get_mut(&person) else {
            return Err(StreamError::OtherTemplate { what: "message" });
        };
        let result = ingest(shown, is_motion, bytes, now);
        if !matches!(result, Err(StreamError::OtherTemplate { .. })) {
            return result;
        }
        if is_motion {
            // The person is there, though not with this template.
            shown.hold(now);
        }
        let Some(successor) = self.successors.get_mut(&person) else { return result };
        ingest(&mut successor.person, is_motion, bytes, now)?;
        successor.since.get_or_insert(now);
        Ok(())
    }

    /// Lets a successor replace the person once it moves with colours, nobody is shown, or the colours are too late.
    fn promote(&mut self, person: u32, now: f64) {
        let Some(Successor { person: new, since: Some(since) }) = self.successors.get(&person) else { return };
        let is_shown = self.by_number.get(&person).is_some_and(|shown| shown.motion_at(now, false).is_some());
        if new.is_moving() && (new.is_painted() || !is_shown || now - since > PATIENCE_SECS) {
            self.by_number.extend(self.successors.remove(&person).map(|successor| (person, successor.person)));
        }
    }

    /// Sets the template of a person, and applies the messages that waited for it. A person who is shown with colours is replaced once
    /// motion and the coarsest colours of the new template have arrived, or two seconds after its first motion.
    pub fn set_template(&mut self, person: u32, template: Arc<StreamTemplate>) {
        if self.by_number.len() >= MAX_PEOPLE && !self.by_number.contains_key(&person) {
            self.by_number.pop_first();
        }
        let hash = template.hash;
        let new = StreamPerson::new(template);
        match self.by_number.get(&person).filter(|shown| shown.is_moving() && shown.is_painted()) {
            // Sent once more.
            Some(shown) if shown.template().hash == hash => drop(self.successors.remove(&person)),
            Some(_) => drop(self.successors.insert(person, Successor { person: new, since: None })),
            None => drop(self.by_number.insert(person, new)),
        }
        self.successors.retain(|number, _| self.by_number.contains_key(number));
        let (ours, others) = std::mem::take(&mut self.waiting).into_iter().partition(|waiting| {
            waiting.person == person && stamp_of(&waiting.bytes).is_ok_and(|stamp| stamp.template == hash)
        });
        self.waiting = others;
        let ours: VecDeque<Waiting> = ours;
        let last = ours.back().map(|waiting| waiting.arrived);
        for waiting in ours {
            // A damaged message counts as lost.
            drop(self.apply(person, waiting.is_motion, &waiting.bytes, waiting.arrived));
        }
        if let (Some(last), Some(successor)) = (last, self.successors.get_mut(&person)) {
            // What waited came before the template.
            successor.since = Some(last);
            self.promote(person, last);
        }
    }

    /// Forgets all people.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Returns whether no template has arrived.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.by_number.is_empty()
    }

    /// Returns a person by number.
    #[must_use]
    pub fn get(&self, number: u32) -> Option<&StreamPerson> {
        self.by_number.get(&number)
    }

    /// Returns a person by number.
    pub fn get_mut(&mut self, number: u32) -> Option<&mut StreamPerson> {
        self.by_number.get_mut(&number)
    }

    /// Iterates over the people by increasing number.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &StreamPerson)> {
        self.by_number.iter().map(|(&number, person)| (number, person))
    }
}

fn ingest(person: &mut StreamPerson, is_motion: bool, bytes: &[u8], now: f64) -> Result<(), StreamError> {
    if is_motion { person.ingest_motion(bytes, now) } else { person.ingest_colors(bytes).map(drop) }
}

#[cfg(test)]
mod tests {
    use flyrig_stream::{
        ColorEncoder, ColorSettings, EncodedTemplate, Motion, MotionEncoder, Posed, Stamp, StreamJoint, TemplateSource,
    };

    use super::*;

    /// Creates a person of a few Gaussians on one joint; each `size` has its own template.
    fn person(size: f32) -> EncodedTemplate {
        let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let joints = [StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }];
        let center_scale: Vec<[f32; 4]> = (0..40).map(|i| [size * i as f32 / 40.0, size, 0.0, 0.01]).collect();
        let skin = vec![([0; 4], [1.0, 0.0, 0.0, 0.0]); 40];
        let normals = vec![[0.0, 0.0, 1.0]; 40];
        let (center_scale, normals, skin) = (&center_scale, &normals, &skin);
        let source = TemplateSource { joints: &joints, center_scale, normals, skin, node_weights: &[], nodes: &[] };
        source.encode().unwrap()
    }

    fn motion(template: &EncodedTemplate, frame: u64, x: f32) -> Vec<u8> {
        let stamp = Stamp { frame, capture_nanos: 100_000_000 * frame as i64, ..Stamp::default() };
        let joint_rotations = vec![[0.0, 0.0, 0.0, 1.0]];
        let motion = Motion { stamp, root_translation: [x, 0.0, 0.0], joint_rotations, nodes: Vec::new() };
        MotionEncoder::new(template).encode(&motion).unwrap()
    }

    #[test]
    fn what_comes_before_the_template_is_applied_with_it() {
        let (template, other) = (person(1.0), person(2.0));
        let hash = template.template.hash;
        let mut encoder = ColorEncoder::new(&template, ColorSettings::default(), 7);
        let colors = encoder.encode(Stamp::default(), &[[0.5, 0.2, 0.1, 1.0]; 40]);
        let mut people = People::default();
        for layer in &colors {
            assert_eq!(people.ingest(3, false, layer, 0.0), Ok(Ingested::Needs(hash)));
        }
        assert_eq!(people.ingest(3, true, &motion(&template, 1, 0.25), 0.0), Ok(Ingested::Needs(hash)));
        assert!(people.is_empty() && people.get(3).is_none());
        // Somebody else's template changes nothing for this one.
        people.set_template(4, Arc::new(other.template.clone()));
        assert!(people.get(4).unwrap().motion_at(0.1, false).is_none());
        people.set_template(3, Arc::new(template.template.clone()));
        let shown = people.get(3).unwrap();
        assert!(shown.is_complete() && shown.color_changes() == colors.len() as u64);
        let found = shown.motion_at(0.1, false).unwrap();
        assert!((found.root_translation[0] - 0.25).abs() < 1e-3);
        let (mut posed, person) = (Posed::default(), people.get_mut(3).unwrap());
        let colors = person.pose(&found, &mut posed);
        assert!(colors.iter().all(|c| (c[0] - 0.5).abs() < 0.05 && (c[2] - 0.1).abs() < 0.05), "{:?}", colors[0]);
        // The rig takes another template for the same person, who is shown as before until its colours have arrived.
        let (before, hash) = (hash, other.template.hash);
        assert_eq!(people.ingest(3, true, &motion(&other, 2, 0.0), 0.2), Ok(Ingested::Needs(hash)));
        people.set_template(3, Arc::new(other.template.clone()));
        let shown = |people: &People| people.get(3).unwrap().motion_at(0.2, false).unwrap().stamp.template;
        assert_eq!(shown(&people), before);
        assert_eq!(people.ingest(3, true, &motion(&other, 3, 0.0), 0.3), Ok(Ingested::Applied));
        assert_eq!(shown(&people), before);
        let colors = ColorEncoder::new(&other, ColorSettings::default(), 7).encode(Stamp::default(), &[[0.1; 4]; 40]);
        assert_eq!(people.ingest(3, false, &colors[0], 0.3), Ok(Ingested::Applied));
        assert_eq!(shown(&people), hash);
        assert_eq!(people.ingest(3, true, &motion(&other, 4, 0.0), 0.4), Ok(Ingested::Applied));
        // Damaged bytes are an error and keep what is there.
        people.ingest(3, true, b"FLM", 0.3).unwrap_err();
        people.ingest(9, false, &[], 0.3).unwrap_err();
        assert!(people.get(3).unwrap().motion_at(0.3, false).is_some());
    }

    #[test]
    fn motion_is_interpolated_and_ends() {
        let template = person(1.0);
        let mut people = People::default();
        people.set_template(0, Arc::new(template.template.clone()));
        // A frame each 100 ms, 1 m/s; the rig's clock is 5 s behind the viewer's, and every other message is 30 ms late.
        for frame in 1..=10u64 {
            let late = 0.03 * (frame % 2) as f64;
            let message = motion(&template, frame, 0.1 * frame as f32);
            assert_eq!(people.ingest(0, true, &message, 5.0 + 0.1 * frame as f64 + late), Ok(Ingested::Applied));
        }
        let place = |now: f64| people.get(0).unwrap().motion_at(now, true).map(|motion| motion.root_translation[0]);
        for now in [5.7, 5.78, 5.91] {
            let (found, expected) = (place(now).unwrap(), (now - 5.0 - 0.15) as f32);
            assert!((found - expected).abs() < 2e-3, "{now}: {found}, {expected}");
        }
        // Held while nothing comes, then gone.
        assert!((place(7.0).unwrap() - 1.0).abs() < 1e-3);
        assert_eq!(place(9.5), None);
        // A late or repeated frame is left out; a rig that began anew is followed.
        assert_eq!(people.ingest(0, true, &motion(&template, 4, 9.0), 6.1), Ok(Ingested::Applied));
        assert!(people.get(0).unwrap().motion_at(6.1, false).unwrap().root_translation[0] < 1.01);
        assert_eq!(people.ingest(0, true, &motion(&template, 400, 9.0), 6.2), Ok(Ingested::Applied));
        assert!((people.get(0).unwrap().motion_at(6.2, true).unwrap().root_translation[0] - 9.0).abs() < 1e-3);
    }

    #[test]
    fn a_new_template_is_shown_without_its_colors_after_a_while_and_one_that_comes_back_at_once() {
        let (first, second) = (person(1.0), person(2.0));
        let mut people = People::default();
        people.set_template(0, Arc::new(first.template.clone()));
        let colors = ColorEncoder::new(&first, ColorSettings::default(), 7).encode(Stamp::default(), &[[0.1; 4]; 40]);
        let ingest = |people: &mut People, of: &EncodedTemplate, frame: u64, now: f64| {
            people.ingest(0, true, &motion(of, frame, 0.0), now).unwrap();
            people.get(0).unwrap().motion_at(now, false).map(|motion| motion.stamp.template)
        };
        let [a, b] = [&first, &second].map(|of| Some(of.template.hash));
        assert_eq!(ingest(&mut people, &first, 1, 0.0), a);
        // A person without colours is replaced at once.
        people.set_template(0, Arc::new(second.template.clone()));
        assert_eq!(ingest(&mut people, &second, 2, 0.1), b);
        people.set_template(0, Arc::new(first.template.clone()));
        assert_eq!(ingest(&mut people, &first, 3, 0.2), a);
        people.ingest(0, false, &colors[0], 0.2).unwrap();
        // Colours do not come.
        people.set_template(0, Arc::new(second.template.clone()));
        assert_eq!(ingest(&mut people, &second, 4, 0.3), a);
        assert_eq!(ingest(&mut people, &second, 5, 2.2), a);
        assert_eq!(ingest(&mut people, &second, 6, 2.4), b);
        // Late messages of the template before keep neither it nor the new one from being shown.
        people.set_template(0, Arc::new(first.template.clone()));
        people.ingest(0, true, &motion(&first, 7, 0.0), 2.5).unwrap();
        people.ingest(0, false, &colors[0], 2.5).unwrap();
        people.set_template(0, Arc::new(second.template.clone()));
        assert_eq!(ingest(&mut people, &second, 8, 2.6), a);
        assert_eq!(people.ingest(0, false, &colors[1], 2.6), Ok(Ingested::Applied));
        assert_eq!(ingest(&mut people, &first, 8, 2.6), a);
        let new = ColorEncoder::new(&second, ColorSettings::default(), 8).encode(Stamp::default(), &[[0.1; 4]; 40]);
        people.ingest(0, false, &new[0], 2.7).unwrap();
        assert_eq!(ingest(&mut people, &second, 9, 2.7), b);
        assert!(people.successors.is_empty());
        // The same template once more changes nothing.
        people.set_template(0, Arc::new(second.template.clone()));
        assert_eq!(ingest(&mut people, &second, 10, 2.8), b);
        assert!(people.successors.is_empty() && people.get(0).unwrap().is_painted());
    }

    #[test]
    fn a_person_stands_still_while_a_template_is_fetched_and_one_who_is_gone_keeps_nobody_waiting() {
        let (first, second) = (person(1.0), person(2.0));
        let mut people = People::default();
        people.set_template(0, Arc::new(first.template.clone()));
        let colors = ColorEncoder::new(&first, ColorSettings::default(), 7).encode(Stamp::default(), &[[0.1; 4]; 40]);
        people.ingest(0, true, &motion(&first, 1, 0.0), 0.0).unwrap();
        people.ingest(0, false, &colors[0], 0.0).unwrap();
        let shown = |people: &People, now: f64| {
            people.get(0).unwrap().motion_at(now, false).map(|motion| motion.stamp.template)
        };
        let [a, b] = [&first, &second].map(|of| Some(of.template.hash));
        // A slow line: the template takes eight seconds.
        for tenth in 1..80 {
            let now = 0.1 * f64::from(tenth);
            assert!(matches!(
                people.ingest(0, true, &motion(&second, 1 + tenth as u64, 0.0), now),
                Ok(Ingested::Needs(_))
            ));
            assert_eq!(shown(&people, now), a, "{now}");
        }
        people.set_template(0, Arc::new(second.template.clone()));
        assert_eq!(shown(&people, 8.0), a, "what waited is no reason to show it without colours");
        people.ingest(0, true, &motion(&second, 90, 0.0), 8.1).unwrap();
        assert_eq!(shown(&people, 8.1), a);
        // Not for ever.
        people.ingest(0, true, &motion(&person(3.0), 91, 0.0), 40.0).unwrap();
        assert_eq!(shown(&people, 50.0), None);

        // Somebody who has left comes back with another template.
        people.set_template(0, Arc::new(second.template.clone()));
        people.ingest(0, true, &motion(&second, 600, 0.0), 60.0).unwrap();
        assert_eq!(shown(&people, 60.0), b);
    }

    #[test]
    fn endless_people_and_messages_are_bounded() {
        let (template, other) = (Arc::new(person(1.0).template), person(2.0));
        let mut people = People::default();
        for number in 0..100 {
            people.set_template(number, Arc::clone(&template));
            let message = motion(&other, u64::from(number), 0.0);
            assert!(matches!(people.ingest(number, true, &message, 0.0), Ok(Ingested::Needs(_))));
        }
        assert_eq!(people.iter().count(), MAX_PEOPLE);
        assert_eq!(people.waiting.len(), MAX_WAITING);
        people.clear();
        assert!(people.is_empty() && people.waiting.is_empty());
    }
}
