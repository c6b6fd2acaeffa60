//! Identity of a computer with cameras, which its frames and its clock share.

use crate::{host, keys};

/// Identity of a computer with cameras.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum HostId {
    /// Program without a key: the publisher that its messages state.
    Program(u64),
    /// Session of a key's holder: its name in topics, of which zenoh lets no other holder make use.
    Holder(String),
}

impl HostId {
    /// Returns the identity of the computer with this name in topics.
    pub fn named(name: &str) -> Self {
        match keys::holder_in(name) {
            Some(_) => Self::Holder(name.to_owned()),
            None => Self::Program(host::fnv1a(name.as_bytes())),
        }
    }

    /// Returns the holder's part of the name, which all sessions of a key share; `None` without a key.
    pub fn holder(&self) -> Option<&str> {
        match self {
            Self::Program(_) => None,
            Self::Holder(name) => keys::holder_in(name),
        }
    }
}
