//! The kernel's V4L2 calls as safe functions. The only module of this crate with `unsafe` in it.
//!
//! Safety rests on three things: every `ioctl` number carries the size of its own argument type; a [`Mapping`] lives no
//! longer than its address range; and mapped bytes are read only between `DQBUF` and `QBUF`, which
//! [`super::queue::BufferQueue`] sees to.
#![allow(unsafe_code)]

mod buffers;
mod settings;

use std::{
    fs::{File, OpenOptions},
    io,
    os::{fd::AsRawFd as _, unix::fs::OpenOptionsExt as _},
    path::Path,
    ptr,
};

use v4l::{
    v4l_sys::{
        v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE as SINGLE_PLANAR,
        v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE as MULTI_PLANAR, v4l2_buffer, v4l2_capability, v4l2_control,
        v4l2_fmtdesc, v4l2_format, v4l2_frmivalenum, v4l2_frmsizeenum, v4l2_plane, v4l2_queryctrl, v4l2_requestbuffers,
        v4l2_streamparm,
    },
    v4l2::{self, vidioc},
};

use self::buffers::Mapping;
pub(crate) use self::settings::{ActiveFormat, Capability, ControlRange, SizeRange};

pub(crate) use super::queue::MAX_PLANES;

/// Plain data of the kernel's interface, for which all zeros is a value.
///
/// # Safety
/// Only for `repr(C)` types of integers, arrays, unions of these, and pointers.
unsafe trait Plain: Copy {
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

/// An open capture device.
#[derive(Debug)]
pub(crate) struct Device {
    file: File,
    buffer_type: u32,
    memory_planes: usize,
    /// By buffer, then by plane.
    mappings: Vec<Vec<Mapping>>,
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

fn invalid(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY | libc::ENODATA))
}

/// Time of `CLOCK_MONOTONIC`, nanoseconds: the clock of live frames' capture times.
#[must_use]
#[allow(clippy::useless_conversion)] // Narrower on 32-bit systems.
pub fn monotonic_nanos() -> i64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes one timespec of ours. It cannot fail for this clock.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut time) };
    i64::from(time.tv_sec).saturating_mul(1_000_000_000).saturating_add(i64::from(time.tv_nsec))
}

impl Device {
    /// Opens a node without waiting, for this process alone (`O_CLOEXEC` is the standard library's).
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).custom_flags(libc::O_NONBLOCK).open(path)?;
        let mut device = Self { file, buffer_type: SINGLE_PLANAR, memory_planes: 1, mappings: Vec::new() };
        if device.capability()?.multi_planar {
            device.buffer_type = MULTI_PLANAR;
        }
        Ok(device)
    }

    /// `request` must be the number for `T`.
    fn ioctl<T: Plain>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
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

    /// Whether the answers of an enumeration go on.
    fn listed<T: Plain>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<bool> {
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
    fn the_clock_runs() {
        let (first, second) = (monotonic_nanos(), monotonic_nanos());
        assert!(0 < first && first <= second);
    }

    #[test]
    fn texts_end_at_the_first_zero() {
        assert_eq!((text(b"vivid\0\0x"), text(b""), text(b"full")), ("vivid".into(), String::new(), "full".into()));
    }
}
