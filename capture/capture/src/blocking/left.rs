//! Registry of threads that still hang in a driver after their camera was given up.

use std::sync::{Arc, Mutex, MutexGuard};

use super::worker::Line;

/// Hanging threads with the name of their device, so that repeated opening of one camera does not accumulate threads.
static LEFT: Mutex<Vec<(String, Arc<Line>)>> = Mutex::new(Vec::new());

fn lock() -> MutexGuard<'static, Vec<(String, Arc<Line>)>> {
    flyrig_types::lock(&LEFT)
}

/// Registers the hanging threads of a device for its next owner.
pub(super) fn leave(device: &str, lines: impl IntoIterator<Item = Arc<Line>>) {
    let mut left = lock();
    left.retain(|(_, line)| !line.events.is_closed());
    let hanging = lines.into_iter().filter(|line| !line.events.is_closed());
    left.extend(hanging.map(|line| (device.to_owned(), line)));
}

/// Removes and returns the threads that hang in the driver of a device.
pub(super) fn take(device: &str) -> Vec<Arc<Line>> {
    let mut left = lock();
    left.retain(|(_, line)| !line.events.is_closed());
    left.extract_if(.., |(of, _)| of == device).map(|(_, line)| line).collect()
}
