//! Choices where a command line names none: the cameras of a take, and the sources of pose, masks and shape.

use std::path::Path;

use anyhow::{Result, ensure};
use clap::{ArgMatches, Args, Command, FromArgMatches, parser::ValueSource};
use flyrig_body::load_gltf;
use flyrig_fusion::{Origin, PerceptionSettings};
use flyrig_takes::{Footage, dataset};
use flyrig_types::CameraId;

/// Settings of perception, with the sources that the command line leaves open.
#[derive(Debug, Clone)]
pub struct PerceptionArgs {
    /// Settings; sources that are not named have no meaning before [`Self::choose`].
    pub settings: PerceptionSettings,
    names_pose: bool,
    names_masks: bool,
}

const POSE_HELP: &str = "Pose from the take's glTF animation, or from the images; by default given where the take has an animated \
    skinned glTF file (and masks or plates), else estimated";
const MASKS_HELP: &str = "Masks from the take, or from the images; by default given where mask/CAM is there for every input camera, else estimated";

impl Args for PerceptionArgs {
    fn augment_args(command: Command) -> Command {
        let command = PerceptionSettings::augment_args(command);
        let open = |help: &'static str| move |arg: clap::Arg| arg.hide_default_value(true).help(help);
        command.mut_arg("pose", open(POSE_HELP)).mut_arg("masks", open(MASKS_HELP))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for PerceptionArgs {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        Self::from_arg_matches_mut(&mut matches.clone())
    }

    fn from_arg_matches_mut(matches: &mut ArgMatches) -> Result<Self, clap::Error> {
        let is_named = |name: &str| matches.value_source(name) == Some(ValueSource::CommandLine);
        let (names_pose, names_masks) = (is_named("pose"), is_named("masks"));
        Ok(Self { settings: PerceptionSettings::from_arg_matches_mut(matches)?, names_pose, names_masks })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl PerceptionArgs {
    /// Chooses the sources that the command line leaves open: given where the take has them for these cameras, else estimated.
    ///
    /// # Errors
    /// The take's glTF file is damaged.
    pub fn choose(&mut self, take: &Path, cameras: &[String]) -> Result<()> {
        let footage = Footage::from_dataset(take);
        let settings = &mut self.settings;
        let all_have = |has: &dyn Fn(&Path, &str) -> bool| {
            footage.folder().is_some_and(|root| cameras.iter().all(|camera| has(root, camera)))
        };
        if !self.names_masks {
            let has_images = matches!(footage, Footage::Folder(_));
            let is_given = has_images && all_have(&|root, camera| root.join("mask").join(camera).is_dir());
            settings.masks = if is_given { Origin::Given } else { Origin::Estimated };
        }
        if !self.names_pose {
            let plates = dataset::plate_folder(take, settings);
            let has_masks = settings.masks == Origin::Given
                || !settings.key_color.is_empty()
                || cameras.iter().all(|camera| dataset::plate_file(&plates, &camera.as_str().into()).exists());
            // What only the images can tell needs a pose from the images.
            let from_images = settings.hands == Origin::Estimated || settings.people > 1;
            let is_given = has_masks && !from_images && footage.folder().map_or(Ok(false), has_motion)?;
            settings.pose = if is_given { Origin::Given } else { Origin::Estimated };
        }
        Ok(())
    }

    /// Formats the sources, in one line.
    pub fn sources(&self) -> String {
        let word = |origin: Origin| if origin == Origin::Given { "given with the take" } else { "estimated" };
        let PerceptionSettings { pose, masks, .. } = self.settings;
        format!("pose {}, masks {}, shape {}", word(pose), word(masks), word(self.settings.shape()))
    }
}

/// Returns whether a folder has one skinned glTF file, and it is animated.
fn has_motion(root: &Path) -> Result<bool> {
    let Ok(file) = dataset::gltf_file(root) else { return Ok(false) };
    Ok(load_gltf(&file)?.track.is_some())
}

/// Returns the calibrated cameras of a take that have images and are not left out.
///
/// # Errors
/// The calibration is missing or wrong, or no camera is left.
pub fn cameras_of(take: &Path, left_out: &[String]) -> Result<Vec<String>> {
    let footage = Footage::from_dataset(take);
    let rig = footage.load_rig(&[])?;
    let has_images = |id: &CameraId| match &footage {
        Footage::Folder(root) => root.join("images").join(id.as_str()).is_dir(),
        Footage::VideoFolder(root) => dataset::video_file(root, id).exists(),
        Footage::Recording(_) | Footage::Videos(_) => true,
    };
    let (found, without): (Vec<_>, Vec<_>) = rig.cameras.iter().map(|camera| &camera.id).partition(|id| has_images(id));
    if !without.is_empty() {
        let names: Vec<&str> = without.iter().map(|id| id.as_str()).collect();
        tracing::warn!("without images, so left out: {}", names.join(", "));
    }
    let names: Vec<String> = found.iter().map(ToString::to_string).filter(|name| !left_out.contains(name)).collect();
    ensure!(
        !names.is_empty(),
        "{} has no images/CAM of a calibrated camera that could be an input; see docs/guide/own-footage.md",
        take.display()
    );
    Ok(names)
}
