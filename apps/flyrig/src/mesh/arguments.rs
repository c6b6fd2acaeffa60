//! Arguments of `flyrig mesh`.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::{Args, ValueEnum};

use super::named::NamedOptions;
use super::units::{Unit, Up};
use crate::arguments::DatasetArgs;

/// Default number of Gaussians, as a rig draws.
const GAUSSIANS: u32 = 115_000;
/// Default steps of the fit.
const STEPS: u64 = 800;

/// Options that apply to takes alone: names in the arguments' definition and on the command line.
const OF_TAKES: [(&str, &str); 22] = [
    ("inputs", "--inputs"),
    ("frames", "--frames"),
    ("frame", "--frame"),
    ("fps", "--fps"),
    ("holdout", "--holdout"),
    ("pose", "--pose"),
    ("masks", "--masks"),
    ("shape", "--shape"),
    ("hands", "--hands"),
    ("people", "--people"),
    ("network", "--network"),
    ("height_m", "--height"),
    ("floor_m", "--floor"),
    ("key_color", "--key-color"),
    ("plates", "--plates"),
    ("solver", "--solver"),
    ("by_camera", "--lag"),
    ("trust_calibration", "--trust-calibration"),
    ("sequence", "--sequence"),
    ("steps", "--steps"),
    ("gaussians", "--gaussians"),
    ("depth", "--depth"),
];

/// Arguments of `flyrig mesh`.
#[derive(Debug, Clone, Args)]
pub struct MeshArgs {
    // First, since the other fields take their options out of the matches.
    #[command(flatten)]
    named: NamedOptions,
    #[command(flatten)]
    pub take: DatasetArgs,
    /// Folder of the mesh; it must be new or empty.
    #[arg(long)]
    pub out: PathBuf,
    /// Mesh what the cameras show in this one frame of a take, in place of all of them.
    #[arg(long, conflicts_with = "sequence")]
    pub frame: Option<u64>,
    /// Motion of an avatar's mesh (BVH or glTF, or the name of a generated one); that of a take is the tracked one.
    #[arg(long)]
    pub motion: Option<PathBuf>,
    /// Gaussians on the person's surface while a take is tracked and fitted; an avatar has its own.
    #[arg(long, default_value_t = GAUSSIANS, value_parser = clap::value_parser!(u32).range(1000..=1_000_000))]
    pub gaussians: u32,
    /// Steps in which the Gaussians are fitted to all images of a take; 0 meshes the tracked surface.
    #[arg(long, default_value_t = STEPS, value_parser = clap::value_parser!(u64).range(0..=1_000_000))]
    pub steps: u64,
    /// Folder of depth images of a take's cameras, which the fit compares the surface with: CAM/000000.exr (channel Z, metres) or
    /// CAM/000000.png (16-bit grey, millimetres), of a depth camera or another program.
    #[arg(long, value_name = "FOLDER")]
    pub depth: Option<PathBuf>,
    /// Fusion of the Gaussians' surfaces into one.
    #[arg(long, value_enum, default_value = "hgm")]
    pub fusion: FusionKind,
    /// Side of a voxel, millimetres; twice the distance of neighbouring Gaussians if not given, 1.5 times that of a splat file's.
    #[arg(long, value_parser = parse_voxel)]
    pub voxel: Option<f32>,
    /// Triangles to simplify the mesh to; more remain where fewer would change its topology.
    #[arg(long, default_value_t = 60_000, value_parser = clap::value_parser!(u32).range(500..=5_000_000))]
    pub triangles: u32,
    /// Texels along a side of the texture.
    #[arg(long, default_value_t = 2048, value_parser = clap::value_parser!(u32).range(64..=4096))]
    pub texture: u32,
    /// Light in the texture; the texture of an avatar's file comes from its Gaussians in both cases.
    #[arg(long, value_enum, default_value = "removed")]
    pub light: LightKind,
    /// Cameras of a take, comma separated, which are left out of everything and then compared with the textured mesh and with the
    /// Gaussians at every tenth frame.
    #[arg(long, value_delimiter = ',')]
    pub holdout: Vec<String>,
    /// Write the surface of every frame of a take, in place of every tenth, and of all frames as one USD file.
    #[arg(long)]
    pub sequence: bool,
    /// Length unit of a splat file (*.ply); metres if not given.
    #[arg(long, value_enum)]
    pub unit: Option<Unit>,
    /// Upward axis of a splat file, which becomes y; y if not given.
    #[arg(long, value_enum, allow_hyphen_values = true)]
    pub up: Option<Up>,
}

