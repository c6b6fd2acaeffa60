//! Memory shared between a driver and this process.

use std::{ffi::c_void, io, os::fd::RawFd, ptr};

use v4l::v4l2;

/// Memory of one plane of one buffer, shared with the driver.
#[derive(Debug)]
pub(super) struct Mapping {
    start: *mut c_void,
    length: usize,
}

// SAFETY: the address range belongs to the process, not to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    pub(super) fn new(fd: RawFd, length: usize, offset: u32) -> io::Result<Self> {
        let protection = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory of ours.
        let start = unsafe { v4l2::mmap(ptr::null_mut(), length, protection, libc::MAP_SHARED, fd, offset.into()) }?;
        Ok(Self { start, length })
    }

    pub(super) fn bytes(&self) -> &[u8] {
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
