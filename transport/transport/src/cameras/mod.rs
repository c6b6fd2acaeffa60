//! Cameras: their calibration on the wire, and frames and clocks of other computers.

pub(crate) mod calibration;
pub(crate) mod clock_exchange;
pub(crate) mod frame;
pub(crate) mod host_clock;
pub(crate) mod host_id;
pub(crate) mod inbox;
pub(crate) mod link;
pub(crate) mod publisher;
pub(crate) mod subscriber;
