//! Safe wrappers of the kernel's V4L2 calls. The only module of this crate with `unsafe` code.
//!
//! Safety rests on three invariants: every `ioctl` number encodes the size of its own argument type; a mapping lives no
//! longer than its address range; and mapped bytes are read only between `DQBUF` and `QBUF`, which
//! [`super::queue::BufferQueue`] ensures.
#![allow(unsafe_code)]

mod buffers;
mod device;
mod mapping;
mod settings;

pub(crate) use self::device::{Capability, Device};
pub(crate) use self::settings::{ActiveFormat, ControlRange, SizeRange};

/// Returns the time of `CLOCK_MONOTONIC`, nanoseconds: the clock of the capture times of live frames.
#[must_use]
#[allow(clippy::useless_conversion)] // Narrower on 32-bit systems.
pub fn monotonic_nanos() -> i64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: writes one timespec of ours. It cannot fail for this clock.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut time) };
    i64::from(time.tv_sec).saturating_mul(1_000_000_000).saturating_add(i64::from(time.tv_nsec))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_runs() {
        let (first, second) = (monotonic_nanos(), monotonic_nanos());
        assert!(0 < first && first <= second);
    }
}
