//! `flyrig view`: a window with a free viewpoint on the people of a running rig.

use anyhow::Result;
use flyrig_gpu::GpuContext;
use flyrig_report::{png, write_whole};
use flyrig_viewer::{ViewOptions, open_window};

use crate::cli::ViewArgs;

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
        seconds: args.seconds.or(args.screenshot.is_some().then_some(SCREENSHOT_SECS)),
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
