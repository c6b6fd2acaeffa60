//! Cameras of a configuration, and what it says about the person.

use anyhow::{Context as _, Result, bail};
use flyrig_body::{ShapeParams, Template, default_template, load_gltf};
use flyrig_calib::load_calibration;
use flyrig_capture::{
    CameraSource, FolderOptions, FolderReplay, Pacing, SourceOpener, VideoOptions, VideoReplay, folder_image_size,
};
use flyrig_fusion::{EstimatedPerception, GivenPerception, GivenPerson, InputFormat, Origin, PersonId};
use flyrig_gpu::GpuContext;
use flyrig_report::dataset;
use flyrig_sim::{SimTime, Simulator};
use flyrig_types::{Camera, CameraId, Image, PoseTrack, Rig, ThreadWatch};

use crate::{
    config::{Config, SourceKind},
    live, network, recording,
};

/// Cameras, and what is known about the person.
pub struct Source {
    /// In the rig's order, images in the cameras' own formats. Only live ones may be opened later.
    pub cameras: Vec<SourceOpener>,
    pub rig: Rig,
    pub template: Template,
    pub track: Option<PoseTrack>,
    /// Images of the empty scene by slot, where there are any.
    pub plates: Vec<Option<Image>>,
    /// Threads that the cameras need.
    pub threads: Vec<ThreadWatch>,
}

/// A person found by the configuration's means.
pub enum FoundBy {
    Given(GivenPerception),
    /// Its shape is still to be learnt.
    Estimated(Box<EstimatedPerception>),
}

impl Source {
    /// How people are found: from the source's pose track, or from the images.
    pub fn perception(&mut self, config: &Config) -> Result<FoundBy> {
        let (settings, plates) = (&config.perception, std::mem::take(&mut self.plates));
        match (config.perception.pose, self.track.take()) {
            (Origin::Given, Some(track)) => {
                let (person, repeat) = (PersonId::default(), config.source.kind == SourceKind::Sim);
                let given = GivenPerson { person, template: self.template.clone(), track, repeat };
                Ok(FoundBy::Given(GivenPerception::new(&self.rig, vec![given]).with_masks(settings, &plates)?))
            }
            (Origin::Given, None) => bail!("perception.pose is \"given\" but the template holds no animation"),
            (Origin::Estimated, _) => {
                let estimated = EstimatedPerception::new(&self.rig, &self.template, settings, &plates)?;
                Ok(FoundBy::Estimated(Box::new(estimated)))
            }
        }
    }
}

/// Pace at which the frames of a configuration's cameras are delivered.
pub fn pacing(config: &Config) -> Pacing {
    match (config.source.real_time, config.source.kind) {
        // Nobody can make a real camera wait.
        (_, SourceKind::Cameras | SourceKind::Network) => Pacing::AsDelivered,
        (false, _) => Pacing::Lossless,
        // Simulated cameras keep the time themselves, whatever their timestamps say.
        (true, SourceKind::Sim) => Pacing::AsDelivered,
        (true, _) => Pacing::RealTime,
    }
}

/// Images that a configuration's cameras send.
pub fn input_format<'a>(kind: SourceKind, rig: &'a Rig) -> InputFormat<'a> {
    match kind {
        SourceKind::Cameras | SourceKind::Network | SourceKind::Mcap => InputFormat::OfRig(rig),
        SourceKind::Folder | SourceKind::Video | SourceKind::Sim => InputFormat::Rgb,
    }
}

/// Opens the cameras of a configuration; only simulated ones need a graphics adapter.
pub fn open(config: &Config, gpu: Option<&GpuContext>) -> Result<Source> {
    let mut source = open_without_plates(config, gpu)?;
    let folder = config.source.calibration_folder();
    let has_folder = folder.is_some() || !config.perception.plates.as_os_str().is_empty();
    if config.source.kind != SourceKind::Sim && has_folder && config.perception.key_color.is_empty() {
        let folder = dataset::plate_folder(folder.unwrap_or(&config.source.path), &config.perception);
        source.plates = dataset::plates(&folder, &source.rig)?;
    }
    dataset::pick(
        &source.rig,
        &config.sync.lags_nanos.keys().map(CameraId::to_string).collect::<Vec<_>>(),
        "the rig, but in sync.lags_ms",
    )?;
    Ok(source)
}

