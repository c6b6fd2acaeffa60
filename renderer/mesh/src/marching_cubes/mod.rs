//! Closed, manifold surfaces of fields.

mod table;
mod walk;

pub use walk::marching_cubes;

#[cfg(test)]
mod tests;
