//! Holders of keys.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use crate::role::Role;

/// Largest number of holders of a ring at a time.
pub const MAX_HOLDERS: usize = 256;

/// Largest number of cameras of a key.
pub(crate) const MAX_CAMERAS: usize = 32;

/// Returns whether a key for these cameras may send `camera`; one that names none may send every camera.
pub(crate) fn covers(cameras: &[String], camera: &str) -> bool {
    cameras.is_empty() || cameras.iter().any(|name| name == camera)
}

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
    /// Cameras that a key of role [`Role::Cameras`] may send; every camera where none is named, as in older keys.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
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
