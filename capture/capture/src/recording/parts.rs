//! Reader of a recording's messages over all of its files.

use std::path::{Path, PathBuf};

use mcap::{McapResult, Message};

use super::{
    disk::part_path,
    messages::{Messages, cause},
    part::Link,
};
use crate::error::{CaptureError, CaptureErrorKind};

/// Messages of a file and, when it is the first of a rotated recording, of the files after it.
pub(super) struct Parts {
    first: PathBuf,
    messages: Messages,
    /// First message of a newly opened file.
    held: Option<Message<'static>>,
    /// Whether the first message was read.
    has_begun: bool,
    /// Link of the current file, if others may follow it.
    link: Option<Link>,
}

impl Parts {
    /// Opens the first file.
    ///
    /// # Errors
    /// `NotFound` if the file is missing.
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        let messages = Messages::open(path).map_err(|error| {
            CaptureError::general(CaptureErrorKind::NotFound, format!("{} cannot be opened: {error}", path.display()))
        })?;
        Ok(Self { first: path.to_owned(), messages, held: None, has_begun: false, link: None })
    }

    /// Continues with the next file; returns false if it is missing or belongs to another recording.
    fn advance(&mut self) -> bool {
        let Some(link) = &mut self.link else { return false };
        let Some(part) = link.part.checked_add(1) else { return false };
        let path = part_path(&self.first, part);
        let Ok(mut next) = Messages::open(&path) else { return false };
        // Without a message it broke off before it began.
        let Some(Ok(message)) = next.next() else { return false };
        let wanted = Link { recording: link.recording.clone(), part };
        if Link::read(&message.channel.metadata).as_ref() != Some(&wanted) {
            tracing::warn!("{} is not a part of {} and is left out", path.display(), self.first.display());
            self.link = None;
            return false;
        }
        *link = wanted;
        (self.messages, self.held) = (next, Some(message));
        true
    }
}

impl Iterator for Parts {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(message) = self.held.take() {
                return Some(Ok(message));
            }
            let end = match self.messages.next() {
                Some(Ok(message)) => {
                    if !std::mem::replace(&mut self.has_begun, true) {
                        // A later part stands by itself.
                        self.link = Link::read(&message.channel.metadata).filter(|link| link.part == 0);
                    }
                    return Some(Ok(message));
                }
                end => end,
            };
            let part = self.link.as_ref().map_or(0, |link| link.part);
            if !self.advance() {
                return end;
            }
            if let Some(Err(error)) = end {
                tracing::warn!("{} breaks off: {}; going on", part_path(&self.first, part).display(), cause(&error));
            }
        }
    }
}
