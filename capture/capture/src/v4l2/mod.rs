//! Cameras of Linux through V4L2: the `v4l` crate's bindings under a buffer queue of our own.
//!
//! The crate's own streams wait for ever on a silent camera, cannot be used after a timeout, know single-planar formats
//! only and panic when dropped after an unplug; see [`queue`] for ours.

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
use crate::{CameraIdentity, CameraOptions, CaptureError, source::forward_source};

/// A camera of this computer. Frames come in the camera's own pixel format; [`crate::Decoding`] makes RGB of them.
///
/// A camera that is unplugged, silent or failing is looked for again by its identity at every call, under whatever number
/// it comes back, and gets its format and controls anew. Frames that the driver flags as damaged, empty ones and cut off
/// ones are `Corrupt`. The capture time is the middle of the exposure on `CLOCK_MONOTONIC`: the driver's stamp, which tells
/// the start of the exposure or the end of the frame, moved by half of exposure and readout. Drivers of USB cameras stamp
/// the first packet and call it the start of the exposure; `lag_secs` corrects what that makes wrong.
#[derive(Debug)]
pub struct V4l2Camera(Stream<System>);

impl V4l2Camera {
    /// Finds the camera, sets it up and starts its stream.
    ///
    /// # Errors
    /// `NotFound` when no such camera is there, `Unsupported` for what it cannot do, `Io` when it is in use, may not be
    /// opened, or its bus has no room. Every text names the camera, the cause and the fix.
    pub fn open(camera: &CameraId, options: &CameraOptions) -> Result<Self, CaptureError> {
        Stream::open(camera, options, System).map(Self)
    }
}

forward_source!(V4l2Camera);

/// This computer.
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
