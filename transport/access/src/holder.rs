//! Holders of keys.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use crate::role::Role;

/// Largest number of holders of a ring at a time.
pub const MAX_HOLDERS: usize = 256;

/// Holder of a key, as the ring lists it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Holder {
    /// Name of the holder.
    pub name: String,
    /// Role of the holder.
    pub role: Role,
    /// Number among the holders, 0..[`MAX_HOLDERS`].
    pub number: usize,
    /// Time after which the key is refused, RFC 3339.
    pub expires: String,
    /// SHA-256 of the certificate, hexadecimal.
    pub fingerprint: String,
    /// Whether the key is revoked.
    #[serde(default)]
    pub revoked: bool,
}

impl Holder {
    /// Returns the time after which the key is refused; one that cannot be read is in the past.
    #[must_use]
    pub fn expires_at(&self) -> SystemTime {
        humantime::parse_rfc3339(&self.expires).unwrap_or(UNIX_EPOCH)
    }
}
