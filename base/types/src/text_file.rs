//! Text files as editors save them.

use std::{
    fs::File,
    io::{Error, ErrorKind, Read as _, Result},
    path::Path,
};

/// Largest file that [`read_text`] accepts: settings and calibrations are small, larger files are something else.
const MAX_BYTES: u64 = 16 << 20;

/// Reads a text file of at most 16 MiB, as editors on any system save it: UTF-8 with or without a byte order mark, or
/// UTF-16 with one. Lines end in `\n`.
///
/// # Errors
/// [`ErrorKind::InvalidData`] for a file that is larger or no such text, with the fix; otherwise the error of the system.
pub fn read_text(path: &Path) -> Result<String> {
    read_text_up_to(path, MAX_BYTES)
}

/// Reads a text file of at most `most_bytes` bytes; see [`read_text`].
///
/// # Errors
/// As [`read_text`].
pub fn read_text_up_to(path: &Path, most_bytes: u64) -> Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(most_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most_bytes {
        return Err(Error::new(ErrorKind::InvalidData, format!("it has more than {most_bytes} bytes")));
    }
    decode_text(bytes)
}

/// Decodes the bytes of a text file; see [`read_text`].
///
/// # Errors
/// [`ErrorKind::InvalidData`] for bytes that are no such text.
pub fn decode_text(bytes: Vec<u8>) -> Result<String> {
    let wide = |bytes: &[u8], unit: fn([u8; 2]) -> u16| {
        let (pairs, rest) = bytes.as_chunks::<2>();
        let units: Vec<u16> = pairs.iter().map(|pair| unit(*pair)).collect();
        String::from_utf16(&units).ok().filter(|_| rest.is_empty())
    };
    let text = match bytes.as_slice() {
        [0xff, 0xfe, rest @ ..] => wide(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => wide(rest, u16::from_be_bytes),
        [0xef, 0xbb, 0xbf, rest @ ..] => std::str::from_utf8(rest).ok().map(str::to_owned),
        _ => String::from_utf8(bytes).ok(),
    };
    let no_text = "it is not text in UTF-8, or in UTF-16 with a byte order mark; save it as UTF-8";
    let text = text.filter(|text| !text.contains('\0')).ok_or_else(|| Error::new(ErrorKind::InvalidData, no_text))?;
    Ok(if text.contains('\r') { text.replace("\r\n", "\n").replace('\r', "\n") } else { text })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_reads_alike_however_an_editor_saved_it() {
        let text = "käse: 1\n  x: 2\n";
        let lines = text.replace('\n', "\r\n");
        let wide = |text: &str, mark: [u8; 2], bytes: fn(u16) -> [u8; 2]| {
            [mark.to_vec(), text.encode_utf16().flat_map(bytes).collect()].concat()
        };
        for (bytes, name) in [
            (text.as_bytes().to_vec(), "plain"),
            (lines.as_bytes().to_vec(), "CRLF"),
            (text.replace('\n', "\r").into_bytes(), "CR"),
            ([b"\xef\xbb\xbf".to_vec(), lines.clone().into_bytes()].concat(), "UTF-8 with a mark"),
            (wide(&lines, [0xff, 0xfe], u16::to_le_bytes), "UTF-16 little endian"),
            (wide(&lines, [0xfe, 0xff], u16::to_be_bytes), "UTF-16 big endian"),
        ] {
            assert_eq!(decode_text(bytes).unwrap(), text, "{name}");
        }
        for bytes in [&b"k\xe4se"[..], b"a\0b\0", b"\xff\xfea\0b", b"\xff\xfe\x00\xd8"] {
            assert!(decode_text(bytes.to_vec()).unwrap_err().to_string().contains("save it as UTF-8"), "{bytes:?}");
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "12345").unwrap();
        assert_eq!(read_text_up_to(file.path(), 5).unwrap(), "12345");
        assert!(read_text_up_to(file.path(), 4).unwrap_err().to_string().contains("more than 4 bytes"));
    }
}
