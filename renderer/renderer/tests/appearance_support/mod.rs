//! Shared by the appearance tests and the benchmark: a hand-made person and the f64 reference.
#![allow(dead_code)]

pub mod reference;
pub mod scene;
