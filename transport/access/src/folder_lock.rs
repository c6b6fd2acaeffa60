//! Lock of a key folder while it is changed, and the note of a key file that is being written.

use std::{
    fs::{File, OpenOptions, TryLockError},
    io::ErrorKind,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use crate::error::AccessError;

/// Empty file that is locked; the list itself is replaced at each change.
const LOCK: &str = "ring.lock";
/// File that names the key file of a change under way.
const NOTE: &str = "ring.unfinished";
/// Longest wait for other commands.
const PATIENCE: Duration = Duration::from_secs(60);
/// Interval between two attempts.
const RETRY: Duration = Duration::from_millis(5);

/// Lock of a key folder, given back when it is dropped or its process ends.
#[derive(Debug)]
pub(crate) struct FolderLock {
    note: PathBuf,
    _file: File,
}

impl FolderLock {
    /// Waits until no other command changes the folder.
    pub fn take(folder: &Path) -> Result<Self, AccessError> {
        let path = folder.join(LOCK);
        // Another user's lock can be taken without the right to write to it.
        let file = File::open(&path)
            .or_else(|_| OpenOptions::new().create(true).append(true).open(&path))
            .map_err(|error| AccessError::file(&path, format!("cannot be written ({error})")))?;
        let end = Instant::now() + PATIENCE;
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Self { note: folder.join(NOTE), _file: file }),
                Err(TryLockError::WouldBlock) if Instant::now() < end => std::thread::sleep(RETRY),
                Err(TryLockError::WouldBlock) => {
                    return Err(AccessError::file(
                        &path,
                        "is locked by another `flyrig keys`; wait for its end, or end it",
                    ));
                }
                Err(TryLockError::Error(error)) => {
                    return Err(AccessError::file(&path, format!("cannot be locked ({error})")));
                }
            }
        }
    }

    /// Notes the key file that is written next.
    pub fn begin(&self, key: &Path) -> Result<(), AccessError> {
        let key = std::path::absolute(key).unwrap_or_else(|_| key.to_owned());
        std::fs::write(&self.note, key.to_string_lossy().as_bytes())
            .map_err(|error| AccessError::file(&self.note, format!("cannot be written ({error})")))
    }

    /// Returns the key file that a command was writing when it was ended midway.
    pub fn unfinished(&self) -> Option<PathBuf> {
        std::fs::read_to_string(&self.note).ok().map(PathBuf::from)
    }

    /// Removes the note.
    pub fn end(&self) {
        if let Err(error) = std::fs::remove_file(&self.note)
            && error.kind() != ErrorKind::NotFound
        {
            // The next command finds the key listed, and removes the note.
            tracing::debug!(%error, "the note of a finished change stays");
        }
    }
}
