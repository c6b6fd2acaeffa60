//! Files that only their owner may read.

use std::{io::Write as _, path::Path};

use crate::error::AccessError;

/// Writes a new file for its owner alone; refuses to replace one.
pub(crate) fn write_secret(path: &Path, text: &str) -> Result<(), AccessError> {
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let written =
        options.open(path).and_then(|mut out| write(&mut out, text).inspect_err(|_| drop(std::fs::remove_file(path))));
    written.map_err(|error| match error.kind() {
        std::io::ErrorKind::AlreadyExists => already_there(path),
        _ => AccessError::file(path, format!("cannot be written ({error})")),
    })
}

/// Writes the text through to the disk: a list may name it next.
fn write(out: &mut std::fs::File, text: &str) -> std::io::Result<()> {
    out.write_all(text.as_bytes())?;
    out.sync_all()
}

/// Returns the error for a file that must not be replaced.
pub(crate) fn already_there(path: &Path) -> AccessError {
    AccessError::file(path, "is there already; move it away, or name another file with --out")
}
