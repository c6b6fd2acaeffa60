//! Identity of a tracked person.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Identifies a person within a session and on the wire; the first person is 0. An id is never given to another person
/// while the session lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PersonId(pub u32);

impl fmt::Display for PersonId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
