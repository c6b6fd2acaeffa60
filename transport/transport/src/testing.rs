//! Helpers of this crate's unit tests.

use std::time::{Duration, Instant};

use zenoh::Session;

use crate::session::{
    config::{Side, TransportConfig},
    opening::{self, Opened},
};

/// Opens a session that listens on a free port of loopback.
pub(crate) fn loopback_session() -> Session {
    let config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..TransportConfig::default() };
    let Opened { session, .. } = opening::open(&config, Side::Receiver, 1 << 16, &[]).unwrap();
    session
}

/// Waits until a condition holds; panics after 90 s.
pub(crate) fn wait_until(what: &str, is_true: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(90);
    while !is_true() {
        assert!(Instant::now() < deadline, "{what} did not happen");
        std::thread::sleep(Duration::from_millis(10));
    }
}
