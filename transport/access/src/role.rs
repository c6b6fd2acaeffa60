//! Roles of holders.

use serde::{Deserialize, Serialize};

/// Role of a key's holder, which determines its rights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Viewer: receives people, views, statistics and calibration, and may have a viewpoint of its own. It publishes nothing.
    Viewer,
    /// Computer with cameras: sends images of the cameras that its key names. It receives nothing but queries of its own clock.
    Cameras,
    /// Relay: receives like a viewer, and may pass people on to viewers of its own.
    Relay,
}

impl Role {
    /// All roles.
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
