//! The command line of `flyrig-bench`.

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use clap::{Args, Parser, Subcommand, builder::TypedValueParser as _};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;
use flyrig_fusion::{BodySettings, BudgetSettings, NetworksOn, Origin, PerceptionSettings, SessionSettings};
use flyrig_report::arguments::{parse_fps, parse_minutes, parse_range, parse_seconds, parse_size};
use flyrig_takes::ReplaySettings;

use crate::stream::Subject;

/// Measure run time against error on simulated people.
#[derive(Debug, Parser)]
#[command(name = "flyrig-bench", version)]
pub struct Cli {
    /// Log more: -v debug, -vv trace. RUST_LOG chooses in detail.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Part of a graphics adapter's name; the fastest one otherwise.
    #[arg(long, global = true)]
    pub adapter: Option<String>,
    /// Write when each stage ran into this file, for Perfetto (ui.perfetto.dev) or about:tracing.
    #[arg(long, global = true, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    #[command(subcommand)]
    pub command: BenchCommand,
}

#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Deformation tracking: solvers, iterations, Gaussians, resolution and views; writes CSV, JSON and SVG.
    Track(BenchTrackArgs),
    /// Thousands of frames of one movement there and back: error and memory over time; writes CSV and SVG.
    Endure(BenchEndureArgs),
    /// Appearance: every mode on simulated people that nobody trained on; writes CSV, JSON and SVG.
    Appearance(BenchAppearanceArgs),
    /// Avatars: error against the time of their fit, time and memory by the number of Gaussians; writes a table, JSON and SVG.
    Avatar(BenchAvatarArgs),
    /// Budgets of time: what each kind of work that may be left out costs in views, and the run time it saves.
    Budget(BenchBudgetArgs),
    /// Capture: memory, latency and processor time of plain cameras of this process, from their threads to whole sets.
    Capture(BenchCaptureArgs),
    /// Fingertips and the head's rotation on simulated people, estimated and relaxed, and the cost of a crop.
    Hands(BenchHandsArgs),
    /// Bias and spread of the landmark network on people whose pose is known.
    Landmarks(BenchLandmarksArgs),
    /// Bumped cameras among switched lights, a walking person and exposure jumps: time to the report, error, false alarms, cost.
    Watch(BenchWatchArgs),
    /// The person stream: bytes and run times against what it loses; writes a table, CSV, JSON and SVG.
    Stream(BenchStreamArgs),
    /// Receive the people of a rig, or of a take that `flyrig play --repeat` publishes: update rates, age, errors of the displayed views.
    Receive(BenchReceiveArgs),
    /// Masks estimated in each camera independently, against which several calibrations are scored.
    Masks(BenchMasksArgs),
    /// Pose, shape and masks from images: errors, and what each of them costs in the views; writes a table and JSON.
    Perception(BenchPerceptionArgs),
    /// Turns, covered cameras, switched lights, people who leave: errors before, during and after, and the time to recover.
    Stress(BenchStressArgs),
    /// Two people in one scene: views, and the cost beside one person; writes a table and PNG images.
    Subjects(BenchSubjectsArgs),
    /// Who is who: takes of several people who walk past one another, found and followed from images alone.
    Takes(BenchTakesArgs),
    /// Run time and error by pixels, input cameras and Gaussians, and the exponents of the run time.
    Scale(BenchScaleArgs),
    /// Recording uncompressed cameras: bytes, processor time and loss of each JPEG quality against images as they come.
    Record(BenchRecordArgs),
}

