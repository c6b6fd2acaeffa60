//! A data set that is replayed into a session: for `flyrig eval`, training and benchmarks.

use std::{
    collections::BTreeMap,
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::{Context, Result, bail};
use flyrig_body::{Outfit, ShapeParams, Template, default_template, load_gltf};
use flyrig_capture::{CameraSource, CaptureErrorKind, FolderOptions, FolderReplay, McapReplay, to_rgb8};
use flyrig_fusion::{
    EstimatedPerception, GivenPerception, GivenPerson, Origin, PerceptionSettings, PersonId, PersonMemory, SHAPE_SECS,
    SHAPE_SETS, Session, SessionBuilder, SessionSettings, SetReader, next_frame,
};
use flyrig_gpu::GpuContext;
use flyrig_renderer::ColorMatcher;
use flyrig_sync::SyncSettings;
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Image, PixelFormat, Rig};

use crate::{dataset, true_joints::TrueJoints};

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
    /// Frame rate of the cameras.
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
    sets: SetReader,
    /// Sets of a recording that are taken.
    recorded: Option<Range<u64>>,
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
        let perceived = &settings.session.perception;
        if settings.recorded.is_some() && [perceived.pose, perceived.masks].contains(&Origin::Given) {
            bail!(
                "the recording {} holds no pose and no masks; add --pose estimated --masks estimated",
                settings.dataset.display()
            );
        }
        let (rig, holdout) = load_rigs(settings)?;
        let sync = SyncSettings { lags_nanos: settings.lags_nanos.clone(), ..SyncSettings::default() };
        let lags_nanos = sync.with_offsets_of(&rig.cameras).with_offsets_of(&holdout).lags_nanos;
        let settings = &ReplaySettings { lags_nanos, ..settings.clone() };
        let (sets, count) = open_inputs(settings, &rig)?;
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
                    perception.find_outfits(&first_sets(settings, &rig)?)?;
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
                    inner.find_outfits(&first_sets(settings, &rig)?)?;
                    match settings.true_joints.as_slice() {
                        [] => builder.perception(inner),
                        names => builder.perception(TrueJoints { inner, template, track, names: names.to_vec() }),
                    }
                } else {
                    let template = default_template(&ShapeParams::default())?;
                    let mut perception = EstimatedPerception::new(&rig, &template, perceived, &plates)?;
                    eprintln!("learning the person's shape from {SHAPE_SETS} frames of the first {SHAPE_SECS} seconds");
                    let first = first_sets(settings, &rig)?;
                    for fit in perception.learn_shapes(&first).context("no person found in the first frames")? {
                        eprintln!("the person is {fit}");
                    }
                    builder.perception(perception)
                }
            }
        };
        let recorded = settings.recorded.is_some().then(|| settings.frames.clone().unwrap_or(0..u64::MAX));
        Ok(Self { session: session.build()?, sets, recorded, count, holdout, truth })
    }

    /// Returns the next set; `None` at the end.
    ///
    /// # Errors
    /// Names the image that cannot be read.
    pub fn next_set(&mut self) -> Result<Option<FrameSet>> {
        next_of(&mut self.sets, self.recorded.as_ref())
    }

    /// Counts of complete and partial sets and of broken images.
    #[must_use]
    pub fn sync_summary(&self) -> serde_json::Value {
        let counts = self.sets.counts();
        let damaged = self.sets.damaged();
        serde_json::json!({ "complete": counts.complete, "partial": counts.partial, "broken_images": damaged })
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
fn first_sets(settings: &ReplaySettings, rig: &Rig) -> Result<Vec<FrameSet>> {
    let (mut reader, count) = open_inputs(settings, rig)?;
    let span = ((SHAPE_SECS * settings.fps) as usize).min(count);
    let every = span.div_ceil(SHAPE_SETS).max(1);
    let recorded = settings.recorded.is_some().then(|| settings.frames.clone().unwrap_or(0..u64::MAX));
    let mut sets = Vec::new();
    for index in 0..span {
        let Some(set) = next_of(&mut reader, recorded.as_ref())? else { break };
        if index % every == 0 {
            sets.push(set);
        }
    }
    Ok(sets)
}

/// The next set of a reader. Those of a recording are numbered in their order, and counted from its first.
fn next_of(sets: &mut SetReader, recorded: Option<&Range<u64>>) -> Result<Option<FrameSet>> {
    let Some(range) = recorded else { return Ok(sets.next_set()?) };
    while let Some(mut set) = sets.next_set()?.filter(|set| set.index < range.end) {
        if set.index >= range.start {
            // Nobody else holds them yet.
            for frame in set.frames.iter_mut().flatten().filter_map(Arc::get_mut) {
                frame.sequence = set.index;
            }
            return Ok(Some(set));
        }
    }
    Ok(None)
}

/// The person of the data set's glTF file.
fn given_person(root: &Path) -> Result<GivenPerson> {
    let file = dataset::gltf_file(root)?;
    let human = load_gltf(&file)?;
    let track = human.track.with_context(|| format!("{} holds no animation; use --pose estimated", file.display()))?;
    Ok(GivenPerson { person: PersonId::default(), template: human.template, track, repeat: false })
}

/// Opens the input cameras; returns their number of frames as well.
fn open_inputs(settings: &ReplaySettings, rig: &Rig) -> Result<(SetReader, usize)> {
    let with_masks = settings.true_masks || settings.session.perception.masks == Origin::Given;
    let (sources, count) = open_sources(settings, &rig.cameras, with_masks)?;
    let sync = SyncSettings {
        window_nanos: Some(half_period_nanos(settings.fps)),
        lags_nanos: settings.lags_nanos.clone(),
        ..SyncSettings::default()
    };
    Ok((SetReader::new(sources, &sync), count))
}

/// Opens cameras of a folder or a recording; returns their number of frames as well.
fn open_sources(
    settings: &ReplaySettings,
    cameras: &[Camera],
    with_masks: bool,
) -> Result<(Vec<Box<dyn CameraSource>>, usize)> {
    let ids: Vec<CameraId> = cameras.iter().map(|camera| camera.id.clone()).collect();
    let path = &settings.dataset;
    if settings.recorded.is_none() {
        let options = FolderOptions { fps: settings.fps, frames: settings.frames.clone(), with_masks };
        let sources = FolderReplay::open(path, Some(&ids), &options)?;
        let count = sources.iter().map(FolderReplay::remaining).max().unwrap_or(0);
        return Ok((sources.into_iter().map(|source| Box::new(source) as Box<dyn CameraSource>).collect(), count));
    }
    let recorded = ids.first().map(|id| McapReplay::count(id, path)).transpose()?.unwrap_or(0);
    let range = settings.frames.clone().unwrap_or(0..u64::MAX);
    let count = (recorded as u64).min(range.end).saturating_sub(range.start) as usize;
    let open = |id: &CameraId| Ok(Box::new(McapReplay::open(id, path)?) as Box<dyn CameraSource>);
    Ok((ids.iter().map(open).collect::<Result<_>>()?, count))
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
    /// Frame of the last time.
    current: Option<Frame>,
}

impl TrueImages {
    /// Corrects time and colours of a frame as those of an input camera are corrected.
    fn corrected(&self, frame: Frame) -> Result<Frame> {
        let capture_nanos = frame.capture_nanos.saturating_sub(self.lag_nanos);
        let Some(matcher) = &self.matcher else { return Ok(Frame { capture_nanos, ..frame }) };
        let (width, height) = (frame.image.width(), frame.image.height());
        let mut rgb = to_rgb8(&frame.image)?;
        matcher.correct(&mut rgb, 3, width as usize, |_| false);
        let image = Image::new(width, height, PixelFormat::Rgb8, rgb)?;
        Ok(Frame { capture_nanos, image, ..frame })
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
        for images in &mut self.sources {
            let earliest = nanos.saturating_sub_unsigned(self.window_nanos);
            while images.current.as_ref().is_none_or(|frame| frame.capture_nanos < earliest) {
                match next_frame(images.source.as_mut()) {
                    Ok(Some(frame)) => images.current = Some(images.corrected(frame)?),
                    Ok(None) => break,
                    Err(error) if error.kind == CaptureErrorKind::Corrupt => {
                        tracing::warn!("held-out {error}; that frame is not scored");
                    }
                    Err(error) => return Err(error.into()),
                }
            }
        }
        let near = |frame: &&Frame| frame.capture_nanos.abs_diff(nanos) <= self.window_nanos;
        Ok(self.sources.iter().map(|images| images.current.as_ref().filter(near)).collect())
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
