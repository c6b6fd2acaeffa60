//! Buffers filled by a driver: allocation, mapping, queueing and dequeueing.

use std::{
    io,
    os::fd::AsRawFd as _,
    ptr,
    time::{Duration, Instant},
};

use v4l::{
    v4l_sys::{
        V4L2_BUF_FLAG_ERROR, V4L2_BUF_FLAG_TIMESTAMP_MASK, V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC,
        V4L2_BUF_FLAG_TSTAMP_SRC_MASK, V4L2_BUF_FLAG_TSTAMP_SRC_SOE, v4l2_buffer,
        v4l2_memory_V4L2_MEMORY_MMAP as MEMORY_MMAP, v4l2_plane, v4l2_requestbuffers,
    },
    v4l2::{self, vidioc},
};

use super::device::{Device, MULTI_PLANAR, Plain};
use super::mapping::Mapping;
use crate::stamps::StampSource;
use crate::v4l2::queue::{BufferDevice, Delivered, MAX_PLANES};

impl Device {
    /// Prepares the buffer argument of a request, with its planes where there are any.
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
            // Rounded up, so that the last millisecond is not spent polling.
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
