//! The shape of a person: bone lengths, girths and build of the template, and clothes.

pub(crate) mod body_shape;
pub(crate) mod bone_lengths;
pub(crate) mod outfit_fit;
pub(crate) mod shape_solve;
