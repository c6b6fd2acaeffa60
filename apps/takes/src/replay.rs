//! Replay of stored footage into a session: for `flyrig eval`, training and benchmarks.

use std::{
    collections::BTreeMap,
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use flyrig_body::{Outfit, ShapeParams, default_template, load_gltf};
use flyrig_capture::{CaptureErrorKind, RecordedCamera, VideoOptions, VideoReplay, recorded_spans};
use flyrig_fusion::{
    EstimatedPerception, GivenPerception, GivenPerson, Origin, PerceptionSettings, PersonId, SHAPE_SECS, SHAPE_SETS,
    Session, SessionBuilder, SessionSettings, next_frame,
};
use flyrig_gpu::GpuContext;
use flyrig_sync::SyncSettings;
use flyrig_types::{Camera, CameraId, FrameSet, Image, Rig};

use crate::{
    dataset,
    footage::Footage,
    frame_sets::{FrameSelection, FrameSets},
    known_avatar::KnownBody,
    recorded::recorded_cameras,
    true_joints::TrueJoints,
    truth::TruthReader,
};

/// Settings of a [`Replay`].
#[derive(Debug, Clone)]
pub struct ReplaySettings {
    /// Folder in EasyMocap's layout, or a recording of `flyrig record`.
    pub dataset: PathBuf,
    /// Input cameras.
    pub inputs: Vec<String>,
    /// Held-out cameras, which are scored; may be empty.
    pub holdout: Vec<String>,
    /// Settings of the session; its origins decide which parts of the data set are read.
    pub session: SessionSettings,
    /// Frame rate of a folder, frames per second; a recording has its own.
    pub fps: f64,
    /// Range of frames, all for `None`. Those of a recording count from its first frame set.
    pub frames: Option<Range<u64>>,
    /// Time offsets that are subtracted from the timestamps, nanoseconds, in place of the calibration's.
    pub lags_nanos: BTreeMap<CameraId, i64>,
    /// Whether frames carry their true masks for scores even if masks are estimated.
    pub true_masks: bool,
    /// Parts of the names of joints whose estimated orientation is replaced by the true one; "place" replaces the root's position. Needs an
    /// estimated pose and the given shape.
    pub true_joints: Vec<String>,
    /// Known body of the person, which given and estimated poses move; neither shape nor clothes are estimated then.
    pub body: Option<KnownBody>,
}

/// Stored footage that is replayed into a session.
///
/// ```no_run
/// use std::collections::BTreeMap;
/// use flyrig_fusion::SessionSettings;
/// use flyrig_gpu::{AdapterChoice, GpuContext};
/// use flyrig_takes::{Replay, ReplaySettings};
///
/// let settings = ReplaySettings {
///     dataset: "data/walk".into(),
///     inputs: ["00", "03", "05"].map(str::to_owned).to_vec(),
///     holdout: vec!["01".to_owned()],
///     session: SessionSettings::default(),
///     fps: 30.0,
///     frames: Some(0..60),
///     lags_nanos: BTreeMap::new(),
///     true_masks: false,
///     true_joints: Vec::new(),
///     body: None,
/// };
/// let mut replay = Replay::open(&settings, &GpuContext::fastest_of(&AdapterChoice::Best)?)?;
/// while let Some(set) = replay.next_set()? {
///     replay.session.process(&set)?;
///     let view = replay.session.render(&replay.holdout[0])?;
///     let truth = replay.truth.at(set.master_nanos)?;
///     println!("{} pixels, ground truth: {}", view.rgba.len() / 4, truth[0].is_some());
/// }
/// # anyhow::Ok(())
/// ```
pub struct Replay {
    /// Session of the input cameras.
    pub session: Session,
    sets: FrameSets,
    /// Number of frame sets.
    pub count: usize,
    /// Held-out cameras.
    pub holdout: Vec<Camera>,
    /// Frames of the held-out cameras.
    pub truth: TruthReader,
}

impl Replay {
    /// Opens the cameras and builds the session.
    ///
    /// # Errors
    /// Names the missing file, camera or person.
    pub fn open(settings: &ReplaySettings, gpu: &GpuContext) -> Result<Self> {
        settings.session.validate()?;
        let footage = Footage::from_dataset(&settings.dataset);
        footage.check_dataset()?;
        let (rig, holdout) = load_rigs(settings, &footage)?;
        let sync = SyncSettings { lags_nanos: settings.lags_nanos.clone(), ..SyncSettings::default() };
        let lags_nanos = sync.with_offsets_of(&rig.cameras).with_offsets_of(&holdout).lags_nanos;
        let recorded = match &footage {
            Footage::Recording(_) => Some(measure_recording(settings, &rig)?),
            Footage::VideoFolder(root) => Some(measure_videos(root, settings)?),
            Footage::Folder(_) | Footage::Videos(_) => None,
        };
        let fps = recorded.map_or(settings.fps, |(fps, _)| fps);
        let selection = FrameSelection { footage, fps, frames: settings.frames.clone(), lags_nanos };
        let with_masks = settings.true_masks || settings.session.perception.masks == Origin::Given;
        if let (Origin::Given, Some(root)) = (settings.session.perception.masks, selection.footage.folder()) {
            dataset::require_given_masks(root, &rig, "estimate them with --masks estimated")?;
        }
        let (sets, in_folder) = selection.open_sets(&rig, with_masks)?;
        let count = recorded.map_or(in_folder, |(_, count)| count);
        let truth = TruthReader::open(&selection, &holdout)?;
        let perceived = &settings.session.perception;
        let plates = dataset::load_plates_of(&settings.dataset, perceived, &rig)?;
        dataset::require_masks(perceived, &plates)?;
        let first = || first_sets(selection.open_sets(&rig, with_masks)?.0, fps, count);
        let mut builder = SessionBuilder::new(gpu.clone(), rig.clone()).settings(settings.session.clone());
        if let Some(memory) = settings.body.as_ref().and_then(|body| body.memory.clone()) {
            builder = builder.person(PersonId::default(), memory);
        }
        let session = match perceived.pose {
            Origin::Given => builder.perception(given_perception(settings, &rig, &plates, first)?),
            Origin::Estimated => with_estimates(builder, settings, &rig, &plates, first)?,
        };
        Ok(Self { session: session.build()?, sets, count, holdout, truth })
    }

    /// Returns the next frame set; `None` at the end.
    ///
    /// # Errors
    /// Names the image that cannot be read.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        self.sets.next_set()
    }

    /// Returns the counts of complete and partial frame sets and of broken images.
    #[must_use]
    pub fn sync_summary(&self) -> serde_json::Value {
        self.sets.summary()
    }
}

