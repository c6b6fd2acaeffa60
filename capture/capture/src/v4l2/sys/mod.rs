//! The kernel's V4L2 calls as safe functions. The only module of this crate with `unsafe` in it.
//!
//! Safety rests on three things: every `ioctl` number carries the size of its own argument type; a [`Mapping`] lives no
//! longer than its address range; and mapped bytes are read only between `DQBUF` and `QBUF`, which
//! [`super::queue::BufferQueue`] sees to.
#![allow(unsafe_code)]

mod buffers;
mod device;
mod mapping;
mod settings;

pub(crate) use self::device::{Capability, Device};
pub(crate) use self::settings::{ActiveFormat, ControlRange, SizeRange};

/// Time of `CLOCK_MONOTONIC`, nanoseconds: the clock of live frames' capture times.
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
