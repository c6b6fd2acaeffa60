//! File system of a recording, behind a trait that tests implement.

use std::{
    fs::{File, OpenOptions},
    io::{self, BufWriter, Seek, Write},
    path::{Path, PathBuf},
};

/// Bytes buffered per write.
const BUFFER: usize = 1 << 20;

/// Storage that creates the files of a recording and makes them durable.
pub(super) trait Disk: Send + 'static {
    type File: Write + Seek + Send;

    /// Returns the path of a part, counted from 0.
    fn path(&self, part: u32) -> PathBuf;

    /// Creates the file of a part and makes its directory entry durable.
    ///
    /// # Errors
    /// `AlreadyExists` rather than overwrite a file.
    fn create(&mut self, part: u32) -> io::Result<Self::File>;

    /// Makes everything written to the newest file durable.
    fn sync(&mut self) -> io::Result<()>;

    /// Returns the bytes that an unprivileged process may still write; `None` where that is unknown.
    fn free_bytes(&self) -> Option<u64>;
}

/// Directory of the file system.
#[derive(Debug)]
pub(super) struct Folder {
    first: PathBuf,
    newest: Option<File>,
}

impl Folder {
    /// Creates the storage. Parts are numbered after the first: `take.mcap`, `take-0001.mcap` ...
    pub fn new(first: &Path) -> Self {
        Self { first: first.to_owned(), newest: None }
    }

    fn directory(&self) -> &Path {
        match self.first.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        }
    }
}

impl Disk for Folder {
    type File = BufWriter<File>;

    fn path(&self, part: u32) -> PathBuf {
        part_path(&self.first, part)
    }

    fn create(&mut self, part: u32) -> io::Result<Self::File> {
        let file = OpenOptions::new().write(true).create_new(true).open(self.path(part))?;
        self.newest = Some(file.try_clone()?);
        sync_directory(self.directory());
        Ok(BufWriter::with_capacity(BUFFER, file))
    }

    fn sync(&mut self) -> io::Result<()> {
        self.newest.as_ref().map_or(Ok(()), File::sync_data)
    }

    fn free_bytes(&self) -> Option<u64> {
        free_bytes(self.directory())
    }
}

/// Returns the path of a part of the recording whose first file is `first`.
pub(super) fn part_path(first: &Path, part: u32) -> PathBuf {
    if part == 0 {
        return first.to_owned();
    }
    let mut name = first.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{part:04}"));
    if let Some(extension) = first.extension() {
        name.push(".");
        name.push(extension);
    }
    first.with_file_name(name)
}

/// Makes a directory entry durable. Some file systems refuse this, which is ignored: the file is written all the same.
#[cfg(unix)]
fn sync_directory(directory: &Path) {
    if let Err(error) = File::open(directory).and_then(|directory| directory.sync_all()) {
        tracing::warn!("{}: the directory cannot be synced: {error}", directory.display());
    }
}

/// Does nothing: directories cannot be opened as files here.
#[cfg(not(unix))]
fn sync_directory(_: &Path) {}

#[cfg(unix)]
fn free_bytes(directory: &Path) -> Option<u64> {
    let disk = rustix::fs::statvfs(directory).ok()?;
    Some(disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(not(unix))]
fn free_bytes(_: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_numbered_before_the_extension() {
        let path = |first: &str, part| part_path(Path::new(first), part).display().to_string();
        assert_eq!(path("a/take.mcap", 0), "a/take.mcap");
        assert_eq!(path("a/take.mcap", 1), "a/take-0001.mcap");
        assert_eq!(path("take.2.mcap", 12_345), "take.2-12345.mcap");
        assert_eq!(path("take", 2), "take-0002");
    }

    #[cfg(unix)]
    #[test]
    fn the_free_space_of_a_directory_is_known() {
        let folder = tempfile::tempdir().unwrap();
        assert!(Folder::new(&folder.path().join("take.mcap")).free_bytes().is_some());
        assert!(Folder::new(Path::new("take.mcap")).free_bytes().is_some(), "the current directory");
        assert_eq!(Folder::new(&folder.path().join("none/take.mcap")).free_bytes(), None);
    }
}
