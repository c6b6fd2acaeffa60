//! External buffers of glTF files: relative URIs confined to the folder of the `.gltf` file.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use crate::BodyError;

/// Characters of a URI that an error quotes.
const SHOWN: usize = 80;

/// Resolves the URI of a buffer to a canonical path below the folder of `gltf`.
///
/// # Errors
/// [`BodyError::Gltf`] for absolute paths, schemes, escapes that are not UTF-8, and paths or symbolic links that leave the
/// folder; [`BodyError::Io`] when there is no such file.
pub(crate) fn resolve(gltf: &Path, uri: &str) -> Result<PathBuf, BodyError> {
    let refuse = |why: &str| {
        let shown: String = uri.chars().take(SHOWN).collect();
        let message = format!("buffer {shown:?} {why}; put the buffer beside the .gltf file or export a .glb");
        BodyError::Gltf { path: gltf.into(), message }
    };
    // A colon before the first slash ends a scheme, or a drive letter.
    if uri.split(['/', '\\']).next().is_some_and(|first| first.contains(':')) {
        return Err(refuse("names a scheme or a drive"));
    }
    let name = percent_decode(uri).ok_or_else(|| refuse("is not valid percent-encoded UTF-8"))?;
    if name.starts_with(['/', '\\']) || name.contains('\0') {
        return Err(refuse("is not a relative path"));
    }
    let mut depth = 0usize;
    for component in Path::new(&name).components() {
        match component {
            Component::Normal(_) => depth += 1,
            Component::CurDir => {}
            Component::ParentDir => {
                depth = depth.checked_sub(1).ok_or_else(|| refuse("lies outside the folder of the file"))?;
            }
            Component::RootDir | Component::Prefix(_) => return Err(refuse("is not a relative path")),
        }
    }
    let canonical = |path: &Path| path.canonicalize().map_err(|source| BodyError::Io { path: path.into(), source });
    let folder = gltf.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let target = canonical(&folder.join(name))?;
    match target.starts_with(canonical(folder)?) {
        true => Ok(target),
        false => Err(refuse("leads outside the folder of the file by a symbolic link")),
    }
}

/// Reads a whole regular file of at most `limit` bytes; the size is checked before anything is read.
///
/// # Errors
/// [`BodyError::Io`]; [`BodyError::Gltf`] for a folder, a pipe or a device, and for a file over the limit.
pub(crate) fn read(path: &Path, limit: u64) -> Result<Vec<u8>, BodyError> {
    let io = |source| BodyError::Io { path: path.into(), source };
    let refuse = |message: String| BodyError::Gltf { path: path.into(), message };
    // Before opening: opening a pipe would wait for a writer.
    let meta = std::fs::metadata(path).map_err(io)?;
    if !meta.is_file() {
        return Err(refuse("is not a regular file".to_owned()));
    }
    let too_large = |bytes: u64| refuse(format!("{bytes} bytes, at most {limit} are read; export a smaller file"));
    if meta.len() > limit {
        return Err(too_large(meta.len()));
    }
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    // It may have grown meanwhile.
    std::fs::File::open(path).map_err(io)?.take(limit + 1).read_to_end(&mut bytes).map_err(io)?;
    match bytes.len() as u64 > limit {
        true => Err(too_large(bytes.len() as u64)),
        false => Ok(bytes),
    }
}

/// Decodes percent escapes (RFC 3986, section 2.1); `None` for an escape without two hexadecimal digits or bytes that are not UTF-8.
fn percent_decode(uri: &str) -> Option<String> {
    let hex = |digit: u8| char::from(digit).to_digit(16).map(|digit| digit as u8);
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        rest = match (first, tail) {
            (b'%', [high, low, tail @ ..]) => {
                bytes.push(hex(*high)? << 4 | hex(*low)?);
                tail
            }
            (b'%', _) => return None,
            _ => {
                bytes.push(*first);
                tail
            }
        };
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_are_decoded_as_utf8() {
        for (uri, expected) in [
            ("body.bin", Some("body.bin")),
            ("the%20body.bin", Some("the body.bin")),
            ("k%C3%B6rper%2ebin", Some("körper.bin")),
            ("körper", Some("körper")),
            ("%25%32%30", Some("%20")),
            ("100%", None),
            ("%2", None),
            ("%zz", None),
            ("%ff", None),
        ] {
            assert_eq!(percent_decode(uri).as_deref(), expected, "{uri}");
        }
    }
}
