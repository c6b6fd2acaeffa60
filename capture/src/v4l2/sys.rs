//! The kernel's V4L2 calls as safe functions. The only module of this crate with `unsafe` in it.
//!
//! Safety rests on three things: every `ioctl` number carries the size of its own argument type; a [`Mapping`] lives no
//! longer than its address range; and mapped bytes are read only between `DQBUF` and `QBUF`, which
//! [`super::queue::BufferQueue`] sees to.
#![allow(unsafe_code)]

use std::{
    ffi::c_void,
    fs::{File, OpenOptions},
    io,
    os::{
        fd::{AsRawFd as _, RawFd},
        unix::fs::OpenOptionsExt as _,
    },
    path::Path,
    ptr,
    time::{Duration, Instant},
};

use v4l::{
    v4l_sys::{
        V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC,
        V4L2_BUF_FLAG_TSTAMP_SRC_MASK, V4L2_BUF_FLAG_TSTAMP_SRC_SOE, V4L2_CAP_DEVICE_CAPS, V4L2_CAP_STREAMING,
        V4L2_CAP_TIMEPERFRAME, V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE,
        v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE as SINGLE_PLANAR,
        v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE as MULTI_PLANAR, v4l2_buffer, v4l2_capability, v4l2_control,
        v4l2_fmtdesc, v4l2_format, v4l2_fract, v4l2_frmivalenum,
        v4l2_frmivaltypes_V4L2_FRMIVAL_TYPE_DISCRETE as INTERVAL_DISCRETE, v4l2_frmsizeenum,
        v4l2_frmsizetypes_V4L2_FRMSIZE_TYPE_DISCRETE as SIZE_DISCRETE, v4l2_memory_V4L2_MEMORY_MMAP as MEMORY_MMAP,
        v4l2_plane, v4l2_queryctrl, v4l2_requestbuffers, v4l2_streamparm,
    },
    v4l2::{self, vidioc},
};

use super::queue::{BufferDevice, Delivered};
use crate::stamps::StampSource;

/// Most memory planes of a buffer (`VIDEO_MAX_PLANES`).
pub(crate) const MAX_PLANES: usize = 8;
/// Most entries of an enumeration that we read: a driver that never says the end must not hang us.
const MAX_ENTRIES: u32 = 512;

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

/// What a device says of itself (`VIDIOC_QUERYCAP`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Capability {
    pub driver: String,
    pub card: String,
    pub bus_info: String,
    /// Whether it gives pictures through memory-mapped buffers.
    pub captures: bool,
    multi_planar: bool,
}

#[cfg(test)]
impl Capability {
    pub fn test(bus_info: &str, captures: bool) -> Self {
        Self { driver: "test".into(), card: "Test".into(), bus_info: bus_info.into(), captures, multi_planar: false }
    }
}

/// A format in force (`VIDIOC_S_FMT` as answered).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ActiveFormat {
    pub fourcc: [u8; 4],
    pub width: u32,
    pub height: u32,
    /// Bytes from a row to the next in each memory plane; 0 where it does not apply.
    pub stride: [u32; MAX_PLANES],
    pub planes: usize,
}

/// An integer control (`VIDIOC_QUERYCTRL`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ControlRange {
    pub minimum: i32,
    pub maximum: i32,
    pub step: i32,
    pub default: i32,
    /// `V4L2_CTRL_FLAG_*`.
    pub flags: u32,
}

/// Picture sizes of a format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SizeRange {
    One(u32, u32),
    /// Minimum, maximum and step of width and of height.
    Steps([u32; 3], [u32; 3]),
}

/// An open capture device.
#[derive(Debug)]
pub(crate) struct Device {
    file: File,
    buffer_type: u32,
    memory_planes: usize,
    /// By buffer, then by plane.
    mappings: Vec<Vec<Mapping>>,
}

/// Memory of one plane of one buffer, shared with the driver.
#[derive(Debug)]
struct Mapping {
    start: *mut c_void,
    length: usize,
}

