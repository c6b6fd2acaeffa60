//! Reader of serialized ROS messages: CDR of ROS 2 in either byte order, and the packed form of ROS 1.

use prost::bytes::Bytes;

/// Reader of a message's fields in their order. Every length is checked against the bytes that remain.
#[derive(Debug)]
pub(super) struct Reader {
    payload: Bytes,
    at: usize,
    /// Position from which fields are aligned.
    origin: usize,
    /// Largest alignment, bytes: 8 in CDR, 4 in its second version, 1 in ROS 1.
    most_aligned: usize,
    is_big_endian: bool,
    /// Whether headers begin with a sequence number, and texts have no zero at their end.
    is_ros1: bool,
}

impl Reader {
    /// Begins a CDR message, whose first four bytes name its encoding.
    pub fn cdr(payload: Bytes) -> Result<Self, String> {
        let Some(&[high, kind, ..]) = payload.get(..4) else { return Err(too_short(4, payload.len())) };
        let (is_big_endian, most_aligned) = match (high, kind) {
            (0, 0) => (true, 8),
            (0, 1) => (false, 8),
            (0, 6) => (true, 4),
            (0, 7) => (false, 4),
            _ => return Err(format!("CDR encoding {high:#04x}{kind:02x}; known: plain CDR and XCDR2 of either order")),
        };
        Ok(Self { payload, at: 4, origin: 4, most_aligned, is_big_endian, is_ros1: false })
    }

    /// Begins a message of ROS 1.
    pub fn ros1(payload: Bytes) -> Self {
        Self { payload, at: 0, origin: 0, most_aligned: 1, is_big_endian: false, is_ros1: true }
    }

    pub fn is_ros1(&self) -> bool {
        self.is_ros1
    }

    fn take(&mut self, count: usize) -> Result<&[u8], String> {
        let end = self.at.checked_add(count).filter(|end| *end <= self.payload.len());
        let end = end.ok_or_else(|| too_short(count, self.payload.len().saturating_sub(self.at)))?;
        let bytes = &self.payload[self.at..end];
        self.at = end;
        Ok(bytes)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let step = N.min(self.most_aligned);
        self.take((step - (self.at - self.origin) % step) % step)?;
        let is_big_endian = self.is_big_endian;
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        if is_big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    pub fn u8(&mut self) -> Result<u8, String> {
        Ok(u8::from_le_bytes(self.number()?))
    }

    pub fn u32(&mut self) -> Result<u32, String> {
        Ok(u32::from_le_bytes(self.number()?))
    }

    pub fn f64(&mut self) -> Result<f64, String> {
        Ok(f64::from_le_bytes(self.number()?))
    }

    pub fn f64s(&mut self, count: usize) -> Result<Vec<f64>, String> {
        // Only as many as there are bytes for: the count comes from the file.
        let remaining = self.payload.len().saturating_sub(self.at) / 8;
        if count > remaining {
            return Err(too_short(count.saturating_mul(8), 8 * remaining));
        }
        (0..count).map(|_| self.f64()).collect()
    }

    pub fn length(&mut self) -> Result<usize, String> {
        Ok(self.u32()? as usize)
    }

    pub fn bytes(&mut self) -> Result<Bytes, String> {
        let count = self.length()?;
        let at = self.at;
        self.take(count)?;
        Ok(self.payload.slice(at..at + count))
    }

    pub fn text(&mut self) -> Result<String, String> {
        let bytes = self.bytes()?;
        let is_ros1 = self.is_ros1;
        let text = if is_ros1 { &bytes[..] } else { bytes.strip_suffix(&[0]).unwrap_or(&bytes) };
        Ok(String::from_utf8_lossy(text).into_owned())
    }

    /// Reads a time, nanoseconds.
    pub fn time(&mut self) -> Result<i64, String> {
        let (seconds, nanos) = (self.u32()?, self.u32()?);
        // Signed in ROS 2, unsigned in ROS 1.
        let seconds = if self.is_ros1 { i64::from(seconds) } else { i64::from(seconds as i32) };
        Ok(seconds.saturating_mul(1_000_000_000).saturating_add(i64::from(nanos)))
    }
}

fn too_short(wanted: usize, remaining: usize) -> String {
    format!("a field needs {wanted} bytes, but {remaining} remain; the message is damaged")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_aligned_from_the_end_of_the_encoding_in_either_order() {
        // u8, text "ab", f64 2.5, u32 7.
        let little = [
            &[0u8, 1, 0, 0, 9, 0, 0, 0][..],
            &3u32.to_le_bytes(),
            b"ab\0\0",
            &[0; 4],
            &2.5f64.to_le_bytes(),
            &[7, 0, 0, 0],
        ];
        let big = [
            &[0u8, 0, 0, 0, 9, 0, 0, 0][..],
            &3u32.to_be_bytes(),
            b"ab\0\0",
            &[0; 4],
            &2.5f64.to_be_bytes(),
            &[0, 0, 0, 7],
        ];
        // The second version aligns to four bytes at most.
        let second = [
            &[0u8, 7, 0, 0, 9, 0, 0, 0][..],
            &3u32.to_le_bytes(),
            b"ab\0\0",
            &[],
            &2.5f64.to_le_bytes(),
            &[7, 0, 0, 0],
        ];
        for parts in [little, big, second] {
            let bytes = parts.concat();
            let mut reader = Reader::cdr(bytes.clone().into()).unwrap();
            assert_eq!((reader.u8().unwrap(), reader.text().unwrap().as_str()), (9, "ab"));
            assert_eq!((reader.f64().unwrap(), reader.u32().unwrap()), (2.5, 7));
            assert!(reader.u8().unwrap_err().contains("a field needs 1 bytes, but 0 remain"));
            for cut in 4..bytes.len() {
                let mut reader = Reader::cdr(bytes[..cut].to_vec().into()).unwrap();
                let all = reader.u8().and_then(|_| reader.text()).and_then(|_| reader.f64()).and_then(|_| reader.u32());
                assert!(all.is_err(), "{cut}");
            }
        }
        let ros1 = [&[9u8][..], &2u32.to_le_bytes(), b"ab", &2.5f64.to_le_bytes()].concat();
        let mut reader = Reader::ros1(ros1.into());
        assert_eq!((reader.u8().unwrap(), reader.text().unwrap().as_str(), reader.f64().unwrap()), (9, "ab", 2.5));
    }

    #[test]
    fn lengths_beyond_the_message_and_other_encodings_are_refused() {
        let mut reader = Reader::cdr([0, 1, 0, 0, 255, 255, 255, 255].to_vec().into()).unwrap();
        assert!(reader.bytes().unwrap_err().contains("a field needs 4294967295 bytes, but 0 remain"));
        assert!(Reader::cdr(vec![0, 1, 0, 0].into()).unwrap().f64s(usize::MAX).is_err());
        assert!(Reader::cdr(vec![0, 3, 0, 0].into()).unwrap_err().contains("CDR encoding 0x0003"));
        assert!(Reader::cdr(vec![0, 1].into()).is_err());
    }
}
