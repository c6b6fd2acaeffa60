//! Threads of zenoh's network runtime.
//!
//! zenoh 1.10.2 reads and writes a TLS connection from two threads at once, without a lock
//! (<https://github.com/eclipse-zenoh/zenoh/issues/2557>): under load that ends the connection, or the process. With one thread for both,
//! reads and writes take turns. zenoh reads the number of threads only from the environment, when its first session opens.

use std::env;

const VARIABLE: &str = "ZENOH_RUNTIME";
const ONE_THREAD: &str = "(rx: (worker_threads: 1), tx: (handover: rx), acc: (handover: rx))";

/// Makes zenoh read and write on one thread, unless the environment says otherwise. Call it at the beginning of `main`: sessions with
/// keys need it.
///
/// # Safety
/// No other thread may run yet: it could read the environment while it changes.
#[allow(unsafe_code)]
pub unsafe fn use_one_network_thread() {
    if env::var_os(VARIABLE).is_none() {
        // SAFETY: the caller guarantees that this is the only thread.
        unsafe { env::set_var(VARIABLE, ONE_THREAD) };
    }
}

/// Warns when connections with keys are read and written by different threads.
pub(crate) fn check_network_threads() {
    let is_one = env::var(VARIABLE).is_ok_and(|text| text.contains("tx: (handover: rx)"));
    if !is_one {
        tracing::warn!(
            "zenoh may end connections with keys: call flyrig_transport::use_one_network_thread first in main, or set {VARIABLE}='{ONE_THREAD}'"
        );
    }
}
