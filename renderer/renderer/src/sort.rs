//! Stable radix sort and prefix sum on the device.

pub(crate) mod radix;
pub(crate) mod scan;
