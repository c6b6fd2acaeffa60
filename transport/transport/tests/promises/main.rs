//! Promises of the transport, one module per promise; a single binary because each links zenoh.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod calibration;
mod cameras;
mod clocks;
mod keys;
mod malformed;
mod people;
mod processes;
mod routers;
mod sessions;
mod splats;
mod support;
mod viewpoints;
