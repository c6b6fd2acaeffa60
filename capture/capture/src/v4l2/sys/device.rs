//! Open capture device: typed `ioctl`s and capabilities.

use std::{
    fs::{File, OpenOptions},
    io,
    os::{fd::AsRawFd as _, unix::fs::OpenOptionsExt as _},
    path::Path,
    ptr,
};

use v4l::{
    v4l_sys::{
        V4L2_CAP_DEVICE_CAPS, V4L2_CAP_STREAMING, V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE,
        v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE as SINGLE_PLANAR, v4l2_buffer, v4l2_capability, v4l2_control,
        v4l2_fmtdesc, v4l2_format, v4l2_frmivalenum, v4l2_frmsizeenum, v4l2_plane, v4l2_queryctrl, v4l2_requestbuffers,
        v4l2_streamparm,
    },
    v4l2::{self, vidioc},
};

use super::mapping::Mapping;

pub(super) use v4l::v4l_sys::v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE as MULTI_PLANAR;

/// Plain data of the kernel's interface, for which all zeros is a valid value.
///
/// # Safety
/// Only for `repr(C)` types of integers, arrays, unions of these, and pointers.
pub(super) unsafe trait Plain: Copy {
    fn zeroed() -> Self {
        // SAFETY: the implementor promises that all zeros is a value.
        unsafe { std::mem::zeroed() }
    }
}

macro_rules! plain {
    ($($name:ty),* $(,)?) => {
        // SAFETY: structures of the kernel's interface, made of integers, arrays, unions and pointers.
        $(unsafe impl Plain for $name {})*
    };
}
plain!(
    v4l2_buffer,
    v4l2_capability,
    v4l2_control,
    v4l2_fmtdesc,
    v4l2_format,
    v4l2_frmivalenum,
    v4l2_frmsizeenum,
    v4l2_plane,
    v4l2_queryctrl,
    v4l2_requestbuffers,
    v4l2_streamparm,
);

/// Open capture device.
#[derive(Debug)]
pub(crate) struct Device {
    pub(super) file: File,
    pub(super) buffer_type: u32,
    pub(super) memory_planes: usize,
    /// Per buffer, then per plane.
    pub(super) mappings: Vec<Vec<Mapping>>,
}

pub(super) fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

pub(super) fn invalid(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY | libc::ENODATA))
}

/// Capabilities of a device (`VIDIOC_QUERYCAP`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Capability {
    pub driver: String,
    pub card: String,
    pub bus_info: String,
    /// Whether the device captures images through memory-mapped buffers.
    pub captures: bool,
    pub(super) multi_planar: bool,
}

#[cfg(test)]
impl Capability {
    pub fn test(bus_info: &str, captures: bool) -> Self {
        Self { driver: "test".into(), card: "Test".into(), bus_info: bus_info.into(), captures, multi_planar: false }
    }
}

impl Device {
    /// Opens a node without blocking, for this process alone (the standard library sets `O_CLOEXEC`).
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).custom_flags(libc::O_NONBLOCK).open(path)?;
        let mut device = Self { file, buffer_type: SINGLE_PLANAR, memory_planes: 1, mappings: Vec::new() };
        if device.capability()?.multi_planar {
            device.buffer_type = MULTI_PLANAR;
        }
        Ok(device)
    }

    pub fn capability(&self) -> io::Result<Capability> {
        let mut raw = v4l2_capability::zeroed();
        self.ioctl(vidioc::VIDIOC_QUERYCAP, &mut raw)?;
        let caps = if raw.capabilities & V4L2_CAP_DEVICE_CAPS == 0 { raw.capabilities } else { raw.device_caps };
        let (single, multi) = (caps & V4L2_CAP_VIDEO_CAPTURE != 0, caps & V4L2_CAP_VIDEO_CAPTURE_MPLANE != 0);
        Ok(Capability {
            driver: text(&raw.driver),
            card: text(&raw.card),
            bus_info: text(&raw.bus_info),
            captures: (single || multi) && caps & V4L2_CAP_STREAMING != 0,
            multi_planar: multi && !single,
        })
    }

    /// Calls `ioctl`; `request` must be the number for `T`.
    pub(super) fn ioctl<T: Plain>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        loop {
            // SAFETY: every caller passes the argument type that the request number is made of; pointers inside of it
            // (the planes of a buffer) point to live arrays whose length is passed along.
            let result = unsafe { v4l2::ioctl(self.file.as_raw_fd(), request, ptr::from_mut(argument).cast()) };
            match result {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                result => return result,
            }
        }
    }

    /// Requests the next entry of an enumeration; returns false at its end.
    pub(super) fn listed<T: Plain>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<bool> {
        match self.ioctl(request, argument) {
            Ok(()) => Ok(true),
            Err(error) if invalid(&error) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn request_numbers_are_the_kernels() {
        // From the kernel's headers on x86-64, through another compiler than bindgen's structures.
        assert_eq!(vidioc::VIDIOC_QUERYCAP, 0x8068_5600);
        assert_eq!(vidioc::VIDIOC_DQBUF, 0xc058_5611);
        assert_eq!(vidioc::VIDIOC_S_FMT, 0xc0d0_5605);
        assert_eq!(vidioc::VIDIOC_STREAMON, 0x4004_5612);
    }

    #[test]
    fn what_is_no_camera_is_refused_without_harm() {
        assert_eq!(Device::open(Path::new("/dev/null")).unwrap_err().raw_os_error(), Some(libc::ENOTTY));
        assert_eq!(Device::open(Path::new("/nowhere")).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn texts_end_at_the_first_zero() {
        assert_eq!((text(b"vivid\0\0x"), text(b""), text(b"full")), ("vivid".into(), String::new(), "full".into()));
    }
}
