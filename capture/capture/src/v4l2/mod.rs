//! Linux cameras through V4L2: the bindings of the crate `v4l` under a buffer queue of this crate.
//!
//! The streams of `v4l` block for ever on a silent camera, are unusable after a timeout, support single-planar formats
//! only and panic when dropped after an unplug; see [`queue`] for the replacement. `identity` finds a camera, `modes`
//! chooses a mode and steps down, `queue` keeps the driver's buffers behind a trait that tests implement,
//! [`stamps`](crate::stamps) turns the driver's timestamps into the middle of the exposure, and `stream` joins them and
//! reconnects after a loss. All `unsafe` code is in `sys`.

mod causes;
mod controls;
mod format;
mod identity;
mod modes;
mod queue;
mod report;
mod sequence;
mod stream;
#[cfg(test)]
mod stream_tests;
mod sys;

use std::{io, path::PathBuf};

use flyrig_types::CameraId;

use self::{
    controls::ControlDevice,
    identity::Roots,
    stream::{CameraDevice, Host, Stream},
    sys::{ActiveFormat, ControlRange, Device, SizeRange},
};
pub use self::{
    identity::{CameraNode, UsbPlace},
    report::{BusPlan, CameraReport, FormatReport, camera_reports, plan_buses},
    sys::monotonic_nanos,
};
use crate::camera_options::{CameraIdentity, CameraOptions};
use crate::error::CaptureError;
use crate::source::forward_source;

/// Camera of this computer. Frames have the camera's own pixel format; [`crate::Decoding`] converts them to RGB.
///
/// A camera that is unplugged, silent or failing is searched for by its identity at every call, under any node number,
/// and its format and controls are applied again. Frames that the driver flags as damaged, empty ones and truncated
/// ones are `Corrupt`. The capture time is the middle of the exposure on `CLOCK_MONOTONIC`: the driver's timestamp,
/// which refers to the start of the exposure or the end of the frame, shifted by half of exposure and readout. Drivers
/// of USB cameras timestamp the first packet as the start of the exposure; `lag_secs` corrects that error.
#[derive(Debug)]
pub struct V4l2Camera(Stream<System>);

impl V4l2Camera {
    /// Finds the camera, configures it and starts its stream.
    ///
    /// # Errors
    /// `NotFound` when there is no such camera, `Unsupported` for options that it lacks, `Io` when it is in use, access
    /// is denied, or its bus lacks bandwidth. Every text names the camera, the cause and the fix.
    pub fn open(camera: &CameraId, options: &CameraOptions) -> Result<Self, CaptureError> {
        Stream::open(camera, options, System).map(Self)
    }
}

forward_source!(V4l2Camera);

/// This computer's devices and clock.
#[derive(Debug)]
struct System;

impl Host for System {
    type Device = Device;

    fn open(&mut self, identity: &CameraIdentity) -> Result<(Device, PathBuf, Option<u32>), CaptureError> {
        let found = identity::find(identity, &identity::scan(&Roots::default()), &identity::probe)?;
        let device =
            Device::open(&found.node).map_err(|error| causes::explain(&error, "cannot be opened", &found.node))?;
        Ok((device, found.node, found.usb.map(|usb| usb.speed_mbit)))
    }

    fn now_nanos(&self) -> i64 {
        monotonic_nanos()
    }
}

impl ControlDevice for Device {
    fn range(&self, id: u32) -> io::Result<Option<ControlRange>> {
        self.control_range(id)
    }

    fn get(&self, id: u32) -> io::Result<i32> {
        self.control(id)
    }

    fn set(&mut self, id: u32, value: i32) -> io::Result<()> {
        self.set_control(id, value)
    }
}

impl CameraDevice for Device {
    fn formats(&self) -> io::Result<Vec<[u8; 4]>> {
        self.formats()
    }

    fn sizes(&self, fourcc: [u8; 4]) -> io::Result<Vec<SizeRange>> {
        self.sizes(fourcc)
    }

    fn rates(&self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<Vec<f64>> {
        self.rates(fourcc, width, height)
    }

    fn set_format(&mut self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<ActiveFormat> {
        self.set_format(fourcc, width, height)
    }

    fn set_rate(&mut self, fps: f64) -> io::Result<Option<f64>> {
        Device::set_rate(self, fps)
    }
}
