//! The command line of `flyrig-bench`.

use std::path::PathBuf;

use clap::{Parser, Subcommand};

use crate::{
    appearance::BenchAppearanceArgs,
    avatar::BenchAvatarArgs,
    budget::BenchBudgetArgs,
    capture::{BenchCaptureArgs, record::BenchRecordArgs},
    deformation::{endure::BenchEndureArgs, track::BenchTrackArgs},
    people::{subjects::BenchSubjectsArgs, takes::BenchTakesArgs},
    perception::{
        BenchPerceptionArgs, hands::BenchHandsArgs, landmarks::BenchLandmarksArgs, masks::BenchMasksArgs,
        stress::BenchStressArgs,
    },
    scale::BenchScaleArgs,
    stream::{arguments::BenchStreamArgs, receive::BenchReceiveArgs},
    watch::BenchWatchArgs,
};

/// Measures run time against error on simulated people.
#[derive(Debug, Parser)]
#[command(name = "flyrig-bench", version)]
pub struct BenchCli {
    /// Log more: -v debug, -vv trace. RUST_LOG selects modules.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Part of a graphics adapter's name; the fastest adapter otherwise.
    #[arg(long, global = true)]
    pub adapter: Option<String>,
    /// Write when each stage ran into this file, for Perfetto (ui.perfetto.dev) or about:tracing.
    #[arg(long, global = true, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    #[command(subcommand)]
    pub command: BenchCommand,
}

/// Subcommands of `flyrig-bench`.
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

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        BenchCli::command().debug_assert();
    }
}
