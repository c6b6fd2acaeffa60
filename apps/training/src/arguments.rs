//! Arguments of a training, and of the samples for it.

use std::path::PathBuf;

use clap::{Args, ValueEnum, builder::TypedValueParser as _};
use flyrig_body::DEFAULT_GAUSSIAN_COUNT;
use flyrig_fusion::Origin;
use flyrig_stfa::NetworkSize;

/// Arguments of `flyrig train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Folder of samples, checkpoint, weights and curves. A folder with a checkpoint is gone on with.
    #[arg(long)]
    pub out: PathBuf,
    /// Simulated people to train on.
    #[arg(long, default_value_t = 60)]
    pub people: u64,
    /// Simulated people, of another seed, that only measure progress.
    #[arg(long, default_value_t = 8)]
    pub test_people: u64,
    /// Instants of each simulated person.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub instants: u64,
    /// Seed of people, starting weights and order.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Recorded data set (EasyMocap layout, with masks) to train on as well, every camera held out in turn; may be given
    /// several times.
    #[arg(long)]
    pub dataset: Vec<PathBuf>,
    /// Cameras of --dataset, comma separated; all of them otherwise.
    #[arg(long, value_delimiter = ',')]
    pub cameras: Vec<String>,
    /// Frames of --dataset from one sample to the next.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub every: u64,
    /// Pose in --dataset: from its glTF animation, or from the images.
    #[arg(long, value_enum, default_value = "given")]
    pub pose: Origin,
    /// Frame rate of --dataset.
    #[arg(long, default_value_t = 30.0)]
    pub fps: f64,
    /// Folder of further samples, as an earlier run left them; may be given several times.
    #[arg(long)]
    pub extra: Vec<PathBuf>,
    /// Steps in all.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    pub steps: u64,
    /// Adam's rate at the start; it falls to zero along half a cosine.
    #[arg(long, default_value_t = 2e-3)]
    pub rate: f32,
    /// Weight of structural similarity beside the mean squared difference.
    #[arg(long, default_value_t = 0.2)]
    pub structure: f32,
    /// Weight of fine contrast beside it, which keeps prints from fading.
    #[arg(long, default_value_t = 1.0)]
    pub contrast: f32,
    /// How large the networks are.
    #[arg(long, value_enum, default_value = "tiny", conflicts_with = "from")]
    pub size: SizeName,
    /// Weights file to start from in place of random weights; "small" or "tiny" for the networks that come with flyrig.
    #[arg(long)]
    pub from: Option<PathBuf>,
    /// Checkpoints (one every 250 steps) from one measurement on the test people to the next.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub test_every: u64,
    /// Pixels of a simulated image's side.
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(64..=2048))]
    pub side: u32,
    /// Gaussians on the person's surface.
    #[arg(long, default_value_t = DEFAULT_GAUSSIAN_COUNT, value_parser = clap::value_parser!(u32).range(200..=2_000_000).map(|n| n as usize))]
    pub gaussians: usize,
}

/// Sizes of the networks of learned appearance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SizeName {
    /// The default: the fastest in a live rig.
    Tiny,
    /// Between the two.
    Small,
    /// The most parameters.
    Medium,
}

impl SizeName {
    pub(crate) fn size(self) -> NetworkSize {
        match self {
            Self::Tiny => NetworkSize::TINY,
            Self::Small => NetworkSize::SMALL,
            Self::Medium => NetworkSize::MEDIUM,
        }
    }
}
