//! Zip archives, which appear whole or not at all.

use std::io::{self, Cursor, Write as _};
use std::path::Path;

use flyrig_types::write_whole;
use zip::ZipWriter;

use super::mesh_file::{MeshFileError, system};

/// Archive in memory.
pub(super) type Archive = ZipWriter<Cursor<Vec<u8>>>;

/// Writes an archive that `fill` fills. It is made in memory: an archive on a full disk would print a line of its own to the terminal.
///
/// # Errors
/// [`MeshFileError::System`] for errors of `fill`, and when the system fails.
pub(super) fn write_archive(
    path: &Path,
    fill: impl FnOnce(&mut Archive) -> io::Result<()>,
) -> Result<(), MeshFileError> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    fill(&mut archive).map_err(system(path))?;
    let finished = archive.finish().map_err(io::Error::from).map_err(system(path))?;
    write_whole(path, |out| out.write_all(finished.get_ref())).map_err(system(path))
}
