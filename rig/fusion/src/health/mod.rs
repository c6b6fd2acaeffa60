//! Health of a running rig: snapshot, run times of stages, and their trace.

pub(crate) mod process;
pub(crate) mod snapshot;
pub(crate) mod stage_times;
pub(crate) mod stage_trace;

pub(crate) use process::release_free_memory;
pub use process::{processor_time, resident_mib, share_memory_pools};
pub use snapshot::{CameraHealth, Health, STUCK_AFTER, check_threads};
pub use stage_times::{StageSummary, StageTimes};
pub use stage_trace::{TracedStage, start_stage_trace, take_stage_trace};
