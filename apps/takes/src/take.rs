//! Opened take: sources, calibration, plates, body, and the way through its frame sets.

use std::{path::Path, time::Duration};

use anyhow::Result;
use flyrig_body::Template;
use flyrig_capture::{CameraSource, Pacing, SourceOpener};
use flyrig_fusion::{InputFormat, Intake};
use flyrig_report::{progress_bar, stop};
use flyrig_sync::SyncSettings;
use flyrig_types::{CameraId, FrameSet, Image, PoseTrack, Rig, ThreadWatch};

use crate::dataset;

/// Longest wait for a camera's frame in stored footage without synchronization settings, nanoseconds.
const MAX_WAIT_NANOS: u64 = 1_000_000_000;
/// Largest jitter of timestamps at the beginning of a span, seconds.
const JITTER_SECS: f64 = 1e-3;

/// Parts of a take that its user needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Needs {
    /// Frames alone: real cameras need no calibration, and plates are not read.
    Frames,
    /// Frames, and calibration and plates if there are any.
    #[default]
    Calibration,
}

/// Calibrated cameras and their plates.
#[derive(Debug)]
pub struct Calibration {
    /// Cameras in the order of the take's sources.
    pub rig: Rig,
    /// Images of the empty scene, one per slot.
    pub plates: Vec<Option<Image>>,
}

impl Calibration {
    /// Returns a calibration without any plate.
    #[must_use]
    pub fn without_plates(rig: Rig) -> Self {
        let plates = rig.cameras.iter().map(|_| None).collect();
        Self { rig, plates }
    }

    /// Loads calibration and plates of a folder for these cameras, whose images lie in the folder `images`.
    pub(crate) fn load(folder: &Path, images: &Path, sources: &[SourceOpener]) -> Result<Self> {
        let cameras: Vec<CameraId> = sources.iter().map(|source| source.camera().clone()).collect();
        let names: Vec<String> = cameras.iter().map(CameraId::to_string).collect();
        let rig = dataset::load_rig_of(folder, images, &cameras)?;
        let rig = dataset::select_cameras(&rig, &names, "the calibration")?;
        let plates = dataset::load_plates(&folder.join("background"), &rig)?;
        Ok(Self { rig, plates })
    }
}

/// Body of the person whom a configuration names.
#[derive(Debug, Clone)]
pub struct TakeBody {
    /// Skinned body.
    pub template: Template,
    /// Poses over time; `None` if they are unknown.
    pub track: Option<PoseTrack>,
}

/// Opened take.
///
/// ```no_run
/// use flyrig_takes::{Footage, Take, TakeInput, TakeOptions, TakeSpan};
///
/// let input = TakeInput::Footage(Footage::from_dataset("take.mcap".as_ref()));
/// // Simulated cameras alone need a graphics adapter.
/// let mut take = Take::open(&input, &TakeOptions::default(), &|| anyhow::bail!("no adapter"))?;
/// let calibration = take.calibration.take().expect("recorded with a calibration");
/// take.for_each_set(&calibration.rig, TakeSpan { secs: [0.0, 5.0], spread_nanos: 0 }, "ms of the take", |set| {
///     println!("{} images at {} ns", set.present().count(), set.master_nanos);
///     Ok(())
/// })?;
/// # anyhow::Ok(())
/// ```
pub struct Take {
    /// One source per camera, in the rig's order if there is a rig. Only live cameras may be missing at first.
    pub sources: Vec<SourceOpener>,
    /// Whether frames arrive as they are captured, and cannot wait.
    pub is_live: bool,
    /// Calibration and plates; `None` for uncalibrated cameras.
    pub calibration: Option<Calibration>,
    /// Whether the frames carry masks to be used.
    pub given_masks: bool,
    /// How frames are joined to sets; includes the time offsets of the calibration, which are subtracted from the timestamps.
    pub sync: SyncSettings,
    /// Body of the person; only configurations have one.
    pub body: Option<TakeBody>,
    /// Threads that the sources need.
    pub threads: Vec<ThreadWatch>,
}

impl Take {
    /// Returns an uncalibrated take of stored cameras.
    #[must_use]
    pub fn from_sources(sources: Vec<SourceOpener>) -> Self {
        Self {
            sources,
            is_live: false,
            calibration: None,
            given_masks: false,
            sync: SyncSettings::default(),
            body: None,
            threads: Vec::new(),
        }
    }

    /// Returns the pace at which every frame is read: live cameras do not wait, all others lose no frame.
    #[must_use]
    pub fn pacing(&self) -> Pacing {
        if self.is_live { Pacing::AsDelivered } else { Pacing::Lossless }
    }

    /// Calls `each` with every frame set of a span, until Ctrl-C, under a progress bar.
    ///
    /// # Errors
    /// The cameras cannot be started; errors of `each`.
    pub fn for_each_set(
        self,
        rig: &Rig,
        span: TakeSpan,
        label: &'static str,
        mut each: impl FnMut(&FrameSet) -> Result<()>,
    ) -> Result<ReadErrors> {
        let [from_secs, to_secs] = span.secs;
        let max_wait_nanos = self.sync.max_wait_nanos.unwrap_or(MAX_WAIT_NANOS).saturating_add(span.spread_nanos);
        let sync = SyncSettings { max_wait_nanos: Some(max_wait_nanos), ..self.sync };
        let mut intake = Intake::start_opening(self.sources, InputFormat::OfRig(rig), &sync, Pacing::Lossless)?;
        let bar = progress_bar((to_secs * 1e3) as u64, label);
        let mut first = None;
        while !intake.ended() && !stop::requested() {
            let Some(set) = intake.next_set(Duration::from_millis(200)) else { continue };
            let begin = *first.get_or_insert(set.master_nanos);
            let at = set.master_nanos.saturating_sub(begin) as f64 * 1e-9;
            if at > to_secs {
                break;
            }
            bar.set_position((at * 1e3) as u64);
            if at >= from_secs - JITTER_SECS {
                each(&set)?;
            }
        }
        bar.finish_and_clear();
        let error = |slot| intake.last_error(slot).map(|error| error.to_string());
        Ok(ReadErrors((0..rig.cameras.len()).map(error).collect()))
    }
}

/// Part of a take that [`Take::for_each_set`] reads.
#[derive(Debug, Clone, Copy)]
pub struct TakeSpan {
    /// First and last time, seconds after the first frame set.
    pub secs: [f64; 2],
    /// Additional wait of frame sets for late cameras, nanoseconds: waiting loses nothing in stored footage.
    pub spread_nanos: u64,
}

/// Last read error of each camera of a take.
pub struct ReadErrors(Vec<Option<String>>);

impl ReadErrors {
    /// Returns the last error of the camera in a slot.
    #[must_use]
    pub fn get(&self, slot: usize) -> Option<&str> {
        self.0.get(slot)?.as_deref()
    }
}

/// Wraps opened sources for the capture threads.
pub(crate) fn ready(sources: Vec<Box<dyn CameraSource>>) -> Vec<SourceOpener> {
    sources.into_iter().map(SourceOpener::ready).collect()
}
