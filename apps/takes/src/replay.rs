//! A data set that is replayed into a session: for `flyrig eval`, training and benchmarks.

use std::{
    collections::BTreeMap,
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use flyrig_body::{Outfit, ShapeParams, Template, default_template, load_gltf};
use flyrig_capture::{
    CameraSource, CaptureErrorKind, Decoding, FolderOptions, FolderReplay, McapReplay, recorded_spans, to_rgb8,
};
use flyrig_fusion::{
    EstimatedPerception, GivenPerception, GivenPerson, Origin, PerceptionSettings, PersonId, PersonMemory, SHAPE_SECS,
    SHAPE_SETS, Session, SessionBuilder, SessionSettings, SetReader, next_frame,
};
use flyrig_gpu::GpuContext;
use flyrig_renderer::ColorMatcher;
use flyrig_sync::SyncSettings;
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Image, PixelFormat, Rig};

use crate::{
    dataset,
    take_sets::{TakeSets, decoded},
    true_joints::TrueJoints,
};

/// Settings of a replayed data set.
#[derive(Debug, Clone)]
pub struct ReplaySettings {
    /// Folder in EasyMocap's layout, or a recording of `flyrig record`.
    pub dataset: PathBuf,
    /// Cameras of a recording; None for a folder, which has its own calibration.
    pub recorded: Option<Rig>,
    /// Input cameras.
    pub inputs: Vec<String>,
    /// Cameras that are scored; may be none.
    pub holdout: Vec<String>,
    /// Settings of the session; its origins decide what is read from the data set.
    pub session: SessionSettings,
    /// Frame rate of the folder; a recording has its own.
    pub fps: f64,
    /// All frames where `None`. Those of a recording count from its first set of images.
    pub frames: Option<Range<u64>>,
    /// Time offsets that are subtracted from the timestamps, nanoseconds, in place of the calibration's.
    pub lags_nanos: BTreeMap<CameraId, i64>,
    /// Whether frames carry their true masks even where masks are estimated, for scores.
    pub true_masks: bool,
    /// Parts of the names of joints whose estimated orientation is replaced by the true one; "place" for the root's position. Needs an
    /// estimated pose and the given shape.
    pub true_joints: Vec<String>,
    /// The person's body where it is known: given and estimated poses then move it, and neither shape nor clothes are looked for.
    pub body: Option<KnownBody>,
}

/// A person who is known before the first image.
#[derive(Debug, Clone)]
pub struct KnownBody {
    /// The body, dressed.
    pub template: Template,
    /// Colours to start with; None: those of the images.
    pub memory: Option<PersonMemory>,
}

impl From<Template> for KnownBody {
    fn from(template: Template) -> Self {
        Self { template, memory: None }
    }
}

