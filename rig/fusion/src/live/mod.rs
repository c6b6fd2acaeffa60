//! Live rig: cameras, session and publisher, step by step, going on after faults.

mod ages;
mod live_rig;
mod recovery;
mod rig_watch;

pub use live_rig::{LiveRig, LiveStep};
pub use rig_watch::{Correction, RigWatch, WatchEvent};
