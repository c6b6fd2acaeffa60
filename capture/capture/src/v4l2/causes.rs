//! Translation of system errors to causes and fixes.

use std::{fs, io, path::Path};

use super::identity;
use crate::error::{CaptureError, CaptureErrorKind};

/// Builds the error of a stream that broke.
pub(crate) fn lost(error: &io::Error) -> CaptureError {
    let text = match error.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO) => {
            "was unplugged or released by its driver; waiting for it to come back".to_owned()
        }
        Some(libc::EIO) => "its driver reports a failed transfer; starting it again".to_owned(),
        _ => format!("its stream broke ({error}); starting it again"),
    };
    CaptureError::general(CaptureErrorKind::Disconnected, text)
}

/// Explains why a camera cannot be set up, with the fix.
pub(crate) fn explain(error: &io::Error, what: &str, node: &Path) -> CaptureError {
    let place = node.display();
    match error.raw_os_error() {
        Some(libc::EACCES | libc::EPERM) => identity::denied(node),
        Some(libc::EBUSY) => {
            let holders = holders(node);
            let who = if holders.is_empty() { "another program".to_owned() } else { holders.join(", ") };
            let text = format!("{what}: {place} is in use by {who}; end that first");
            CaptureError::general(CaptureErrorKind::Io, text)
        }
        Some(libc::ENODEV | libc::ENXIO | libc::ENOENT) => CaptureError::general(
            CaptureErrorKind::Disconnected,
            format!("{what}: {place} is gone; plug the camera in again"),
        ),
        _ => CaptureError::general(CaptureErrorKind::Io, format!("{what}: {place}: {error}")),
    }
}

/// Lists other processes that have a node open, as far as this user may see them.
fn holders(node: &Path) -> Vec<String> {
    let own = std::process::id();
    let numbers = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = numbers.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok()).filter(|pid| *pid != own);
    pids.filter(|pid| {
        let mut links = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
        links.any(|link| fs::read_link(link.path()).is_ok_and(|target| target == node))
    })
    .map(|pid| {
        let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        format!("{} (process {pid})", name.trim())
    })
    .collect()
}
