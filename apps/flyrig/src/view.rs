//! `flyrig view`: a window with a free viewpoint on the people of a running rig.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::parse_size, png, write_whole};
use flyrig_viewer::{ViewOptions, open_window};

use crate::arguments::{RigArgs, StopArgs};

/// Arguments of `flyrig view`.
#[derive(Debug, Args)]
pub struct ViewArgs {
    #[command(flatten)]
    pub rig: RigArgs,
    /// Show the newest frame immediately; otherwise motion is interpolated with a delay of 1.5 frames.
    #[arg(long)]
    pub lowest_latency: bool,
    /// Follow the person from the start (key F).
    #[arg(long)]
    pub follow: bool,
    /// Name of the rig's camera at which the view starts.
    #[arg(long)]
    pub camera: Option<String>,
    /// Size of the window, WIDTHxHEIGHT.
    #[arg(long, value_parser = parse_size, default_value = "1280x720")]
    pub size: [u32; 2],
    /// Save the window as PNG once a person is shown with complete colours, and close it.
    #[arg(long)]
    pub screenshot: Option<PathBuf>,
    #[command(flatten)]
    pub stop: StopArgs,
}

/// Default time until a screenshot is taken, seconds.
const SCREENSHOT_SECS: f64 = 60.0;

/// Runs the command.
pub fn view(args: &ViewArgs, gpu: &GpuContext) -> Result<()> {
    let options = ViewOptions {
        transport: args.rig.transport()?,
        lowest_latency: args.lowest_latency,
        follow: args.follow,
        camera: args.camera.clone(),
        size: args.size,
        screenshot: args.screenshot.is_some(),
        seconds: args.stop.seconds.or(args.screenshot.is_some().then_some(SCREENSHOT_SECS)),
    };
    let transport = &options.transport;
    eprintln!("view: rig '{}' at {}; close the window to end", transport.rig, transport.connect.join(", "));
    let shot = open_window(options, &gpu.fastest())?;
    if let (Some(path), Some(shot)) = (&args.screenshot, shot) {
        write_whole(path, &png::encode_rgb(&shot.rgb, shot.width, shot.height)?)?;
        println!("{}", path.display());
    }
    Ok(())
}
