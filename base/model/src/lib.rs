//! Formulas that the rig, its viewers and its tests share. One definition each, without I/O, allocation or `std`.
//!
//! Results reach files, messages and tests that compare bytes. Functions that need a power or a root therefore take it as an
//! argument: `std` and `libm` differ in the last bits, and each caller keeps its own.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod light;
pub mod quaternion;
mod random;
pub mod srgb;
pub mod stretch;

pub use random::{SplitMix64, mix};