#[derive(Debug, Args)]
pub struct BenchAppearanceArgs {
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-appearance")]
    pub out: PathBuf,
    /// Seed of the first person; the others follow.
    #[arg(long, default_value_t = 101)]
    pub seed: u64,
    /// How many people.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub people: u64,
    /// Frames of each sequence; the second half is scored.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    /// Numbers of input cameras, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "3,1", value_parser = clap::value_parser!(u8).range(1..=6).map(usize::from))]
    pub views: Vec<usize>,
    /// Weights files of the learned modes, in place of all networks that come with flyrig; may be given several times.
    #[arg(long)]
    pub weights: Vec<PathBuf>,
    /// Reuse of the networks' results from frame to frame: see `reuse` in the configuration.
    #[arg(long, default_value_t = 0.0)]
    pub reuse: f32,
    /// Where the networks run; "adapter" needs a program that was built with the feature gpu-networks.
    #[arg(long, value_enum, default_value = "processor")]
    pub networks_on: NetworksOn,
    /// Pixels of an image's side.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

/// Frames and cameras of recorded data sets.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// Input cameras, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "00,03,05")]
    pub inputs: Vec<String>,
    /// Cameras that the views are compared with, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "01,02,04,06")]
    pub holdout: Vec<String>,
    /// Frames FIRST..END, END excluded; all of them otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    /// Frames a second of the data sets.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
}

impl ReplayArgs {
    /// Returns settings for one data set, with poses and masks from `origin`.
    pub fn settings(&self, dataset: &Path, origin: Origin, gaussians: usize, budget: BudgetSettings) -> ReplaySettings {
        let perception = PerceptionSettings { pose: origin, masks: origin, ..PerceptionSettings::default() };
        let body = BodySettings { gaussians, ..BodySettings::default() };
        ReplaySettings {
            dataset: dataset.to_owned(),
            inputs: self.inputs.clone(),
            holdout: self.holdout.clone(),
            session: SessionSettings { perception, body, budget, ..SessionSettings::default() },
            fps: self.fps,
            frames: self.frames.clone(),
            lags_nanos: Default::default(),
            true_masks: false,
            true_joints: Vec::new(),
            body: None,
        }
    }
}

