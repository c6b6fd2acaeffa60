//! File descriptors of this process: connections leave some to cameras, files and sessions.
//!
//! They are counted on systems with /proc, at most ten times per second; elsewhere nothing is refused.

use std::{
    io::Error,
    sync::Mutex,
    time::{Duration, Instant},
};

use flyrig_types::lock;

/// File descriptors that connections leave free.
const RESERVE: usize = 64;
/// Age up to which a count is used; connections since then are subtracted.
const AGE: Duration = Duration::from_millis(100);
/// Errors of the system without a file descriptor: ENFILE, EMFILE.
const NO_DESCRIPTOR: [i32; 2] = [23, 24];

/// Time of the last count, and the number of connections that may still be admitted since then.
type Known = Option<(Instant, usize)>;

/// Count that all listeners share.
static KNOWN: Mutex<Known> = Mutex::new(None);

/// Returns whether a connection that was just accepted leaves [`RESERVE`] file descriptors free, and counts it if so.
pub(crate) fn admit() -> bool {
    admit_of(&mut lock(&KNOWN), Instant::now(), free)
}

fn admit_of(known: &mut Known, now: Instant, free: impl Fn() -> Option<usize>) -> bool {
    let recent = known.filter(|(at, _)| now.saturating_duration_since(*at) < AGE);
    // The new connection has its descriptor already.
    let count = || (now, free().map_or(usize::MAX, |free| (free + 1).saturating_sub(RESERVE)));
    let (at, room) = recent.unwrap_or_else(count);
    *known = Some((at, room.saturating_sub(1)));
    room > 0
}

/// Returns the number of file descriptors that this process may still open; `None` where it is not known.
fn free() -> Option<usize> {
    let none_left = |error: Error| error.raw_os_error().filter(|code| NO_DESCRIPTOR.contains(code)).map(|_| 0);
    let limits = match std::fs::read_to_string("/proc/self/limits") {
        Ok(limits) => limits,
        Err(error) => return none_left(error),
    };
    let limit = limits.lines().find_map(|line| line.strip_prefix("Max open files"))?;
    let limit: usize = limit.split_whitespace().next()?.parse().ok()?;
    match std::fs::read_dir("/proc/self/fd") {
        // One of them is that of the folder itself.
        Ok(open) => Some((limit + 1).saturating_sub(open.count())),
        Err(error) => none_left(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_leave_descriptors_to_the_others() {
        let (mut known, now) = (None, Instant::now());
        // 70 are free besides that of the first connection: the seventh leaves 64.
        let admitted = (0..20).filter(|_| admit_of(&mut known, now, || Some(70))).count();
        assert_eq!(admitted, 7);
        assert!(!admit_of(&mut known, now + AGE / 2, || Some(1000)), "counted a moment ago");
        assert!(admit_of(&mut known, now + AGE, || Some(1000)));
        assert!(!admit_of(&mut known, now + 2 * AGE, || Some(63)));
        assert!(admit_of(&mut known, now + 3 * AGE, || Some(64)));
        assert!(admit_of(&mut known, now + 4 * AGE, || None), "on a system that does not say");
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn open_files_are_counted() {
        // Other tests of this process open and close hundreds of files too, for a moment.
        let is_counted = |_: usize| {
            let before = free().unwrap();
            let held: Vec<_> = (0..500).filter_map(|_| std::fs::File::open("/dev/null").ok()).collect();
            let after = free().unwrap();
            assert_eq!(held.len(), 500);
            std::thread::sleep(AGE);
            before.abs_diff(after + 500) < 200
        };
        assert!((0..100).any(is_counted), "500 open files were never counted");
    }
}
