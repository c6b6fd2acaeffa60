//! The command line of `flyrig-bench`.

use clap::{Parser, Subcommand};
use flyrig_report::arguments::ProgramArgs;

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
    surfaces::BenchSurfacesArgs,
    watch::BenchWatchArgs,
};

/// Measures run time against error on simulated people.
#[derive(Debug, Parser)]
#[command(name = "flyrig-bench", version)]
pub struct BenchCli {
    #[command(flatten)]
    pub program: ProgramArgs,
    #[command(subcommand)]
    pub command: BenchCommand,
}

/// Subcommands of `flyrig-bench`.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Deformation tracking: error over run time of solvers, iterations, Gaussians, resolutions and views. Writes CSV, JSON and SVG.
    Track(BenchTrackArgs),
    /// Deformation tracking over thousands of frames of one motion back and forth: error and memory over time. Writes CSV and SVG.
    Endure(BenchEndureArgs),
    /// Appearance: every mode and ablation on simulated people outside of the training data. Writes CSV, JSON and SVG.
    Appearance(BenchAppearanceArgs),
    /// Avatars: error over the time of the fit for its variants, run time and memory over the number of Gaussians. Writes a table, JSON
    /// and SVG.
    Avatar(BenchAvatarArgs),
    /// Budgets: error in views and saved run time of each kind of work that a budget may skip.
    Budget(BenchBudgetArgs),
    /// Capture: memory, latency and processor time of plain cameras of this process, from their threads to frame sets.
    Capture(BenchCaptureArgs),
    /// Hands: errors of fingertips and of the head's rotation on simulated people, estimated and relaxed, and the run time per crop.
    Hands(BenchHandsArgs),
    /// Landmarks: bias and spread of the landmark network on people whose pose is known.
    Landmarks(BenchLandmarksArgs),
    /// Bumped cameras among switched lights, a walking person and exposure jumps: delay of the report, error, false alarms, run time.
    Watch(BenchWatchArgs),
    /// Person stream: bytes, run times and losses, beside other encodings. Writes a table, CSV, JSON and SVG.
    Stream(BenchStreamArgs),
    /// Reception of the people of a rig, or of a take that `flyrig play --repeat` publishes: update rates, age, errors of displayed views.
    Receive(BenchReceiveArgs),
    /// Masks estimated in each camera independently, against which several calibrations are scored.
    Masks(BenchMasksArgs),
    /// Pose, shape and masks from images: their errors, and the error in the views that each causes. Writes a table and JSON.
    Perception(BenchPerceptionArgs),
    /// Turns, covered cameras, switched lights, people who leave: errors before, during and after, and the time to recover.
    Stress(BenchStressArgs),
    /// Two or more people in one scene: views, and run time compared with one person. Writes a table and PNG images.
    Subjects(BenchSubjectsArgs),
    /// Identities: takes of several people who walk past one another, found and followed from images alone.
    Takes(BenchTakesArgs),
    /// Meshes: their distance from the true surfaces of takes, over what they are made from, and the run time. Writes a table and JSON.
    Surfaces(BenchSurfacesArgs),
    /// Run time and error over pixels, input cameras and Gaussians, and the exponents of the run time.
    Scale(BenchScaleArgs),
    /// Recordings of uncompressed cameras: bytes, processor time and loss of each JPEG quality.
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