#[derive(Debug, Args)]
pub struct BenchAvatarArgs {
    /// Data set in EasyMocap layout, as `flyrig eval` and `flyrig sim export` know it.
    pub dataset: PathBuf,
    #[command(flatten)]
    pub replay: ReplayArgs,
    /// Frames of poses that avatars are not fitted to; they are fitted to --frames, the first 30 without it.
    #[arg(long, default_value = "30..60", value_parser = parse_range)]
    pub novel: Range<u64>,
    /// Frames from one that is scored to the next.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub every: u32,
    /// Where pose and masks come from.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Numbers of Gaussians, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "10000,41000,164000", value_parser = clap::value_parser!(u32).range(1000..=1_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
    /// Seconds of fitting after which they are scored, comma separated; the last ones end the fit.
    #[arg(long, value_delimiter = ',', default_value = "5,15,30,60,120", value_parser = parse_seconds)]
    pub seconds: Vec<f64>,
    /// As in `flyrig avatar build`.
    #[arg(long, default_value_t = 5.0)]
    pub pull: f32,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-avatar")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct BenchBudgetArgs {
    /// Data set in EasyMocap layout, as `flyrig eval` and `flyrig sim export` know it.
    pub dataset: PathBuf,
    #[command(flatten)]
    pub replay: ReplayArgs,
    /// Where pose and masks come from.
    #[arg(long, value_enum, default_value = "estimated")]
    pub pose: Origin,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
    /// Budgets, sets a second, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3,4,5,6,8,10,15,30")]
    pub budgets: Vec<f64>,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-budget")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct BenchReceiveArgs {
    /// The recording that is played (`flyrig watch --record`): views are compared with those of nothing lost. Without one every motion is
    /// drawn as it comes, and its age then is measured as well.
    pub take: Option<PathBuf>,
    /// Key to the rig.
    #[arg(long, conflicts_with_all = ["rig", "connect"])]
    pub key: Option<PathBuf>,
    /// Name of the rig.
    #[arg(long, default_value = "flyrig")]
    pub rig: String,
    /// zenoh endpoint of `flyrig play`.
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub connect: String,
    /// Seconds from the start to the end.
    #[arg(long, default_value_t = 30.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// Name of the line in the results.
    #[arg(long, default_value = "loopback")]
    pub label: String,
    /// File of the results (JSON).
    #[arg(long)]
    pub out: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct BenchStreamArgs {
    /// Data sets in EasyMocap layout, as `flyrig eval` and `flyrig sim export` know them, or simulated people: sim:turn, sim:dance, sim:walk,
    /// sim:still and so on.
    #[arg(required = true)]
    pub datasets: Vec<Subject>,
    #[command(flatten)]
    pub replay: ReplayArgs,
    /// Seed of the first simulated person; the others follow.
    #[arg(long, default_value_t = 811)]
    pub seed: u64,
    /// Pixels of a simulated image's side.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Where pose and masks come from, comma separated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "given")]
    pub pose: Vec<Origin>,
    /// Numbers of Gaussians on the person's surface, comma separated.
    #[arg(long, value_delimiter = ',', default_values_t = [DEFAULT_GAUSSIAN_COUNT], value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
    /// Quantisation steps of the colours, codes of 255, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "4,8,12,16")]
    pub steps: Vec<f32>,
    /// Qualities of the colours as a video, 0 (best) to 63, comma separated; needs the program ffmpeg.
    #[arg(long, value_delimiter = ',', default_value = "10,20,30", value_parser = clap::value_parser!(u8).range(0..=63))]
    pub crf: Vec<u8>,
    /// The person's avatar (`flyrig avatar build`): tracking starts from it, and it is sent once, then poses alone.
    #[arg(long, value_name = "FILE")]
    pub avatar: Option<PathBuf>,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-stream")]
    pub out: PathBuf,
}

#[derive(Debug, Args)]
pub struct BenchEndureArgs {
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-endure")]
    pub out: PathBuf,
    /// Seed of the person.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Frames in all.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(300..=10_000_000))]
    pub frames: u64,
    /// Pixels of an image's side.
    #[arg(long, default_value_t = 160, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = 12_000, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

#[derive(Debug, Args)]
pub struct BenchCaptureArgs {
    /// How long.
    #[arg(long, default_value_t = 30.0, value_parser = parse_minutes)]
    pub minutes: f64,
    /// Cameras; every second one sends JPEG.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=32))]
    pub cameras: u32,
    /// Frames a second.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Size of the images, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "640x360")]
    pub size: [u32; 2],
}

#[derive(Debug, Args)]
pub struct BenchRecordArgs {
    /// Seconds for each quality.
    #[arg(long, default_value_t = 5.0, value_parser = parse_seconds)]
    pub seconds: f64,
    /// Cameras, all YUYV.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=32))]
    pub cameras: u32,
    /// Frames a second.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Size of the images, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "640x360")]
    pub size: [u32; 2],
    /// JPEG qualities, comma separated; 0 records images as they come.
    #[arg(long, value_delimiter = ',', default_values_t = [0, 80, 90, 95, 98], value_parser = clap::value_parser!(u8).range(0..=100))]
    pub qualities: Vec<u8>,
    /// Folder for the recordings, which are removed again; the system's for temporary files otherwise.
    #[arg(long)]
    pub folder: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct BenchHandsArgs {
    /// Lengths of the hands in the images, pixels, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "20,40,80")]
    pub px: Vec<f64>,
    /// Seed of the first person; the others follow.
    #[arg(long, default_value_t = 401)]
    pub seed: u64,
    /// How many people.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub people: u64,
    /// Frame sets of each person, 0.2 seconds apart.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub frames: u64,
    /// Cameras on a ring of 3 metres.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=32).map(usize::from))]
    pub cameras: usize,
    /// ONNX file of another hand network with the same outputs.
    #[arg(long)]
    pub hand_net: Option<PathBuf>,
    /// Folder for the images of each person's first set.
    #[arg(long)]
    pub images: Option<PathBuf>,
    /// Learns the face's points instead and prints their table, at the largest of the lengths.
    #[arg(long)]
    pub learn_face: bool,
}

#[derive(Debug, Args)]
pub struct BenchLandmarksArgs {
    /// Data sets with an animated glTF body, as `flyrig sim export` writes them; all of their cameras are used.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Only every so many frames.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    pub every: u64,
    /// Frames a second of the data sets.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
}

#[derive(Debug, Args)]
pub struct BenchWatchArgs {
    /// Number of bumps.
    #[arg(long, default_value_t = 12)]
    pub bumps: u32,
    /// Rotation of a bump, degrees.
    #[arg(long, default_value_t = 0.3)]
    pub deg: f64,
    /// Translation of a bump, millimetres.
    #[arg(long, default_value_t = 5.0)]
    pub mm: f64,
    /// Simulated minutes without a bump.
    #[arg(long, default_value_t = 30.0, value_parser = parse_minutes)]
    pub minutes: f64,
    /// Number of cameras.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..))]
    pub cameras: u32,
    /// Width of an image, pixels.
    #[arg(long, default_value_t = 1280)]
    pub width: u32,
    /// Height of an image, pixels.
    #[arg(long, default_value_t = 720)]
    pub height: u32,
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub struct BenchMasksArgs {
    /// A data set in EasyMocap's layout.
    pub dataset: PathBuf,
    /// Folder of the masks, CAM/000000.png.
    #[arg(long)]
    pub out: PathBuf,
    /// Frames a second of the data set.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
}

#[derive(Debug, Args)]
pub struct BenchPerceptionArgs {
    /// Data sets with true masks and an animated glTF body, as `flyrig sim export` writes them.
    #[arg(required = true)]
    pub datasets: Vec<PathBuf>,
    /// Input cameras, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "00,03,05")]
    pub inputs: Vec<String>,
    /// Cameras that the views are compared with, comma separated.
    #[arg(long, value_delimiter = ',', default_value = "01,02,04,06")]
    pub holdout: Vec<String>,
    /// Frames FIRST..END, END excluded; all of them otherwise.
    #[arg(long, value_parser = parse_range)]
    pub frames: Option<Range<u64>>,
    /// Frames a second of the data sets.
    #[arg(long, default_value_t = 30.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Only these rows: letters of pose, shape and masks, g for given and e for estimated, comma separated.
    #[arg(long, value_delimiter = ',')]
    pub only: Vec<String>,
    /// Parts of the names of joints whose orientation is the true one, or "place" for the true position, comma separated: what a part
    /// of the pose costs. For the rows with an estimated pose and the given shape.
    #[arg(long, value_delimiter = ',')]
    pub true_joints: Vec<String>,
    /// Leaves out the deformation and the views: poses, shapes and masks alone, in a fraction of the time.
    #[arg(long)]
    pub no_views: bool,
    /// `perception.look_after_m`: how far the body moves in a view until the network looks at that view again, metres.
    #[arg(long)]
    pub look_after_m: Option<f64>,
    /// Folder of the plates CAM.png; an empty one measures without plates. The data set's own by default.
    #[arg(long, value_name = "FOLDER")]
    pub plates: Option<PathBuf>,
    /// Writes a picture of every so many sets' masks beside the results: red where the person is missing, blue where the mask
    /// is too large.
    #[arg(long, value_name = "SETS", value_parser = clap::value_parser!(u64).range(1..))]
    pub mask_pictures: Option<u64>,
    /// Description of a landmark network to use in place of the one built in.
    #[arg(long, value_name = "FILE")]
    pub network: Option<PathBuf>,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-perception")]
    pub out: PathBuf,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

#[derive(Debug, Args)]
pub struct BenchSubjectsArgs {
    /// People in the scene: one waves, the others turn or walk.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(2..=4).map(usize::from))]
    pub people: usize,
    /// Poses, shapes and masks from the simulator, or from the images. In the latter case all but the first walk, and it is counted
    /// how often the tracks change places.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-subjects")]
    pub out: PathBuf,
    /// Seed of the first person; the next ones make the others.
    #[arg(long, default_value_t = 3)]
    pub seed: u64,
    /// Frames of the sequence; the second half is scored.
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    /// Pixels of an image's side.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Gaussians on each person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

#[derive(Debug, Args)]
pub struct BenchScaleArgs {
    /// Pose and masks from the simulator, or from the images.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-scale")]
    pub out: PathBuf,
    /// Seed of the person.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Frames of a sequence; the first twelve are neither timed nor scored.
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u16).range(13..=1000).map(usize::from))]
    pub frames: usize,
    /// Pixels of an image's side, comma separated. The first one is that of the other rows.
    #[arg(long, value_delimiter = ',', default_value = "512,256,1024,1440", value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub sides: Vec<u32>,
    /// Numbers of input cameras, comma separated. The first one is that of the other rows.
    #[arg(long, value_delimiter = ',', default_value = "3,2,4,6", value_parser = clap::value_parser!(u8).range(1..=6).map(usize::from))]
    pub views: Vec<usize>,
    /// Numbers of Gaussians on the person's surface, comma separated. The first one is that of the other rows.
    #[arg(long, value_delimiter = ',', default_value = "115000,29000,58000,230000", value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: Vec<usize>,
}

#[derive(Debug, Args)]
pub struct BenchTakesArgs {
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-takes")]
    pub out: PathBuf,
    /// How many takes, each with people and a room of its own.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub takes: u64,
    /// People in each take: one stays in the middle, the others walk around.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(2..=4).map(usize::from))]
    pub people: usize,
    /// Seed of the first take.
    #[arg(long, default_value_t = 601)]
    pub seed: u64,
    /// Seconds of a take.
    #[arg(long, default_value_t = 5.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// The last person leaves 3 s after the start, for so many seconds; nobody leaves otherwise.
    #[arg(long, value_parser = parse_seconds)]
    pub away_secs: Option<f64>,
    /// Frame sets a second.
    #[arg(long, default_value_t = 10.0, value_parser = parse_fps)]
    pub fps: f64,
    /// Pixels of an image's side.
    #[arg(long, default_value_t = 384, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
}

#[derive(Debug, Args)]
pub struct BenchTrackArgs {
    /// Folder of the results.
    #[arg(long, default_value = "out/bench-track")]
    pub out: PathBuf,
    /// Seed of the person.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Frames of the sequence.
    #[arg(long, default_value_t = 14, value_parser = clap::value_parser!(u16).range(2..=1000).map(usize::from))]
    pub frames: usize,
    /// Pixels of an image's side.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
    /// Only the three solvers.
    #[arg(long)]
    pub quick: bool,
    /// Only the cases whose name has this text in it, "2 views" for example.
    #[arg(long)]
    pub only: Option<String>,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}

#[derive(Debug, Args)]
pub struct BenchStressArgs {
    /// Folder of the table and images.
    #[arg(long, default_value = "out/bench-stress")]
    pub out: PathBuf,
    /// Only the cases whose names contain one of these texts, comma separated.
    #[arg(long, value_delimiter = ',')]
    pub only: Vec<String>,
    /// Seed of the person and the room.
    #[arg(long, default_value_t = 501)]
    pub seed: u64,
    /// Width and height of the images, pixels.
    #[arg(long, default_value_t = 384, value_parser = clap::value_parser!(u32).range(96..=2048))]
    pub side: u32,
    /// Cameras on a ring of 3 metres.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..=16).map(usize::from))]
    pub cameras: usize,
    /// Frame sets a second.
    #[arg(long, default_value_t = 10.0, value_parser = parse_fps)]
    pub fps: f64,
}
