//! `flyrig run`: a rig that stays up.

mod known;
mod live;
mod person_saver;

use std::path::Path;

use anyhow::{Context as _, Result};
use flyrig_capture::Recorder;
use flyrig_fusion::{Intake, LivePublisher, LiveRig, LiveViews, RigWatch, Session, SessionBuilder};
use flyrig_gpu::GpuContext;
use flyrig_monitor::Monitor;
use flyrig_report::stop;
use flyrig_takes::{Calibration, Needs, Take, dataset};
use flyrig_transport::{Publisher, TransportConfig};
use flyrig_types::Image;
use flyrig_web::WebServer;

use self::{known::PriorKnowledge, live::LiveRun};
use crate::{
    config::{Config, WatchMode},
    config_check::check_endpoint,
    opening::{image_origin, open_cameras},
    recording::{self, RigRecording},
    serve::print_fingerprint,
};

/// Runs the command. `recording` names a file that the cameras are recorded to; `show_table` prints the cameras' health as a table.
pub fn run(config: &Config, gpu: &GpuContext, recording: Option<&Path>, show_table: bool) -> Result<()> {
    stop::flag();
    // Cameras and kernels take their time; a taken address is reported before.
    config.transport.listen.iter().try_for_each(|endpoint| check_endpoint("transport.listen", endpoint))?;
    let mut monitor = Monitor::start(&config.health.listen, show_table)?
        .with_keys(&config.transport.keys)
        .with_origin(image_origin(config.source.kind));
    let mut take = open_cameras(config, Needs::Calibration, Some(gpu))?;
    let calibration = take.calibration.take().context("the cameras have no calibration")?;
    dataset::require_masks(&config.perception, &calibration.plates)?;
    let ids: Vec<_> = calibration.rig.cameras.iter().map(|camera| camera.id.clone()).collect();
    let start = |path| recording::recorder(path, &ids, Some(&calibration.rig), &config.record, config.source.pacing());
    let recorder = recording.map(start).transpose()?;
    let rig_run = RigRun { config, gpu, recorder: recorder.as_ref(), show_table };
    let ended = rig_run.capture_people(take, &calibration, &mut monitor);
    let recorded = match (recorder, recording) {
        (Some(recorder), Some(path)) => recording::summary(&recorder.finish(), path)
            .map(|text| eprintln!("run: recorded {text}"))
            .inspect_err(|error| eprintln!("run: {error}")),
        _ => Ok(()),
    };
    ended.and(recorded)
}

/// Run of a rig.
struct RigRun<'a> {
    config: &'a Config,
    gpu: &'a GpuContext,
    recorder: Option<&'a Recorder>,
    show_table: bool,
}

impl RigRun<'_> {
    /// Runs the rig until its cameras end or it is asked to stop.
    fn capture_people(&self, mut take: Take, calibration: &Calibration, monitor: &mut Monitor) -> Result<()> {
        let config = self.config;
        let recording = self.recorder.map(RigRecording::new);
        let intake = self.start_intake(&mut take, calibration)?;
        Monitor::ready();
        let body = take.body.take().context("the take has no body")?;
        let known = PriorKnowledge::load(config, &body.template)?;
        let watch = rig_watch(config.calibration.watch, calibration)?;
        let builder = SessionBuilder::new(self.gpu.clone(), calibration.rig.clone()).settings(config.session());
        let builder = known.add_to(builder, config, calibration, body)?;
        let mut session = monitor.during(self.gpu, || builder.build())?;
        if config.source.real_time {
            session.use_threads();
        }
        let publisher = self.publish(&session)?;
        // The page is a viewer like any other, beside the rig; it lives until the rig has ended.
        let web = self.start_page(&publisher)?;
        let publisher = LivePublisher::start(publisher, config.output.jpeg_quality)?;
        let mut rig = LiveRig::new(session, intake, LiveViews::new(&config.output), Some(publisher))
            .with_splats(config.output.splats)
            .with_threads(take.threads);
        if config.source.real_time {
            rig = rig.with_ages();
        }
        if let Some(watch) = watch {
            rig = rig.with_watch(watch);
        }
        let mut live = LiveRun::new(config, rig, self.recorder, recording, !self.show_table)?;
        live.run_until_end(monitor)?;
        let ended = live.finish();
        drop(web);
        ended
    }

    /// Starts the cameras, recorded if there is a recorder.
    fn start_intake(&self, take: &mut Take, calibration: &Calibration) -> Result<Intake> {
        let source = &self.config.source;
        let mut cameras = std::mem::take(&mut take.sources);
        if let Some(recorder) = self.recorder {
            cameras = recording::tap(recorder, cameras)?;
        }
        let format = source.kind.input_format(&calibration.rig);
        let intake = Intake::start_opening(cameras, format, &take.sync, source.pacing())?;
        Ok(if source.kind.is_live() { intake.live() } else { intake })
    }

    /// Opens the publisher of the results.
    fn publish(&self, session: &Session) -> Result<Publisher> {
        let publisher = Publisher::open(&self.config.transport())?;
        publisher.set_calibration(session.rig())?;
        eprintln!(
            "run: rig '{}' on {}, {} cameras, listening on {} (Ctrl-C ends)",
            self.config.rig.name,
            session.gpu().adapter_name(),
            session.rig().cameras.len(),
            publisher.endpoints().join(", ")
        );
        if let Some(address) = publisher.gate() {
            eprintln!("run: holders of keys connect at {address}");
        }
        Ok(publisher)
    }

    /// Starts the web page, if the configuration names an address.
    fn start_page(&self, publisher: &Publisher) -> Result<Option<WebServer>> {
        let config = self.config;
        if config.web.listen.is_empty() {
            return Ok(None);
        }
        let own = TransportConfig {
            connect: publisher.endpoints().first().map(|at| loopback_of(at)).into_iter().collect(),
            ..TransportConfig::subscriber(&config.rig.name)
        };
        let web = WebServer::start(&config.web, own)?;
        eprintln!("run: people are shown at {}", web.link());
        print_fingerprint("run", &web, &config.web);
        Ok(Some(web))
    }
}

/// Returns the watch that detects bumped cameras, if the configuration asks for it.
fn rig_watch(mode: WatchMode, calibration: &Calibration) -> Result<Option<RigWatch>> {
    let watch = || RigWatch::new(&calibration.rig, &calibration.plates);
    let copy = |plate: &Option<Image>| {
        let copy = |plate: &Image| Image::new(plate.width(), plate.height(), plate.format(), plate.bytes().to_vec());
        plate.as_ref().map(copy).transpose()
    };
    Ok(match mode {
        WatchMode::Off => None,
        WatchMode::Warn => Some(watch()),
        WatchMode::Correct => Some(watch().correcting(calibration.plates.iter().map(copy).collect::<Result<_, _>>()?)),
    })
}

/// Returns the endpoint as this computer reaches it: a rig that listens on all its addresses also listens on loopback.
fn loopback_of(endpoint: &str) -> String {
    endpoint.replace("tcp/0.0.0.0:", "tcp/127.0.0.1:").replace("tcp/[::]:", "tcp/[::1]:")
}
