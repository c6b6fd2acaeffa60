//! Camera names, which survive reconnects and files.

use std::{fmt, sync::Arc};

use serde::{Deserialize, Serialize};

/// Name of a camera: a folder name, a USB serial or a bus path, never a device index.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub struct CameraId(Arc<str>);

impl CameraId {
    /// Returns the name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl From<&str> for CameraId {
    fn from(name: &str) -> Self {
        Self(name.into())
    }
}

impl From<String> for CameraId {
    fn from(name: String) -> Self {
        Self(name.into())
    }
}

impl From<CameraId> for String {
    fn from(id: CameraId) -> Self {
        id.0.as_ref().to_owned()
    }
}

impl fmt::Display for CameraId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Pads, so that tables have columns.
        f.pad(&self.0)
    }
}

impl fmt::Debug for CameraId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CameraId({})", self.0)
    }
}
