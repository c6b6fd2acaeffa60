//! Ctrl-C and SIGTERM as a flag for loops to check.

use std::sync::{
    Arc, OnceLock,
    atomic::{AtomicBool, Ordering},
};

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Returns the flag that the first Ctrl-C sets. A second Ctrl-C ends the process at once.
pub fn flag() -> Arc<AtomicBool> {
    FLAG.get_or_init(|| {
        let flag = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&flag);
        let handler = move || {
            if seen.swap(true, Ordering::Relaxed) {
                std::process::exit(130);
            }
        };
        if let Err(error) = ctrlc::set_handler(handler) {
            tracing::warn!(%error, "Ctrl-C will end the process without a report");
        }
        flag
    })
    .clone()
}

/// Returns whether the user asked to stop.
#[must_use]
pub fn requested() -> bool {
    flag().load(Ordering::Relaxed)
}
