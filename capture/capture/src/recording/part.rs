//! File of a recording while it is written.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use mcap::{McapResult, WriteOptions, Writer, records::MessageHeader};

use super::{
    disk::Disk,
    message::Channel,
    outlet::{Item, Note},
};

/// Overhead of a message's record and its index entry, bytes.
const MESSAGE_BYTES: u64 = 64;
/// Metadata keys of the channels, which link the parts of a recording.
const RECORDING: &str = "recording";
const PART: &str = "part";

/// Link between the parts of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Link {
    /// Identifier shared by all parts, unique to the recording.
    pub recording: String,
    /// Number of the part, counted from 0.
    pub part: u32,
}

impl Link {
    pub fn read(metadata: &BTreeMap<String, String>) -> Option<Self> {
        Some(Self { recording: metadata.get(RECORDING)?.clone(), part: metadata.get(PART)?.parse().ok()? })
    }

    fn put(&self, metadata: &mut BTreeMap<String, String>) {
        metadata.insert(RECORDING.to_owned(), self.recording.clone());
        metadata.insert(PART.to_owned(), self.part.to_string());
    }
}

/// File that is complete by itself, with notes, schemas and channels.
pub(super) struct RecordingPart<D: Disk> {
    writer: Writer<D::File>,
    link: Link,
    channels: Vec<(Arc<Channel>, u16)>,
    /// Time of the first message after the notes.
    begun: Option<Instant>,
    /// Approximate length of the file.
    bytes: u64,
}

impl<D: Disk> RecordingPart<D> {
    /// Creates the file and writes the notes.
    pub fn create(disk: &mut D, notes: &[Note], link: Link) -> McapResult<Self> {
        let target = disk.create(link.part)?;
        // Chunks are made in memory and written whole: a killed process leaves no half of one behind.
        let options = WriteOptions::new().compression(None).chunk_size(None).disable_seeking(true);
        let writer = Writer::with_options(target, options.library(concat!("flyrig ", env!("CARGO_PKG_VERSION"))))?;
        let mut part = Self { writer, link, channels: Vec::new(), begun: None, bytes: 0 };
        for (sequence, note) in (0..).zip(notes) {
            let channel_id = part.add(&note.schema, &note.topic, &BTreeMap::new())?;
            part.put(&MessageHeader { channel_id, sequence, log_time: 0, publish_time: 0 }, &note.payload)?;
        }
        part.flush()?;
        disk.sync()?;
        Ok(part)
    }

    fn add(
        &mut self,
        (name, encoding, data): &(String, String, Vec<u8>),
        topic: &str,
        metadata: &BTreeMap<String, String>,
    ) -> McapResult<u16> {
        let schema = self.writer.add_schema(name, encoding, data)?;
        let mut metadata = metadata.clone();
        self.link.put(&mut metadata);
        // Once in the data and once in the index.
        self.bytes += 2 * (data.len() + topic.len()) as u64 + 2 * MESSAGE_BYTES;
        self.writer.add_channel(schema, topic, "protobuf", &metadata)
    }

    fn put(&mut self, header: &MessageHeader, payload: &[u8]) -> McapResult<()> {
        self.bytes += payload.len() as u64 + MESSAGE_BYTES;
        self.writer.write_to_known_channel(header, payload)
    }

    /// Returns the length of the file with another message, bytes, and the time of its first message; `None` as long as
    /// it holds notes only.
    pub fn with(&self, item: &Item) -> Option<(u64, Instant)> {
        self.begun.map(|begun| (self.bytes + item.payload.len() as u64 + MESSAGE_BYTES, begun))
    }

    pub fn write(&mut self, item: &Item) -> McapResult<()> {
        self.begun.get_or_insert_with(Instant::now);
        let known = self.channels.iter().find(|(known, _)| Arc::ptr_eq(known, &item.channel) || *known == item.channel);
        let channel_id = match known {
            Some((_, id)) => *id,
            None => {
                let channel = Arc::clone(&item.channel);
                let id = self.add(&channel.schema, &channel.topic, &channel.metadata)?;
                self.channels.push((channel, id));
                id
            }
        };
        let log_time = u64::try_from(item.nanos).unwrap_or(0);
        let header = MessageHeader { channel_id, sequence: item.sequence as u32, log_time, publish_time: log_time };
        self.put(&header, &item.payload)
    }

    /// Writes all buffered bytes to the file system.
    pub fn flush(&mut self) -> McapResult<()> {
        self.writer.flush()
    }

    /// Writes the index and makes the file durable.
    pub fn finish(mut self, disk: &mut D) -> McapResult<()> {
        use std::io::Write as _;
        self.writer.finish()?;
        self.writer.into_inner().flush()?;
        Ok(disk.sync()?)
    }
}
