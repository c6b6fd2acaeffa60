//! What the transport promises, a module for each promise; one binary because every one links zenoh.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod calibration;
mod cameras;
mod clocks;
mod keys;
mod malformed;
mod people;
mod processes;
mod sessions;
mod splats;
mod support;
mod viewpoints;
