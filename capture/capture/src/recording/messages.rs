//! Messages of one MCAP file, read with bounded memory.

use std::{
    fs::File,
    io::{self, BufReader, Read},
    path::Path,
};

use mcap::{
    McapError, McapResult, Message,
    sans_io::{LinearReaderOptions, MessageReadEvent, MessageReader},
};

/// Bytes per read.
const BUFFER: usize = 1 << 20;
/// Most bytes that a compressed byte may become, on average over the file: images compress 100 times at most.
const MOST_RATIO: u64 = 1000;
/// Bytes beyond that ratio, for small files of images of one colour.
const SLACK_BYTES: u64 = 64 << 20;
/// Longest message in a compressed chunk, bytes; all others are at most as long as the file.
const MOST_COMPRESSED: u64 = 64 << 20;

/// Opcode of a chunk, and the bytes of records up to a chunk's uncompressed size.
const CHUNK: u8 = 6;
const RECORD_HEAD: usize = 9;
const CHUNK_HEAD: usize = RECORD_HEAD + 24;

/// Reader of a file's messages in their order. A damaged length asks for no more memory than the file has bytes, or
/// within compressed chunks than a bounded multiple.
pub(super) struct Messages {
    reader: MessageReader,
    source: BufReader<Watched>,
    is_over: bool,
}

impl Messages {
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        let longest = length.max(length.saturating_mul(MOST_RATIO).min(MOST_COMPRESSED));
        let limit = usize::try_from(longest).unwrap_or(usize::MAX);
        let options = LinearReaderOptions::default().with_record_length_limit(limit);
        let source = Watched { file, remaining: length, to_skip: 8, head: Vec::new(), allowed: SLACK_BYTES };
        let source = BufReader::with_capacity(BUFFER, source);
        Ok(Self { reader: MessageReader::new_with_options(options), source, is_over: false })
    }

    /// Returns the bytes of the file that were not handed to the reader yet.
    fn remaining(&self) -> usize {
        let unread = self.source.get_ref().remaining.saturating_add(self.source.buffer().len() as u64);
        usize::try_from(unread).unwrap_or(usize::MAX)
    }
}

impl Iterator for Messages {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.is_over {
            match self.reader.next_event() {
                Some(Ok(MessageReadEvent::ReadRequest(wanted))) => {
                    let room = wanted.min(self.remaining()).max(1);
                    let read = loop {
                        match self.source.read(self.reader.insert(room)) {
                            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                            result => break result,
                        }
                    };
                    match read {
                        Ok(count) => self.reader.notify_read(count),
                        Err(error) => {
                            self.is_over = true;
                            return Some(Err(McapError::Io(error)));
                        }
                    }
                }
                Some(Ok(MessageReadEvent::Message(message))) => return Some(Ok(message)),
                Some(Err(error)) => {
                    self.is_over = true;
                    return Some(Err(error));
                }
                None => self.is_over = true,
            }
        }
        None
    }
}

/// Returns the text of an error, with the system's own, which the text of the mcap crate omits.
pub(super) fn cause(error: &McapError) -> String {
    match error {
        McapError::Io(error) => error.to_string(),
        other => other.to_string(),
    }
}

/// File whose chunks must not expand beyond all measure.
struct Watched {
    file: File,
    remaining: u64,
    /// Bytes up to the next record.
    to_skip: u64,
    /// Beginning of the current record.
    head: Vec<u8>,
    /// Bytes that chunks may still expand to.
    allowed: u64,
}

impl Watched {
    fn watch(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        while !bytes.is_empty() {
            if self.to_skip > 0 {
                let skipped = usize::try_from(self.to_skip).unwrap_or(usize::MAX).min(bytes.len());
                self.to_skip -= skipped as u64;
                bytes = &bytes[skipped..];
                continue;
            }
            let wanted = if self.head.len() < RECORD_HEAD { RECORD_HEAD } else { CHUNK_HEAD };
            let (taken, rest) = bytes.split_at((wanted - self.head.len()).min(bytes.len()));
            self.head.extend_from_slice(taken);
            bytes = rest;
            if self.head.len() < wanted {
                continue;
            }
            let length = little_endian(&self.head[1..RECORD_HEAD]);
            if wanted == RECORD_HEAD && self.head[0] == CHUNK && length >= 24 {
                continue;
            }
            if wanted == CHUNK_HEAD {
                self.expand(length, little_endian(&self.head[CHUNK_HEAD - 8..]))?;
            }
            self.to_skip = length - (wanted - RECORD_HEAD) as u64;
            self.head.clear();
        }
        Ok(())
    }

    fn expand(&mut self, length: u64, expanded: u64) -> io::Result<()> {
        let allowed = self.allowed.saturating_add(length.saturating_mul(MOST_RATIO));
        self.allowed = allowed.checked_sub(expanded).ok_or_else(|| {
            let text = format!("a chunk of {length} bytes expands to {expanded}, more than {MOST_RATIO} times as many");
            io::Error::new(io::ErrorKind::InvalidData, text)
        })?;
        Ok(())
    }
}

impl Read for Watched {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        self.remaining = self.remaining.saturating_sub(count as u64);
        self.watch(&buffer[..count])?;
        Ok(count)
    }
}

fn little_endian(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |value, byte| value << 8 | u64::from(*byte))
}
