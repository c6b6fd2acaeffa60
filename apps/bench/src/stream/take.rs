//! Tracked people to encode, kept so that every encoding gets the same input.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::{Context, Result, ensure};
use flyrig_fusion::{BudgetSettings, Origin, Outcome, PersonFrame, PersonId, Session};
use flyrig_gpu::GpuContext;
use flyrig_metrics::{ScoreSheet, score_view};
use flyrig_report::{progress_bar, stop};
use flyrig_sim::{ExportOptions, MotionConfig, MotionKind, SimConfig, Simulator, export};
use flyrig_stream::EncodedTemplate;
use flyrig_takes::{Replay, frame_number, known_body};
use flyrig_transport::SplatState;
use flyrig_types::{Camera, Image, Mask, RenderedView};

use super::{
    arguments::BenchStreamArgs,
    subject::{CodedSubject, SIMULATED},
};
use crate::harness::images::copy;

/// Frame sets that are neither counted nor scored: colours are sent for the first time.
const WARM_UP: usize = 12;
/// Default number of frames of a simulated person.
const SIMULATED_FRAMES: u64 = 40;
/// Returns name and folder of every data set; simulated people, each with its own seed, are first exported to the folder of the results,
/// unless they are there already.
pub fn folders(args: &BenchStreamArgs, gpu: &GpuContext) -> Result<Vec<(String, PathBuf)>> {
    let mut seed = args.simulation.seed;
    let mut folders = Vec::new();
    for subject in &args.datasets {
        folders.push(match subject {
            CodedSubject::Folder(path) => {
                let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
                (name.unwrap_or_else(|| path.display().to_string()), path.clone())
            }
            CodedSubject::Simulated(kind, motion) => {
                let frames = args.replay.frames.as_ref().map_or(SIMULATED_FRAMES, |frames| frames.end);
                let folder = args
                    .simulation
                    .output
                    .out
                    .join("takes")
                    .join(format!("{motion}-{seed}-{}-{frames}", args.simulation.side));
                simulate(gpu, &folder, *kind, seed, args.simulation.side, frames)?;
                seed += 1;
                (format!("{SIMULATED}{motion}"), folder)
            }
        });
    }
    Ok(folders)
}

fn simulate(gpu: &GpuContext, folder: &Path, kind: MotionKind, seed: u64, side: u32, frames: u64) -> Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    let parent = folder.parent().context("the folder of the results has no name")?;
    std::fs::create_dir_all(parent).with_context(|| format!("cannot create {}", parent.display()))?;
    let motion = MotionConfig { kind, ..MotionConfig::default() };
    let config = SimConfig { seed, motion, width: side, height: side, ..SimConfig::default() };
    let bar = progress_bar(frames, "simulate");
    let options = ExportOptions { frames, truth: false };
    export(&mut Simulator::new(gpu, &config)?, folder, options, &mut |done| {
        bar.set_position(done);
        !stop::requested()
    })?;
    bar.finish_and_clear();
    Ok(())
}

/// A person's frames with the held-out views of them.
pub struct CodedTake {
    /// Name of the data set.
    pub name: String,
    /// Source of pose and masks.
    pub pose: Origin,
    /// Held-out cameras.
    pub cameras: Vec<Camera>,
    /// Frames that show the person.
    pub kept: Vec<Kept>,
    /// Scores of the uncoded person.
    pub uncoded: ScoreSheet,
    /// The person's avatar as it is sent.
    pub avatar: Option<Arc<EncodedTemplate>>,
}

/// One frame.
pub struct Kept {
    /// Number of the frame in the data set.
    pub number: u64,
    /// Input of the encoder of the person stream.
    pub frame: PersonFrame,
    /// Centres, standard deviations and colours, in the order of the session.
    pub splats: SplatState,
    /// Unit normals; w: 0.
    pub normals: Vec<[f32; 4]>,
    /// Views of the held-out cameras; empty during the warm-up.
    pub views: Vec<KeptView>,
}

/// A view of a held-out camera.
pub struct KeptView {
    /// The person, uncoded.
    pub uncoded: RenderedView,
    /// The camera's image, with its mask if there is one.
    pub truth: Option<(Image, Option<Mask>)>,
}

impl CodedTake {
    /// Replays a data set and keeps its frames.
    ///
    /// # Errors
    /// Names what cannot be read, or says that no person was found.
    pub fn record(
        args: &BenchStreamArgs,
        gpu: &GpuContext,
        (name, folder): &(String, PathBuf),
        pose: Origin,
        gaussians: usize,
    ) -> Result<Self> {
        let mut settings = args.replay.settings(folder, pose, gaussians, BudgetSettings::default());
        settings.session.body.avatar = args.avatar.clone().unwrap_or_default();
        settings.body = known_body(&settings.session.body, true)?;
        // The other forms send the surface that is tracked.
        let stream = settings.body.as_mut().and_then(|body| body.memory.as_mut()?.take_stream());
        let mut replay = Replay::open(&settings, gpu)?;
        let cameras = replay.holdout.clone();
        let mut take = Self {
            name: name.clone(),
            pose,
            cameras,
            kept: Vec::new(),
            uncoded: ScoreSheet::default(),
            avatar: stream,
        };
        let bar = progress_bar(replay.count as u64, "replay");
        bar.set_message(name.clone());
        while let Some(set) = replay.next_set()? {
            bar.inc(1);
            if stop::requested() || matches!(replay.session.process(&set)?, Outcome::Held(_)) {
                continue;
            }
            let Some(frame) = replay.session.person_frame(PersonId::default(), &set)? else { continue };
            let number = frame_number(&set);
            let (splats, normals) = splats(&replay.session)?;
            let mut views = Vec::new();
            if take.kept.len() >= WARM_UP {
                let truth = replay.truth.at(set.master_nanos)?;
                for (camera, truth) in take.cameras.iter().zip(truth) {
                    let uncoded = replay.session.render(camera)?;
                    let truth = truth.map(|frame| Ok::<_, anyhow::Error>((copy(&frame.image)?, frame.mask.clone())));
                    let truth = truth.transpose()?;
                    if let Some((image, mask)) = &truth {
                        take.uncoded.extend(score_view(&camera.id, number, &uncoded, image, mask.as_ref())?);
                    }
                    views.push(KeptView { uncoded, truth });
                }
            }
            take.kept.push(Kept { number, frame, splats, normals, views });
        }
        bar.finish_and_clear();
        let found = take.kept.len();
        ensure!(found > WARM_UP, "{name}: a person in more than {WARM_UP} frames is needed, found {found}");
        Ok(take)
    }
}

/// Returns the Gaussians of the person as they were last rendered, with normals.
fn splats(session: &Session) -> Result<(SplatState, Vec<[f32; 4]>)> {
    let splats = session.splats(PersonId::default())?;
    let state = SplatState {
        center_scale: splats.iter().map(|s| [s.position[0], s.position[1], s.position[2], s.scale_m[0]]).collect(),
        color: splats.iter().map(|s| [s.color[0], s.color[1], s.color[2], s.opacity]).collect(),
        ..SplatState::default()
    };
    Ok((state, splats.iter().map(|s| [s.normal[0], s.normal[1], s.normal[2], 0.0]).collect()))
}
