//! Sizes that a video file states of its own parts: a part that ends beyond the file was cut off.
//!
//! The number of frames in a header is no evidence: programs write it before they know it, or round it from a duration.

use std::io::{Read, Seek, SeekFrom};

/// Bytes between two synchronisation marks of an MPEG transport stream.
const TRANSPORT_PACKET: u64 = 188;
/// Level-1 elements of Matroska that hold pictures.
const SEGMENT: u64 = 0x1853_8067;
const CLUSTER: u64 = 0x1f43_b675;

/// Returns the number of bytes that a file lacks by its own account; `None` when it is whole, or its format does not
/// say. Understands AVI, MP4 and QuickTime, Matroska and WebM, and MPEG transport streams.
pub(crate) fn missing_bytes(file: &mut (impl Read + Seek)) -> Option<u64> {
    let length = file.seek(SeekFrom::End(0)).ok()?;
    let head: [u8; 12] = bytes_at(file, 0)?;
    let end = match head {
        [b'R', b'I', b'F', b'F', ..] => riff_end(file, length),
        [0x1a, 0x45, 0xdf, 0xa3, ..] => matroska_end(file, length),
        [_, _, _, _, kind @ .., _, _, _, _] if is_box(kind) => mp4_end(file, length),
        [0x47, ..] if bytes_at(file, TRANSPORT_PACKET) == Some([0x47]) => {
            Some(length.next_multiple_of(TRANSPORT_PACKET))
        }
        _ => None,
    };
    end.and_then(|end| end.checked_sub(length)).filter(|missing| *missing > 0)
}

fn bytes_at<const N: usize>(file: &mut (impl Read + Seek), at: u64) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    file.seek(SeekFrom::Start(at)).ok()?;
    file.read_exact(&mut bytes).ok()?;
    Some(bytes)
}

/// Returns the end of the last of a file's RIFF chunks: long films have several. Recorders that died leave a size of 0.
fn riff_end(file: &mut (impl Read + Seek), length: u64) -> Option<u64> {
    let mut at = 0;
    while at + 8 <= length {
        let [kind @ .., a, b, c, d] = bytes_at::<8>(file, at)?;
        let size = u32::from_le_bytes([a, b, c, d]);
        if kind != *b"RIFF" || size == 0 || size == u32::MAX {
            break;
        }
        at += 8 + u64::from(size);
        if at > length {
            return Some(at);
        }
        at += at % 2;
    }
    None
}

fn is_box(kind: [u8; 4]) -> bool {
    [b"ftyp", b"styp", b"moov", b"moof", b"mdat", b"wide", b"free", b"skip", b"pnot", b"sidx", b"mfra", b"uuid"]
        .contains(&&kind)
}

fn mp4_end(file: &mut (impl Read + Seek), length: u64) -> Option<u64> {
    let mut at = 0u64;
    while at.checked_add(8)? <= length {
        let [a, b, c, d, kind @ ..] = bytes_at::<8>(file, at)?;
        let size = match u32::from_be_bytes([a, b, c, d]) {
            0 => break, // to the end, wherever that is
            1 => u64::from_be_bytes(bytes_at(file, at + 8)?),
            size => u64::from(size),
        };
        // What programs append behind the boxes is no box.
        if size < 8 || !is_box(kind) {
            break;
        }
        at = at.checked_add(size)?;
        if at > length {
            return Some(at);
        }
    }
    None
}

/// Reads a number of Matroska: with its length marker for an identifier, without for a size, which is `None` where the
/// writer did not know it. Returns it and its length in bytes.
fn matroska_number(file: &mut (impl Read + Seek), at: u64, is_identifier: bool) -> Option<(Option<u64>, u64)> {
    let [first] = bytes_at(file, at)?;
    let bytes = u64::from(first.leading_zeros()) + 1;
    if bytes > 8 {
        return None;
    }
    let marker = 1u64.checked_shl(7 * bytes as u32)?;
    let mut value = u64::from(first);
    for k in 1..bytes {
        let [next] = bytes_at(file, at + k)?;
        value = value << 8 | u64::from(next);
    }
    if is_identifier {
        return Some((Some(value), bytes));
    }
    let size = value & (marker - 1);
    Some(((size != marker - 1).then_some(size), bytes))
}