impl MeshArgs {
    /// Checks that no option of takes is given for another input; `kind` is what it is.
    ///
    /// # Errors
    /// Names these options.
    pub(super) fn check_no_take(&self, kind: &str) -> Result<()> {
        let given = OF_TAKES.iter().filter(|(name, _)| self.named.contains(name));
        let given: Vec<&str> = given.map(|(_, option)| *option).collect();
        ensure!(
            given.is_empty(),
            "{} is {kind} and not a take: leave out {}",
            self.take.dataset.display(),
            given.join(" and ")
        );
        Ok(())
    }
}

/// Light in a texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LightKind {
    /// Divided by the light of the take, as programs light the mesh again.
    Removed,
    /// As the person looked in the mean of the take.
    Baked,
}

/// Fusion of oriented points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FusionKind {
    /// Weights that fall with the distance, of points that face the same way (HGM, Eq. 18).
    Hgm,
    /// Equal weights of all points within the truncation distance.
    Naive,
}

fn parse_voxel(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(side) if (1.0..=50.0).contains(&side) => Ok(side / 1000.0),
        _ => Err(format!("'{text}' is not between 1 and 50 millimetres")),
    }
}

#[cfg(test)]
mod tests {
    use clap::{ArgAction, Command, FromArgMatches as _};

    use super::*;

    /// Options for every input, and those that are checked elsewhere.
    const OTHERS: [&str; 10] =
        ["dataset", "out", "motion", "fusion", "voxel", "triangles", "texture", "light", "unit", "up"];

    fn parsed(words: &[&str]) -> MeshArgs {
        let command = MeshArgs::augment_args(Command::new("mesh"));
        let words = [&["mesh", "a.flyavatar", "--out", "m"], words].concat();
        MeshArgs::from_arg_matches_mut(&mut command.try_get_matches_from(words).unwrap()).unwrap()
    }

    #[test]
    fn options_of_takes_are_refused_for_avatars_even_with_their_default() {
        parsed(&["--voxel", "9", "--light", "baked", "--triangles", "60000"]).check_no_take("an avatar").unwrap();
        let command = MeshArgs::augment_args(Command::new("mesh"));
        let mut checked = Vec::new();
        for argument in command.get_arguments().filter(|argument| !OTHERS.contains(&argument.get_id().as_str())) {
            let option = format!("--{}", argument.get_long().unwrap());
            let default = argument.get_default_values().first().map(|value| value.to_string_lossy().into_owned());
            let value = match argument.get_id().as_str() {
                "frames" => "0..4".to_owned(),
                "by_camera" => "00=3".to_owned(),
                "shape" => "given".to_owned(),
                "height_m" => "1.7".to_owned(),
                _ => default.unwrap_or_else(|| "7".to_owned()),
            };
            let takes_value = matches!(argument.get_action(), ArgAction::Set | ArgAction::Append);
            let words = if takes_value { vec![option.as_str(), &value] } else { vec![option.as_str()] };
            let error = parsed(&words).check_no_take("an avatar").unwrap_err().to_string();
            assert_eq!(error, format!("a.flyavatar is an avatar and not a take: leave out {option}"));
            checked.push(option);
        }
        assert_eq!(checked.len(), OF_TAKES.len(), "{checked:?}");
    }
}