// SAFETY: the address range belongs to the process, not to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(fd: RawFd, length: usize, offset: u32) -> io::Result<Self> {
        let protection = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory of ours.
        let start = unsafe { v4l2::mmap(ptr::null_mut(), length, protection, libc::MAP_SHARED, fd, offset.into()) }?;
        Ok(Self { start, length })
    }

    fn bytes(&self) -> &[u8] {
        // SAFETY: `start` is mapped for `length` bytes until Drop. The driver writes to it only while the buffer is
        // queued, and the queue hands these bytes out only while it is not.
        unsafe { std::slice::from_raw_parts(self.start.cast::<u8>(), self.length) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: ours, mapped once, and unmapped here alone. It fails only for ranges that are not mapped.
        let _ = unsafe { v4l2::munmap(self.start, self.length) };
    }
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

    /// Pixel formats, in the driver's order.
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

    /// Sizes of a format; empty where the driver does not tell.
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

    /// Frame rates of a format and size, frames a second; only the fastest and the slowest where the driver has a
    /// continuous range, empty where it does not tell.
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

    /// Sets format and size; the driver may answer with others.
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

    /// Asks for a frame rate and gives the one in force; `None` where the driver has no say in it.
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

    /// Range of a control; `None` when the camera does not have it.
    pub fn control_range(&self, id: u32) -> io::Result<Option<ControlRange>> {
        let mut raw = v4l2_queryctrl { id, ..Plain::zeroed() };
        let (exists, r) = (self.listed(vidioc::VIDIOC_QUERYCTRL, &mut raw)?, raw);
        Ok(exists.then_some(ControlRange {
            minimum: r.minimum,
            maximum: r.maximum,
            step: r.step,
            default: r.default_value,
            flags: r.flags,
        }))
    }

    pub fn control(&self, id: u32) -> io::Result<i32> {
        let mut raw = v4l2_control { id, value: 0 };
        self.ioctl(vidioc::VIDIOC_G_CTRL, &mut raw)?;
        Ok(raw.value)
    }

    pub fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        self.ioctl(vidioc::VIDIOC_S_CTRL, &mut v4l2_control { id, value })
    }

    /// A buffer to ask the driver about; with its planes where there are any.
    fn buffer(&self, index: u32, planes: &mut [v4l2_plane; MAX_PLANES]) -> v4l2_buffer {
        let mut raw = v4l2_buffer { index, type_: self.buffer_type, memory: MEMORY_MMAP, ..Plain::zeroed() };
        if self.buffer_type == MULTI_PLANAR {
            raw.m.planes = planes.as_mut_ptr();
            raw.length = self.memory_planes as u32;
        }
        raw
    }

    fn map(&self, index: u32) -> io::Result<Vec<Mapping>> {
        let mut planes = [v4l2_plane::zeroed(); MAX_PLANES];
        let mut raw = self.buffer(index, &mut planes);
        self.ioctl(vidioc::VIDIOC_QUERYBUF, &mut raw)?;
        let fd = self.file.as_raw_fd();
        if self.buffer_type == MULTI_PLANAR {
            let planes = planes.iter().take((raw.length as usize).min(MAX_PLANES));
            // SAFETY: an integer, in the arm that belongs to mapped buffers.
            planes.map(|plane| Mapping::new(fd, plane.length as usize, unsafe { plane.m.mem_offset })).collect()
        } else {
            // SAFETY: as above.
            Ok(vec![Mapping::new(fd, raw.length as usize, unsafe { raw.m.offset })?])
        }
    }

    fn stream(&self, on: bool) -> io::Result<()> {
        let request = if on { vidioc::VIDIOC_STREAMON } else { vidioc::VIDIOC_STREAMOFF };
        let kind = self.buffer_type as libc::c_int;
        loop {
            // SAFETY: the argument of both requests is an int.
            let result = unsafe { v4l2::ioctl(self.file.as_raw_fd(), request, ptr::from_ref(&kind).cast_mut().cast()) };
            match result {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                result => return result,
            }
        }
    }
}

