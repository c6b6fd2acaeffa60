//! Ports for programs that a test starts.

use std::{
    net::TcpListener,
    sync::atomic::{AtomicU32, Ordering},
};

/// First of the ports that are given. Systems give those from 32768 on to programs that ask for any port, and to connections.
const FIRST: u32 = 20_000;
const COUNT: u32 = 12_000;

/// Returns a port that is free, as is its successor, and that no other test gets before the program under test listens there.
#[must_use]
pub fn free_port() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    loop {
        // Tests of other processes begin at other ports.
        let turn = std::process::id().wrapping_mul(97).wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed));
        let port = (FIRST + 2 * (turn % (COUNT / 2))) as u16;
        if [port, port + 1].iter().all(|port| TcpListener::bind(("0.0.0.0", *port)).is_ok()) {
            return port;
        }
    }
}
