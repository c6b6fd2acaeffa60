//! Health of a running rig: snapshot, run times of stages, and their trace.

pub(crate) mod process;
pub(crate) mod snapshot;
pub(crate) mod stage_times;
pub(crate) mod stage_trace;

pub use process::{processor_time, resident_mib};
pub use snapshot::{CameraHealth, Health, STUCK_AFTER, check_threads};
pub use stage_times::{StageSummary, StageTimes};
pub use stage_trace::{TracedStage, start_stage_trace, take_stage_trace};
