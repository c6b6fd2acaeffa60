//! `flyrig calibrate convert`: calibrations of other programs.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use flyrig_calib::{Format, save_lenses};
use flyrig_capture::{FolderOptions, folder_image_size};
use flyrig_fusion::Upright;
use flyrig_takes::{Footage, person_up};
use flyrig_types::{Camera, ColorMatch, Rig};
use glam::DVec3;

use super::output::refuse_existing;
use crate::arguments::TargetArgs;

/// Cosine of the angle between stated up and image up beyond which a camera is upside down.
const UPSIDE_DOWN: f64 = 0.5;

/// Arguments of `flyrig calibrate convert`.
#[derive(Debug, Args)]
pub struct CalibrateConvertArgs {
    /// File or folder of the other program; see --from.
    pub input: PathBuf,
    /// Format of the input, recognized by file names otherwise: flyrig, easymocap, opencv, kalibr, colmap, nerfstudio, qualisys,
    /// anipose (Pose2Sim and caliscope too), mrcal.
    #[arg(long, value_parser = parse_format)]
    pub from: Option<Format>,
    /// Format of the output, one of those of --from.
    #[arg(long, value_parser = parse_format, default_value = "flyrig")]
    pub to: Format,
    /// Length of the unit of the input, metres: 0.001 for millimetres; the measured length for COLMAP and nerfstudio, whose unit is arbitrary.
    #[arg(long, default_value_t = 1.0, value_parser = parse_scale)]
    pub scale: f64,
    /// Folder with images/CAM, for formats without the size of the images; the input otherwise.
    #[arg(long)]
    pub images: Option<PathBuf>,
    #[command(flatten)]
    pub target: TargetArgs,
}

fn parse_format(text: &str) -> Result<Format, String> {
    let known = Format::ALL.map(Format::name);
    Format::ALL
        .into_iter()
        .find(|format| format.name() == text)
        .ok_or_else(|| format!("no such format; known: {}", known.join(", ")))
}

/// Parses metres of a unit.
///
/// # Errors
/// Names the range.
pub fn parse_scale(text: &str) -> Result<f64, String> {
    let scale = text.parse().ok().filter(|scale| (1e-9..=1e9).contains(scale));
    scale.ok_or_else(|| "expected metres of a unit, between 1e-9 and 1e9".to_owned())
}

/// Runs the command.
pub fn convert(args: &CalibrateConvertArgs) -> Result<()> {
    let input = &args.input;
    ensure!(input.exists(), "{} does not exist", input.display());
    let from = args.from.or_else(|| Format::detect(input)).with_context(|| {
        let known = Format::ALL.map(Format::name);
        format!("{}: the format is not recognised; name it with --from: {}", input.display(), known.join(", "))
    })?;
    let size = |id: &_| folder_image_size(args.images.as_ref().unwrap_or(input), id).ok();
    let imported = from.read(input, &size, args.scale)?;
    let rig = imported.rig(input)?;
    let names = match args.to {
        Format::Flyrig => vec!["calibration.toml"],
        Format::EasyMocap => vec!["intri.yml", "extri.yml"],
        _ => Vec::new(),
    };
    refuse_existing(&args.target.out, &names, args.target.force)?;
    ensure!(
        args.target.force || !names.is_empty() || !args.target.out.exists(),
        "{} is there already; name a new folder, or replace its files with --force",
        args.target.out.display()
    );
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    println!("from {}: {}", from.name(), from.conventions());
    println!("to {}: {}", args.to.name(), args.to.conventions());
    for warning in &imported.warnings {
        println!("warning: {warning}");
    }
    let Some(mut rig) = rig else {
        if args.to != Format::Flyrig {
            bail!("{} holds lenses without poses; they can be written as flyrig's alone", input.display());
        }
        save_lenses(&args.target.out, &imported.lenses())?;
        println!("{}: calibration.toml with lenses alone", args.target.out.display());
        println!("next: flyrig calibrate rig TAKE --lenses {}", args.target.out.display());
        return Ok(());
    };
    for camera in &rig.cameras {
        let (i, at) = (&camera.intrinsics, camera.position());
        let offset = match camera.time_offset_nanos {
            0 => String::new(),
            nanos => format!(", stamps {:.1} ms late", nanos as f64 * 1e-6),
        };
        println!(
            "camera {}: {}x{}, focal length {:.1} px, at {:.3} {:.3} {:.3} m{offset}",
            camera.id, i.width, i.height, i.focal_px.x, at.x, at.y, at.z
        );
    }
    // EasyMocap's files do not state it either.
    let is_stated = imported.up.is_some() && from != Format::EasyMocap;
    check_up(&mut rig, is_stated, args.images.as_ref().unwrap_or(input));
    let lost = args.to != Format::Flyrig && args.to != Format::Kalibr;
    if lost && rig.cameras.iter().any(|camera| camera.time_offset_nanos != 0) {
        println!("warning: {} has no place for time offsets; they are left out", args.to.name());
    }
    if args.to != Format::Flyrig && rig.cameras.iter().any(|camera| camera.color != ColorMatch::NONE) {
        println!("warning: {} has no place for colour corrections; they are left out", args.to.name());
    }
    // A folder that stays empty is removed again.
    let files = args.to.write(&args.target.out, &rig).inspect_err(|_| drop(std::fs::remove_dir(&args.target.out)))?;
    println!("{}: {}", args.target.out.display(), files.join(", "));
    Ok(())
}

/// Checks the up direction against the person in the images, where there are some: takes it from them where the file does not state
/// it, and warns where they contradict the file.
fn check_up(rig: &mut Rig, is_stated: bool, images: &Path) {
    let footage = Footage::from_dataset(images);
    let has_images = images.join("images").is_dir() || matches!(footage, Footage::VideoFolder(_));
    let person =
        if has_images { person_up(rig, &footage, FolderOptions::default().fps) } else { Ok(Upright::default()) };
    let person = person.unwrap_or_else(|error| {
        eprintln!("warning: up is not checked against the person in {}: {error:#}", images.display());
        Upright::default()
    });
    let fault = person.fault(rig.world_up);
    let source = match person.up() {
        None if is_stated => return warn_of_cameras(rig),
        None => "if the cameras are held level; correct it in calibration.toml",
        Some(_) if fault.is_none() => "and the person in the images agrees",
        Some(up) if !is_stated => {
            rig.world_up = up;
            "as the person in the images stands"
        }
        Some(_) => "as the file says, but see the warning",
    };
    let up = rig.world_up;
    println!("up is {:.3} {:.3} {:.3}, {source}", up.x + 0.0, up.y + 0.0, up.z + 0.0);
    if let Some(fault) = fault.filter(|_| is_stated) {
        eprintln!("warning: {fault}");
    }
}

/// Warns where the stated up direction is down in the cameras' images.
fn warn_of_cameras(rig: &Rig) {
    let above = |camera: &Camera| camera.camera_from_world.rotation.inverse() * DVec3::NEG_Y;
    let below = rig.cameras.iter().filter(|camera| above(camera).dot(rig.world_up) < -UPSIDE_DOWN).count();
    if below > 0 && below == rig.cameras.len() {
        eprintln!(
            "warning: the file's up direction is down in the images of all cameras: the world is upside down, or the cameras hang upside \
             down; with --images FOLDER a person in its images tells"
        );
    }
}
