//! Modes and controls of a device: formats, sizes, rates and settings.

use std::io;

use v4l::{
    v4l_sys::{
        V4L2_CAP_TIMEPERFRAME, v4l2_control, v4l2_fmtdesc, v4l2_format, v4l2_fract, v4l2_frmivalenum,
        v4l2_frmivaltypes_V4L2_FRMIVAL_TYPE_DISCRETE as INTERVAL_DISCRETE, v4l2_frmsizeenum,
        v4l2_frmsizetypes_V4L2_FRMSIZE_TYPE_DISCRETE as SIZE_DISCRETE, v4l2_queryctrl, v4l2_streamparm,
    },
    v4l2::vidioc,
};

use super::device::{Device, MULTI_PLANAR, Plain, invalid};
use crate::v4l2::queue::MAX_PLANES;

/// Most entries read of an enumeration, against a driver that never signals its end.
const MAX_ENTRIES: u32 = 512;

/// Format in effect (`VIDIOC_S_FMT` as answered).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ActiveFormat {
    pub fourcc: [u8; 4],
    pub width: u32,
    pub height: u32,
    /// Bytes from one row to the next in each memory plane; 0 where it does not apply.
    pub stride: [u32; MAX_PLANES],
    pub planes: usize,
}

/// Integer control (`VIDIOC_QUERYCTRL`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ControlRange {
    pub minimum: i32,
    pub maximum: i32,
    /// `V4L2_CTRL_FLAG_*`.
    pub flags: u32,
}

/// Image sizes of a format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SizeRange {
    One(u32, u32),
    /// Minimum, maximum and step of width and of height.
    Steps([u32; 3], [u32; 3]),
}

impl Device {
    /// Lists the pixel formats, in the driver's order.
    pub fn formats(&self) -> io::Result<Vec<[u8; 4]>> {
        let mut formats = Vec::new();
        for index in 0..MAX_ENTRIES {
            let mut raw = v4l2_fmtdesc { index, type_: self.buffer_type, ..Plain::zeroed() };
            if !self.listed(vidioc::VIDIOC_ENUM_FMT, &mut raw)? {
                break;
            }
            formats.push(raw.pixelformat.to_le_bytes());
        }
        Ok(formats)
    }

    /// Lists the sizes of a format; empty where the driver does not report them.
    pub fn sizes(&self, fourcc: [u8; 4]) -> io::Result<Vec<SizeRange>> {
        let mut sizes = Vec::new();
        for index in 0..MAX_ENTRIES {
            let mut raw = v4l2_frmsizeenum { index, pixel_format: u32::from_le_bytes(fourcc), ..Plain::zeroed() };
            if !self.listed(vidioc::VIDIOC_ENUM_FRAMESIZES, &mut raw)? {
                break;
            }
            // SAFETY: both arms of the union are integers; `type_` says which one the driver wrote.
            let (one, steps) = unsafe { (raw.__bindgen_anon_1.discrete, raw.__bindgen_anon_1.stepwise) };
            if raw.type_ != SIZE_DISCRETE {
                sizes.push(SizeRange::Steps(
                    [steps.min_width, steps.max_width, steps.step_width],
                    [steps.min_height, steps.max_height, steps.step_height],
                ));
                break;
            }
            sizes.push(SizeRange::One(one.width, one.height));
        }
        Ok(sizes)
    }

