//! `flyrig calibrate person`: better poses and time offsets of cameras from one person who moves.

use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use flyrig_body::{ShapeParams, default_template};
use flyrig_calib::{OutlineCorner, PersonFit, PersonOptions, PersonTracks, calibrate_person, save_easymocap};
use flyrig_capture::Pacing;
use flyrig_fusion::{InputFormat, Intake};
use flyrig_gpu::GpuContext;
use flyrig_report::{progress_bar, stop};
use flyrig_sync::{HullCorner, SyncSettings, silhouette_hull};
use flyrig_tracker::{PoseConfig, PoseNet, Viewers};
use flyrig_types::{Image, Rig};
use glam::DVec2;

use super::refuse_existing;
use crate::{
    cli::CalibratePersonArgs,
    take::{self, CalibratedTake},
};

/// Landmarks that are used, by their number in the network: nose, eyes, ears, shoulders to wrists, index fingers, hips to toes.
const LANDMARKS: [usize; 23] =
    [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 19, 20, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32];
/// Pairs of the network's landmarks at a constant distance.
const LIMBS: [(usize, usize); 17] = [
    (7, 8),
    (0, 7),
    (0, 8),
    (2, 5),
    (11, 12),
    (11, 13),
    (13, 15),
    (12, 14),
    (14, 16),
    (23, 24),
    (23, 25),
    (25, 27),
    (24, 26),
    (26, 28),
    (27, 29),
    (28, 30),
    (29, 31),
];
/// Pairs of the network's landmarks, left and right, that it takes for each other together: of the face, the arms, the legs.
const MIRRORED: [&[(usize, usize)]; 3] =
    [&[(2, 5), (7, 8)], &[(11, 12), (13, 14), (15, 16), (19, 20)], &[(23, 24), (25, 26), (27, 28), (29, 30), (31, 32)]];
/// Landmarks of less confidence are not used.
const CONFIDENCE: f64 = 0.3;

/// Runs the command.
pub fn person(args: &CalibratePersonArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    refuse_existing(&args.out, &["intri.yml", "extri.yml"], args.force)?;
    let mut take = take::open_calibrated(&args.input, args.fps, args.calibration.as_deref(), gpu)?;
    ensure!(
        !take.is_live,
        "live cameras cannot be looked at frame by frame; record them first (flyrig record) and give the recording"
    );
    let (rig, plates) = take.calibration.take().context(
        "no calibration: name its folder with --calibration; flyrig calibrate rig makes one from a board",
    )?;
    ensure!(rig.cameras.len() > 1, "one camera alone has nothing to agree with");
    let tracks = look_through(args, &rig, plates, take)?;
    let number = |landmark: usize| LANDMARKS.iter().position(|known| *known == landmark);
    let numbers = |pairs: &[(usize, usize)]| -> Vec<(usize, usize)> {
        pairs.iter().filter_map(|(a, b)| Some((number(*a)?, number(*b)?))).collect()
    };
    let options = PersonOptions { lags: !args.no_offsets, ..PersonOptions::default() };
    let fit = calibrate_person(&rig, &tracks, &numbers(&LIMBS), &MIRRORED.map(numbers), options)?;
    print(&rig, &tracks, &fit);
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    save_easymocap(&args.out, &fit.rig)?;
    println!("{}: intri.yml, extri.yml", args.out.display());
    Ok(())
}

/// Landmarks of the person in all images.
fn look_through(
    args: &CalibratePersonArgs,
    rig: &Rig,
    plates: Vec<Option<Image>>,
    take: CalibratedTake,
) -> Result<PersonTracks> {
    let template = default_template(&ShapeParams::default())?;
    let mut viewers = Viewers::new(&PoseNet::embedded()?, &template, rig, plates, &PoseConfig::default())?;
    let mut tracks = PersonTracks::new(rig.cameras.len(), LANDMARKS.len());
    let sync = SyncSettings {
        max_wait_nanos: Some(take.sync.max_wait_nanos.unwrap_or(1_000_000_000)),
        ..take.sync
    };
    let mut intake = Intake::start_opening(take.sources, InputFormat::OfRig(rig), &sync, Pacing::Lossless)?;
    let bar = progress_bar((args.secs * 1e3) as u64, "the person, ms of the take");
    let mut first = None;
    while !intake.ended() && !stop::requested() {
        let Some(set) = intake.next_set(Duration::from_millis(200)) else { continue };
        let from = *first.get_or_insert(set.master_nanos);
        let at = set.master_nanos.saturating_sub(from) as f64 * 1e-9 - args.from_secs;
        if at < -1e-3 {
            continue;
        }
        if at > args.secs {
            break;
        }
        bar.set_position((at * 1e3) as u64);
        for (slot, found) in viewers.look(&set)?.into_iter().enumerate() {
            let (Some(found), Some(frame)) = (found, &set.frames[slot]) else { continue };
            if let Some(mask) = found.masks.iter().flatten().next() {
                let corner = |corner: HullCorner| OutlineCorner { ray: corner.ray, is_cut: corner.is_cut };
                let hull = silhouette_hull(&rig.cameras[slot], mask).into_iter().map(corner).collect();
                tracks.add_outline(slot, frame.capture_nanos, hull);
            }
            let Some(keypoints) = found.keypoints.into_iter().next().flatten() else { continue };
            let seen: Vec<Option<(DVec2, f64)>> = LANDMARKS
                .iter()
                .map(|landmark| keypoints[*landmark])
                .map(|point| (point.usable() && point.confidence >= CONFIDENCE).then_some((point.pixel, point.confidence)))
                .collect();
            tracks.add(slot, frame.capture_nanos, &seen);
        }
    }
    bar.finish_and_clear();
    for (slot, camera) in rig.cameras.iter().enumerate() {
        if let Some(error) = intake.last_error(slot) {
            eprintln!("warning: not every image of camera {} could be used; the last: {error}", camera.id);
        }
        ensure!(
            tracks.images(slot) > 0,
            "camera {}: nobody is seen; let one person move where all cameras see them whole",
            camera.id
        );
    }
    Ok(tracks)
}

fn print(rig: &Rig, tracks: &PersonTracks, fit: &PersonFit) {
    println!(
        "{:<14} {:>6} {:>16} {:>18} {:>9} {:>10} {:>16} {:>10}",
        "camera", "images", "error px", "moved deg, mm", "moved px", "halves px", "offset ms", "halves ms"
    );
    for (slot, (camera, solved)) in rig.cameras.iter().zip(&fit.cameras).enumerate() {
        println!(
            "{:<14} {:>6} {:>16} {:>18} {:>9.2} {:>10} {:>16} {:>10}",
            camera.id,
            tracks.images(slot),
            format!("{:.2} -> {:.2}", solved.error_px.0, solved.error_px.1),
            format!("{:.3} {:.1}", solved.moved.0, solved.moved.1),
            solved.moved_px,
            solved.halves_px.map_or_else(|| "?".to_owned(), |px| format!("{px:.2}")),
            format!("{:.1} +-{:.1}", 1e3 * solved.lag_s.0, 1e3 * solved.lag_s.1),
            solved.lag_halves_s.map_or_else(|| "?".to_owned(), |secs| format!("{:.1}", 1e3 * secs)),
        );
    }
    println!("{} instants, landmarks {:.2} px", fit.instants, fit.sigma_px);
}
