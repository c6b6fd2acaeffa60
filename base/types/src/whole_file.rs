//! Atomic replacement of files.

use std::{
    fs,
    io::{self, BufWriter, Write as _},
    path::Path,
};

/// Writes a file beside `path`, then renames it over `path`, so that readers never meet half a file.
///
/// # Errors
/// Error of the system or of `content`; an old file is then untouched.
pub fn write_whole(
    path: &Path,
    content: impl FnOnce(&mut BufWriter<fs::File>) -> io::Result<()>,
) -> Result<(), io::Error> {
    let Some(name) = path.file_name() else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name"));
    };
    let mut partial_name = name.to_owned();
    partial_name.push(format!(".{}.partial", std::process::id()));
    let partial = path.with_file_name(partial_name);
    let write = || {
        let mut out = BufWriter::new(fs::File::create(&partial)?);
        content(&mut out)?;
        out.flush()?;
        drop(out);
        fs::rename(&partial, path)
    };
    write().inspect_err(|_| {
        // The first error is the one to report, even if this fails too.
        let _ = fs::remove_file(&partial);
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_fails_half_way_leaves_the_old_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        write_whole(&path, |out| out.write_all(b"old")).unwrap();
        let failed = write_whole(&path, |out| {
            out.write_all(b"new, but")?;
            Err(io::Error::other("the source ended"))
        });
        assert_eq!(failed.unwrap_err().to_string(), "the source ended");
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert!(write_whole(Path::new("/"), |_| Ok(())).is_err());
        assert!(write_whole(&folder.path().join("no/such/folder"), |_| Ok(())).is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing half-written stays");
    }
}