fn matroska_end(file: &mut (impl Read + Seek), length: u64) -> Option<u64> {
    let mut at = 0u64;
    while at < length {
        let (identifier, bytes) = matroska_number(file, at, true)?;
        at += bytes;
        let (size, bytes) = matroska_number(file, at, false)?;
        at += bytes;
        match size {
            Some(size) => at = at.checked_add(size)?,
            // A live recording: its parts have sizes where the writer went on.
            None if matches!(identifier, Some(SEGMENT | CLUSTER)) => continue,
            None => break,
        }
        if at > length {
            return Some(at);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn missing(bytes: &[u8]) -> Option<u64> {
        missing_bytes(&mut Cursor::new(bytes))
    }

    fn mp4_box(kind: &[u8; 4], body: &[u8]) -> Vec<u8> {
        [&(8 + body.len() as u32).to_be_bytes(), &kind[..], body].concat()
    }

    /// Whole files of every format.
    fn files() -> Vec<Vec<u8>> {
        let riff = |kind: &[u8; 4]| [b"RIFF", &100u32.to_le_bytes()[..], kind, &[7; 96]].concat();
        let large = [&1u32.to_be_bytes(), &b"mdat"[..], &48u64.to_be_bytes(), &[9; 32]].concat();
        let cluster = |size: u8| [&[0x1f, 0x43, 0xb6, 0x75, 0x80 | size][..], &[5; 30]].concat();
        let head = [0x1a, 0x45, 0xdf, 0xa3, 0x82, 1, 2, 0x18, 0x53, 0x80, 0x67];
        let mut packet = vec![0x47; 1];
        packet.resize(188, 3);
        vec![
            [riff(b"AVI "), riff(b"AVIX")].concat(),
            [mp4_box(b"ftyp", b"isom1234"), mp4_box(b"moov", &[1; 40]), mp4_box(b"mdat", &[2; 60])].concat(),
            [mp4_box(b"ftyp", b"isom1234"), large].concat(),
            [&head[..], &[0xa3], &cluster(30)].concat(),
            [&head[..], &[0x01, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff], &cluster(30), &cluster(30)].concat(),
            [packet.clone(), packet].concat(),
        ]
    }

    #[test]
    fn a_whole_file_lacks_nothing_and_a_cut_one_is_noticed() {
        for file in files() {
            assert_eq!(missing(&file), None);
            for cut in [1, 10, 20] {
                assert_eq!(missing(&file[..file.len() - cut]), Some(cut as u64), "{:?}", &file[..8]);
            }
        }
    }

    #[test]
    fn sizes_that_are_unknown_and_appended_bytes_are_no_damage() {
        let head = [0x1a, 0x45, 0xdf, 0xa3, 0x80];
        for whole in [
            [b"RIFF", &0u32.to_le_bytes()[..], b"AVI ", &[7; 96]].concat(),
            [mp4_box(b"ftyp", b"isom1234"), vec![0, 0, 0, 0], b"mdat".to_vec(), vec![1; 50]].concat(),
            [mp4_box(b"ftyp", b"isom1234"), mp4_box(b"moov", &[1; 40]), vec![0x7f; 100]].concat(),
            [&head[..], &[0x18, 0x53, 0x80, 0x67, 0xff, 0x1f, 0x43, 0xb6, 0x75, 0xff, 0xe7, 0x81, 0], &[9; 3]].concat(),
            b"no video at all".to_vec(),
            Vec::new(),
        ] {
            assert_eq!(missing(&whole), None, "{:?}", whole.get(..8));
        }
    }

    #[test]
    fn any_bytes_come_to_an_end() {
        let mut state = 3u64;
        for file in files() {
            for _ in 0..2000 {
                let mut bytes = file.clone();
                for _ in 0..4 {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    let at = (state >> 33) as usize % bytes.len().min(40);
                    bytes[at] = (state >> 20) as u8;
                }
                let _ = missing(&bytes);
            }
        }
    }
}
