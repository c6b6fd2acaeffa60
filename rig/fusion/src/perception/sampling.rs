//! Choice of the frame sets from which a person is measured.

/// Number of frame sets to which a person's shape is fitted.
pub const SHAPE_SETS: usize = 8;
/// Time over which they are spread, seconds, so that a moving person is seen in several poses.
pub const SHAPE_SECS: f64 = 1.5;
/// Least time from one of them to the next, nanoseconds.
pub(super) const SHAPE_EVERY_NANOS: i64 = (SHAPE_SECS * 1e9 / SHAPE_SETS as f64) as i64;
