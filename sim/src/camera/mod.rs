//! Simulated cameras: ring, optics, sensor, clock, faults, and the frame source of each.

pub(crate) mod calibration_error;
pub(crate) mod clock;
pub(crate) mod faults;
pub(crate) mod frame;
pub(crate) mod name;
pub(crate) mod optics;
pub(crate) mod ring;
pub(crate) mod sensor;
pub(crate) mod shot;
pub(crate) mod source;
