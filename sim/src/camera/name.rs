//! Names of the simulated cameras.

/// Returns the name of a camera of the ring.
pub(crate) fn camera_name(slot: usize) -> String {
    format!("{slot:02}")
}