/// A data set that is replayed into a session.
pub struct Replay {
    /// The session.
    pub session: Session,
    sets: TakeSets,
    /// Number of frames.
    pub count: usize,
    /// The held-out cameras.
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
        let (rig, holdout) = load_rigs(settings)?;
        let sync = SyncSettings { lags_nanos: settings.lags_nanos.clone(), ..SyncSettings::default() };
        let lags_nanos = sync.with_offsets_of(&rig.cameras).with_offsets_of(&holdout).lags_nanos;
        let mut settings = ReplaySettings { lags_nanos, ..settings.clone() };
        let recorded = settings.recorded.is_some().then(|| measure_recording(&settings, &rig)).transpose()?;
        if let Some((fps, _)) = recorded {
            settings.fps = fps;
        }
        let settings = &settings;
        let (sets, in_folder) = open_inputs(settings, &rig)?;
        let count = recorded.map_or(in_folder, |(_, count)| count);
        let truth = TruthReader::open(settings, &holdout)?;
        let perceived = &settings.session.perception;
        let plates = dataset::plates(&dataset::plate_folder(&settings.dataset, perceived), &rig)?;
        dataset::require_masks(perceived, &plates)?;
        let mut builder = SessionBuilder::new(gpu.clone(), rig.clone()).settings(settings.session.clone());
        if let Some(memory) = settings.body.as_ref().and_then(|body| body.memory.clone()) {
            builder = builder.person(PersonId::default(), memory);
        }
        let session = match perceived.pose {
            Origin::Given => {
                let mut person = given_person(&settings.dataset)?;
                if let Some(KnownBody { template, .. }) = &settings.body {
                    template.check_same_joints(&person.template)?;
                    person.template = template.clone();
                    let perception = GivenPerception::new(&rig, vec![person]).with_masks(perceived, &plates)?;
                    builder.perception(perception.dressed())
                } else {
                    let mut perception = GivenPerception::new(&rig, vec![person]).with_masks(perceived, &plates)?;
                    perception.find_outfits(&first_sets(settings, &rig, count)?)?;
                    builder.perception(perception)
                }
            }
            Origin::Estimated => {
                if let Some(KnownBody { template, .. }) = &settings.body {
                    let perceived = PerceptionSettings { shape: Some(Origin::Given), ..perceived.clone() };
                    let mut perception = EstimatedPerception::new(&rig, template, &perceived, &plates)?;
                    perception.know_shape(template, Outfit::default())?;
                    builder.perception(perception)
                } else if perceived.shape() == Origin::Given {
                    let GivenPerson { template, track, .. } = given_person(&settings.dataset)?;
                    let mut inner = EstimatedPerception::new(&rig, &template, perceived, &plates)?;
                    inner.find_outfits(&first_sets(settings, &rig, count)?)?;
                    match settings.true_joints.as_slice() {
                        [] => builder.perception(inner),
                        names => builder.perception(TrueJoints { inner, template, track, names: names.to_vec() }),
                    }
                } else {
                    let template = default_template(&ShapeParams::default())?;
                    let mut perception = EstimatedPerception::new(&rig, &template, perceived, &plates)?;
                    eprintln!("learning the person's shape from {SHAPE_SETS} frames of the first {SHAPE_SECS} seconds");
                    let first = first_sets(settings, &rig, count)?;
                    for fit in perception.learn_shapes(&first).context("no person found in the first frames")? {
                        eprintln!("the person is {fit}");
                    }
                    builder.perception(perception)
                }
            }
        };
        Ok(Self { session: session.build()?, sets, count, holdout, truth })
    }

    /// Returns the next set; `None` at the end.
    ///
    /// # Errors
    /// Names the image that cannot be read.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        self.sets.next_set()
    }

    /// Counts of complete and partial sets and of broken images.
    #[must_use]
    pub fn sync_summary(&self) -> serde_json::Value {
        self.sets.summary()
    }
}

fn load_rigs(args: &ReplaySettings) -> Result<(Rig, Vec<Camera>)> {
    let chosen: Vec<CameraId> = args.inputs.iter().chain(&args.holdout).map(|name| name.as_str().into()).collect();
    let all = match &args.recorded {
        Some(rig) => rig.clone(),
        None => dataset::load_rig(&args.dataset, &chosen)?,
    };
    let whose = format!("the calibration of {}", args.dataset.display());
    let rig = dataset::pick(&all, &args.inputs, &whose)?;
    // No name would pick all cameras.
    let holdout = if args.holdout.is_empty() {
        Rig { cameras: Vec::new(), world_up: all.world_up }
    } else {
        dataset::pick(&all, &args.holdout, &whose)?
    };
    let used = Rig { cameras: rig.cameras.iter().chain(&holdout.cameras).cloned().collect(), world_up: all.world_up };
    let with_lags: Vec<String> = args.lags_nanos.keys().map(CameraId::to_string).collect();
    dataset::pick(&used, &with_lags, "--inputs or --holdout, but in --lag")?;
    if let Some(both) = args.inputs.iter().find(|name| args.holdout.contains(name)) {
        bail!("camera {both} is both an input and held out; scores would flatter");
    }
    Ok((rig, holdout.cameras))
}

