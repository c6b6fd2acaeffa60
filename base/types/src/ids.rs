//! Camera names, which survive reconnects and files.

use std::{fmt, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::{printable::is_obeyed, shortened};

/// Longest name of a camera, characters.
const MAX_NAME: usize = 64;

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

    /// Checks that the name can name files and can be printed. Called where names enter: for every calibrated camera by
    /// [`crate::Camera::validate`], and for the names of recordings, folders and configurations by their readers.
    ///
    /// ```
    /// use flyrig_types::CameraId;
    ///
    /// assert!(CameraId::from("front left").check().is_ok());
    /// let error = CameraId::from("../x").check().unwrap_err().to_string();
    /// assert!(error.starts_with("the camera name '../x' has a path separator"), "{error}");
    /// ```
    ///
    /// # Errors
    /// The name does not have 1 to 64 characters, is `.` or `..`, begins or ends with a space, or has a path separator
    /// or a character that cannot be seen.
    pub fn check(&self) -> Result<(), CameraNameError> {
        let name = self.as_str();
        let fault = if name.is_empty() {
            "is empty"
        } else if name.chars().nth(MAX_NAME).is_some() {
            "is too long"
        } else if name == "." || name == ".." {
            "is a folder's own"
        } else if name.contains(['/', '\\']) {
            "has a path separator"
        } else if name.chars().any(is_unseen) {
            "has characters that cannot be seen"
        } else if name.trim() != name {
            "begins or ends with a space"
        } else {
            return Ok(());
        };
        let mut seen = String::new();
        for char in name.chars().take(2 * MAX_NAME) {
            if is_unseen(char) {
                seen.extend(char.escape_unicode());
            } else {
                seen.push(char);
            }
        }
        Err(CameraNameError { name: shortened(&seen).into_owned(), fault })
    }
}

/// Returns whether a character has no picture: controls, and marks of no width.
fn is_unseen(char: char) -> bool {
    is_obeyed(char)
        || matches!(char, '\u{ad}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff0}'..='\u{fffb}' | '\u{e0000}'..='\u{e0fff}')
}

/// Error of a name that no camera may have.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the camera name '{name}' {fault}; rename it to 1 to 64 printable characters without / and \\, and neither . nor .."
)]
pub struct CameraNameError {
    /// The name, escaped and cut.
    name: String,
    fault: &'static str,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_leave_their_folder_or_cannot_be_seen_are_refused() {
        for (name, fault) in [
            ("", "is empty"),
            (".", "folder's own"),
            ("..", "folder's own"),
            ("../../x", "separator"),
            ("/tmp/x", "separator"),
            ("a\\b", "separator"),
            ("a\u{1b}[2J", "cannot be seen"),
            ("a\nb", "cannot be seen"),
            ("a\u{202e}b", "cannot be seen"),
            ("a\u{200b}b", "cannot be seen"),
            ("a\u{0}", "cannot be seen"),
            ("\u{feff}a", "cannot be seen"),
            (" ", "a space"),
            ("a ", "a space"),
            (&"x".repeat(65), "too long"),
            (&"x".repeat(300), "too long"),
        ] {
            let error = CameraId::from(name).check().unwrap_err().to_string();
            assert!(error.contains(fault), "{name:?}: {error}");
            assert!(!error.chars().any(is_unseen) && error.chars().count() < 240, "{error}");
        }
        for name in ["0", "00", "front left", "cam.1", "...", "Körper", "体", "usb-0000:00:14.0-1", &"x".repeat(64)] {
            assert_eq!(CameraId::from(name).check(), Ok(()), "{name}");
        }
    }
}