    /// Lists the rates of a format and size, frames per second; only the fastest and the slowest where the driver has a
    /// continuous range, empty where it does not report them.
    pub fn rates(&self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<Vec<f64>> {
        let rate = |interval: v4l2_fract| f64::from(interval.denominator) / f64::from(interval.numerator.max(1));
        let mut rates = Vec::new();
        for index in 0..MAX_ENTRIES {
            let pixel_format = u32::from_le_bytes(fourcc);
            let mut raw = v4l2_frmivalenum { index, pixel_format, width, height, ..Plain::zeroed() };
            if !self.listed(vidioc::VIDIOC_ENUM_FRAMEINTERVALS, &mut raw)? {
                break;
            }
            // SAFETY: as for the sizes.
            let (one, steps) = unsafe { (raw.__bindgen_anon_1.discrete, raw.__bindgen_anon_1.stepwise) };
            if raw.type_ != INTERVAL_DISCRETE {
                rates.extend([rate(steps.min), rate(steps.max)]);
                break;
            }
            rates.push(rate(one));
        }
        Ok(rates)
    }

    /// Sets format and size; returns those in effect, which may differ.
    pub fn set_format(&mut self, fourcc: [u8; 4], width: u32, height: u32) -> io::Result<ActiveFormat> {
        const FIELD_NONE: u32 = 1;
        let pixelformat = u32::from_le_bytes(fourcc);
        let mut raw = v4l2_format { type_: self.buffer_type, ..Plain::zeroed() };
        if self.buffer_type == MULTI_PLANAR {
            // SAFETY: the union is integers alone, and zeroed.
            let mut format = unsafe { raw.fmt.pix_mp };
            (format.width, format.height, format.pixelformat, format.field) = (width, height, pixelformat, FIELD_NONE);
            raw.fmt.pix_mp = format;
        } else {
            // SAFETY: as above.
            let mut format = unsafe { raw.fmt.pix };
            (format.width, format.height, format.pixelformat, format.field) = (width, height, pixelformat, FIELD_NONE);
            raw.fmt.pix = format;
        }
        self.ioctl(vidioc::VIDIOC_S_FMT, &mut raw)?;
        let mut stride = [0; MAX_PLANES];
        let active = if self.buffer_type == MULTI_PLANAR {
            // SAFETY: the driver has answered in this arm of the union.
            let format = unsafe { raw.fmt.pix_mp };
            let planes = format.plane_fmt;
            for (stride, plane) in stride.iter_mut().zip(planes) {
                *stride = plane.bytesperline;
            }
            let (width, height, fourcc) = (format.width, format.height, format.pixelformat);
            let planes = usize::from(format.num_planes).clamp(1, MAX_PLANES);
            ActiveFormat { fourcc: fourcc.to_le_bytes(), width, height, stride, planes }
        } else {
            // SAFETY: the driver has answered in this arm of the union.
            let format = unsafe { raw.fmt.pix };
            stride[0] = format.bytesperline;
            let fourcc = format.pixelformat.to_le_bytes();
            ActiveFormat { fourcc, width: format.width, height: format.height, stride, planes: 1 }
        };
        self.memory_planes = active.planes;
        Ok(active)
    }

    /// Requests a frame rate and returns the one in effect; `None` where the driver does not support it.
    pub fn set_rate(&self, fps: f64) -> io::Result<Option<f64>> {
        let mut raw = v4l2_streamparm { type_: self.buffer_type, ..Plain::zeroed() };
        match self.ioctl(vidioc::VIDIOC_G_PARM, &mut raw) {
            Ok(()) => {}
            Err(error) if invalid(&error) => return Ok(None),
            Err(error) => return Err(error),
        }
        // SAFETY: the capture arm belongs to both buffer types we use.
        let mut capture = unsafe { raw.parm.capture };
        if capture.capability & V4L2_CAP_TIMEPERFRAME != 0 {
            capture.timeperframe = v4l2_fract { numerator: 1000, denominator: (fps * 1000.0).round() as u32 };
            raw.parm.capture = capture;
            self.ioctl(vidioc::VIDIOC_S_PARM, &mut raw)?;
            // SAFETY: as above.
            capture = unsafe { raw.parm.capture };
        }
        let interval = capture.timeperframe;
        let known = interval.numerator > 0 && interval.denominator > 0;
        Ok(known.then(|| f64::from(interval.denominator) / f64::from(interval.numerator)))
    }

    /// Returns the range of a control; `None` when the camera lacks it.
    pub fn control_range(&self, id: u32) -> io::Result<Option<ControlRange>> {
        let mut raw = v4l2_queryctrl { id, ..Plain::zeroed() };
        let (exists, r) = (self.listed(vidioc::VIDIOC_QUERYCTRL, &mut raw)?, raw);
        Ok(exists.then_some(ControlRange { minimum: r.minimum, maximum: r.maximum, flags: r.flags }))
    }

    pub fn control(&self, id: u32) -> io::Result<i32> {
        let mut raw = v4l2_control { id, value: 0 };
        self.ioctl(vidioc::VIDIOC_G_CTRL, &mut raw)?;
        Ok(raw.value)
    }

    pub fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        self.ioctl(vidioc::VIDIOC_S_CTRL, &mut v4l2_control { id, value })
    }
}
