//! Holders of keys.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use crate::role::Role;

/// Largest number of holders of a ring at a time.
pub const MAX_HOLDERS: usize = 256;

/// Holder of a key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Holder {
    /// Its name.
    pub name: String,
    /// Role: the rights of the holder.
    pub role: Role,
    /// Its number among the holders, 0..[`MAX_HOLDERS`].
    pub number: usize,
    /// Time after which it is refused, RFC 3339.
    pub expires: String,
    /// SHA-256 of its certificate, hexadecimal.
    pub fingerprint: String,
    /// Whether it is refused.
    #[serde(default)]
    pub revoked: bool,
}

impl Holder {
    /// Returns the time after which it is refused; a time that cannot be read is in the past.
    #[must_use]
    pub fn expires_at(&self) -> SystemTime {
        humantime::parse_rfc3339(&self.expires).unwrap_or(UNIX_EPOCH)
    }
}