/// Returns images of the simulated room without people, by slot of `inputs`.
pub fn simulated_plates(simulator: &Simulator, inputs: &Rig) -> Result<Vec<Option<Image>>> {
    let plate = |camera: &Camera| -> Result<Option<Image>> {
        let slot = simulator.rig().slot(&camera.id).context("the input cameras are the simulator's")?;
        let plate = simulator.plate(slot)?;
        Ok(Some(Image::new(plate.width(), plate.height(), plate.format(), plate.bytes().to_vec())?))
    };
    inputs.cameras.iter().map(plate).collect()
}

/// The same without the plates of a folder: they may be missing or wrong.
pub fn open_without_plates(config: &Config, gpu: Option<&GpuContext>) -> Result<Source> {
    let source = &config.source;
    if source.kind == SourceKind::Sim {
        let gpu = gpu.context("the simulated rig needs a graphics adapter")?;
        let simulator = Simulator::new(gpu, &config.sim)?;
        let (rig, template, track) =
            (simulator.reported_rig(), simulator.template().clone(), simulator.track().clone());
        // Nobody tells an estimator whom it will see.
        let knows_shape = config.perception.shape() == Origin::Given;
        let template = if knows_shape { template } else { default_template(&ShapeParams::default())? };
        let picked = dataset::pick(&rig, &source.names(), "the simulated rig")?;
        let plates = simulated_plates(&simulator, &picked)?;
        let simulator = std::sync::Arc::new(std::sync::Mutex::new(simulator));
        let time = if source.real_time { SimTime::Real } else { SimTime::Exact };
        let sources = flyrig_sim::sources(&simulator, time)
            .into_iter()
            .filter(|source| picked.slot(source.camera()).is_some())
            .collect();
        let sources = ready(sources);
        let threads = Vec::new();
        return Ok(Source { cameras: sources, rig: picked, template, track: Some(track), plates, threads });
    }
    let chosen: Vec<CameraId> = source.names().into_iter().map(CameraId::from).collect();
    let rig = match source.kind {
        SourceKind::Cameras | SourceKind::Network => live::load_rig(source)?,
        SourceKind::Mcap | SourceKind::Folder | SourceKind::Video | SourceKind::Sim => {
            match source.calibration_folder() {
                Some(folder) if folder == source.path => dataset::load_rig(folder, &chosen)?,
                Some(folder) => load_calibration(folder, &|id| folder_image_size(&source.path, id).ok())?,
                None => recording::recorded_rig(&source.path)?,
            }
        }
    };
    let rig = dataset::pick(&rig, &source.names(), "the calibration")?;
    let ids: Vec<CameraId> = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let mut threads = Vec::new();
    let sources: Vec<SourceOpener> = match source.kind {
        SourceKind::Folder => {
            let with_masks = config.perception.masks == Origin::Given;
            ready(FolderReplay::open(
                &source.path,
                Some(&ids),
                &FolderOptions { fps: source.fps, with_masks, frames: None },
            )?)
        }
        SourceKind::Cameras => live::openers(source)?,
        SourceKind::Network => {
            let (openers, clocks) = network::openers(&config.transport(), &rig)?;
            threads.push(clocks);
            openers
        }
        SourceKind::Mcap => ready(recording::replay_sources(&source.path, &ids)?),
        SourceKind::Video | SourceKind::Sim => {
            let open = |id| VideoReplay::open(id, &dataset::video_file(&source.path, id), &VideoOptions::default());
            ready(ids.iter().map(open).collect::<Result<_, _>>()?)
        }
    };
    let (template, track) = if config.body.template.as_os_str().is_empty() {
        (default_template(&ShapeParams::default())?, None)
    } else {
        let human = load_gltf(&config.body.template)?;
        (human.template, human.track)
    };
    let plates = rig.cameras.iter().map(|_| None).collect();
    Ok(Source { cameras: sources, rig, template, track, plates, threads })
}

/// Returns sources that are open already as the capture threads take them.
pub fn ready<S: CameraSource + 'static>(sources: Vec<S>) -> Vec<SourceOpener> {
    sources.into_iter().map(|source| SourceOpener::ready(Box::new(source))).collect()
}