/// Builds the perception of given poses, which move the known body or the data set's own.
fn given_perception(
    settings: &ReplaySettings,
    rig: &Rig,
    plates: &[Option<Image>],
    first: impl FnOnce() -> Result<Vec<FrameSet>>,
) -> Result<GivenPerception> {
    let perceived = &settings.session.perception;
    let mut person = given_person(settings)?;
    if let Some(KnownBody { template, .. }) = &settings.body {
        template.check_same_joints(&person.template)?;
        person.template = template.clone();
        return Ok(GivenPerception::new(rig, vec![person]).with_masks(perceived, plates)?.dressed());
    }
    let mut perception = GivenPerception::new(rig, vec![person]).with_masks(perceived, plates)?;
    perception.find_outfits(&first()?)?;
    Ok(perception)
}

/// Adds the perception that estimates poses of the known body, of the data set's, or of a body whose shape is estimated first.
fn with_estimates(
    builder: SessionBuilder,
    settings: &ReplaySettings,
    rig: &Rig,
    plates: &[Option<Image>],
    first: impl FnOnce() -> Result<Vec<FrameSet>>,
) -> Result<SessionBuilder> {
    let perceived = &settings.session.perception;
    if let Some(KnownBody { template, .. }) = &settings.body {
        let perceived = PerceptionSettings { shape: Some(Origin::Given), ..perceived.clone() };
        let mut perception = EstimatedPerception::new(rig, template, &perceived, plates)?;
        perception.know_shape(template, Outfit::default())?;
        return Ok(builder.perception(perception));
    }
    if perceived.shape() == Origin::Given {
        let GivenPerson { template, track, .. } = given_person(settings)?;
        let mut inner = EstimatedPerception::new(rig, &template, perceived, plates)?;
        inner.find_outfits(&first()?)?;
        return Ok(match settings.true_joints.as_slice() {
            [] => builder.perception(inner),
            names => builder.perception(TrueJoints { inner, template, track, names: names.to_vec() }),
        });
    }
    let template = default_template(&ShapeParams::default())?;
    let mut perception = EstimatedPerception::new(rig, &template, perceived, plates)?;
    eprintln!("learning the person's shape from {SHAPE_SETS} frames of the first {SHAPE_SECS} seconds");
    for fit in perception.learn_shapes(&first()?).context("no person found in the first frames")? {
        eprintln!("the person is {fit}");
    }
    Ok(builder.perception(perception))
}

/// Loads the rig of the input cameras, and the held-out cameras.
fn load_rigs(settings: &ReplaySettings, footage: &Footage) -> Result<(Rig, Vec<Camera>)> {
    let chosen: Vec<CameraId> =
        settings.inputs.iter().chain(&settings.holdout).map(|name| name.as_str().into()).collect();
    let all = footage.load_rig(&chosen)?;
    let place = format!("the calibration of {}", settings.dataset.display());
    let rig = dataset::select_cameras(&all, &settings.inputs, &place)?;
    // No names would select all cameras.
    let holdout = if settings.holdout.is_empty() {
        Vec::new()
    } else {
        dataset::select_cameras(&all, &settings.holdout, &place)?.cameras
    };
    let used = Rig { cameras: rig.cameras.iter().chain(&holdout).cloned().collect(), world_up: all.world_up };
    let with_lags: Vec<String> = settings.lags_nanos.keys().map(CameraId::to_string).collect();
    dataset::select_cameras(&used, &with_lags, "--inputs or --holdout, but in --lag")?;
    if let Some(both) = settings.inputs.iter().find(|name| settings.holdout.contains(name)) {
        bail!("camera {both} is both an input and held out; scores would flatter");
    }
    Ok((rig, holdout))
}

