//! Opening of cameras in threads of their own, so that a missing camera delays nothing.

use std::{fmt, sync::Arc, thread::Builder};

use crossbeam::channel::{Receiver, Sender, bounded};
use flyrig_types::{CameraId, caught};

use super::pulse::Pulse;
use crate::error::{CaptureError, CaptureErrorKind};
use crate::recording::SourceTap;
use crate::source::CameraSource;

type Source = Box<dyn CameraSource>;
type Open = Box<dyn FnMut() -> Result<Source, CaptureError> + Send>;

/// Camera that may be missing at the start: opens its source, and reopens it after a loss.
pub struct SourceOpener {
    pub(super) camera: CameraId,
    pub(super) how: How,
}

pub(super) enum How {
    Ready(Source),
    Factory(Open),
}

impl SourceOpener {
    /// Creates an opener from a function, which may block, fail and panic. It must return a source of this camera.
    #[must_use]
    pub fn new(camera: &CameraId, open: impl FnMut() -> Result<Source, CaptureError> + Send + 'static) -> Self {
        Self { camera: camera.clone(), how: How::Factory(Box::new(open)) }
    }

    /// Wraps a source that is open already. Its camera ends when it fails for good.
    #[must_use]
    pub fn ready(source: Source) -> Self {
        Self { camera: source.camera().clone(), how: How::Ready(source) }
    }

    /// Records the camera's frames across reopenings.
    ///
    /// # Errors
    /// As [`SourceTap::tap`], for a source that is open already.
    pub fn recorded(self, tap: SourceTap) -> Result<Self, CaptureError> {
        let tapped = move |source: Source| Ok(Box::new(tap.tap(source)?) as Source);
        let how = match self.how {
            How::Ready(source) => How::Ready(tapped(source)?),
            How::Factory(mut open) => How::Factory(Box::new(move || tapped(open()?))),
        };
        Ok(Self { how, ..self })
    }

    /// Returns the name of the camera.
    #[must_use]
    pub fn camera(&self) -> &CameraId {
        &self.camera
    }

    /// Opens the source in the calling thread.
    pub(super) fn open_now(self) -> Result<Source, CaptureError> {
        match self.how {
            How::Ready(source) => Ok(source),
            How::Factory(mut open) => call(&self.camera, &mut open),
        }
    }
}

impl fmt::Debug for SourceOpener {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SourceOpener").field("camera", &self.camera).finish_non_exhaustive()
    }
}

fn call(camera: &CameraId, open: &mut Open) -> Result<Source, CaptureError> {
    let source = caught(open).unwrap_or_else(|text| {
        let message = format!("opening it failed inside: {text}");
        Err(CaptureError::general(CaptureErrorKind::Disconnected, message))
    });
    let source = source.map_err(|error| error.of(camera))?;
    if source.camera() == camera {
        return Ok(source);
    }
    let message = format!("its opener gave a source of camera {}; give that of this camera", source.camera());
    let _ = caught(move || drop(source));
    Err(CaptureError::new(camera, CaptureErrorKind::Unsupported, message))
}

/// Thread that opens one camera on request. It ends after the call during which its owner was dropped.
#[derive(Debug)]
pub(super) struct Opening {
    pub requests: Sender<()>,
    pub results: Receiver<Result<Source, CaptureError>>,
}

impl Opening {
    /// Starts the thread.
    ///
    /// # Errors
    /// `Io` when the system cannot start a thread.
    pub fn start(camera: &CameraId, mut open: Open, pulse: Arc<Pulse>) -> Result<Self, CaptureError> {
        let (requests, to_do) = bounded(1);
        let (done, results) = bounded(1);
        let of_thread = camera.clone();
        let work = move || {
            for () in &to_do {
                pulse.beat();
                let result = call(&of_thread, &mut open);
                pulse.rest();
                if let Err(unwanted) = done.send(result) {
                    let _ = caught(move || drop(unwanted));
                    break;
                }
            }
            let _ = caught(move || drop(open));
        };
        Builder::new()
            .name(format!("open {camera}"))
            .spawn(work)
            .map_err(|error| CaptureError::new(camera, CaptureErrorKind::Io, format!("no thread: {error}")))?;
        Ok(Self { requests, results })
    }
}
