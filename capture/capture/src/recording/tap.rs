//! Recording of passing data: a camera's frames, and messages of other kinds.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use flyrig_types::{CameraId, Frame, PixelFormat};

use super::{
    compress::{Compression, Compressor},
    message::Channel,
    outlet::Outlet,
};
use crate::error::CaptureError;
use crate::source::{CameraSource, SourceHealth};

/// Attaches a recording to sources, wherever they are opened. Cheap to clone; does not keep the recording from ending.
#[derive(Debug, Clone)]
pub struct SourceTap {
    pub(super) outlet: Outlet,
    pub(super) compression: Option<Compression>,
}

impl SourceTap {
    /// Records the frames of a source as they pass.
    ///
    /// # Errors
    /// `Io` when the system cannot start a thread for the compression.
    pub fn tap<S: CameraSource>(&self, source: S) -> Result<Recording<S>, CaptureError> {
        Recording::new(source, self.outlet.clone(), self.compression)
    }
}

/// Source whose frames are recorded as they pass: JPEG images unchanged, others compressed where the recorder is
/// configured so. The frames themselves pass unchanged.
#[derive(Debug)]
pub struct Recording<S> {
    source: S,
    outlet: Outlet,
    channel: Option<Arc<Channel>>,
    compressor: Option<Compressor>,
}

impl<S: CameraSource> Recording<S> {
    pub(super) fn new(source: S, outlet: Outlet, compression: Option<Compression>) -> Result<Self, CaptureError> {
        let start = |compression| Compressor::start(source.camera(), compression, outlet.clone());
        let compressor = compression.map(start).transpose()?;
        Ok(Self { source, outlet, channel: None, compressor })
    }
}

impl<S> Recording<S> {
    fn record(&mut self, frame: &Frame) {
        if !self.outlet.is_open() {
            return;
        }
        match &self.compressor {
            Some(compressor) if frame.image.format() != PixelFormat::Mjpeg => compressor.record(frame),
            _ => self.outlet.frame(&mut self.channel, frame, frame.image.bytes().len()),
        }
    }
}

impl<S: CameraSource> CameraSource for Recording<S> {
    fn camera(&self) -> &CameraId {
        self.source.camera()
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, CaptureError> {
        let frame = self.source.next_frame(timeout)?;
        self.record(&frame);
        Ok(frame)
    }

    fn order_nanos(&self, frame: &Frame) -> i64 {
        self.source.order_nanos(frame)
    }

    fn next_nanos(&self) -> Option<i64> {
        self.source.next_nanos()
    }

    fn health(&self) -> SourceHealth {
        self.source.health()
    }
}

/// Channel of messages other than frames, such as poses. Messages after the recording's end are lost.
#[derive(Debug)]
pub struct MessageTap {
    outlet: Outlet,
    channel: Arc<Channel>,
    sequence: u64,
}

impl MessageTap {
    pub(super) fn new(outlet: Outlet, topic: &str, schema: (String, String, Vec<u8>)) -> Self {
        let channel = Channel { topic: topic.to_owned(), schema, metadata: BTreeMap::new() };
        Self { outlet, channel: Arc::new(channel), sequence: 0 }
    }

    /// Records a message (protobuf) of an instant, nanoseconds on the clock of the frames. Never blocks; has no effect
    /// once the recording has stopped.
    pub fn record(&mut self, nanos: i64, payload: Vec<u8>) {
        if self.outlet.is_open() {
            self.outlet.message(&self.channel, nanos, self.sequence, payload);
            self.sequence += 1;
        }
    }
}
