//! Roles of holders.

use serde::{Deserialize, Serialize};

/// Role of a key's holder: its rights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Watches: receives people, views, statistics and calibration, and may have a viewpoint of its own. Publishes nothing.
    Viewer,
    /// Sends images of cameras. Receives nothing but questions for its clock.
    Cameras,
    /// Watches as a viewer does, and may pass people on to viewers of its own.
    Relay,
}

impl Role {
    /// Every role.
    pub const ALL: [Self; 3] = [Self::Viewer, Self::Cameras, Self::Relay];

    /// Returns the role's name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Viewer => "viewer",
            Self::Cameras => "cameras",
            Self::Relay => "relay",
        }
    }
}