impl BufferDevice for Device {
    fn allocate(&mut self, count: u32) -> io::Result<u32> {
        // The driver frees nothing that is mapped.
        self.mappings.clear();
        let mut raw = v4l2_requestbuffers { count, type_: self.buffer_type, memory: MEMORY_MMAP, ..Plain::zeroed() };
        self.ioctl(vidioc::VIDIOC_REQBUFS, &mut raw)?;
        for index in 0..raw.count.min(count.saturating_mul(4)) {
            let mapped = self.map(index)?;
            self.mappings.push(mapped);
        }
        Ok(self.mappings.len() as u32)
    }

    fn enqueue(&mut self, index: u32) -> io::Result<()> {
        let mut planes = [v4l2_plane::zeroed(); MAX_PLANES];
        let mut raw = self.buffer(index, &mut planes);
        self.ioctl(vidioc::VIDIOC_QBUF, &mut raw)
    }

    #[allow(clippy::useless_conversion)] // The kernel's times are narrower on 32-bit systems.
    fn dequeue(&mut self) -> io::Result<Delivered> {
        let mut planes = [v4l2_plane::zeroed(); MAX_PLANES];
        let mut raw = self.buffer(0, &mut planes);
        self.ioctl(vidioc::VIDIOC_DQBUF, &mut raw)?;
        let mut ranges = [(0, 0); MAX_PLANES];
        if self.buffer_type == MULTI_PLANAR {
            for (range, plane) in ranges.iter_mut().zip(&planes[..self.memory_planes]) {
                *range = (plane.data_offset as usize, plane.bytesused as usize);
            }
        } else {
            ranges[0] = (0, raw.bytesused as usize);
        }
        let is_monotonic = raw.flags & V4L2_BUF_FLAG_TIMESTAMP_MASK == V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
        let starts = raw.flags & V4L2_BUF_FLAG_TSTAMP_SRC_MASK == V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
        let (secs, micros) = (i64::from(raw.timestamp.tv_sec), i64::from(raw.timestamp.tv_usec));
        Ok(Delivered {
            index: raw.index,
            sequence: raw.sequence,
            is_broken: raw.flags & V4L2_BUF_FLAG_ERROR != 0,
            stamp_nanos: secs.wrapping_mul(1_000_000_000).wrapping_add(micros.wrapping_mul(1000)),
            stamp_source: match (is_monotonic, starts) {
                (false, _) => StampSource::Other,
                (true, true) => StampSource::StartOfExposure,
                (true, false) => StampSource::EndOfFrame,
            },
            ranges,
        })
    }

    fn start(&mut self) -> io::Result<()> {
        self.stream(true)
    }

    fn stop(&mut self) -> io::Result<()> {
        self.stream(false)
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<bool> {
        let deadline = Instant::now().checked_add(timeout);
        loop {
            let left = deadline.map_or(timeout, |deadline| deadline.saturating_duration_since(Instant::now()));
            // Rounded up, lest the last millisecond is spent turning.
            let millis = i32::try_from(left.as_micros().div_ceil(1000)).unwrap_or(i32::MAX);
            let mut poll = libc::pollfd { fd: self.file.as_raw_fd(), events: libc::POLLIN, revents: 0 };
            // SAFETY: one pollfd of ours.
            let ready = unsafe { libc::poll(&raw mut poll, 1, millis) };
            match ready {
                // The cause of POLLERR and POLLHUP is what DQBUF then says.
                1.. => return Ok(true),
                0 => return Ok(false),
                _ => {}
            }
            let error = io::Error::last_os_error();
            if error.kind() != io::ErrorKind::Interrupted {
                return Err(error);
            }
        }
    }

    fn plane(&self, index: u32, plane: usize) -> &[u8] {
        self.mappings.get(index as usize).and_then(|planes| planes.get(plane)).map_or(&[], Mapping::bytes)
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
