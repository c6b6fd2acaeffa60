//! `flyrig view`: a window with a free viewpoint on the people of a running rig.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::Args;
use flyrig_gpu::GpuContext;
use flyrig_report::{
    arguments::{parse_seconds, parse_size},
    png, write_whole,
};
use flyrig_viewer::{ViewOptions, check_desktop, open_window};

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
    /// Save what is shown after this time, with a warning, where the colours are incomplete (default 60).
    #[arg(long, value_name = "SECONDS", value_parser = parse_seconds, requires = "screenshot")]
    pub wait: Option<f64>,
    #[command(flatten)]
    pub stop: StopArgs,
}

/// Default time until a screenshot is taken, seconds.
const SCREENSHOT_SECS: f64 = 60.0;

/// Runs the command.
pub fn view(args: &ViewArgs, gpu: impl FnOnce() -> Result<GpuContext>) -> Result<()> {
    check_desktop()?;
    let options = ViewOptions {
        transport: args.rig.transport()?,
        lowest_latency: args.lowest_latency,
        follow: args.follow,
        camera: args.camera.clone(),
        size: args.size,
        screenshot_within: args.screenshot.is_some().then_some(args.wait.unwrap_or(SCREENSHOT_SECS)),
        seconds: args.stop.seconds,
    };
    let transport = &options.transport;
    eprintln!("view: rig '{}' at {}; close the window to end", transport.rig, transport.connect.join(", "));
    let shot = open_window(options, &gpu()?.fastest())?;
    if let Some(path) = &args.screenshot {
        let shot = shot.context("the window was closed before the screenshot")?;
        if let Some(missing) = &shot.missing {
            eprintln!("view: warning: the screenshot shows what there was: {missing}");
        }
        write_whole(path, &png::encode_rgb(&shot.rgb, shot.width, shot.height)?)?;
        println!("{}", path.display());
    }
    Ok(())
}