/// Reads frame sets spread over the first seconds, in which the person takes several poses.
fn first_sets(mut reader: FrameSets, fps: f64, count: usize) -> Result<Vec<FrameSet>> {
    let span = ((SHAPE_SECS * fps) as usize).min(count);
    let every = span.div_ceil(SHAPE_SETS).max(1);
    let mut sets = Vec::new();
    for index in 0..span {
        let Some(set) = reader.next_set()? else { break };
        if index % every == 0 {
            sets.push(set);
        }
    }
    Ok(sets)
}

/// Returns the frame rate of a recording, frames per second, and the number of its frame sets in the chosen range.
fn measure_recording(settings: &ReplaySettings, rig: &Rig) -> Result<(f64, usize)> {
    let (path, perceived) = (settings.dataset.display(), &settings.session.perception);
    if [perceived.pose, perceived.masks].contains(&Origin::Given) {
        bail!("the recording {path} holds no pose and no masks; add --pose estimated --masks estimated");
    }
    if settings.body.is_none() && perceived.shape() == Origin::Given {
        bail!("the recording {path} holds no body; leave --shape out, or use a folder with a glTF file");
    }
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let recorded = recorded_cameras(&settings.dataset)?;
    let images: Vec<RecordedCamera> = ids.iter().map(|id| recorded.images_of(id)).collect();
    let spans = recorded_spans(&settings.dataset, &images)?;
    let Some(longest) = spans.iter().max_by_key(|span| span.frames).filter(|span| span.frames > 0) else {
        bail!("the recording {path} holds no image of the cameras {}", settings.inputs.join(", "));
    };
    let Range { start, end } = settings.frames.clone().unwrap_or(0..u64::MAX);
    let frames = longest.frames as u64;
    if start >= frames {
        bail!("no frame of {path} is in {start}..{end}; there are frames 0 to {}", frames - 1);
    }
    Ok((longest.fps().unwrap_or(settings.fps), (frames.min(end) - start) as usize))
}

/// Returns the frame rate of a folder's videos, frames per second, and the number of their frames in the chosen range.
fn measure_videos(root: &Path, settings: &ReplaySettings) -> Result<(f64, usize)> {
    if settings.session.perception.masks == Origin::Given {
        bail!("the videos in {} have no masks; add --masks estimated", root.display());
    }
    let measure = |name: &String| {
        let id = CameraId::from(name.as_str());
        let video = VideoReplay::open(&id, &dataset::video_file(root, &id), &VideoOptions::default())?;
        video.header_rate().map_or_else(|| count_frames(video, settings.fps), Ok)
    };
    let rates = settings.inputs.iter().map(measure).collect::<Result<Vec<_>>>()?;
    let (fps, frames) = rates.into_iter().max_by_key(|(_, frames)| *frames).unwrap_or((settings.fps, 0));
    let Range { start, end } = settings.frames.clone().unwrap_or(0..u64::MAX);
    if start >= frames {
        bail!("no frame of {} is in {start}..{end}; there are frames 0 to {}", root.display(), frames.max(1) - 1);
    }
    Ok((fps, frames.min(end).saturating_sub(start) as usize))
}

/// Counts the frames of a video whose header states none; returns their rate, per second, with them: `fps` for fewer than two.
fn count_frames(mut video: VideoReplay, fps: f64) -> Result<(f64, u64)> {
    let (mut frames, mut last_nanos) = (0u64, 0);
    loop {
        match next_frame(&mut video) {
            Ok(Some(frame)) => (frames, last_nanos) = (frames + 1, frame.capture_nanos),
            Ok(None) => break,
            Err(error) if error.kind == CaptureErrorKind::Corrupt => {}
            Err(error) => return Err(error.into()),
        }
    }
    let rate = frames.saturating_sub(1) as f64 / (last_nanos as f64 * 1e-9);
    Ok((if rate.is_finite() && rate > 0.0 { rate } else { fps }, frames))
}

/// Loads the person of the data set's glTF file.
fn given_person(settings: &ReplaySettings) -> Result<GivenPerson> {
    let file = dataset::gltf_file(&settings.dataset)?;
    let human = load_gltf(&file)?;
    let track = human.track.with_context(|| format!("{} holds no animation; use --pose estimated", file.display()))?;
    Ok(GivenPerson { person: PersonId::default(), template: human.template, track, repeat: false })
}

/// Returns the number of a frame set in the data set's file names.
#[must_use]
pub fn frame_number(set: &FrameSet) -> u64 {
    let at_master = set.present().min_by_key(|(_, frame)| frame.capture_nanos.abs_diff(set.master_nanos));
    at_master.map_or(set.index, |(_, frame)| frame.sequence)
}
