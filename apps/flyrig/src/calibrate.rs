//! `flyrig calibrate`: boards, lenses, rigs, and files of other programs.

mod advice;
mod board;
mod color;
mod convert;
mod lens;
mod live;
mod output;
mod page;
mod person;
mod rig;
mod unjoined;
mod views;

use std::{path::PathBuf, slice::from_ref};

use anyhow::Result;
use clap::Subcommand;
use flyrig_gpu::GpuContext;

pub use convert::parse_scale;

/// Subcommands of `flyrig calibrate`.
#[derive(Debug, Subcommand)]
pub enum CalibrateAction {
    /// Write a printable board (SVG, PDF) and its description, board.toml.
    Board(board::CalibrateBoardArgs),
    /// Calibrate the lens of each camera from a take with many poses of the board.
    Lens(lens::CalibrateLensArgs),
    /// Calibrate poses and time offsets of all cameras from a take in which they see the board together.
    Rig(rig::CalibrateRigArgs),
    /// Calibrate lenses and poses while the board is shown, with instructions in the terminal and on a local page.
    Live(live::CalibrateLiveArgs),
    /// Refine poses and time offsets of calibrated cameras from the motion of one person.
    Person(person::CalibratePersonArgs),
    /// Match the colours of calibrated cameras (exposure, white balance, response, vignetting) from people in view.
    Color(color::CalibrateColorArgs),
    /// Convert a calibration from or to the format of another program.
    Convert(convert::CalibrateConvertArgs),
}

impl CalibrateAction {
    /// Returns the command's name and the inputs that it opens; `None` for a command without any.
    pub fn input(&self) -> Option<(&'static str, &[PathBuf])> {
        match self {
            Self::Board(_) => None,
            Self::Lens(args) => Some(("calibrate lens", &args.take.source.input)),
            Self::Rig(args) => Some(("calibrate rig", &args.take.source.input)),
            Self::Live(args) => Some(("calibrate live", &args.take.source.input)),
            Self::Person(args) => Some(("calibrate person", &args.input.source.input)),
            Self::Color(args) => Some(("calibrate color", &args.input.source.input)),
            Self::Convert(args) => Some(("calibrate convert", from_ref(&args.input))),
        }
    }
}

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras and for tracking people.
pub fn calibrate(action: &CalibrateAction, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    match action {
        CalibrateAction::Board(args) => board::board(args),
        CalibrateAction::Lens(args) => lens::lens(args, gpu),
        CalibrateAction::Rig(args) => rig::rig(args, gpu),
        CalibrateAction::Live(args) => live::live(args, gpu),
        CalibrateAction::Person(args) => person::person(args, gpu),
        CalibrateAction::Color(args) => color::color(args, gpu),
        CalibrateAction::Convert(args) => convert::convert(args),
    }
}
