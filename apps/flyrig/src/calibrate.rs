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
mod views;

use anyhow::Result;
use flyrig_gpu::GpuContext;

use crate::cli::CalibrateAction;

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