/// Sets spread over the first seconds, in which the person is seen in several poses.
fn first_sets(settings: &ReplaySettings, rig: &Rig, count: usize) -> Result<Vec<FrameSet>> {
    let (mut reader, _) = open_inputs(settings, rig)?;
    let span = ((SHAPE_SECS * settings.fps) as usize).min(count);
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

/// Returns the frame rate of a recording and the number of sets that are taken of it.
fn measure_recording(settings: &ReplaySettings, rig: &Rig) -> Result<(f64, usize)> {
    let (path, perceived) = (settings.dataset.display(), &settings.session.perception);
    if [perceived.pose, perceived.masks].contains(&Origin::Given) {
        bail!("the recording {path} holds no pose and no masks; add --pose estimated --masks estimated");
    }
    if settings.body.is_none() && perceived.shape() == Origin::Given {
        bail!("the recording {path} holds no body; leave --shape out, or use a folder with a glTF file");
    }
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let spans = recorded_spans(&settings.dataset, &ids)?;
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

/// The person of the data set's glTF file.
fn given_person(root: &Path) -> Result<GivenPerson> {
    let file = dataset::gltf_file(root)?;
    let human = load_gltf(&file)?;
    let track = human.track.with_context(|| format!("{} holds no animation; use --pose estimated", file.display()))?;
    Ok(GivenPerson { person: PersonId::default(), template: human.template, track, repeat: false })
}

/// Opens the input cameras; returns a folder's number of frames as well.
fn open_inputs(settings: &ReplaySettings, rig: &Rig) -> Result<(TakeSets, usize)> {
    let with_masks = settings.true_masks || settings.session.perception.masks == Origin::Given;
    let (sources, count) = open_sources(settings, &rig.cameras, with_masks)?;
    let is_folder = settings.recorded.is_none();
    let sync = SyncSettings {
        // A folder's frames have the times of their numbers, those of a recording come as they come.
        window_nanos: is_folder.then(|| half_period_nanos(settings.fps)),
        lags_nanos: settings.lags_nanos.clone(),
        ..SyncSettings::default()
    };
    let reader = SetReader::new(sources, &sync);
    let range = settings.frames.clone().unwrap_or(0..u64::MAX);
    let sets = if is_folder { TakeSets::folder(reader) } else { TakeSets::recording(reader, &rig.cameras, range) };
    Ok((sets, count))
}

/// Opens cameras of a folder, or of a recording; returns a folder's number of frames as well.
fn open_sources(
    settings: &ReplaySettings,
    cameras: &[Camera],
    with_masks: bool,
) -> Result<(Vec<Box<dyn CameraSource>>, usize)> {
    let ids: Vec<CameraId> = cameras.iter().map(|camera| camera.id.clone()).collect();
    let path = &settings.dataset;
    if settings.recorded.is_some() {
        let open = |id: &CameraId| Ok(Box::new(McapReplay::open(id, path)?) as Box<dyn CameraSource>);
        return Ok((ids.iter().map(open).collect::<Result<_>>()?, 0));
    }
    let options = FolderOptions { fps: settings.fps, frames: settings.frames.clone(), with_masks };
    let sources = FolderReplay::open(path, Some(&ids), &options)?;
    let count = sources.iter().map(FolderReplay::remaining).max().unwrap_or(0);
    Ok((sources.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect(), count))
}

/// Reads the held-out cameras alongside, never ahead of what is scored.
pub struct TruthReader {
    sources: Vec<TrueImages>,
    window_nanos: u64,
}

/// Images of one held-out camera.
struct TrueImages {
    source: Box<dyn CameraSource>,
    /// Is taken off the stamps, nanoseconds.
    lag_nanos: i64,
    matcher: Option<ColorMatcher>,
    /// Of a recording.
    decoding: Option<Decoding>,
    /// Next frame that was read.
    ahead: Option<Frame>,
    /// Frame nearest to the last time, and whether its image is decoded and corrected.
    current: Option<(Frame, bool)>,
}

impl TrueImages {
    /// Goes on to the frame nearest to a time.
    fn seek(&mut self, nanos: i64) -> Result<()> {
        loop {
            if self.ahead.is_none() {
                match next_frame(self.source.as_mut()) {
                    Ok(Some(frame)) => {
                        let capture_nanos = frame.capture_nanos.saturating_sub(self.lag_nanos);
                        self.ahead = Some(Frame { capture_nanos, ..frame });
                    }
                    Ok(None) => return Ok(()),
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        tracing::warn!("held-out {error}; that frame is not scored");
                        continue;
                    }
                    Err(error) => return Err(error.into()),
                }
            }
            let away = |frame: &Frame| frame.capture_nanos.abs_diff(nanos);
            let is_nearer = |ahead: &Frame| self.current.as_ref().is_none_or(|(now, _)| away(ahead) <= away(now));
            match self.ahead.take_if(|ahead| is_nearer(ahead)) {
                Some(frame) => self.current = Some((frame, false)),
                None => return Ok(()),
            }
        }
    }

    /// Decodes the frame and corrects its colours as those of an input camera are corrected.
    fn prepare(&mut self) -> Result<()> {
        let Some((mut frame, false)) = self.current.take_if(|(_, is_ready)| !*is_ready) else { return Ok(()) };
        if let Some(decoding) = &mut self.decoding {
            let Some(found) = decoded(decoding, frame)? else { return Ok(()) };
            frame = found;
        }
        if let Some(matcher) = &self.matcher {
            let (width, height) = (frame.image.width(), frame.image.height());
            let mut rgb = to_rgb8(&frame.image)?;
            matcher.correct(&mut rgb, 3, width as usize, |_| false);
            frame.image = Image::new(width, height, PixelFormat::Rgb8, rgb)?;
        }
        self.current = Some((frame, true));
        Ok(())
    }
}

impl TruthReader {
    fn open(args: &ReplaySettings, holdout: &[Camera]) -> Result<Self> {
        let ids: Vec<CameraId> = holdout.iter().map(|camera| camera.id.clone()).collect();
        let with_masks = ids.iter().all(|id| args.dataset.join("mask").join(id.as_str()).is_dir());
        let (sources, _) = open_sources(args, holdout, with_masks)?;
        let of = |(source, camera): (Box<dyn CameraSource>, &Camera)| TrueImages {
            source,
            lag_nanos: args.lags_nanos.get(&camera.id).copied().unwrap_or_default(),
            matcher: ColorMatcher::new(camera),
            decoding: args.recorded.is_some().then(|| Decoding::new(Some(camera.size()))),
            ahead: None,
            current: None,
        };
        let sources = sources.into_iter().zip(holdout).map(of).collect();
        Ok(Self { sources, window_nanos: half_period_nanos(args.fps) })
    }

    /// Per held-out camera the frame nearest in time, within half a frame period.
    ///
    /// # Errors
    /// Names the image that cannot be read; one that is broken is left out.
    pub fn at(&mut self, nanos: i64) -> Result<Vec<Option<&Frame>>> {
        let window = self.window_nanos;
        let is_near = |frame: &Frame| frame.capture_nanos.abs_diff(nanos) <= window;
        for images in &mut self.sources {
            images.seek(nanos)?;
            if images.current.as_ref().is_some_and(|(frame, _)| is_near(frame)) {
                images.prepare()?;
            }
        }
        let sources = self.sources.iter().map(|images| images.current.as_ref());
        Ok(sources.map(|current| current.map(|(frame, _)| frame).filter(|frame| is_near(frame))).collect())
    }
}

/// Half of the time from frame to frame: nearer than that a frame's set is unambiguous.
fn half_period_nanos(fps: f64) -> u64 {
    (0.5e9 / fps).ceil() as u64
}

/// Number of a set's frames in the data set's file names.
#[must_use]
pub fn frame_number(set: &FrameSet) -> u64 {
    let at_master = set.present().min_by_key(|(_, frame)| frame.capture_nanos.abs_diff(set.master_nanos));
    at_master.map_or(set.index, |(_, frame)| frame.sequence)
}
