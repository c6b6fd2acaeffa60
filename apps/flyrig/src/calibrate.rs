//! `flyrig calibrate`: boards, lenses, rigs, and files of other programs.

mod advice;
mod board;
mod color;
mod convert;
mod lens;
mod live;
mod page;
mod person;
mod rig;
mod views;

use std::path::Path;

use anyhow::{Result, bail};
use flyrig_gpu::GpuContext;

use crate::cli::CalibrateAction;

/// Files of a calibrated rig.
const FILES: [&str; 2] = ["calibration.toml", "calibration.json"];

/// Refuses to replace files of an earlier run.
fn refuse_existing(folder: &Path, names: &[&str], force: bool) -> Result<()> {
    match names.iter().map(|name| folder.join(name)).find(|file| file.exists()) {
        Some(known) if !force => bail!("{} is there already; --force replaces it", known.display()),
        _ => Ok(()),
    }
}

/// Runs the command. `gpu` opens a graphics adapter, for simulated cameras and for following people.
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
