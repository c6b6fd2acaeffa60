//! Several people in one scene.

#[cfg(test)]
mod other_person_tests;
pub mod subjects;
pub mod takes;
