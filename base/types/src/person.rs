//! Identity of a tracked person.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Number of a person within a session and on the wire; the first person is 0. No number is given to a second person in a
/// session.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PersonId(pub u32);

impl fmt::Display for PersonId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
